"""The best linear estimate on a torus that is seen everywhere, with its variance: one gain a
lattice frequency.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.budget import budget, spread
from plenocli.base.linear_maps import BlockCirculant
from plenocli.base.progress import bar
from plenocli.inverse.volume.lattice import Lattice, back_through_prior, through_prior


@dataclass(frozen=True, kw_only=True)
class Gain:
    """Posterior of a stationary Gaussian volume.

    matrix: (frequency, unknown, pixel), from whitened pixels to voxels, single precision.
    variance: (unknown,) of a voxel's error.
    leverage: (pixel,) what a pixel has to say in its own prediction, 0 to 1.
    whitening: (pixel,) one over the noise's standard deviation.
    """

    matrix: np.ndarray
    variance: np.ndarray
    leverage: np.ndarray
    whitening: np.ndarray


def gain_of(
    op: BlockCirculant, lattice: Lattice, factor: np.ndarray, whitening: np.ndarray
) -> Gain:
    """The gain of every frequency, its Gram matrix in double precision.

    op: the map.
    lattice: its frequencies.
    factor: (frequency, fine frequency, plane, plane) roots of the prior's covariance.
    whitening: (pixel,) one over the noise's standard deviation, 0 for pixels that never count.

    With B = A L, C = I + B' B = R R' and T = L R^-H, the posterior covariance is T T' and the gain
    T T' A'. Single precision breaks the root of C.
    Raises NumericsError where memory is lacking.
    """
    frequencies, pixels, unknowns = op.spectrum.shape
    itemsize = op.spectrum.itemsize
    needed = itemsize * frequencies * pixels * unknowns + 128 * unknowns * (unknowns + pixels)
    budget().require(needed, "the gain of every lattice frequency", fewer="take fewer planes")
    matrix = np.empty((frequencies, unknowns, pixels), op.spectrum.dtype)
    variance = np.empty((frequencies, unknowns))
    leverage = np.empty((frequencies, pixels))
    scale = whitening[:, None]

    with bar(None, frequencies, "gains") as shown:

        def work(some: range) -> None:
            for k in some:
                mixing, root = lattice.mixing[k], factor[k]
                t, w = _one(scale * op.spectrum[k], mixing, root)
                matrix[k] = t.astype(matrix.dtype) @ w.astype(matrix.dtype).conj().T
                variance[k] = _squares(t, 1)
                leverage[k] = _squares(w, 1)
                shown.update()

        step = max(1, frequencies // 32)
        spread([(range(i, min(i + step, frequencies)),) for i in range(0, frequencies, step)], work)
    return Gain(
        matrix=matrix,
        variance=lattice.mean(variance),
        leverage=lattice.mean(leverage),
        whitening=whitening,
    )


def _one(matrix: np.ndarray, mixing: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, ...]:
    """T (unknown, mode) and B R^-H (pixel, mode) of one frequency."""
    from scipy.linalg.blas import zherk, ztrmm
    from scipy.linalg.lapack import zpotrf, ztrtri

    b = np.asfortranarray(through_prior(matrix, mixing, root))
    gram = zherk(1.0, b, trans=2, lower=1)
    gram[np.diag_indices_from(gram)] += 1
    inverse = ztrtri(zpotrf(gram, lower=1, clean=1)[0], lower=1)[0]
    t = back_through_prior(inverse.conj().T, mixing, root)
    return t, ztrmm(1.0, inverse, b, side=1, lower=1, trans_a=2, overwrite_b=1)


def _squares(array: np.ndarray, axis: int) -> np.ndarray:
    return (array.real**2 + array.imag**2).sum(axis=axis)
