"""The last resort: a picture that does not go on across the lenslets' borders is drawn back towards
the mean of each lenslet.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.inverse.picture.error_bars import about
from plenocli.inverse.picture.lenslet_model import Common, alone
from plenocli.inverse.picture.reconstruction import Reconstruction
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


def guarded(
    found: Reconstruction,
    y: np.ndarray,
    belief: Belief,
    shape: tuple[int, int],
    common: Common = alone,
) -> tuple[Reconstruction, float]:
    """(the picture with as much of its detail as `detail_kept` says, that share).

    Its standard deviation grows by the detail that is given up, see error_bars.about.

    y: (lenslet_row, lenslet_column, pixel) own light.
    common: gives that share, of lenslets that are a part.
    """
    lmmse, stacked = belief.lmmse, y.reshape(-1, y.shape[-1]).T
    mean = (lmmse.even @ (lmmse.levels @ stacked)).T.reshape(found.value.shape)
    kept = common("kept", lambda: detail_kept(found.value, mean, belief, shape))
    if kept == 1:
        return found, kept
    drawn = mean + kept * (found.value - mean)
    sigma = None if found.sigma is None else about(drawn - found.value, found.sigma)
    return replace(found, value=drawn, sigma=sigma), kept
