"""Vignetting within superpixels, from the white image: what its pixels have over the even light
that the matrix predicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from plenocli.base.tiling import Room

SEEN = 0.1
"""Of the brightest pixel of even light from which on the white of a pixel is compared with it."""
PUPIL = 0.3
"""Likewise for what varies smoothly: beyond, at the edge of the pupil's image, a lenslet that sits
elsewhere looks like vignetting.
"""
TYPICAL = 0.003
"""Vignetting, root mean square of most lenslets, below which a lenslet has none of its own."""
BAD = 0.2
"""Share by which a pixel's white is off that counts for nothing."""
ROUNDS = 3
"""Of what lenslets have of their own and in common, in turn."""
STEEPEST = 4.0
"""Factor beyond which no pixel is brightened or darkened."""
LEAST = 16
"""Pixels that are looked at together, at least."""


def falloff(white: np.ndarray, even: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Light of each pixel over that of even light, but for the lenslet's brightness.

    Of each lenslet its own a quadratic of the pixel's place, smooth like the vignetting of stops
    and filters; and what all lenslets have in common, pixel by pixel, as far as it stands out from
    how they differ. That takes with it what is wrong with the matrix for even light.

    white: (lenslet, pixel) at the brightness of `even`, NaN where nothing is known.
    even: (pixel,), as the matrix predicts it.
    shape: (rows, columns) of a superpixel.

    Returns (lenslet, pixel), 1 on average, and everywhere where there is nothing to divide out; NaN
        where a pixel is not smooth at all, as dead ones are and those under dust.
    """
    return falloff_in_bands(white, even, shape, [slice(0, len(white))], np.empty)[:]


def falloff_in_bands(
    white: Any, even: np.ndarray, shape: tuple[int, int], lenslets: Sequence[slice], room: Room
) -> Any:
    """As falloff, of white that may stay in a file.

    lenslets: bands that are worked on one after the other.
    room: for values of a shape and dtype, put and looked at by slices.

    Returns what is looked at by slices of lenslets.
    """
    bright = even > SEEN * even.max()
    inner, common = even > PUPIL * even.max(), np.ones(even.size)
    bad, own = room(white.shape, np.dtype(bool)), room(white.shape, np.dtype(float))
    apart = room(white.shape[::-1], np.dtype(float))
    groups = max(1, min(len(lenslets), even.size // LEAST))
    ends = np.linspace(0, even.size, groups + 1).astype(int).tolist()
    pixels = [slice(first, last) for first, last in zip(ends[:-1], ends[1:])]

    def ratio(some: slice) -> np.ndarray:
        return np.where(bright, white[some, :], np.nan) / np.where(bright, even, 1.0)

    for number in range(ROUNDS):
        away = []
        for some in lenslets:
            good = np.where(bad[some, :], np.nan, ratio(some)) if number else ratio(some)
            fitted, off = _smooth(np.where(inner, good, np.nan) / common, even, shape)
            own[some, :] = fitted
            away.append(off)
        told = np.concatenate(away)
        is_smooth = not told.size or float(np.median(told)) < TYPICAL
        for some in lenslets:
            good = np.where(bad[some, :], np.nan, ratio(some)) if number else ratio(some)
            if is_smooth:
                own[some, :] = np.ones_like(good)
            apart[:, some] = (good / own[some, :]).T
        common = np.concatenate([_common(np.ascontiguousarray(apart[k, :].T)) for k in pixels])
        for some in lenslets:
            far = ratio(some) / (own[some, :] * common)
            seen = np.where(np.isfinite(far).any(axis=1, keepdims=True), far, 1.0)
            middle = np.nanmedian(seen, axis=1, keepdims=True)
            bad[some, :] = np.abs(far - middle) > BAD * middle
    for some in lenslets:
        light = np.clip(own[some, :] * common, 1 / STEEPEST, STEEPEST)
        own[some, :] = np.where(bad[some, :], np.nan, light)
    return own


def _common(ratio: np.ndarray) -> np.ndarray:
    """What lenslets have in common, (pixel,), from ratios (lenslet, pixel), NaN where unknown: the
    mean but for outliers, drawn towards 1 by how uncertain it is.
    """
    known = np.isfinite(ratio)
    count = known.sum(axis=0)
    middle = np.ones(ratio.shape[1])
    some = count >= 4
    middle[some] = np.nanmedian(ratio[:, some], axis=0)
    far = np.where(known, np.abs(ratio - middle), np.nan)
    spread = np.zeros(ratio.shape[1])
    spread[some] = 1.4826 * np.nanmedian(far[:, some], axis=0)
    inside = known & (far <= 4 * spread)
    mean = np.where(inside, ratio, 0.0).sum(axis=0) / np.maximum(inside.sum(axis=0), 1)
    excess = np.where(some, mean - 1, 0.0)
    unsure = spread**2 / np.maximum(count, 1)
    return 1 + excess * np.maximum(1 - unsure / np.maximum(excess**2, 1e-300), 0.0)


def _smooth(
    ratio: np.ndarray, even: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Quadratics of the place through ratios (lenslet, pixel), NaN where unknown; by least
    squares, weighted by the even light; 1 on average. And how far they are from 1, root mean
    square, of those lenslets that have one.
    """
    rows, columns = np.meshgrid(*(np.linspace(-1, 1, n) for n in shape), indexing="ij")
    place = np.stack([rows.ravel(), columns.ravel()])
    basis = np.stack([np.ones(even.size), *place, *(place**2), place[0] * place[1]], axis=1)
    known = np.isfinite(ratio)
    weight, ratio = np.where(known, even**2, 0.0), np.where(known, ratio, 0.0)
    normal = np.einsum("pi,lp,pj->lij", basis, weight, basis, optimize=True)
    told = np.linalg.cond(normal) < 1e6
    fitted = np.ones_like(ratio)
    right = (ratio * weight)[told] @ basis
    fitted[told] = np.linalg.solve(normal[told], right[:, :, None])[:, :, 0] @ basis.T
    # the lenslet's brightness is another matter
    total = np.maximum(weight.sum(axis=1), np.finfo(float).tiny)
    level = (weight * fitted).sum(axis=1) / total
    sound = told & (level > 0)
    fitted = np.where(sound[:, None], fitted / np.where(sound, level, 1)[:, None], 1.0)
    away = np.sqrt((weight * (fitted - 1) ** 2).sum(axis=1) / total)
    return np.clip(fitted, 1 / STEEPEST, STEEPEST), away[sound]
