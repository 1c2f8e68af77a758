"""LMMSE over 3x3 lenslets, and what it tells of the neighbours' light."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture import error_bars
from plenocli.inverse.picture.estimators import INNER, Estimators, root_mean_square
from plenocli.inverse.picture.lenslet_model import Superpixels


@dataclass(frozen=True, kw_only=True)
class JointEstimate:
    """LMMSE over 3x3 lenslets.

    value, sigma: (lenslet_row, lenslet_column, point), the picture and its standard deviation.
    scale: factor of the photographs' covariance, geometric mean of the lenslets.
    """

    value: np.ndarray
    sigma: np.ndarray
    scale: float


def estimate_jointly(estimators: Estimators, data: Superpixels) -> JointEstimate:
    """LMMSE over 3x3 lenslets, the contrast of each its own. sigma is what each lenslet's own light
    leaves open (docs/model.md, "Spatial reconstruction").
    """
    own = estimators.prior.lmmse(data.known_sigma, data.scene)
    x, _, scale = estimators.prior.joint(data.known_sigma, data.scene).apply(data.y, data.common)
    y = own_light(estimators, data.y, x) if estimators.coupled else data.y
    apart, left = error_bars.posterior(own, y, estimators.system.object_shape, data.common)
    return JointEstimate(
        value=x,
        sigma=error_bars.JOINTLY * error_bars.about(x - apart, left),
        scale=float(np.exp(np.mean(np.log(scale)))),
    )


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
    inside = tuple(slice(reach, reach + n) for n in y.shape[:2])
    return y - estimators.sensor(beyond.shape[:2]).neighbours_only().forward(beyond)[inside]


def left_over(estimators: Estimators, y: np.ndarray, x: np.ndarray) -> float:
    """Root mean square of y - A x over the lenslets that have all their neighbours
    (all, where none has).
    """
    rest = y - estimators.sensor(y.shape[:2]).forward(x)
    return root_mean_square(rest[INNER] if rest[INNER].size else rest)
