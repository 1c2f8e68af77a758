"""Whether a picture that jumps at the borders of lenslets is one of a scene that jumps everywhere.

They are told apart by what a wrong matrix does and a scene does not: it leaves light where the
matrix reaches nothing; it spoils weak coordinates before strong ones; it makes the same pattern in
every lenslet, as bright as the lenslet; it makes light negative.

docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

import numpy as np

from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import Lmmse

EXPLAINED, MORE, FEW = 0.5, 0.03, 4
"""Shares of the detail's energy from which on a pattern is the matrix's: what goes in proportion to
brightness, and how much more that is than what all lenslets have in common; by so many bright
lenslets at least.
"""
NEGATIVE = 0.2
"""Share of negative light in the energy of the detail that no scene has: stars on black, which ring
most, have 0.14.
"""


def dark(svd: Svd) -> int:
    """Directions of a superpixel that no object reaches."""
    return len(svd.u) - svd.rank(1e-6)


def reached(svd: Svd, energy: float, sigma: float) -> np.ndarray:
    """(pixel, direction) that objects reach with what stands above the noise, were all light of a
    superpixel of one direction.

    energy: of an object, the sum of its squares.
    sigma: noise of a pixel.
    """
    loud = int(np.count_nonzero(svd.s**2 * energy > sigma**2))
    return svd.u[:, : min(svd.rank(1e-6), loud)]


def spoilt_by_matrix(lmmse: Lmmse, y: np.ndarray) -> bool:
    """Whether the estimate from superpixels y (pixel, signal) is what a wrong matrix makes and no
    scene: a pattern in proportion to brightness, or much negative light.
    """
    bright = lmmse.brightness(y)
    detail = lmmse.gain @ lmmse.likely_detail(y)
    energy = float(np.sum(detail**2))
    if not energy > 0:
        return False
    along = detail @ bright
    squares = float(bright @ bright)
    in_proportion = float(along @ along) / squares / energy
    count = squares**2 / float(np.sum(bright**4))
    alike = detail.sum(axis=1)
    in_common = float(alike @ alike) / detail.shape[1] / energy
    pattern = in_proportion > max(EXPLAINED, in_common + MORE) and count > FEW
    level = lmmse.even @ (lmmse.levels @ y) + lmmse.mean[:, None]
    negative = float(np.sum(np.minimum(level + detail, 0) ** 2))
    return pattern or negative > NEGATIVE * energy
