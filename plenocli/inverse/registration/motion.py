"""Where the lenslets of a capture are, relative to their calibration, from the capture itself.

Between calibration and capture a lenslet array moves by parts of a pixel. A superpixel then shows
F(p - d) b + o instead of F(p) b: d (rows, columns) px is the displacement, b the radiances of the
bands, o an offset that both share. All three are fitted to the pixels of a lenslet; displacements
of many lenslets make a rigid motion with stretch, d = m + M (c - c0). A gain of the whole capture
cannot be told from brighter radiances, and a mixture of bands that every cell shares looks like
other radiances: neither is visible here. docs/model.md, "Registration".
"""

from __future__ import annotations

import math
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.sensor.superpixel import extract, inside
from plenocli.inverse.registration.reference import (
    REACH,
    Reference,
    evenly,
    own_pixels,
    stacked,
)
from plenocli.inverse.registration.smooth_response import LEAST_SHIFT

if TYPE_CHECKING:
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.registration.smooth_response import SmoothResponses

ITERATIONS = 8
ROOM = REACH + ITERATIONS + 1
"""px by which a window may move: the search, and at most a pixel in each iteration."""
SIGNIFICANT = 4.0
"""Standard deviations from which something is more than chance."""
CLOSE = 0.01
"""px: a step after which the next would be 1e-4 px."""
GOOD_FIT = 1.5
"""Residual over noise, mean squares, up to which a fit needs no second look."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Displacement of superpixels: shift + matrix (c - middle) at c (row, column) px.

    shift: (2,) px, rows and columns.
    matrix: (2, 2), rigid motion with stretch.
    middle: (2,) px, of the array.
    offset: that all pixels share, in the values' unit; NaN sigma where no pixel of a superpixel
        tells it from light.
    stray: light that the calibration does not know, spread over superpixels, in shares of their
        mean light; below zero by no more than the calibration's darkest pixel has.
    sigma: (3,), standard deviations of row shift, column shift and offset.
    beyond_chance: of the whole displacement, in standard deviations.
    stray_sigma: of `stray`, NaN where all lenslets are alike.
    before, after: mean square of the residual over the expected one, median over the lenslets used,
        without and with the motion.
    lenslets: how many were used.
    reach: px, largest displacement over the array.
    """

    shift: np.ndarray
    matrix: np.ndarray
    middle: np.ndarray
    offset: float
    stray: float
    sigma: np.ndarray
    beyond_chance: float
    stray_sigma: float
    before: float
    after: float
    lenslets: int
    reach: float

    def at(self, centres: np.ndarray) -> np.ndarray:
        """Displacements (..., 2) px at centres (..., 2) px."""
        return self.shift + (np.asarray(centres, float) - self.middle) @ self.matrix.T

    @property
    def rotation(self) -> float:
        """Radians, positive where columns to the right move up (counter-clockwise in a picture
        whose rows go down).
        """
        return float(self.matrix[1, 0] - self.matrix[0, 1]) / 2

    @property
    def moved(self) -> bool:
        """Whether the lenslets moved by more than chance, enough to matter and not further
        than can be followed.
        """
        return bool(
            self.reach < REACH + 2 and self.reach > LEAST_SHIFT and self.beyond_chance > SIGNIFICANT
        )

    @property
    def lifted(self) -> bool:
        """Whether there is an offset by more than chance."""
        return bool(abs(self.offset) > SIGNIFICANT * self.sigma[2])

    @property
    def strayed(self) -> bool:
        """Whether there is light that the calibration does not know."""
        return bool(abs(self.stray) > max(0.002, SIGNIFICANT * self.stray_sigma))


def motion_since(
    reference: Reference, signal: np.ndarray | Readout, noise: Noise | None = None
) -> Motion | None:
    """Motion of the lenslets of a capture since their calibration.

    reference: of the calibration.
    signal: (row, column), dark removed, NaN where saturated.
    noise: of the signal; None: unknown, all pixels weigh the same.

    Returns None where fewer than three lenslets show it. Displacements beyond REACH px are not
    found.
    """
    data = _LensletSample(reference, signal, noise)
    if data.count < 3:
        return None
    first = data.fit(np.zeros(2))
    if first.after <= GOOD_FIT and first.reach <= 0.7:
        return first
    start = data.search()
    if not start.any():
        return first
    return replace(
        min((first, data.fit(start)), key=lambda motion: motion.after), before=first.before
    )


class _Patches:
    """Pixels around windows, cut out of a capture once, for windows that move by ROOM at most.

    signal: (row, column), dark removed.
    origin: (lenslet, 2), first pixels of the windows, on the sensor.
    window: rows and columns, px.
    """

    def __init__(
        self, signal: np.ndarray | Readout, origin: np.ndarray, window: tuple[int, int]
    ) -> None:
        size = np.minimum(np.asarray(window) + 2 * ROOM, signal.shape)
        corner = np.clip(origin - ROOM, 0, np.asarray(signal.shape) - size)
        rows, columns = (int(n) for n in size)
        self.values = extract(signal, corner[:, None], (rows, columns)).reshape(-1, rows, columns)
        self.start, self.window = origin - corner, window

    def some(self, which: np.ndarray) -> _Patches:
        """Those of some windows."""
        part = copy(self)
        part.values, part.start = self.values[which], self.start[which]
        return part

    def moved_by(self, whole: np.ndarray | int) -> np.ndarray:
        """Pixels (lenslet, pixel) of windows moved by whole pixels, NaN off the sensor.

        whole: (2,) or (lenslet, 2) px.
        """
        start = self.start + whole
        good = np.flatnonzero(inside(start, self.window, self.values.shape[1:]))
        out = np.full((len(start), math.prod(self.window)), np.nan, self.values.dtype)
        view = np.lib.stride_tricks.sliding_window_view(self.values, self.window, axis=(1, 2))
        out[good] = view[good, start[good, 0], start[good, 1]].reshape(len(good), -1)
        return out


class _LensletSample:
    """The lenslets that tell the motion: bright, whole and spread over the array."""

    def __init__(
        self, reference: Reference, signal: np.ndarray | Readout, noise: Noise | None
    ) -> None:
        patches = _Patches(signal, reference.origin, reference.window)
        values = patches.moved_by(0)
        known = np.isfinite(values)
        values = np.where(known, values, 0)
        level, power = values.sum(axis=-1, dtype=float), np.vecdot(values, values)
        # of a sum of pixels that are noise alone
        spread = power - level**2 / np.maximum(known.sum(axis=-1), 1)
        level[(known.mean(axis=-1) <= 0.5) | (level < 6 * np.sqrt(np.maximum(spread, 0)))] = 0
        bright = (
            np.flatnonzero(level > 0.25 * np.percentile(level, 90))
            if len(level)
            else np.zeros(0, int)
        )
        self.which = bright[evenly(len(bright), reference.sample)]
        self.reference, self.count, self.patches, self.window, self.noise = (
            reference,
            len(self.which),
            patches.some(self.which),
            reference.window,
            noise,
        )
        self.spread = None if reference.variance is None else np.nan_to_num(reference.variance)
        self.origin, self.centres = reference.origin[self.which], reference.centres[self.which]
        self.middle, self.extremes = reference.middle, reference.extremes

    @cached_property
    def response(self) -> np.ndarray:
        return self.reference.response(self.which)

    @cached_property
    def smooth(self) -> SmoothResponses:
        return self.reference.smooth(self.which)

    @cached_property
    def least_stray(self) -> float:
        """Light cannot be below zero: what the darkest pixel of the calibration has, taken off."""
        typical = np.nanmean(self.response, axis=0, dtype=float).sum(axis=-1)
        typical = typical[own_pixels(self.window) & np.isfinite(typical)]
        lit = len(typical) and typical.mean() > 0
        return -max(0.0, float(typical.min() / typical.mean())) if lit else 0.0

    def values(self, whole: np.ndarray) -> np.ndarray:
        """Values (lenslet, pixel) of windows moved by whole pixels, NaN at their borders."""
        return np.where(own_pixels(self.window), self.patches.moved_by(whole).astype(float), np.nan)

    def search(self) -> np.ndarray:
        """Displacement (2,) in whole pixels (an even number where there is a colour mosaic) that
        leaves the least residual.
        """
        step = 1 if self.reference.cfa == "mono" else 2
        some = slice(None, None, max(1, self.count // 24))
        known = np.isfinite(self.response[some]).all(axis=-1)
        q = np.linalg.qr(np.where(known[..., None], self.response[some], 0))[0]
        best, where = np.inf, np.zeros(2)
        for row in range(-REACH, REACH + 1, step):
            for column in range(-REACH, REACH + 1, step):
                x = self.values(np.array([row, column]))[some]
                x = np.where(known & np.isfinite(x), x, 0)
                part = 1 - ((np.swapaxes(q, -1, -2) @ x[..., None]) ** 2).sum(
                    axis=(1, 2)
                ) / np.maximum((x**2).sum(axis=1), 1e-30)
                if np.median(part) < best:
                    best, where = np.median(part), np.array([row, column], float)
        return where

    def fit(self, start: np.ndarray) -> Motion:
        """Gauss-Newton from displacement `start`: the common motion that leaves the least
        weighted residual.
        """
        affine = (
            self.count >= 12
            and np.linalg.matrix_rank(self.centres - self.middle, tol=1e-3 * np.ptp(self.centres))
            == 2
        )
        reach = np.abs(self.extremes - self.middle).max(axis=0)
        arms = (self.centres - self.middle) / np.where(reach > 0, reach, 1)  # a single row has none
        arms = (
            np.concatenate([np.ones((self.count, 1)), arms], axis=1)
            if affine
            else np.ones((self.count, 1))
        )
        q = np.zeros((2, arms.shape[1]))
        q[:, 0] = start
        for turn in range(ITERATIONS):
            shifts = arms @ q.T
            normal, right, chi, product = self._equations(shifts, arms)
            if turn == 0:
                before = chi
            solved, spread = _solve(normal, right, self.least_stray)
            step = solved[: q.size].reshape(q.shape)
            length = np.abs(arms @ step.T).max()
            q = q + step / max(1.0, length)
            if np.abs(q[:, 0]).max() > REACH + 1:
                break
            if length < CLOSE:  # steps shrink by their square
                break
        # a poor fit is bent by what the equations leave out
        linear = length < CLOSE and np.median(chi) < GOOD_FIT
        after = (
            _chi_after(product, chi, arms @ step.T)
            if linear
            else self._equations(arms @ q.T, arms)[2]
        )
        scale = np.sqrt(max(np.median(after), 1.0)) if self.noise is not None else 1.0
        size = np.abs(self.extremes - self.middle).max(axis=0)
        matrix = q[:, 1:] / size if affine else np.zeros((2, 2))
        reach = np.linalg.norm(q[:, 0] + (self.extremes - self.middle) @ matrix.T, axis=1).max()
        sigma = np.array([spread[0], spread[arms.shape[1]], spread[-2]]) * scale
        return Motion(
            shift=q[:, 0].copy(),
            matrix=matrix,
            middle=self.middle,
            offset=float(solved[-2]),
            stray=float(solved[-1]),
            sigma=sigma,
            beyond_chance=_beyond_chance(normal / scale**2, q.ravel()),
            stray_sigma=float(spread[-1] * scale),
            before=float(np.median(before)),
            after=float(np.median(after)),
            lenslets=self.count,
            reach=float(reach),
        )

    def _equations(
        self, shifts: np.ndarray, arms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Normal equations of (displacement coefficients, offset, stray) with radiances eliminated,
        and chi^2 a lenslet.

        The offset is that of the capture; stray is in shares of each lenslet's mean light. Lenslets
        that fit worse than the median weigh less.
        """
        whole = np.rint(shifts).astype(int)
        if self.reference.cfa == "mono":
            whole = np.broadcast_to(np.rint(shifts.mean(axis=0)).astype(int), whole.shape)
        parts = (
            self._parts(self.origin + whole, shifts - whole)
            if shifts.any()
            else self.reference.still(self.which)
        )
        bands, x = parts.shape[1] // 3, self.values(whole)
        known = np.isfinite(parts[:, :bands]).all(axis=1)
        good = np.isfinite(x) & known
        parts = parts if known.all() else np.where(known[:, None], parts, 0)
        x, weight = np.where(good, x, 0), good.astype(float)
        plain = _products(parts[:, :bands], weight, x)
        if self.noise is not None:
            b = _rough(plain)
            expected = self.noise.variance((b[:, None] @ parts[:, :bands])[:, 0])
            if self.spread is not None:
                expected = expected + b**2 @ self.spread.T
            weight = weight / np.maximum(expected, 1e-12)
        count = good.sum(axis=-1)
        mean = plain[:, :bands, -2] / np.maximum(count, 1)[:, None]
        product = _reduced(_products(parts, weight, x), bands, mean)
        chi = product[:, -1, -1] / np.maximum(count - bands, 1)
        unit = 1.0 if self.noise is not None else max(float(np.median(chi)), 1e-30)
        weight = 1 / unit / np.maximum(1, chi / max(np.median(chi), 1e-30)) ** 2
        terms = arms.shape[1]
        carry = np.zeros((len(arms), 4, 2 * terms + 2))
        carry[:, 0, :terms], carry[:, 1, terms : 2 * terms] = arms, arms
        carry[:, 2, -2] = carry[:, 3, -1] = 1
        turned = np.swapaxes(carry, -1, -2) * weight[:, None, None]
        normal = (turned @ product[:, :4, :4] @ carry).sum(axis=0)
        right = (turned @ product[:, :4, 4:]).sum(axis=0)[:, 0]
        return normal, right, chi, product

    def _parts(self, origin: np.ndarray, shifts: np.ndarray) -> np.ndarray:
        """F and its derivatives by row and by column shift (lenslet, 3 * band, pixel)."""
        return stacked(self.smooth.at(origin, shifts, derivatives=True, sharp=False))


def _products(parts: np.ndarray, weight: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Products (lenslet, n + 2, n + 2), summed over weighted pixels, of parts, 1 and x.

    parts: (lenslet, n, pixel), or (1, n, pixel) for all lenslets: then as matrix products.
    weight, x: (lenslet, pixel).
    """
    if len(parts) == len(x):
        rows = np.concatenate([parts, np.ones_like(x)[:, None], x[:, None]], axis=1)
        rows *= np.sqrt(weight)[:, None]
        return rows @ np.swapaxes(rows, -1, -2)
    rows, weighted = np.concatenate([parts[0], np.ones((1, x.shape[1]))]), weight * x
    out = np.empty((len(x), len(rows) + 1, len(rows) + 1))
    for n, row in enumerate(rows):
        out[:, n, n:-1] = out[:, n:-1, n] = weight @ (row * rows[n:]).T
    out[:, -1, :-1] = out[:, :-1, -1] = weighted @ rows.T
    out[:, -1, -1] = np.vecdot(weighted, x)
    return out


def _rough(gram: np.ndarray) -> np.ndarray:
    """Radiances (lenslet, band) by normal equations, good enough for weights; gram: products of F,
    1 and x.
    """
    f = gram[:, :-2, :-2]
    least = (1e-10 * np.trace(f, axis1=-2, axis2=-1) + 1e-300)[:, None, None]
    return np.linalg.solve(f + least * np.eye(f.shape[-1]), gram[:, :-2, -1:])[..., 0]


def _reduced(gram: np.ndarray, bands: int, mean: np.ndarray) -> np.ndarray:
    """Products (lenslet, 5, 5) of what remains, outside the span of F, of the columns (row shift,
    column shift, offset, stray, x).

    gram: weighted products of F, its derivatives by row and by column shift (band each), 1 and x.
    mean (lenslet, band): of F over pixels. F that cannot tell radiances counts as far as it does.
    """
    size = np.sqrt(np.maximum(np.diagonal(gram, axis1=-2, axis2=-1)[:, :bands], 1e-300))
    inverse = np.linalg.pinv(
        gram[:, :bands, :bands] / (size[:, :, None] * size[:, None]), rcond=1e-12, hermitian=True
    ) / (size[:, :, None] * size[:, None])
    b = (inverse @ gram[:, :bands, -1:])[..., 0]
    light = np.maximum((mean * b).sum(axis=-1), 0)
    rest = gram[:, bands:, bands:] - gram[:, bands:, :bands] @ inverse @ gram[:, :bands, bands:]
    mix = np.zeros((len(gram), rest.shape[-1], 5))
    mix[:, :bands, 0] = mix[:, bands : 2 * bands, 1] = b
    mix[:, -2, 2], mix[:, -2, 3], mix[:, -1, 4] = 1, light, 1
    return np.swapaxes(mix, -1, -2) @ rest @ mix


def _chi_after(product: np.ndarray, chi: np.ndarray, step: np.ndarray) -> np.ndarray:
    """chi a lenslet after a small displacement `step` (lenslet, 2), from the products of the
    equations before it.
    """
    gain = (
        2 * (step * product[:, :2, 4]).sum(axis=-1)
        - (step[:, None] @ product[:, :2, :2] @ step[..., None])[:, 0, 0]
    )
    return chi * (1 - gain / np.maximum(product[:, 4, 4], 1e-300))


def _beyond_chance(normal: np.ndarray, q: np.ndarray) -> float:
    """Standard deviations by which displacement coefficients q are more than chance: their squared
    distance from none is chi^2 of as many degrees of freedom if they are (R. A. Fisher's root).

    normal: of q and of what else was fitted.
    """
    n = len(q)
    others = np.linalg.pinv(normal[n:, n:], hermitian=True)
    told = normal[:n, :n] - normal[:n, n:] @ others @ normal[n:, :n]
    return float(np.sqrt(2 * max(q @ told @ q, 0.0)) - np.sqrt(2 * n - 1))


def _solve(
    normal: np.ndarray, right: np.ndarray, least: float = -np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Solution and standard deviations; what the data do not tell is 0 with deviation NaN:
    stray before offset. Stray is at least `least`, to which the others then go.
    """
    scale = np.sqrt(np.maximum(np.diag(normal), 1e-30))
    spread, solved = np.full((2, len(right)), [[np.nan], [0.0]])
    keep = list(range(len(right)))
    for drop in (None, len(right) - 1, len(right) - 2):
        if drop is not None:
            keep.remove(drop)
        if np.linalg.cond(_unit(normal, scale, keep)) < 1e4:
            break
    solved[keep], spread[keep] = _solved(normal, right, scale, keep)
    if solved[-1] < least:
        solved[-1] = least
        keep.remove(len(right) - 1)
        solved[keep], spread[keep] = _solved(normal, right - least * normal[-1], scale, keep)
    return solved, spread


def _unit(normal: np.ndarray, scale: np.ndarray, keep: list[int]) -> np.ndarray:
    return normal[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep])


def _solved(
    normal: np.ndarray, right: np.ndarray, scale: np.ndarray, keep: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Solution and standard deviations of the unknowns `keep`, the others being 0."""
    inverse = np.linalg.pinv(_unit(normal, scale, keep))
    value = inverse @ (right[keep] / scale[keep]) / scale[keep]
    return value, np.sqrt(np.maximum(np.diag(inverse), 0)) / scale[keep]
