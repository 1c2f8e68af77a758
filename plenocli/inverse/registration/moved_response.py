"""Responses of lenslets that are made where they are asked for: moved since the calibration, or
widened by stray light.

A sensor of thousands of superpixels has hundreds of megabytes of responses; one capture's own copy
of them never exists whole.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.inverse.registration.smooth_response import PARITIES, SmoothResponses, parity

if TYPE_CHECKING:
    from plenocli.inverse.calibration.calibration import MadeResponses
    from plenocli.inverse.calibration.low_rank import Basis
    from plenocli.inverse.registration.reference import Reference

NODES = 1 / 16
"""px between displacements for which pictures are moved, where lenslets have many: the rest is
first order, good to 2e-4 of the peak.
"""
KEPT = 64
"""Displacements whose pictures are kept."""


class MovedResponses:
    """Responses (lenslet_row, lenslet_column, pixel, band) after a motion, made by
    `moved[rows, columns]` as (lenslet, pixel, band).

    What lenslets have in common is moved, and its change added to each lenslet's own response: a
    spline would spread the noise of single responses, magnified where a colour is weak, and what a
    lenslet has alone is as good as its noise or belongs to the pixels.
    response: of the calibration, (pixel, band) or (lenslet_row, lenslet_column, pixel, band).
    before, after: (lenslet_row, lenslet_column, 2), first pixels of the windows, which moved by
        whole periods of the mosaic.
    rest: (lenslet_row, lenslet_column, 2) px, by which the light is displaced within them.
    reference: of the response.
    """

    ndim = 4

    def __init__(
        self,
        response: np.ndarray | MadeResponses,
        before: np.ndarray,
        after: np.ndarray,
        rest: np.ndarray,
        reference: Reference,
    ) -> None:
        self.shape = (*before.shape[:2], *response.shape[-2:])
        self._response, self._before, self._after, self._rest, self._reference = (
            response,
            before,
            after,
            np.round(rest, 4),
            reference,
        )
        self._even = bool(np.ptp(self._rest.reshape(-1, 2), axis=0).max() == 0)
        self._made: dict[Any, tuple[np.ndarray, np.ndarray, Basis | None]] = {}

    def __getitem__(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        out = (
            self._response[places]
            if self._response.ndim > 2
            else np.array(
                np.broadcast_to(np.asarray(self._response), (len(places[0]), *self.shape[2:]))
            )
        )
        rest, kinds = self._rest[places], self._reference.kinds(self._before[places])
        nodes = rest if self._even else np.rint(rest / NODES) * NODES
        groups, which = np.unique(np.column_stack([kinds, nodes]), axis=0, return_inverse=True)
        for k, (kind, *node) in enumerate(groups):
            some = np.flatnonzero(which.ravel() == k)
            pictures, lost, basis = self._change(int(kind), tuple(node), places, some[0])
            part = out if len(groups) == 1 else out[some]
            c = np.ones((len(some), 1), np.float32) if basis is None else basis.coefficients(part)
            step = (rest[some] - node).astype(np.float32)
            if step.any():
                c = np.concatenate([c, c * step[:, :1], c * step[:, 1:]], axis=1)
            part += (c @ pictures[: c.shape[1]].reshape(c.shape[1], -1)).reshape(part.shape)
            part[:, lost] = np.nan
            if part is not out:
                out[some] = part
        return out

    def _change(
        self, kind: int, node: tuple[float, ...], places: tuple[np.ndarray, ...], one: int
    ) -> tuple[np.ndarray, np.ndarray, Basis | None]:
        """(what a displacement by `node` changes in the common pictures and its derivatives (3
        rank, pixel, band), which pixels (pixel,) cannot be told after it, the Basis or None).
        """
        if (kind, node) not in self._made:
            if len(self._made) >= KEPT:
                self._made.clear()
            reference = self._reference
            basis = None if reference.shared else reference.bases[kind]
            pictures = self._response[None] if basis is None else basis.pictures
            typical = (
                self._response[None]
                if basis is None
                else basis.mixed(basis.middle[None].astype(np.float32))
            )
            before, after = (np.array([o[places][one]]) for o in (self._before, self._after))
            shift = np.array([node])
            settings = reference.window, reference.cfa, reference.gains
            parts = SmoothResponses(pictures, before.repeat(len(pictures), axis=0), *settings).at(
                after.repeat(len(pictures), axis=0), shift, derivatives=True, sharp=False
            )
            seen = SmoothResponses(typical, before, *settings).at(after, shift)[0]
            parts[0] = parts[0] - pictures
            self._made[kind, node] = (
                np.nan_to_num(np.concatenate(parts)),
                ~np.isfinite(seen).all(axis=-1),
                basis,
            )
        return self._made[kind, node]


class WidenedResponses:
    """Responses (lenslet_row, lenslet_column, pixel, band + n) with patterns as further bands.

    response: (pixel, band) or (lenslet_row, lenslet_column, pixel, band).
    patterns: (4, pixel, n), by the parity of the window's first pixel.
    origin: (lenslet_row, lenslet_column, 2), first pixels of the windows.
    """

    ndim = 4

    def __init__(
        self, response: np.ndarray | MadeResponses, patterns: np.ndarray, origin: np.ndarray
    ) -> None:
        self.shape = (
            *origin.shape[:2],
            response.shape[-2],
            response.shape[-1] + patterns.shape[-1],
        )
        self._response, self._patterns, self._origin = response, patterns, origin

    def __getitem__(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        more = self._patterns[parity(self._origin[places])]
        own = (
            np.broadcast_to(self._response, (len(more), *self._response.shape))
            if isinstance(self._response, np.ndarray) and self._response.ndim == 2
            else self._response[places]
        )
        return np.concatenate([own, more], axis=-1)


class MixedResponses:
    """Responses (lenslet_row, lenslet_column, pixel, mixed band) to mixtures of bands.

    response: (lenslet_row, lenslet_column, pixel, band).
    mixture: (band, mixed band).
    """

    def __init__(self, response: MadeResponses, mixture: np.ndarray) -> None:
        self.shape, self.ndim = (*response.shape[:-1], mixture.shape[1]), response.ndim
        self._response, self._mixture = response, mixture

    def __getitem__(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        own = self._response[places]
        return own @ self._mixture.astype(own.dtype)


def mixed(response: np.ndarray | MadeResponses, mixture: np.ndarray) -> np.ndarray | MixedResponses:
    """As MixedResponses, one array where the response is one."""
    if isinstance(response, np.ndarray):
        return response @ mixture.astype(response.dtype)
    return MixedResponses(response, mixture)


def widened(
    response: np.ndarray | MadeResponses,
    patterns: np.ndarray,
    origin: np.ndarray,
    sites: tuple[np.ndarray, ...],
) -> np.ndarray | WidenedResponses:
    """As WidenedResponses, one array (pixel, band + n) where one response and one pattern serve all
    lenslets at `sites`.
    """
    kinds = np.unique(parity(origin[sites]))
    if response.ndim == 2 and len(kinds) == 1:
        return np.concatenate([response, patterns[kinds[0]]], axis=-1)
    return WidenedResponses(response, patterns, origin)


def even_light(window: tuple[int, int], cfa: str) -> np.ndarray:
    """Patterns of stray light that is even over a superpixel.

    window: rows and columns, px.
    cfa: "mono" or four letters.

    Returns (4, pixel, colour), by the parity of the window's first pixel: 1 where a pixel has that
    colour, NaN at the border, where the neighbours' light cannot be told from stray light.
    """
    from plenocli.forward.sensor.cfa import MONO, cfa_map
    from plenocli.inverse.registration.reference import own_pixels

    letters = dict.fromkeys(cfa if cfa != "mono" else MONO)
    patterns = np.stack(
        [
            np.stack(
                [cfa_map(window, cfa, corner).ravel() == letter for letter in letters], axis=-1
            )
            for corner in PARITIES
        ]
    )
    return np.where(own_pixels(window)[:, None], patterns, np.nan).astype(np.float32)
