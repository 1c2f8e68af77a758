"""LMMSE over 3x3 lenslets, and what it tells of the neighbours' light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture import error_bars
from plenocli.inverse.picture.estimators import Estimators, root_mean_square
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.spectra.lattice_system import LatticeSystem, PointPrior


@dataclass(frozen=True, kw_only=True)
class JointEstimate:
    """LMMSE over 3x3 lenslets.

    value, sigma: (lenslet_row, lenslet_column, point), the picture and its standard deviation.
    scale: factor of the photographs' covariance, geometric mean of the lenslets.
    own: (lenslet_row, lenslet_column, pixel), superpixels without the neighbours' light as this
        picture sends it.
    """

    value: np.ndarray
    sigma: np.ndarray
    scale: float
    own: np.ndarray


def estimate_jointly(estimators: Estimators, data: Superpixels) -> JointEstimate:
    """LMMSE over 3x3 lenslets, the contrast of each its own. sigma is what each lenslet's own light
    leaves open (docs/model.md, "Spatial reconstruction").

    Of several bands every lenslet's brightness in each is free, as in demultiplexing: scenes are
    not as alike in them as surfaces under one photograph.
    """
    own = estimators.prior.lmmse(data.known_sigma, data.scene)
    joint, y = estimators.prior.joint(data.known_sigma, data.scene), data.y
    if estimators.coupled and len(estimators.system.bands) > 1:
        brightness, seen = _even_light(estimators, data, joint.mean)
        x, _, scale = joint.apply(y - seen, data.common)
        x += np.repeat(brightness, x.shape[-1] // brightness.shape[-1], axis=-1)
    else:
        x, _, scale = joint.apply(y, data.common)
    y = own_light(estimators, y, x) if estimators.coupled else y
    apart, left = error_bars.posterior(own, y, estimators.system.object_shape, data.common)
    return JointEstimate(
        value=x,
        sigma=error_bars.JOINTLY * error_bars.about(x - apart, left),
        scale=float(np.exp(np.mean(np.log(scale)))),
        own=y,
    )


def _even_light(
    estimators: Estimators, data: Superpixels, mean: float
) -> tuple[np.ndarray, np.ndarray]:
    """What the brightnesses (lenslet_row, lenslet_column, band) of lenslets differ from `mean`, by
    least squares over all lenslets, drawn to it where bands are hardly told apart, and the
    superpixels that they make.
    """
    system, count = estimators.system, len(estimators.system.bands)
    blocks = system.even_blocks
    prior = PointPrior(
        mean=np.zeros(count),
        inverse=np.linalg.inv(estimators.prior.bands() + 1e-4 * np.eye(count)),
        rho=0.0,
    )
    variance = np.full(blocks.shape[1], data.known_sigma**2)
    lattice = LatticeSystem(blocks, system.offsets, variance, data.y.shape[:2], prior)
    left = data.y - mean * blocks.sum(axis=(0, 2))
    found = lattice.solved(left, np.zeros((*data.y.shape[:2], count)))
    return found, lattice.forward(found)


def own_light(estimators: Estimators, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Superpixels without the light that the objects under their neighbours send.

    An estimate per lenslet cannot tell that light from its own and amplifies it; taking it away by
    repeated estimates diverges where the matrix is ill-conditioned, so that x comes from the joint
    estimate.

    y: (lenslet_row, lenslet_column, pixel).
    x: (lenslet_row, lenslet_column, point); beyond the array it goes on mirrored.
    """
    system = estimators.system
    reach, shape = int(np.abs(system.offsets).max()), system.object_shape
    planes = to_plane(x, shape).reshape(-1, *(n * k for n, k in zip(y.shape[:2], shape)))
    beyond = to_blocks(
        np.pad(planes, [(0, 0), *((reach * k, reach * k) for k in shape)], mode="symmetric"), shape
    )
    lattice = BlockToeplitz(system.blocks, system.offsets, beyond.shape[:2])
    return y - lattice.neighbours_only().forward(beyond)[reach:-reach, reach:-reach]


def left_over(estimators: Estimators, joint: JointEstimate) -> float:
    """Root mean square of what the picture does not explain, over the lenslets that have all their
    neighbours (all, where none has).
    """
    rest = joint.own - joint.value @ estimators.system.own.T
    inner = rest[estimators.inner(rest.shape[:2])]
    return root_mean_square(inner if inner.size else rest)
