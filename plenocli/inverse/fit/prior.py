"""What lies in front of a lenslet, as a fit believes: a brightness of its own, and a field with the
covariance of photographs at a contrast of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.inverse.prior.natural_images import draw_patches

CONTRASTS = np.geomspace(0.03, 7, 5)
"""Scales of the covariance, one of which a lenslet has: sky and foliage differ a hundredfold."""
BRIGHTNESS = 0.4
"""Standard deviation of the brightness of a lenslet's field, relative to white."""
LEFT = 1e-2
"""Share of the variance that the least important patterns hold together, which are left out."""
MOST_PATTERNS = 300
PATCHES_A_POINT = 10


@dataclass(frozen=True)
class PhotographPrior:
    """patterns: (point, pattern); their coefficients are independent, of variance 1 times a
    contrast, and the last one is the brightness, whose variance no contrast changes.
    """

    patterns: np.ndarray

    def scales(self, contrast: float) -> np.ndarray:
        """(pattern,) standard deviations of the coefficients."""
        scales = np.full(self.patterns.shape[1], np.sqrt(contrast))
        scales[-1] = 1.0
        return scales

    def seen(self, A: np.ndarray, sigma: float) -> PhotographPrior:
        """Without the patterns of least variance, which a matrix A (pixel, point) shows weaker
        than `sigma`, all together, a pixel.
        """
        energy = np.mean((A @ self.patterns[:, :-1]) ** 2, axis=0)
        tail = np.append(np.cumsum(energy[::-1])[::-1], 0)
        kept = max(1, int(np.argmax(tail <= sigma**2)))
        return PhotographPrior(np.delete(self.patterns, np.s_[kept:-1], axis=1))


def photograph_prior(
    pictures: Sequence[np.ndarray], shape: tuple[int, int], seed: int = 0
) -> PhotographPrior:
    """The prior from training pictures.

    pictures: linear luminance (row, column) in [0, 1], at several scales.
    shape: (rows, columns) of the points of a lenslet.
    seed: of the patches drawn.
    """
    points = shape[0] * shape[1]
    patches = draw_patches(pictures, shape, PATCHES_A_POINT * points, stream(seed, "fit-camera"))
    patches = patches - patches.mean(axis=0)
    # photographs have no up and down that a fit should take for a defocus
    covariance = patches @ patches.T / patches.shape[1]
    covariance = (covariance + covariance[::-1, ::-1]) / 2
    values, vectors = np.linalg.eigh(covariance)
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = int(np.searchsorted(np.cumsum(values) / values.sum(), 1 - LEFT)) + 1
    kept = min(kept, MOST_PATTERNS)
    return PhotographPrior(
        np.column_stack([vectors[:, :kept] * np.sqrt(values[:kept]), np.full(points, BRIGHTNESS)])
    )
