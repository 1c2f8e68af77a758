"""Responses of lenslets that are made where they are asked for: moved since the calibration, or widened by stray light.

A sensor of thousands of superpixels has hundreds of megabytes of responses; one capture's own copy of them never exists whole.
"""

import numpy as np

from plenocli.sensor.registration import Smooth, _parity


class Moved:
    """Responses (R, C, pixel, band) whose light is displaced by `rest` (R, C, 2) px within windows that went from `before` to `after`
    (R, C, 2). response: of the calibration, (pixel, band) or (R, C, pixel, band); gains: of the mosaic's colours.
    `moved[rows, columns]` makes (lenslet, pixel, band)."""

    ndim = 4

    def __init__(self, response, before, after, rest, window, cfa, gains):
        self.shape = (*before.shape[:2], *response.shape[-2:])
        self._response, self._before, self._after, self._rest = response, before, after, np.round(rest, 4)  # 1e-4 px is nothing, and few values are quick
        self._kind = window, cfa, gains

    def __getitem__(self, places):
        own = self._response[places] if self._response.ndim > 2 else np.broadcast_to(self._response, (len(places[0]), *self._response.shape))
        return Smooth(own, self._before[places], *self._kind).at(self._after[places], self._rest[places])


class Widened:
    """Responses (R, C, pixel, band + n) with `patterns` (4, pixel, n) as further bands, chosen by the parity of windows' first pixels
    `origin` (R, C, 2)."""

    ndim = 4

    def __init__(self, response, patterns, origin):
        self.shape = (*origin.shape[:2], response.shape[-2], response.shape[-1] + patterns.shape[-1])
        self._response, self._patterns, self._origin = response, patterns, origin

    def __getitem__(self, places):
        more = self._patterns[_parity(self._origin[places])]
        own = self._response[places] if self._response.ndim > 2 else np.broadcast_to(self._response, (len(more), *self._response.shape))
        return np.concatenate([own, more], axis=-1)


def widened(response, patterns, origin, sites):
    """As Widened, one array (pixel, band + n) where one response and one pattern serve all lenslets at `sites`."""
    kinds = np.unique(_parity(origin[sites]))
    if response.ndim == 2 and len(kinds) == 1:
        return np.concatenate([response, patterns[kinds[0]]], axis=-1)
    return Widened(response, patterns, origin)


def even_light(window, cfa):
    """Patterns (4, pixel, colour) of stray light that is even over a superpixel, by the parity of the window's first pixel: 1 where a
    pixel has that colour, NaN at the border, where the neighbours' light cannot be told from stray light."""
    from plenocli.sensor.cfa import MONO, cfa_map
    from plenocli.sensor.registration import PARITIES, own_pixels

    letters = dict.fromkeys(cfa if cfa != "mono" else MONO)
    patterns = np.stack([np.stack([cfa_map(window, cfa, corner).ravel() == letter for letter in letters], axis=-1) for corner in PARITIES])
    return np.where(own_pixels(window)[:, None], patterns, np.nan).astype(np.float32)
