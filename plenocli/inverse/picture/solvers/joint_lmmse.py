"""Reconstruction that looks over the lenslet's edge: light that neighbours send, and scenes
that go on next door.

The paper removes block edges "by performing object reconstruction from 3x3 lenslet areas and then
averaging" (Berkner et al. 2013, section 3-2). Where only own superpixels are modelled, the 3x3
system falls apart into nine single ones and least squares gains nothing from it: what couples
neighbours is the light between them and the prior. So LMMSE estimates each block from the nine
superpixels around it, with the covariance of the scene across lenslets; the other methods work on
superpixels from which the neighbours' light, as that estimate predicts it, is taken away. No
3x3 matrix is formed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import require_noise

RING = 1
MOST = 256
"""Singular vectors through which a superpixel is seen at most."""


@dataclass(frozen=True, kw_only=True)
class JointLmmse:
    """LMMSE of a block from the superpixels within one ring, see `prepare_joint`.

    mean: of the scene.
    analysis, offset: (k, pixel) and (k,), a superpixel to its coordinates.
    cross: (point, 9 k) covariance of the block with the coordinates of the ring.
    data: (9 k, 9 k) covariance of these.
    variance: (point,) of the block.
    """

    mean: float
    analysis: np.ndarray
    offset: np.ndarray
    cross: np.ndarray
    data: np.ndarray
    variance: np.ndarray

    def apply(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The picture behind superpixels.

        Beyond the array's border there is nothing to look at: blocks there use the superpixels that
        exist. Light from outside the array is taken to have the scene's mean and covariance.

        y: (lenslet_row, lenslet_column, pixel).

        Returns (x, its standard deviation), both (lenslet_row, lenslet_column, point).
        """
        from scipy.linalg import cholesky, solve_triangular

        rows, columns = y.shape[:2]
        z = y @ self.analysis.T - self.offset
        x, sigma = np.empty((2, rows, columns, len(self.variance)))
        ring = _ring(RING)
        alike: dict[tuple[bool, ...], list[tuple[int, int]]] = {}
        for r in range(rows):
            for c in range(columns):
                inside = tuple(0 <= r + dr < rows and 0 <= c + dc < columns for dr, dc in ring)
                alike.setdefault(inside, []).append((r, c))
        used = self.analysis.shape[0]
        for inside, lenslets in alike.items():
            keep = np.flatnonzero(np.repeat(inside, used))
            cross = self.cross[:, keep]
            factor = cholesky(self.data[np.ix_(keep, keep)], lower=True)
            whitened = solve_triangular(factor, cross.T, lower=True)
            near = [d for d, there in zip(ring, inside) if there]
            seen = np.stack(
                [np.concatenate([z[r + dr, c + dc] for dr, dc in near]) for r, c in lenslets],
                axis=1,
            )
            estimate = self.mean + whitened.T @ solve_triangular(factor, seen, lower=True)
            error = np.sqrt(
                np.maximum(self.variance - np.einsum("ij,ij->j", whitened, whitened), 0)
            )
            for k, (r, c) in enumerate(lenslets):
                x[r, c], sigma[r, c] = estimate[:, k], error
        return x, sigma


def prepare_joint(
    svd: Svd,
    blocks: np.ndarray,
    offsets: np.ndarray,
    object_shape: tuple[int, int],
    mean: float,
    autocovariance: np.ndarray,
    sigma: float,
    bands: np.ndarray | Sequence[Sequence[float]] = ((1.0,),),
    *,
    most: int = MOST,
) -> JointLmmse:
    """Set up LMMSE from 3x3 superpixels for a stationary scene.

    Superpixels are seen through left singular vectors of A_0, those whose signal can exceed a
    hundredth of the noise: a linear reduction of the data, for which the estimate is exact,
    neighbours' light included. Covariances are inner products of each vector's footprint on the
    object with the footprints filtered by the autocovariance (FFT).

    svd: of the own block A_0.
    blocks, offsets: (offset, pixel, point) and (offset, 2) as in BlockToeplitz, points of several
        bands one band after the other.
    object_shape: points (rows, columns) of a block in one band.
    mean, autocovariance: of plenocli.inverse.prior.natural_images.autocovariance, lags up to
        `needed_reach`.
    sigma: noise of a pixel, > 0.
    bands: (band, band) covariance of the bands at a point, its diagonal about 1.
    most: singular vectors at most.

    Raises NumericsError where sigma is not positive.
    docs/model.md, "Spatial reconstruction".
    """
    require_noise(sigma)
    offsets, bands = np.asarray(offsets, int), np.asarray(bands, float)
    (rows, columns), count = object_shape, len(bands)
    brightest = np.linalg.eigvalsh(bands)[-1]
    strength = svd.s**2 * np.abs(autocovariance).max() * brightest * rows * columns
    used = max(1, min(int(np.count_nonzero(strength > 1e-4 * sigma**2)), most, svd.rank()))
    analysis = svd.u[:, :used].T
    response = np.stack([analysis @ block for block in np.asarray(blocks, float)])
    footprint = _footprints(response, offsets, object_shape, used * count)
    margin = 2 * RING * np.array([rows, columns])
    filtered = _filter(footprint, autocovariance, margin)
    if count > 1 or bands[0, 0] != 1:
        filtered = np.einsum(
            "ab,kbrc->karc", bands, filtered.reshape(used, count, *filtered.shape[1:])
        ).reshape(filtered.shape)

    data, cross = _covariances(footprint, filtered, used, object_shape)
    rounding = _rounding(footprint.reshape(used, -1), np.abs(autocovariance).sum(), brightest)
    data[np.diag_indices(len(data))] += sigma**2 + np.tile(rounding, len(data) // used)
    middle = autocovariance.shape[0] // 2
    return JointLmmse(
        mean=mean,
        analysis=analysis,
        offset=mean * response.sum(axis=(0, 2)),
        cross=cross,
        data=data,
        variance=np.repeat(np.diag(bands) * autocovariance[middle, middle], rows * columns),
    )


def _covariances(
    footprint: np.ndarray, filtered: np.ndarray, used: int, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """(data, cross) of JointLmmse, without noise.

    footprint: (coordinate times band, row, column).
    filtered: the same, filtered by the scene's covariance and larger by 2 RING objects on each
        side.
    used: coordinates of a superpixel.
    shape: (rows, columns) of an object in one band.
    """
    (rows, columns), flat, ring = shape, footprint.reshape(used, -1), _ring(RING)

    def shifted(dr: int, dc: int) -> np.ndarray:
        """The filtered footprints as seen by a lenslet (dr, dc) from the one whose
        footprints they are.
        """
        r, c = (2 * RING + dr) * rows, (2 * RING + dc) * columns
        return filtered[:, r : r + footprint.shape[1], c : c + footprint.shape[2]]

    by_shift = {d: flat @ shifted(*d).reshape(used, -1).T for d in _ring(2 * RING)}
    data = np.block([[by_shift[(a[0] - b[0], a[1] - b[1])] for b in ring] for a in ring])
    r, c = (footprint.shape[1] - rows) // 2, (footprint.shape[2] - columns) // 2
    own = np.s_[:, r : r + rows, c : c + columns]
    cross = np.concatenate([shifted(-dr, -dc)[own].reshape(used, -1) for dr, dc in ring]).T
    return (data + data.T) / 2, cross


def _rounding(footprint: np.ndarray, strength: float, brightest: float) -> np.ndarray:
    """(coordinate,) variance that rounding may have taken away, in proportion to each coordinate's
    light: almost without noise the covariance of the data would be none.

    footprint: (coordinate, point).
    strength, brightest: magnitudes of the scene's covariance, summed, and of the bands'.
    """
    size = len(_ring(RING)) * len(footprint)
    light = np.einsum("ij,ij->i", footprint, footprint)
    return size * np.finfo(float).eps * strength * brightest * light


def _ring(reach: int) -> list[tuple[int, int]]:
    """Lenslets (rows, columns) up to `reach` away, the middle one included."""
    steps = range(-reach, reach + 1)
    return [(dr, dc) for dr in steps for dc in steps]


def _footprints(
    response: np.ndarray, offsets: np.ndarray, shape: tuple[int, int], count: int
) -> np.ndarray:
    """(footprint, row, column) what each coordinate sees of the objects around.

    response: (offset, coordinate, point).
    shape: (rows, columns) of an object in one band.
    count: coordinates times bands.
    """
    rows, columns = shape
    reach = int(np.abs(offsets).max(initial=0))
    side = 2 * reach + 1
    footprint = np.zeros((count, side * rows, side * columns))
    for block, (dr, dc) in zip(response, offsets):
        r, c = (reach - dr) * rows, (reach - dc) * columns
        footprint[:, r : r + rows, c : c + columns] += block.reshape(-1, rows, columns)
    return footprint


def needed_reach(object_shape: tuple[int, int], offsets: np.ndarray) -> int:
    """Largest lag (points) of the autocovariance that `prepare_joint` can use."""
    reach = int(np.abs(np.asarray(offsets)).max(initial=0))
    return (2 * RING + 2 * reach + 1) * max(object_shape) - 1


def _filter(footprint: np.ndarray, autocovariance: np.ndarray, margin: np.ndarray) -> np.ndarray:
    """footprint convolved with the autocovariance, on its own grid enlarged by
    `margin` on each side.
    """
    from scipy.fft import irfft2, next_fast_len, rfft2

    reach = autocovariance.shape[0] // 2
    out = [n + 2 * m for n, m in zip(footprint.shape[1:], margin)]
    shape = [next_fast_len(n + o, real=True) for n, o in zip(footprint.shape[1:], out)]
    kernel = np.zeros(shape)
    lags = [np.arange(-min(reach, s // 2 - 1), min(reach, s // 2 - 1) + 1) for s in shape]
    kernel[np.ix_(*lags)] = autocovariance[np.ix_(*(lag + reach for lag in lags))]
    spectrum = rfft2(kernel)
    filtered = np.empty((len(footprint), *out))
    rows, columns = (np.arange(-m, n + m) for n, m in zip(footprint.shape[1:], margin))
    for k, plane in enumerate(footprint):
        filtered[k] = irfft2(rfft2(plane, shape) * spectrum, shape)[np.ix_(rows, columns)]
    return filtered
