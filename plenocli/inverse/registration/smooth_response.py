"""Responses of superpixels without the colours of the mosaic, which can be moved by parts of a
pixel. docs/model.md, "Registration".
"""

from __future__ import annotations

from typing import Any

import numpy as np

DEGREE = 5
"""Of the interpolating splines."""
WEAK = 0.02
"""Of a band's best colour: a colour with less response is filled in from its neighbours before
interpolation.
"""
UNSURE = 0.02
"""Of a band's peak: pixels whose interpolated response may be off by more take no part."""
LEAST_SHIFT = 0.01
"""px: what less than this costs is below the noise of one lenslet."""
PARITIES = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
"""Rows and columns of a mosaic's 2x2 pattern on which a window may begin."""


def parity(origin: np.ndarray) -> np.ndarray:
    """Index (lenslet,) into PARITIES of windows by their first pixels (lenslet, 2)."""
    return origin[:, 0] % 2 * 2 + origin[:, 1] % 2


def spline_matrix(
    count: int, shift: np.ndarray, degree: int = DEGREE, derivative: bool = False
) -> np.ndarray:
    """Matrices that move samples by a part of a pixel.

    f is the interpolating spline through the samples, with mirrored ends.
    count: of the samples f(0), f(1) ...
    shift: (...) px.
    degree: of the spline, 3 or 5.
    derivative: by the shift, instead of the moved samples.

    Returns (..., count, count), samples f(x) to samples of f(x - shift).
    """
    from scipy.interpolate import BSpline

    shift, places = np.unique(shift, return_inverse=True)  # of a moved array, many are alike
    half = (degree + 1) // 2
    kernel = BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, extrapolate=False)

    def weights(position: np.ndarray, order: int) -> np.ndarray:
        """Coefficients of the B-spline (position..., count) that its value, or derivative for
        order 1, at `position` (px) takes.
        """
        first = np.floor(position).astype(int) - half + 1
        taps = first[..., None] + np.arange(2 * half)
        value = np.nan_to_num(
            (kernel.derivative() if order else kernel)(position[..., None] - taps)
        )
        folded = np.abs(taps) % (2 * (count - 1))
        folded = np.where(folded > count - 1, 2 * (count - 1) - folded, folded)
        out = np.zeros((*position.shape, count))
        for k in range(2 * half):
            at = folded[..., k : k + 1]
            np.put_along_axis(out, at, np.take_along_axis(out, at, -1) + value[..., k : k + 1], -1)
        return out

    index = np.arange(count, dtype=float)
    fit = np.linalg.inv(weights(index, 0))
    position = index - shift[:, None].astype(float)
    return ((-1 if derivative else 1) * (weights(position, int(derivative)) @ fit))[places]


class SmoothResponses:
    """Responses without the colours of the mosaic: F = gain(colour of the pixel, band) * smooth,
    and smooth can be moved.

    Under narrow-band light the mosaic's filters multiply the picture of the pupil by one number
    each, which is why a motion by an odd number of pixels can be followed at all.
    response: (lenslet, pixel, band), NaN at pixels that are not known.
    origin: (lenslet, 2), first pixels.
    window: rows and columns, px.
    cfa: "mono" or four letters.
    gains: (letter, band); None: measured.

    smooth: (lenslet, band, row, column).
    """

    def __init__(
        self,
        response: np.ndarray,
        origin: np.ndarray,
        window: tuple[int, int],
        cfa: str,
        gains: np.ndarray | None = None,
    ) -> None:
        self._set(window, cfa, gains)
        response = np.ascontiguousarray(np.swapaxes(response, -1, -2), np.float32).reshape(
            len(response), -1, *self.window
        )
        known = np.all(np.isfinite(response), axis=1)
        if gains is None:
            self._set(
                window,
                cfa,
                self._measure(response, known, origin)
                if len(self.letters) > 1
                else np.ones((1, response.shape[1]), np.float32),
            )
        self.smooth = self._without_colours(response, known, origin)

    @classmethod
    def of(
        cls, pictures: np.ndarray, window: tuple[int, int], cfa: str, gains: np.ndarray
    ) -> SmoothResponses:
        """From smooth pictures (lenslet, band, row, column) made before."""
        out = cls.__new__(cls)
        out._set(window, cfa, gains)
        out.smooth = pictures
        return out

    def _set(self, window: tuple[int, int], cfa: str, gains: np.ndarray | None) -> None:
        self.window, self.cfa, self.gains = window, cfa, gains
        self.letters = tuple(dict.fromkeys(cfa)) if cfa != "mono" else ("Y",)
        self._tiles = (
            None
            if gains is None or len(self.letters) == 1
            else np.moveaxis(np.asarray(gains, np.float32)[self._colours(PARITIES)], -1, 1).copy()
        )

    def _without_colours(
        self, response: np.ndarray, known: np.ndarray, origin: np.ndarray
    ) -> np.ndarray:
        """Pictures (lenslet, band, h, w) over their gains; unknown pixels and weak colours
        filled in from their neighbours.
        """
        if self._tiles is None:
            return (
                response
                if known.all()
                else _filled(response, np.broadcast_to(known[:, None], response.shape))
            )
        strong = self._tiles > WEAK
        over = np.where(strong, 1 / np.maximum(self._tiles, WEAK), 0)
        kind = parity(origin)
        smooth = over[kind]
        smooth *= response
        if strong.all() and known.all():
            return smooth
        good = strong[kind]
        good &= known[:, None]
        some = ~good.all(axis=(0, 2, 3))  # bands that need it
        smooth[:, some] = _filled(smooth[:, some], good[:, some])
        return smooth

    def _measure(self, response: np.ndarray, known: np.ndarray, origin: np.ndarray) -> np.ndarray:
        where = self._colours(origin)
        sites = [known & (where == k) for k in range(len(self.letters))]
        mean = np.stack(
            [np.moveaxis(response, 1, -1)[one].mean(axis=0, dtype=float) for one in sites]
        )
        gains = mean / np.maximum(mean.max(axis=0), 1e-30)
        with np.errstate(divide="ignore", invalid="ignore"):
            smooth = np.where(
                known[:, None], response / np.moveaxis(gains.astype(np.float32)[where], -1, 1), 0
            )
        return (
            gains
            * _flat_ratios(
                _filled(np.nan_to_num(smooth), np.broadcast_to(known[:, None], smooth.shape)), sites
            )
        ).astype(np.float32)

    def _colours(self, origin: np.ndarray) -> np.ndarray:
        """Index (lenslet, h, w) into letters."""
        tile = (
            np.array([self.letters.index(c) for c in self.cfa]).reshape(2, 2)
            if len(self.letters) > 1
            else np.zeros((2, 2), int)
        )
        rows = (origin[:, 0, None] + np.arange(self.window[0])) % 2
        columns = (origin[:, 1, None] + np.arange(self.window[1])) % 2
        return tile[rows[:, :, None], columns[:, None, :]]

    def gain(self, origin: np.ndarray) -> np.ndarray | np.float32:
        """Gains (lenslet, band, h, w) of the colours under windows at `origin` (lenslet, 2); the
        number 1 without a mosaic.
        """
        return np.float32(1) if self._tiles is None else self._tiles[parity(origin)]

    def moved_variance(
        self, variance: np.ndarray, before: np.ndarray, after: np.ndarray, shift: np.ndarray
    ) -> np.ndarray:
        """Variance of a response that `at` moved. A pixel that takes its value from a weak colour
        takes its noise, which was magnified, too.

        variance: (pixel, band), its own.
        before, after: (2,), first pixels of the windows it was moved between.
        shift: (2,) px.

        Returns (pixel, band).
        """
        h, w = self.window
        planes = np.nan_to_num(variance).T.reshape(-1, h, w).astype(np.float32)
        gains = [
            np.broadcast_to(self.gain(np.asarray(one)[None]), (1, *planes.shape))[0]
            for one in (before, after)
        ]
        strong = gains[0] > WEAK
        planes = _filled(np.where(strong, planes / np.maximum(gains[0], WEAK) ** 2, 0), strong)
        rows, columns = (spline_matrix(n, shift[k]) ** 2 for k, n in enumerate((h, w)))
        return ((rows @ planes @ columns.T) * gains[1] ** 2).reshape(len(planes), -1).T

    def _sure(self, shift: np.ndarray) -> np.ndarray:
        """Mask (lenslet, h, w) of pixels whose spline is good: a sixth difference shows what a
        spline cannot know.

        It passes the frequencies near Nyquist's, which alias; a shift by half a pixel errs by about
        all of them. Where a band would lose more than half of its light (cells of a few pixels),
        nothing is masked.
        """
        aliased = np.abs(np.sin(np.pi * shift)).astype(np.float32)
        if aliased.sum(axis=1).max() < UNSURE:  # no difference is larger than the peak
            return np.ones((len(self.smooth), *self.window), bool)
        light = np.maximum(self.smooth, 0)
        peak = np.maximum(light.max(axis=(2, 3), keepdims=True), 1e-30)
        error = sum(
            aliased[:, axis - 2, None, None, None] * _sixth_difference(self.smooth, axis)
            for axis in (2, 3)
        )
        good = (error < UNSURE * peak).all(axis=1)
        flat = light.reshape(*light.shape[:2], -1)
        kept = (flat @ good.reshape(len(good), -1, 1).astype(np.float32))[..., 0] / np.maximum(
            flat.sum(axis=-1), 1e-30
        )
        return good | (kept < 0.5).any(axis=-1)[:, None, None]

    def at(
        self, origin: np.ndarray, shift: np.ndarray, derivatives: bool = False, sharp: bool = True
    ) -> np.ndarray | list[np.ndarray]:
        """Responses whose light is displaced.

        origin: (lenslet, 2), first pixels of the windows.
        shift: (lenslet or 1, 2) px, within them.
        derivatives: whether those by row and by column shift are wanted, too.
        sharp: whether pixels are NaN at which the spline cannot be trusted.

        Returns (lenslet, pixel, band), three of them with derivatives. Rows and columns that the
        shift brings in from outside are NaN.
        """
        h, w = self.window
        rows, columns = (_matrices(n, shift[:, k]) for k, n in enumerate((h, w)))
        gain = self.gain(origin)
        across = self.smooth @ np.swapaxes(columns, -1, -2)
        out = [rows @ across]
        if derivatives:
            by_row, by_column = (
                _matrices(n, shift[:, k], derivative=True) for k, n in enumerate((h, w))
            )
            out += [by_row @ across, rows @ (self.smooth @ np.swapaxes(by_column, -1, -2))]
        for part in out:
            part *= gain
        seen = (
            _seen(np.arange(h), shift[:, 0], h)[:, :, None]
            & _seen(np.arange(w), shift[:, 1], w)[:, None, :]
        )
        if sharp:
            seen = seen & self._sure(shift)
        if not seen.all():
            np.copyto(out[0], np.float32(np.nan), where=~seen[:, None])
        flat = [np.swapaxes(part.reshape(*part.shape[:2], h * w), -1, -2) for part in out]
        return flat if derivatives else flat[0]


def _matrices(count: int, shift: np.ndarray, **kind: Any) -> np.ndarray:
    """spline_matrix for every band of a lenslet, (lenslet, 1, count, count) float32."""
    return spline_matrix(count, shift, **kind).astype(np.float32)[:, None]


def _flat_ratios(pictures: np.ndarray, sites: list[np.ndarray]) -> np.ndarray:
    """Median (site class, band) of pictures (lenslet, band, h, w) over their local means,
    where there is light.

    The local mean weighs the four positions of a 2x2 mosaic alike and slopes cancel in it. Three
    pixels from any edge are left out: there colours sample the picture at different places.
    """
    from scipy.ndimage import convolve1d, minimum_filter

    local = pictures
    for axis in (2, 3):
        local = convolve1d(local, np.array([1, 2, 1], np.float32) / 4, axis, mode="nearest")
    bright = local > 0.5 * np.percentile(local, 99.5, axis=(2, 3), keepdims=True)
    bright = minimum_filter(bright, (0, 0, 7, 7), mode="constant")
    out = np.ones((len(sites), pictures.shape[1]))
    for k, site in enumerate(sites):
        for band in range(pictures.shape[1]):
            where = site & bright[:, band]
            if where.sum() >= 12:
                out[k, band] = np.median(pictures[:, band][where] / local[:, band][where])
    return out


def _seen(index: np.ndarray, shift: np.ndarray, count: int) -> np.ndarray:
    """Which samples (lenslet, count) come from inside, a pixel's margin kept where there
    is a shift at all.
    """
    position = index - shift[:, None]
    margin = np.where(np.abs(shift) > LEAST_SHIFT / 2, 0.5, -1e-6)[:, None]
    return (position >= margin) & (position <= count - 1 - margin)


def _sixth_difference(pictures: np.ndarray, axis: int) -> np.ndarray:
    """Largest |[1, -6, 15, -20, 15, -6, 1] / 64| of each sample and its two neighbours along an
    axis; edges go on as they end.
    """
    pad = [(0, 0)] * pictures.ndim
    pad[axis] = (3, 3)
    rough = np.abs(np.diff(np.pad(pictures, pad, mode="edge"), 6, axis))
    rough *= np.float32(1 / 64)
    low, high, out = (
        (slice(None),) * axis + (slice(None, -1),),
        (slice(None),) * axis + (slice(1, None),),
        rough.copy(),
    )
    np.maximum(out[low], rough[high], out=out[low])
    np.maximum(out[high], rough[low], out=out[high])
    return out


def _filled(values: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Values (..., h, w), those that are not good replaced by means of their good neighbours,
    farther ones where it takes that.
    """
    out = np.where(good, values, 0)
    kept, weight, todo = out.copy(), good.astype(np.float32), ~good
    for size in (3, 5, 9):
        if not todo.any():
            break
        total, share = _box(kept, size), _box(weight, size)
        ready = todo & (share > 0.5)
        np.divide(total, share, out=out, where=ready)
        todo &= ~ready
    return out


def _box(values: np.ndarray, size: int) -> np.ndarray:
    """Sums over size x size neighbours (..., h, w), nothing beyond the edges."""
    for axis in (-2, -1):
        out = values.copy()
        last = values.shape[axis]
        for step in range(1, min(size // 2, last - 1) + 1):
            low, high = (
                (..., slice(a, b)) + (slice(None),) * (-1 - axis)
                for a, b in ((None, last - step), (step, None))
            )
            out[low] += values[high]
            out[high] += values[low]
        values = out
    return values
