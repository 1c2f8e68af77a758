"""Noise by coordinate: what a capture holds in each coordinate of LMMSE beyond what photographs and
noise explain.

An error of the matrix falls upon a few directions, and upon strong ones does no harm: so noise is
raised only where the capture's lenslets together show more than is expected.
"""

from __future__ import annotations

import numpy as np

from plenocli.inverse.picture.solvers.lmmse import SCALES, Lmmse, mean_scale

STRONG = 20
"""Strongest coordinates, which tell the lenslets' contrast before anything is known of excess."""
TOGETHER = 9
"""Coordinates of similar power whose excess is averaged."""
TIMES = 1.5
"""Times what is expected, from which on there is an excess: photographs differ so much."""
ROUNDS = 4
SURE = 1.0
"""Variances of chance by which a pattern of even light is drawn towards nothing."""


def with_excess(lmmse: Lmmse, y: np.ndarray, floor: float) -> np.ndarray:
    """(k,) variance of the noise in each coordinate of `lmmse`.

    y: (pixel, signal) superpixels.
    floor: least variance.
    """
    w = lmmse.coordinates(y)
    order = np.argsort(-lmmse.power, kind="stable")
    noise = np.maximum(lmmse.noise, floor)
    used = order[:STRONG]
    for _ in range(ROUNDS):
        scale = float(np.mean(_contrasts(lmmse.power[used], noise[used], w[used])))
        expected = scale * lmmse.power + np.maximum(lmmse.noise, floor)
        ratio = np.mean(w**2, axis=1) / expected
        ratio[order] = _running_mean(ratio[order])
        noise = np.maximum(lmmse.noise, floor)
        noise = noise + np.where(ratio > TIMES, ratio - 1, 0) * expected
        used = order
    return noise


def even_light(lmmse: Lmmse, y: np.ndarray) -> np.ndarray:
    """(pixel,) what even light makes in a superpixel beside what the matrix says, for a brightness
    of 1.

    Photographs have no detail that goes with the brightness of lenslets in all of them; an error of
    the matrix has, and leaves the same pattern in every bright one. By least squares over the
    lenslets, each coordinate drawn towards nothing by what chance makes of it.

    y: (pixel, signal) superpixels.
    """
    w, bright = lmmse.coordinates(y), lmmse.brightness(y)
    power = max(float(bright @ bright), np.finfo(float).tiny)
    found = w @ bright / power
    rest = w - np.outer(found, bright)
    variance = rest**2 @ bright**2 / power**2
    sure = 1 - SURE * variance / np.maximum(found**2, np.finfo(float).tiny)
    return lmmse.analysis.T @ (np.maximum(sure, 0) * found)


def without_pattern(lmmse: Lmmse, y: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Superpixels y (.., pixel) without `pattern` (pixel,), as `even_light` gives it, times the
    brightness of each.
    """
    bright = lmmse.brightness(y.reshape(-1, y.shape[-1]).T)
    return y - bright.reshape(*y.shape[:-1], 1) * pattern


def _contrasts(power: np.ndarray, noise: np.ndarray, w: np.ndarray) -> np.ndarray:
    """(signal,) most likely scale of each, on the whole, of coordinates w (k, signal)."""
    expected = np.outer(SCALES, power) + noise
    likelihood = -0.5 * (np.log(expected).sum(axis=1)[:, None] + (1 / expected) @ w**2)
    likelihood = np.exp(likelihood - likelihood.max(axis=0))
    prior = np.full(len(SCALES), 1 / len(SCALES))
    for _ in range(5):
        posterior = likelihood * prior[:, None]
        posterior /= posterior.sum(axis=0)
        prior = np.maximum(posterior.mean(axis=1), 1e-12)
    return mean_scale(posterior)


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Means of TOGETHER values in a row, as many as come out where there are fewer."""
    if not len(values):
        return values
    half = TOGETHER // 2
    padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(2 * half + 1, 1 / (2 * half + 1)), "valid")
