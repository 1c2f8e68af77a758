"""Standard deviations of pictures, whatever method made them: half the width of the interval that
holds the truth with 95 %, over 1.96.

All rest on what LMMSE knows of a lenslet when it has seen its superpixel, widened or narrowed by
what the capture itself says of weak directions and of the lenslets' borders, and on each picture's
distance from LMMSE's (docs/model.md, "Spatial reconstruction").
"""

from __future__ import annotations

from functools import lru_cache
from statistics import NormalDist

import numpy as np

from plenocli.base.budget import both
from plenocli.base.tiling import to_plane
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.lenslet_model import Common, Superpixels
from plenocli.inverse.picture.solvers.lmmse import SCALES, Lmmse, mean_scale

INTERVAL, INSIDE = 1.96, 0.95
"""The interval is INTERVAL standard deviations each way, and holds the truth with INSIDE."""

HARDLY = 2.0
"""Power over the noise up to which a direction counts as one that hardly stands above it."""
FACTORS = np.exp(np.linspace(-2.5, 2.5, 41))
"""Factors of the weak directions' power that are tried."""
SPREAD_OF_FACTOR = 0.5
"""Standard deviation of the logarithm of that factor, before the capture is seen."""

JOINTLY, BY_VARIATION, BY_MATCHING = 0.93, 0.95, 0.88
"""Factors of the joint estimate, of total variation and of plug and play, whose distance from LMMSE
is in part what they gain over it.
"""

BY_WEAK, BY_BORDER, USUAL_BORDER = 0.38, 0.10, 0.0
"""How the logarithm of the standard deviation follows that of the weak directions' factor, and of
the difference across borders; and the latter where there is no border. By
pipelines/benchmarks/error_bars.py --fit on photographs that judge nothing (docs/model.md).
"""


def of_picture(
    estimators: Estimators,
    data: Superpixels,
    y: np.ndarray,
    value: np.ndarray,
    factor: float = 1.0,
) -> np.ndarray:
    """Standard deviations of a picture, (lenslet_row, lenslet_column, point).

    data: the capture, its noise known.
    y: (lenslet_row, lenslet_column, pixel) own light that the picture was made from.
    value: (lenslet_row, lenslet_column, point) the picture.
    factor: of its method.
    """
    lmmse = estimators.prior.lmmse(data.known_sigma, data.scene)
    x, left = posterior(lmmse, y, estimators.system.object_shape, data.common)
    return factor * about(value - x, left)


def posterior(
    lmmse: Lmmse, y: np.ndarray, shape: tuple[int, int], common: Common
) -> tuple[np.ndarray, np.ndarray]:
    """LMMSE of each lenslet by itself, and its standard deviation in this capture.

    y: (lenslet_row, lenslet_column, pixel) own light.
    shape: points (rows, columns) of a block in one band.
    common: gives what lenslets that are a part have in common.

    Returns (x, sigma), (lenslet_row, lenslet_column, point) each.
    docs/model.md, "Spatial reconstruction".
    """
    rows, columns = y.shape[:2]
    signals = y.reshape(rows * columns, -1).T
    w = lmmse.coordinates(signals)
    contrast = lmmse.contrast(w, common)
    scale = mean_scale(contrast)
    x, sigma = (
        found.T.reshape(rows, columns, -1)
        for found in both(
            lambda: lmmse.apply(signals, scale, w), lambda: spread(lmmse, w, contrast)
        )
    )

    def wider() -> float:
        border, weak = both(
            lambda: disagreement(x, sigma, shape), lambda: weak_power(lmmse, w, scale)
        )
        return float(np.exp(BY_WEAK * weak + BY_BORDER * (border - USUAL_BORDER)))

    return x, sigma * common("wider", wider, (lmmse.sigma, float(lmmse.noise.sum())))


def spread(lmmse: Lmmse, w: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """Standard deviation of each point given its superpixel, by the law of total variance over the
    contrast: the mean of what each contrast leaves, and what the estimate moves with it.

    w: (k, signal) coordinates.
    contrast: (scale, signal) probability of each of SCALES.

    Returns (point, signal).
    """
    logs, noise = np.log(SCALES), lmmse.noise[:, None]
    known = lmmse.gain**2 @ (1 / (lmmse.power[:, None] + noise / SCALES))
    left = (SCALES * np.maximum(lmmse.variance[:, None] - known, 0)) @ contrast
    middle = logs @ contrast
    doubt = np.maximum(logs**2 @ contrast - middle**2, 0)
    weaker = noise / np.exp(middle)
    moved = lmmse.gain @ (w * weaker / (lmmse.power[:, None] + weaker) ** 2)
    level = lmmse.even**2 @ np.sum(lmmse.levels**2, axis=1)
    return np.sqrt(left + moved**2 * doubt + lmmse.sigma**2 * level[:, None])


def weak_power(lmmse: Lmmse, w: np.ndarray, scale: np.ndarray) -> float:
    """Logarithm of the power that directions which hardly stand above the noise have over what
    photographs of this contrast have there: its mean given all signals, 0 where there are none.

    w: (k, signal) coordinates.
    scale: (signal,) factor of the photographs' covariance.
    """
    expected = np.outer(lmmse.power / lmmse.noise, scale)
    weak = expected <= HARDLY
    expected = expected[weak]
    found = (w**2 / lmmse.noise[:, None])[weak]
    logs = np.log(FACTORS)
    likelihood = np.array(
        [-0.5 * np.sum(np.log1p(f * expected) + found / (1 + f * expected)) for f in FACTORS]
    )
    likelihood -= 0.5 * (logs / SPREAD_OF_FACTOR) ** 2
    posterior = np.exp(likelihood - likelihood.max())
    return float(posterior @ logs / posterior.sum())


def disagreement(x: np.ndarray, sigma: np.ndarray, shape: tuple[int, int]) -> float:
    """Logarithm of the upper quartile of squared differences of adjacent points across lenslets'
    borders over the mean square of sigma; USUAL_BORDER where there is no border.

    x, sigma: (lenslet_row, lenslet_column, point).
    shape: points (rows, columns) of a block in one band.
    """
    picture = to_plane(x, shape)
    rows, columns = (np.arange(n, size, n) for n, size in zip(shape, picture.shape[-2:]))
    across = np.concatenate(
        [
            (picture[..., rows, :] - picture[..., rows - 1, :]).ravel(),
            (picture[..., columns] - picture[..., columns - 1]).ravel(),
        ]
    )
    if not across.size:
        return USUAL_BORDER
    return float(np.log(np.quantile(across**2, 0.75) / np.mean(sigma**2) + 1e-4))


def about(distance: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Standard deviations of a picture at some distance from LMMSE's.

    The truth is normal about LMMSE's picture with `sigma`; INTERVAL times the result each way about
    the other picture hold it with probability INSIDE: |N(distance, sigma^2)|, between
    sigma where the two agree and (|distance| + 1.645 sigma) / 1.96 far away.

    distance, sigma: of the same shape.
    """
    apart, radius = _radii()
    ratio = np.abs(distance) / np.maximum(sigma, np.finfo(float).tiny)
    far = np.maximum(ratio - apart[-1], 0)
    return sigma * (np.interp(ratio, apart, radius) + far) / INTERVAL


@lru_cache(maxsize=1)
def _radii() -> tuple[np.ndarray, np.ndarray]:
    """(distances, radii that hold INSIDE of a normal variable of deviation one about them)."""
    normal = np.vectorize(NormalDist().cdf)
    apart = np.linspace(0, 4, 81)
    low, high = np.zeros(81), apart + 3
    for _ in range(50):
        middle = (low + high) / 2
        short = normal(middle - apart) - normal(-middle - apart) < INSIDE
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return apart, (low + high) / 2
