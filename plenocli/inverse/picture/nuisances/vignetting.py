"""Vignetting within superpixels, from the white image: what its pixels have over the even light
that the matrix predicts.
"""

from __future__ import annotations

import numpy as np

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
    bright = even > SEEN * even.max()
    ratio = np.where(bright, white, np.nan) / np.where(bright, even, 1.0)
    inner, common = even > PUPIL * even.max(), np.ones(even.size)
    bad = np.zeros(white.shape, bool)
    for _ in range(ROUNDS):
        good = np.where(bad, np.nan, ratio)
        own = _smooth(np.where(inner, good, np.nan) / common, even, shape)
        common = _common(good / own)
        far = ratio / (own * common)
        seen = np.where(np.isfinite(far).any(axis=1, keepdims=True), far, 1.0)
        middle = np.nanmedian(seen, axis=1, keepdims=True)
        bad = np.abs(far - middle) > BAD * middle
    return np.where(bad, np.nan, np.clip(own * common, 1 / STEEPEST, STEEPEST))


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


def _smooth(ratio: np.ndarray, even: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Quadratics of the place through ratios (lenslet, pixel), NaN where unknown; by least
    squares, weighted by the even light; 1 on average, and everywhere where that is TYPICAL.
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
    if not sound.any() or np.median(away[sound]) < TYPICAL:
        return np.ones_like(ratio)
    return np.clip(fitted, 1 / STEEPEST, STEEPEST)
