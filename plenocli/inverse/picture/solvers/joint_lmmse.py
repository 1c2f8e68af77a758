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

from plenocli.inverse.picture.lenslet_model import Common, Keep, alone, work_out
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import given, require_noise, usual

RING = 1
MOST = 96
"""Directions through which a superpixel is seen at most. With all 160 that photographs show at
60 dB the picture gains 0.07 dB, for three times the time.
"""
CONTRASTS = 2.0 ** np.arange(-5, 5)
"""Scales of the covariance of which `JointLmmse.apply` takes a mean."""
LOUD = 0.005
"""Power of a direction of a superpixel over that of the noise, from which on it is worth a look:
photographs of sixteen times the usual variance then add a twelfth to the noise.
"""
FAINT = 1e-9
"""Power that a direction may have at most, over that of the strongest, of those that are not looked
at whatever the noise.
"""


@dataclass(frozen=True, kw_only=True)
class JointLmmse:
    """LMMSE of a block from the superpixels within one ring, see `prepare_joint`.

    mean: of the scene.
    analysis, offset: (k, pixel) and (k,), a superpixel to its coordinates, in terms of their noise.
    cross: (point, 9 k) covariance of the block with the coordinates of the ring.
    data: (9 k, 9 k) covariance of these, but for the noise.
    variance: (point,) of the block.
    """

    mean: float
    analysis: np.ndarray
    offset: np.ndarray
    cross: np.ndarray
    data: np.ndarray
    variance: np.ndarray

    def apply(
        self, y: np.ndarray, common: Common = alone
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The picture behind superpixels whose contrast differs from place to place.

        The covariance about each lenslet is that of photographs times an unknown scale, the same
        over its ring: a Gaussian scale mixture (Portilla, Strela, Wainwright, Simoncelli, IEEE
        Trans. Image Processing 12 (2003) 1338). The estimate is the posterior mean over CONTRASTS,
        their prior a normal distribution of the logarithm fitted to all lenslets, as in
        lmmse.Lmmse.contrast, but with what all nine superpixels say.

        Beyond the array's border there is nothing to look at: blocks there use the superpixels that
        exist. Light from outside the array is taken to have the scene's mean and covariance.

        y: (lenslet_row, lenslet_column, pixel).
        common: gives that distribution, of lenslets that are a part.

        Returns (x, its standard deviation, scale), (lenslet_row, lenslet_column, point) and
        (lenslet_row, lenslet_column), the scale the mean of its logarithm.
        """
        groups = self._alike(y)
        turned = [self._turned(group) for group in groups]
        likelihood = np.empty((len(CONTRASTS), *y.shape[:2]))
        for group, (power, _, seen) in zip(groups, turned):
            for k, scale in enumerate(CONTRASTS):
                expected = scale * power + 1
                likelihood[k][group.at] = -0.5 * (np.log(expected).sum() + (1 / expected) @ seen**2)
        likelihood = np.exp(likelihood - likelihood.max(axis=0)).reshape(len(CONTRASTS), -1)
        which = ("joint", float(np.trace(self.data)))
        prior = common("contrasts", lambda: usual(likelihood, CONTRASTS, 0.5), which)
        share = given(prior, likelihood).reshape(-1, *y.shape[:2])
        x, sigma = np.empty((2, *y.shape[:2], len(self.variance)))
        for group, (power, gain, seen) in zip(groups, turned):
            shares = share[:, group.at[0], group.at[1]]
            shrink = 1 / (power + 1 / CONTRASTS[:, None])
            middle = gain @ (seen * (shrink.T @ shares))
            variance = np.zeros_like(middle)
            for scale, taken, part in zip(CONTRASTS, shares, shrink):
                left = scale * np.maximum(self.variance - gain**2 @ part, 0)
                apart = gain @ (seen * part[:, None]) - middle
                variance += taken * (left[:, None] + apart**2)
            x[group.at], sigma[group.at] = self.mean + middle.T, np.sqrt(variance).T
        return x, sigma, np.exp(np.tensordot(np.log(CONTRASTS), share, 1))

    def _turned(self, group: _Alike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(power (k,), gain (point, k), coordinates (k, lenslet)) in the eigenvectors of the
        signal's covariance, where those of a group have the variance scale power + 1.
        """
        power, vectors = np.linalg.eigh(self.data[np.ix_(group.kept, group.kept)])
        return (
            np.maximum(power, 0),
            self.cross[:, group.kept] @ vectors,
            vectors.T @ group.z,
        )

    def _alike(self, y: np.ndarray) -> list[_Alike]:
        """The lenslets of superpixels y in groups that have the same neighbours."""
        rows, columns = y.shape[:2]
        z, ring = y @ self.analysis.T - self.offset, _ring(RING)
        groups: dict[tuple[bool, ...], list[tuple[int, int]]] = {}
        for r in range(rows):
            for c in range(columns):
                inside = tuple(0 <= r + dr < rows and 0 <= c + dc < columns for dr, dc in ring)
                groups.setdefault(inside, []).append((r, c))
        found = []
        for inside, lenslets in groups.items():
            near = [d for d, there in zip(ring, inside) if there]
            found.append(
                _Alike(
                    at=(np.array([r for r, _ in lenslets]), np.array([c for _, c in lenslets])),
                    kept=np.flatnonzero(np.repeat(inside, self.analysis.shape[0])),
                    z=np.stack(
                        [
                            np.concatenate([z[r + dr, c + dc] for dr, dc in near])
                            for r, c in lenslets
                        ],
                        axis=1,
                    ),
                )
            )
        return found


@dataclass(frozen=True)
class _Alike:
    """Lenslets that have the same neighbours.

    at: (rows, columns) of the lenslets.
    kept: coordinates of the ring that there are.
    z: (k, lenslet) their values.
    """

    at: tuple[np.ndarray, np.ndarray]
    kept: np.ndarray
    z: np.ndarray


def prepare_joint(
    directions: np.ndarray,
    blocks: np.ndarray,
    offsets: np.ndarray,
    object_shape: tuple[int, int],
    mean: float,
    autocovariance: np.ndarray,
    sigma: float,
    bands: np.ndarray | Sequence[Sequence[float]] = ((1.0,),),
    *,
    keep: Keep = work_out,
) -> JointLmmse:
    """Set up LMMSE from 3x3 superpixels for a stationary scene.

    Superpixels are seen through `directions`: a linear reduction of the data, for which the
    estimate is exact, neighbours' light included. Covariances are inner products of each
    direction's footprint on the object with the footprints filtered by the autocovariance (FFT).

    directions: (pixel, k) orthonormal, see `shown_directions`.
    blocks, offsets: (offset, pixel, point) and (offset, 2) as in BlockToeplitz, points of several
        bands one band after the other.
    object_shape: points (rows, columns) of a block in one band.
    mean, autocovariance: of plenocli.inverse.prior.natural_images.autocovariance, lags up to
        `needed_reach`.
    sigma: noise of a pixel, > 0.
    bands: (band, band) covariance of the bands at a point, its diagonal about 1.
    keep: of the covariances, whatever the noise.

    Raises NumericsError where sigma is not positive.
    docs/model.md, "Spatial reconstruction".
    """
    require_noise(sigma)
    offsets, bands = np.asarray(offsets, int), np.asarray(bands, float)
    rows, columns = object_shape
    analysis = directions.T
    response = np.stack([analysis.astype(block.dtype) @ block for block in blocks]).astype(float)
    strength = np.abs(autocovariance).sum() * np.linalg.eigvalsh(bands)[-1]
    noise = np.sqrt(sigma**2 + _rounding(response, strength))
    data, cross = keep(
        "ring",
        [response, offsets, np.array(object_shape), autocovariance, bands],
        lambda: ring_covariances(response, offsets, object_shape, autocovariance, bands),
    )
    each = np.tile(noise, len(_ring(RING)))
    middle = autocovariance.shape[0] // 2
    return JointLmmse(
        mean=mean,
        analysis=analysis / noise[:, None],
        offset=mean * response.sum(axis=(0, 2)) / noise,
        cross=cross / each,
        data=data / np.outer(each, each),
        variance=np.repeat(np.diag(bands) * autocovariance[middle, middle], rows * columns),
    )


def least_power(svd: Svd, covariance: np.ndarray, sigma: float, bands: np.ndarray) -> float:
    """Power below which no direction of a superpixel is looked at: the same for all noise that is
    not below FAINT.

    svd, covariance, bands: as in `shown_directions`.
    sigma: noise of a pixel.
    """
    require_noise(sigma)
    return min(LOUD * sigma**2, FAINT * float(_strength(svd, covariance, bands)[0]))


def _strength(svd: Svd, covariance: np.ndarray, bands: np.ndarray) -> np.ndarray:
    """Bounds of the power of photographs in the directions of a decomposition."""
    return svd.s**2 * np.trace(covariance) * np.linalg.eigvalsh(bands)[-1]


def shown_directions(
    svd: Svd, covariance: np.ndarray, least: float, bands: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Directions of a superpixel in which photographs have more than `least` power.

    svd: of the own block.
    covariance: (point, point) of fields of photographs in one band.
    bands: (band, band) covariance of the bands at a point.

    Returns (k,) their power, ascending, and (pixel, k), orthonormal; one at least.
    """
    strength = _strength(svd, covariance, bands)
    used = max(1, min(int(np.count_nonzero(strength > least)), svd.rank()))
    seen = svd.s[:used, None] * svd.vt[:used]
    pulled = seen.reshape(used, len(bands), -1) @ covariance
    pulled = np.einsum("ab,kbp->kap", bands, pulled).reshape(seen.shape)
    power, vectors = np.linalg.eigh(pulled @ seen.T)
    kept = power > min(least, power[-1] / 2)
    return power[kept], svd.u[:, :used] @ vectors[:, kept]


def ring_covariances(
    response: np.ndarray,
    offsets: np.ndarray,
    object_shape: tuple[int, int],
    autocovariance: np.ndarray,
    bands: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """What a stationary scene makes of the superpixels within one ring, without noise.

    response: (offset, k, point) objects to the k coordinates of a superpixel, points of several
        bands one band after the other.
    offsets, object_shape, autocovariance: as in `prepare_joint`.
    bands: (band, band) covariance of the bands at a point.

    Returns (9 k, 9 k), the covariance of the ring's coordinates, and (point, 9 k), that of the
    middle object with them.
    """
    used = response.shape[1]
    footprint = _footprints(response, offsets, object_shape, used * len(bands))
    return _covariances(footprint, autocovariance, bands, used, object_shape)


def _covariances(
    footprint: np.ndarray,
    autocovariance: np.ndarray,
    bands: np.ndarray,
    used: int,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """(data, cross) of JointLmmse, without noise.

    footprint: (coordinate times band, row, column).
    autocovariance: of the scene.
    bands: (band, band) covariance of the bands at a point.
    used: coordinates of a superpixel.
    shape: (rows, columns) of an object in one band.
    """
    (rows, columns), flat, ring = shape, footprint.reshape(used, -1), _ring(RING)
    # larger by 2 RING objects on each side
    filtered = _filter(footprint, autocovariance, 2 * RING * np.array(shape))
    if len(bands) > 1 or bands[0, 0] != 1:
        filtered = np.einsum(
            "ab,kbrc->karc", bands, filtered.reshape(used, len(bands), *filtered.shape[1:])
        ).reshape(filtered.shape)

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


def _rounding(response: np.ndarray, strength: float) -> np.ndarray:
    """(coordinate,) variance that rounding may have taken away, in proportion to each coordinate's
    light: almost without noise the covariance of the data would be none.

    response: (offset, coordinate, point).
    strength: magnitude of the scene's covariance, summed.
    """
    size = len(_ring(RING)) * response.shape[1]
    light = np.einsum("oij,oij->i", response, response)
    return size * np.finfo(float).eps * strength * light


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
