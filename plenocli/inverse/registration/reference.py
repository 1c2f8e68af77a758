"""What registration needs of a calibration, whatever the capture."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.registration.smooth_response import SmoothResponses, parity

if TYPE_CHECKING:
    from plenocli.inverse.calibration.calibration import MadeResponses
    from plenocli.inverse.calibration.low_rank import Basis

REACH = 4
"""px: how far the search for a whole-pixel displacement goes."""
SAMPLE = 48
"""Lenslets that tell the motion; the answer is far better known than it needs to be."""
GAIN_PIXELS = 30_000
"""Pixels that tell the gains of a mosaic's colours."""
EXACT = 1e-3
"""Of a band's peak: what a response without a variance is taken to be known to."""


def evenly(count: int, wanted: int) -> np.ndarray:
    """Indices of at most `wanted` of `count` things, evenly."""
    return (
        np.unique(np.linspace(0, count - 1, min(count, wanted)).astype(int))
        if count
        else np.zeros(0, int)
    )


def own_pixels(window: tuple[int, ...]) -> np.ndarray:
    """Mask (pixel,) without the outermost pixels of a window, where the neighbours' light, which
    follows
    another radiance, would pass for an offset or stray light: none below 16 px, one below 32, two
    above.
    """
    keep = np.ones(tuple(window), bool)
    for axis, count in enumerate(window):
        edge = min(2, count // 16)
        keep &= np.expand_dims(
            (np.arange(count) >= edge) & (np.arange(count) < count - edge), 1 - axis
        )
    return keep.ravel()


class Reference:
    """What registration needs of a calibration, whatever the capture: where lenslets are, and
    smooth responses of a few of them, made when first asked for.

    response: (lenslet_row, lenslet_column, pixel, band), or (pixel, band) for all.
    origin: (lenslet_row, lenslet_column, 2), first pixels of the windows, those of lenslets without
        response far outside.
    window: rows and columns of a superpixel, px.
    centres: (lenslet_row, lenslet_column, 2) px.
    cfa: "mono" or four letters.
    shape: rows and columns of the sensor.
    variance: (pixel, band) of the response; None: known to EXACT.
    sample: how many lenslets tell a motion.
    """

    def __init__(
        self,
        response: np.ndarray | MadeResponses,
        origin: np.ndarray,
        window: tuple[int, int],
        centres: np.ndarray,
        cfa: str,
        shape: tuple[int, ...],
        variance: np.ndarray | None = None,
        sample: int = SAMPLE,
    ) -> None:
        from plenocli.forward.sensor.superpixel import inside

        self.window, self.cfa, self.sample = window, cfa, sample
        whole = inside(origin - REACH, (window[0] + 2 * REACH, window[1] + 2 * REACH), shape)
        place = np.argwhere(whole)
        place = place[evenly(len(place), 4 * sample)]
        self.shared = response.ndim == 2
        own = np.asarray(response[None] if self.shared else response[tuple(place.T)], np.float32)
        if not self.shared:
            known = np.isfinite(own).all(axis=-1).mean(axis=-1) > 0.5
            own, place = own[known], place[known]
        places = tuple(place.T)
        self.origin, self.centres = origin[places], centres[places]
        self.bases: dict[int, Basis] = {}
        self.variance = variance
        self._response = own
        if not self.shared and len(self.origin):
            self._response = self._clean(self._response)
        corners = centres[np.isfinite(centres).all(axis=-1)].reshape(-1, 2)
        self.middle, self.extremes = (
            corners.mean(axis=0),
            np.array(
                [
                    [f(corners[:, 0]), g(corners[:, 1])]
                    for f in (np.min, np.max)
                    for g in (np.min, np.max)
                ]
            ),
        )
        self._smooth: dict[Any, np.ndarray] = {}
        self._still: dict[Any, np.ndarray] = {}
        self._lock = threading.Lock()

    def _clean(self, response: np.ndarray) -> np.ndarray:
        """Responses without most of their noise, which would draw a motion towards none; `bases` of
        what they have in common by the colours under their windows, and what is
        left of the variance.
        """
        from plenocli.inverse.calibration.low_rank import common

        kinds, known = self.kinds(self.origin), np.isfinite(response)
        variance = (
            self.variance
            if self.variance is not None
            else np.broadcast_to(
                (EXACT * np.nanmax(response, axis=(0, 1))) ** 2, response.shape[1:]
            )
        )
        self.bases = {
            int(kind): common(response[kinds == kind], variance) for kind in np.unique(kinds)
        }
        out = np.empty_like(response)
        for kind, basis in self.bases.items():
            out[kinds == kind] = basis.mixed(basis.coefficients(response[kinds == kind]))
        if self.variance is not None:
            self.variance = self.variance * max(basis.left for basis in self.bases.values())
        return np.where(known, out, np.float32(np.nan))

    def kinds(self, origin: np.ndarray) -> np.ndarray:
        """Which colours (lenslet,) windows at `origin` (lenslet, 2) begin on, an index into
        PARITIES; 0 without a mosaic.
        """
        return parity(origin) if self.cfa != "mono" else np.zeros(len(origin), int)

    @cached_property
    def gains(self) -> np.ndarray:
        """Of the mosaic's colours, from lenslets all over the array, fewer where
        they have many pixels.
        """
        count = self._response.shape[1]
        some = (
            slice(1)
            if self.shared
            else evenly(len(self.origin), int(np.clip(GAIN_PIXELS // count, 12, self.sample)))
        )
        smooth = SmoothResponses(self._response[some], self.origin[some], self.window, self.cfa)
        return there(smooth.gains)

    def response(self, which: np.ndarray) -> np.ndarray:
        """F (lenslet, pixel, band) of lenslets by their index."""
        return (
            np.broadcast_to(self._response[0], (len(which), *self._response.shape[1:]))
            if self.shared
            else self._response[which]
        )

    def smooth(self, which: np.ndarray) -> SmoothResponses:
        """Smooth responses of lenslets by their index."""
        self._make(which)
        return SmoothResponses.of(
            np.stack([self._smooth[key] for key in self._keys(which)]),
            self.window,
            self.cfa,
            self.gains,
        )

    def still(self, which: np.ndarray) -> np.ndarray:
        """F and its derivatives by row and by column shift (lenslet, 3 * band, pixel), (1, ...)
        where they are the same for all, where nothing moved.
        """
        self._make(which)
        keys = self._keys(which)
        return np.stack([self._still[key] for key in (keys[:1] if len(set(keys)) == 1 else keys)])

    def _keys(self, which: np.ndarray) -> list[Any]:
        """What lenslets have in common if they share a response: the colours
        under their windows.
        """
        return (
            [tuple(o % 2) for o in self.origin[which]] if self.shared else [int(n) for n in which]
        )

    def _make(self, which: np.ndarray) -> None:
        with self._lock:
            missing = {
                key: number
                for number, key in zip(which, self._keys(which))
                if key not in self._smooth
            }
            if not missing:
                return
            todo = np.array(list(missing.values()))
            smooth = SmoothResponses(
                self.response(todo), self.origin[todo], self.window, self.cfa, self.gains
            )
            parts = stacked(
                smooth.at(self.origin[todo], np.zeros((1, 2)), derivatives=True, sharp=False)
            )
            for k, key in enumerate(self._keys(todo)):
                self._smooth[key], self._still[key] = smooth.smooth[k], parts[k]


def stacked(parts: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
    """Three (lenslet, pixel, band) as one (lenslet, 3 * band, pixel), float64."""
    return np.ascontiguousarray(np.swapaxes(np.concatenate(parts, axis=-1), -1, -2), float)
