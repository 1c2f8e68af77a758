"""The last resort: a picture that does not go on across the lenslets' borders, or is amplified
noise, is drawn back towards the mean of each lenslet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.inverse.picture.error_bars import about
from plenocli.inverse.picture.lenslet_model import Common, alone
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.trust.believe import CHANCE, CONTINUOUS, Belief
from plenocli.inverse.picture.trust.continuity import LEAST_REFERENCE, Jumps, jumps


def detail_kept(
    value: np.ndarray, mean: np.ndarray, belief: Belief, shape: tuple[int, int]
) -> float:
    """How much of a picture's detail is kept, from 0 to 1: all where it is as continuous as the
    matrix is believed to make it.

    value: (lenslet_row, lenslet_column, point) the picture.
    mean: the same shape, the brightness of each lenslet and band.
    belief: about the matrix.
    shape: (rows, columns) of an object in one band.
    """
    if belief.reference is None:
        return 1.0
    found = Jumps(
        level=jumps(mean, shape), detail=jumps(value - mean, shape)[:, None], along=min(shape)
    )
    # chance and unusual scenes are given the benefit of the doubt where the matrix is believed only
    least = max(belief.reference, LEAST_REFERENCE) * (CONTINUOUS if belief.right else 1.0)
    factor = found.factor + CHANCE * found.deviation * (1 if belief.right else -1)
    return float(np.clip(factor / least, 0, 1))


def is_noise(value: np.ndarray, detail: np.ndarray, svd: Svd, sigma: float) -> bool:
    """Whether a non-negative picture by least squares has less detail than noise leaves in it, were
    the points above zero those of the scene.

    value, detail: (lenslet_row, lenslet_column, point).
    svd: of the matrix.
    sigma: noise of a pixel.
    """
    left = float(np.sum(detail**2)) / sigma**2
    rows = svd.s[:, None] * svd.vt
    for x in value.reshape(-1, value.shape[-1]):
        seen = rows[:, x > 0]
        values = np.linalg.eigvalsh(seen.T @ seen)
        if len(values) and values[0] <= np.finfo(float).eps * values[-1]:
            return True  # noise without a bound
        left -= float(np.sum(1 / values))
        if left < 0:
            return True
    return False


def likely_share(detail: np.ndarray, likely: np.ndarray) -> float:
    """Share of a picture's detail that is kept beside what LMMSE expects of it (the same shape):
    all, unless none at all would be nearer to that.
    """
    if np.sum((detail - likely) ** 2) <= np.sum(likely**2):
        return 1.0
    return float(np.clip(np.sum(detail * likely) / np.sum(detail**2), 0, 1))


def guarded(
    found: Reconstruction,
    y: np.ndarray,
    belief: Belief,
    shape: tuple[int, int],
    common: Common = alone,
    svd: Svd | None = None,
) -> tuple[Reconstruction, float]:
    """(the picture with as much of its detail as is kept, that share).

    Its standard deviation grows by the detail that is given up, see error_bars.about.

    y: (lenslet_row, lenslet_column, pixel) own light.
    common: gives that share, of lenslets that are a part.
    svd: of the matrix, where nothing but it and a sign made the picture: noise as large as the
        detail is drawn back then, see `is_noise` and `likely_share`.
    """
    lmmse, stacked = belief.lmmse, y.reshape(-1, y.shape[-1]).T
    mean = (lmmse.even @ (lmmse.levels @ stacked)).T.reshape(found.value.shape)

    def share() -> float:
        kept, detail = detail_kept(found.value, mean, belief, shape), found.value - mean
        if svd is not None:
            likely = lmmse.likely(stacked).T.reshape(detail.shape) - mean
            least = likely_share(detail, likely)
            if least < kept and is_noise(found.value, detail, svd, belief.level.sigma):
                return least
        return kept

    kept = common("kept", share)
    if kept == 1:
        return found, kept
    drawn = mean + kept * (found.value - mean)
    sigma = None if found.sigma is None else about(drawn - found.value, found.sigma)
    return replace(found, value=drawn, sigma=sigma), kept
