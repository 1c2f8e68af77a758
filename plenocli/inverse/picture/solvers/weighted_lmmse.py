"""LMMSE over 3x3 lenslets from pixels of which each has a noise of its own, or none that counts:
what a real sensor gives.

Superpixels are whitened by the noise of a typical one and seen through the k vectors U that hold
what any scene of the prior can make of them: y = U z + n. Of n only U^T W (y - U m) and
J = U^T W U are needed, W the inverse variances of a superpixel's pixels, 0 where a pixel is
missing. With J = G G, G symmetric, and K the covariance of z over the ring,

    (I + G K G) b = G^+ U^T W (y - U m),      x = mean + cov(x, z) G b

is positive definite with any pixels missing, those of whole lenslets too.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.tiling import bands
from plenocli.inverse.picture.lenslet_model import Common, LensletMatrix, alone
from plenocli.inverse.picture.solvers.joint_lmmse import RING, ring_covariances

MOST = 96
"""Vectors through which a superpixel is seen at most."""
FAINT = 0.1
"""Of a pixel's noise, the signal over a whole superpixel from which on a vector is kept."""
LEAST = 1e-10
"""Of the most that pixels say of a vector, below which they say nothing."""
SCALES = 2.0 ** np.arange(-8, 5)
"""Factors of the scene's covariance that are tried."""
CHUNK = 64
"""Lenslets whose coordinates are worked out at a time."""
ROUNDS = 10
"""Of how common each of them is, and what it is for each lenslet, in turn."""


@dataclass(frozen=True, kw_only=True)
class Ringed:
    """What LMMSE makes of superpixels.

    value, sigma: (lenslet_row, lenslet_column, point), the picture and its standard deviation.
    superpixels: (lenslet_row, lenslet_column, pixel) A x, at missing pixels too.
    """

    value: np.ndarray
    sigma: np.ndarray
    superpixels: np.ndarray


@dataclass(frozen=True)
class Coordinates:
    """What superpixels say of their coordinates.

    root: (lenslet_row, lenslet_column, k, k) G.
    seen: (lenslet_row, lenslet_column, k) G^+ U^T W y.
    even: the same of an even object of 1.
    level: (lenslet_row, lenslet_column) brightness, least squares on even objects; 0 where no pixel
        counts.
    """

    root: np.ndarray
    seen: np.ndarray
    even: np.ndarray
    level: np.ndarray

    def around(self) -> np.ndarray:
        """Mean level of the lenslets within one ring that have one."""
        from scipy.ndimage import uniform_filter

        known = np.any(self.even != 0, axis=2).astype(float)
        size = 2 * RING + 1
        total = uniform_filter(self.level * known, size, mode="constant")
        count = uniform_filter(known, size, mode="constant")
        return np.where(count > 0, total / np.maximum(count, 0.5 / size**2), 0.0)


@dataclass(frozen=True, kw_only=True)
class WeightedLmmse:
    """LMMSE of a block from the superpixels within one ring, see `prepare_weighted`.

    even: (pixel,) superpixel of an even object of 1 that goes on next door.
    profile: (pixel,) noise of a typical superpixel.
    basis: (pixel, k) U, of whitened pixels.
    data: (9 k, 9 k) covariance of the ring's coordinates.
    cross: (point, 9 k) covariance of the block with them.
    variance: (point,) of the block.
    """

    even: np.ndarray
    profile: np.ndarray
    basis: np.ndarray
    data: np.ndarray
    cross: np.ndarray
    variance: np.ndarray

    def coordinates(self, y: np.ndarray, weight: np.ndarray) -> Coordinates:
        """Pixels and their weights as what they say of coordinates.

        y: (lenslet_row, lenslet_column, pixel).
        weight: like y, one over a pixel's variance, 0 for a pixel that counts for nothing.
        """
        shape, used = y.shape[:2], self.basis.shape[1]
        y, weight = (a.reshape(-1, a.shape[2]) for a in (y, weight))
        root = np.empty((len(y), used, used))
        seen, even, level = np.empty((len(y), used)), np.empty((len(y), used)), np.empty(len(y))
        for some in bands(len(y), CHUNK):
            root[some], seen[some], even[some], level[some] = self._told(y[some], weight[some])
        return Coordinates(*(a.reshape(*shape, *a.shape[1:]) for a in (root, seen, even, level)))

    def _told(self, y: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, ...]:
        """What Coordinates hold of some lenslets; y, weight: (lenslet, pixel)."""
        share = weight * self.profile**2
        known = weight > 0
        light = np.where(known, y, 0) / self.profile * share
        white = np.where(known, self.even, 0) / self.profile * share
        power_of_white = np.sum(white * self.even / self.profile, axis=1)
        level = np.sum(light * self.even / self.profile, axis=1)
        information = np.einsum("pk,lp,pj->lkj", self.basis, share, self.basis, optimize=True)
        power, turn = np.linalg.eigh(information)
        least = LEAST * power.max(axis=-1, keepdims=True) + np.finfo(float).tiny
        root = np.sqrt(np.where(power > least, power, 0))
        inverse = np.where(root > 0, 1 / np.where(root > 0, root, 1), 0)
        back = turn.swapaxes(-1, -2)
        return (
            (turn * root[..., None, :]) @ back,
            _each(turn, inverse * _each(back, light @ self.basis)),
            _each(turn, inverse * _each(back, white @ self.basis)),
            level / np.where(power_of_white > 0, power_of_white, 1.0),
        )

    def apply(
        self,
        found: Coordinates,
        scale: np.ndarray,
        *,
        only_superpixels: bool = False,
        lenslets: Iterable[tuple[int, int]] | None = None,
    ) -> Ringed:
        """The picture behind superpixels.

        found: their coordinates.
        scale: (lenslet_row, lenslet_column) factor of the scene's covariance around each.
        only_superpixels: leave out the standard deviation, which takes half of the time.
        lenslets: (row, column) of those that are wanted, None for all; the others are NaN.
        """
        from scipy.linalg import cho_solve, cholesky, solve_triangular

        rows, columns = found.level.shape
        used, levels = self.basis.shape[1], found.around()
        even = self.even / self.profile @ self.basis
        x, sigma = np.full((2, rows, columns, len(self.variance)), np.nan)
        made = np.full((rows, columns, len(self.even)), np.nan)
        for r, c in np.ndindex(rows, columns) if lenslets is None else lenslets:
            near = [
                (k, r + dr, c + dc)
                for k, (dr, dc) in enumerate(np.ndindex(2 * RING + 1, 2 * RING + 1))
                if 0 <= r + dr - RING < rows and 0 <= c + dc - RING < columns
            ]
            places = [(k, i - RING, j - RING) for k, i, j in near]
            root = np.stack([found.root[i, j] for _, i, j in places])
            seen = np.concatenate(
                [found.seen[i, j] - levels[r, c] * found.even[i, j] for _, i, j in places]
            )
            keep = (np.array([k for k, _, _ in places])[:, None] * used + np.arange(used)).ravel()
            data = scale[r, c] * self.data[np.ix_(keep, keep)]
            cross = scale[r, c] * self.cross[:, keep]
            own = keep.tolist().index((2 * RING * (RING + 1)) * used)
            factor = cholesky(_system(root, data), lower=True)
            spread = _spread(root, cho_solve((factor, True), seen))
            x[r, c] = levels[r, c] + cross @ spread
            z = levels[r, c] * even + data[own : own + used] @ spread
            made[r, c] = (self.basis @ z) * self.profile
            if only_superpixels:
                continue
            seen_by = solve_triangular(factor, _spread(root, cross.T), lower=True)
            explained = np.einsum("ij,ij->j", seen_by, seen_by)
            sigma[r, c] = np.sqrt(np.maximum(scale[r, c] * self.variance - explained, 0))
        return Ringed(value=x, sigma=sigma, superpixels=made)

    def contrasts(
        self,
        found: Coordinates,
        common: Common = alone,
        which: Any = None,
        counted: np.ndarray | None = None,
    ) -> np.ndarray:
        """Factors of the scene's covariance, one for each lenslet, from what it shows itself about
        its brightness: means of the logarithm, given how common each of SCALES is among all.

        found: coordinates of the superpixels.
        common, which: give how common each is, of superpixels that are a part.
        counted: (lenslet_row, lenslet_column), those of which it is; None for all.

        Returns (lenslet_row, lenslet_column), of the ring's mean where that is more; at most what
        an object has whose points are dark or as bright as the brightest lenslet of the ring.
        """
        from scipy.ndimage import maximum_filter, uniform_filter

        likely = self._likelihoods(found)
        likely = np.exp(likely - likely.max(axis=0))
        told = likely if counted is None else likely[:, counted.ravel()]
        share = common("contrasts", lambda: _shares(told), which)
        posterior = _given(share, likely)
        mean = np.exp(np.sum(posterior * np.log(SCALES)[:, None], axis=0))
        mean = mean.reshape(found.level.shape)
        mean = np.maximum(mean, uniform_filter(mean, 2 * RING + 1, mode="nearest"))
        brightest = maximum_filter(np.maximum(found.level, 0), 2 * RING + 1, mode="nearest")
        return np.clip(
            mean, SCALES[0], np.maximum(brightest**2 / 4 / self.variance.max(), SCALES[0])
        )

    def _likelihoods(self, found: Coordinates) -> np.ndarray:
        """Logarithms of how likely each of SCALES makes each lenslet, (scale, lenslet)."""
        used = self.basis.shape[1]
        middle = 2 * RING * (RING + 1) * used
        own = self.data[middle : middle + used, middle : middle + used]
        roots = found.root.reshape(-1, used, used)
        rest = (found.seen - found.level[..., None] * found.even).reshape(-1, used)
        likely = np.empty((len(SCALES), len(rest)))
        for some in bands(len(rest), CHUNK):
            power, turn = np.linalg.eigh(roots[some] @ own @ roots[some])
            square = _each(turn.swapaxes(-1, -2), rest[some]) ** 2
            total = 1 + SCALES[:, None, None] * np.maximum(power, 0)
            likely[:, some] = -0.5 * np.sum(np.log(total) + square / total, axis=-1)
        return likely


def _shares(likely: np.ndarray) -> np.ndarray:
    """How common each of SCALES is among lenslets, (scale,); likely: (scale, lenslet)."""
    share = np.full(len(SCALES), 1 / len(SCALES))
    for _ in range(ROUNDS - 1):
        share = np.maximum(_given(share, likely).mean(axis=1), 1e-6)
    return share


def _given(share: np.ndarray, likely: np.ndarray) -> np.ndarray:
    """Probabilities (scale, lenslet) of SCALES that are so common."""
    posterior = likely * share[:, None]
    return posterior / np.sum(posterior, axis=0)


def prepare_weighted(
    system: LensletMatrix,
    autocovariance: np.ndarray,
    profile: np.ndarray,
    bands: np.ndarray,
    *,
    most: int = MOST,
) -> WeightedLmmse:
    """Set up LMMSE from weighted pixels of 3x3 superpixels for a stationary scene.

    system: the matrix, neighbours' light included.
    autocovariance: of plenocli.inverse.prior.natural_images.autocovariance, lags up to
        plenocli.inverse.picture.solvers.joint_lmmse.needed_reach.
    profile: (pixel,) noise of a typical superpixel, > 0.
    bands: (band, band) covariance of the bands at a point, its diagonal about 1.
    most: vectors of a superpixel at most.

    docs/model.md, "Real light".
    """
    blocks = np.asarray(system.blocks, float)
    basis = _basis(blocks / profile[:, None], system.object_shape, autocovariance, bands, most)
    response = np.stack([basis.T @ (block / profile[:, None]) for block in blocks])
    data, cross = ring_covariances(
        response, np.asarray(system.offsets, int), system.object_shape, autocovariance, bands
    )
    middle = autocovariance.shape[0] // 2
    return WeightedLmmse(
        even=blocks.sum(axis=(0, 2)),
        profile=profile,
        basis=basis,
        data=data,
        cross=cross,
        variance=np.repeat(
            np.diag(bands) * autocovariance[middle, middle], int(np.prod(system.object_shape))
        ),
    )


def _basis(
    blocks: np.ndarray,
    shape: tuple[int, int],
    autocovariance: np.ndarray,
    bands: np.ndarray,
    most: int,
) -> np.ndarray:
    """(pixel, k) orthonormal: an even object's superpixel, then what scenes make of one, the
    strongest first.

    blocks: (offset, pixel, point) whitened.
    """
    reach = autocovariance.shape[0] // 2
    place = np.indices(shape).reshape(2, -1)
    lag = place[:, :, None] - place[:, None, :]
    power, turn = np.linalg.eigh(np.kron(bands, autocovariance[lag[0] + reach, lag[1] + reach]))
    root = turn * np.sqrt(np.maximum(power, 0))
    made = np.sum([(block @ root) @ (block @ root).T for block in blocks], axis=0)
    strength, vectors = np.linalg.eigh(made)
    used = max(1, min(most, int(np.count_nonzero(strength > FAINT**2))))
    even = blocks.sum(axis=(0, 2))[:, None]
    return np.linalg.qr(np.concatenate([even, vectors[:, ::-1][:, :used]], axis=1))[0]


def _system(root: np.ndarray, data: np.ndarray) -> np.ndarray:
    """I + G K G of a ring.

    root: (lenslet, k, k).
    data: (lenslet times k, lenslet times k).
    """
    count, used = root.shape[:2]
    blocks = data.reshape(count, used, count, used).swapaxes(1, 2)
    product = (root[:, None] @ blocks @ root[None]).swapaxes(1, 2).reshape(data.shape)
    return np.eye(len(data)) + (product + product.T) / 2


def _spread(root: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """G times vectors (lenslet times k, ..)."""
    return (root @ vectors.reshape(*root.shape[:2], -1)).reshape(vectors.shape)


def _each(matrices: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    return (matrices @ vectors[..., None])[..., 0]
