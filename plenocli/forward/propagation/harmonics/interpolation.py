"""Interpolation of what is sampled more finely than its band asks for."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from plenocli.forward.camera.quadrature import gauss

FALL = 4
"""Power of a column's frequencies falls as (1 - f/f_max)^FALL where weights are sought: where 1
and 9 stood, the worst columns had twice the error.
"""
EVEN = 100.0
"""Weight of what does not change from sample to sample, which is most of a column."""
CUT = 1e-12
"""Combinations of taps that see less of the band than this share of the most are not used."""


def tap_weights(places: np.ndarray, taps: int, oversampling: float) -> np.ndarray:
    """Weights of the samples about each place that best give the value there.

    Least squares over a band whose power falls to nothing at its end, as that of a squared field
    does, and over its mean.

    places: (place,) from 0 to 1, in samples beyond the one before the middle of the taps;
    taps: how many samples, an even number;
    oversampling: rate of the samples over twice the highest frequency.

    Returns (place, tap).
    """
    cycles, root, inverse = _band(taps, oversampling)
    return _waves(places, cycles, root) @ inverse


@lru_cache(maxsize=512)
def tap_error(taps: int, oversampling: float, rate: float | None = None) -> float:
    """Root mean square error of tap_weights at the worst place, where 1 is all but the mean.

    rate: of the samples over twice the highest frequency, where it is more than `oversampling`.
    """
    places = np.linspace(0, 0.5, 5)
    cycles, root, _ = _band(taps, rate or oversampling)
    found = tap_weights(places, taps, oversampling) @ _waves(_stand(taps), cycles, root)
    missed = found - _waves(places, cycles, root)
    return float(np.sqrt((missed**2).sum(axis=1).max() / (root[:-1] ** 2).sum()))


@lru_cache(maxsize=512)
def _band(taps: int, oversampling: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(frequencies in cycles a sample, roots of their power, what makes waves at a place to
    weights of taps).
    """
    t, w = gauss(16 + 2 * taps)
    cycles, root = (t + 1) / (4 * oversampling), np.sqrt((1 - t) ** FALL * w)
    cycles, root = np.append(cycles, 0.0), np.append(root, EVEN)
    return cycles, root, np.linalg.pinv(_waves(_stand(taps), cycles, root), CUT)


def _stand(taps: int) -> np.ndarray:
    return np.arange(taps) - (taps / 2 - 1)


def _waves(places: np.ndarray, cycles: np.ndarray, root: np.ndarray) -> np.ndarray:
    """(place, cosines then sines)."""
    phase = 2 * np.pi * places[:, None] * cycles
    return np.hstack([np.cos(phase) * root, np.sin(phase) * root])
