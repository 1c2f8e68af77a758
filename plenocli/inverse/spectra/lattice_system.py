"""Least squares over a lattice of lenslets that all answer alike: y_l = sum_o F_o b_(l-o) + noise.

With stationary weights 1/v the normal equations are a convolution, and a Fourier transform over
lenslets leaves one small system for each frequency. Beyond the array lenslets are taken to be
mirrored. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plenocli.inverse.spectra.field_modes import EVEN, FieldModes

PAD = 4
"""Mirrored lenslets on each side, at least."""
IMPULSE = 16
"""Lenslets a side of the lattice on which what one pixel does to the answer is computed."""
FAINT = 1e-4
"""Of the strongest direction of a superpixel, over the noise: fainter ones are not looked along."""
UNTOLD = 1e-3
"""Variance that a direction has beforehand, over the noise's, below which it tells nothing."""


@dataclass(frozen=True, kw_only=True)
class PointPrior:
    """Values of object points that are alike where they are near: normal, of mean `mean` and
    covariance C rho^(fields apart down + across).

    mean: (band,).
    inverse: (band, band), of C.
    rho: correlation of points a field apart.
    modes: of a field, which are known of them.
    """

    mean: np.ndarray
    inverse: np.ndarray
    rho: float
    modes: FieldModes = EVEN

    @property
    def even(self) -> np.ndarray:
        """The mean of the unknowns (mode * band,)."""
        return np.outer(self.modes.even, self.mean).ravel()

    @property
    def spread(self) -> np.ndarray:
        """Standard deviations of the unknowns (mode * band,)."""
        axis = np.diagonal(self._near())
        modes = np.prod(axis[self.modes.kept], axis=1)
        return np.sqrt(np.outer(modes, np.diagonal(np.linalg.inv(self.inverse)))).ravel()

    def precision(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Inverse covariance of modes at frequencies (n,) and (m,), radians a lenslet, all bands
        alike: (n, m, mode, mode) complex.
        """
        down, across = (self._axis(one) for one in (rows, columns))
        first, second = (np.ix_(one, one) for one in self.modes.kept.T)
        covariance = down[:, None, *first] * across[None, :, *second]
        return np.linalg.inv(covariance)

    def _axis(self, frequency: np.ndarray) -> np.ndarray:
        """Covariance of patterns along one axis at frequencies (n,): (n, pattern, pattern)."""
        place = np.arange(self.modes.points) / self.modes.points
        before = self.modes.weights @ self._alike(1 + place[:, None] - place) @ self.modes.weights.T
        turn = np.exp(-1j * frequency)[:, None, None]
        out = before * turn / (1 - self.rho * turn)
        return self._near() + out + out.conj().swapaxes(1, 2)

    def _near(self) -> np.ndarray:
        """Covariance of patterns along an axis of one field."""
        place = np.arange(self.modes.points) / self.modes.points
        alike = self._alike(np.abs(place[:, None] - place))
        return np.asarray(self.modes.weights @ alike @ self.modes.weights.T)

    def _alike(self, apart: np.ndarray) -> np.ndarray:
        return np.power(float(self.rho), apart)

    def pull(self, b: np.ndarray, precision: np.ndarray) -> np.ndarray:
        """Precision times (mean - b), b (row, column, unknown) on a periodic lattice, as rfft2.

        precision: at the frequencies of rfft2.
        """
        from scipy.fft import rfft2

        apart = rfft2((self.even - b).astype(np.float32), axes=(0, 1))
        found = precision @ apart.reshape(*apart.shape[:2], -1, len(self.mean)) @ self.inverse
        return found.reshape(apart.shape)


class LatticeSystem:
    """The system of one array; arrays `inner` are (lenslet_row, lenslet_column, ...), padded ones
    go on beyond.

    blocks: F_o (block, pixel, unknown).
    offsets: (block, 2), o: superpixels from the lenslet.
    variance: v (pixel,), inf where a pixel says nothing.
    shape: rows and columns of lenslets.
    prior: of the unknowns, modes times bands; None: one value a band, and no prior.
    """

    def __init__(
        self,
        blocks: np.ndarray,
        offsets: np.ndarray,
        variance: np.ndarray,
        shape: tuple[int, int],
        prior: PointPrior | None = None,
    ) -> None:
        """Set the system up; nothing is solved yet."""
        from scipy.fft import next_fast_len

        self.offsets, self.shape, self.prior = offsets, shape, prior
        self.unknowns = blocks.shape[-1]
        self.modes = EVEN if prior is None else prior.modes
        self.padded = tuple(next_fast_len(n + 2 * PAD, real=True) for n in shape)
        there = np.concatenate(list(blocks.swapaxes(1, 2)))
        gram = (there / variance) @ there.T
        self._there = there.astype(np.float32)
        self._apart, self._products = _stencil(gram, offsets)
        spread = np.ones(len(gram)) if prior is None else np.tile(prior.spread, len(offsets))
        power, turn = np.linalg.eigh(spread[:, None] * gram * spread)
        strong = power > (FAINT**2 * power[-1] if prior is None else UNTOLD)
        turn, size = turn[:, strong], np.sqrt(power[strong])
        self._seen = (turn * size / spread[:, None]).astype(np.float32)
        self._look = (there.T / variance[:, None] @ (turn * spread[:, None] / size)).astype(
            np.float32
        )

    def mirrored(self, inner: np.ndarray) -> np.ndarray:
        """Unknowns (rows, columns, unknown) as a padded array, object points mirrored."""
        places, turned = zip(*(_beyond(n, size) for n, size in zip(self.shape, self.padded)))
        x = inner[np.ix_(*places)]
        if len(self.modes.kept) > 1:
            x = x.reshape(*self.padded, len(self.modes.kept), -1)
            down, across = self.modes.mirrored
            x[turned[0]] = down @ x[turned[0]]
            x[:, turned[1]] = across @ x[:, turned[1]]
        return x.reshape(*self.padded, -1)

    def inner(self, padded: np.ndarray) -> np.ndarray:
        """The part of a padded array that is the lenslets'."""
        return padded[PAD : PAD + self.shape[0], PAD : PAD + self.shape[1]]

    def forward(self, b: np.ndarray) -> np.ndarray:
        """Superpixels (rows, columns, pixel) float32 of padded unknowns."""
        return self._gathered(b) @ self._there

    def directions(self, values: np.ndarray) -> np.ndarray:
        """What superpixels (..., pixel) show along the few directions in which unknowns act on
        them, of unit noise: (..., direction).
        """
        return values.astype(np.float32, copy=False) @ self._look

    def left(self, told: np.ndarray, b: np.ndarray, masked: np.ndarray) -> np.ndarray:
        """What padded unknowns do not explain of directions (rows, columns, direction).

        masked: (rows, columns, pixel) superpixels, NaN where they are not known; of those that
            lack none `told` counts.
        """
        gathered = self._gathered(b)
        out = told - gathered @ self._seen
        some = np.isnan(masked).any(axis=-1)
        if some.any():
            out[some] = self.directions(np.nan_to_num(masked[some] - gathered[some] @ self._there))
        return out

    def _gathered(self, b: np.ndarray) -> np.ndarray:
        """Padded unknowns that reach each superpixel: (rows, columns, block * unknown) float32."""
        rows, columns = self.shape
        out = np.empty((rows, columns, len(self.offsets), self.unknowns), np.float32)
        for k, (down, across) in enumerate(self.offsets):
            top, left = PAD - down, PAD - across
            out[:, :, k] = b[top : top + rows, left : left + columns]
        return out.reshape(rows, columns, -1)

    def back(self, told: np.ndarray) -> np.ndarray:
        """A^T V^-1 of superpixels by their directions, padded."""
        rows, columns = self.shape
        parts = told @ self._seen.T
        parts = parts.reshape(rows, columns, len(self.offsets), self.unknowns)
        out = np.zeros((*self.padded, self.unknowns))
        for k, (down, across) in enumerate(self.offsets):
            top, left = PAD - down, PAD - across
            out[top : top + rows, left : left + columns] += parts[:, :, k]
        return out

    def normal(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """A^T V^-1 A and the prior's precision at frequencies, radians a lenslet.

        Returns (len(rows), len(columns), unknown, unknown) complex64.
        """
        out = self._information(rows, columns)
        if self.prior is None:
            return out
        before = self.prior.precision(rows, columns).astype(np.complex64)
        return out + np.kron(before, self.prior.inverse.astype(np.float32))

    def _information(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        phases = [
            np.exp(-1j * np.multiply.outer(k, self._apart[:, axis]))
            for axis, k in enumerate((rows, columns))
        ]
        phase = (phases[0][:, None] * phases[1][None]).astype(np.complex64)
        out = phase @ self._products.reshape(len(self._apart), -1)
        return out.reshape(len(rows), len(columns), self.unknowns, self.unknowns)

    @property
    def _frequencies(self) -> tuple[np.ndarray, np.ndarray]:
        rows, columns = self.padded
        return 2 * np.pi * np.fft.fftfreq(rows), 2 * np.pi * np.fft.rfftfreq(columns)

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Of `normal`, at the frequencies of the padded array: every step takes it, and what its
        rounding leaves, the next one finds.
        """
        return _inverted(self.normal(*self._frequencies))

    @cached_property
    def _before(self) -> np.ndarray | None:
        """The prior's precision at the same frequencies."""
        if self.prior is None:
            return None
        return self.prior.precision(*self._frequencies).astype(np.complex64)

    def solve(self, right: np.ndarray, pull: np.ndarray | float = 0.0) -> np.ndarray:
        """N^-1 of a padded array, and of what is added to its spectrum."""
        from scipy.fft import irfft2, rfft2

        spectrum = rfft2(right.astype(np.float32), axes=(0, 1)) + pull
        found = (self._inverse @ spectrum[..., None])[..., 0]
        return irfft2(found, s=self.padded, axes=(0, 1)).astype(float)

    def step(self, left: np.ndarray, b: np.ndarray) -> np.ndarray:
        """What unknowns b, padded, lack: inner.

        left: of the superpixels' directions.
        """
        pull: np.ndarray | float = 0.0
        if self.prior is not None and self._before is not None:
            pull = self.prior.pull(b, self._before)
        return self.inner(self.solve(self.back(left), pull))

    def surprise(self, left: np.ndarray, points: np.ndarray, prior: PointPrior) -> float:
        """-2 ln of the evidence a lenslet (but for what all systems of a capture share): what is
        left over of the data, how far the answer is from its prior, and how much of the prior the
        data rule out.

        left: of the superpixels, over the noise's standard deviation.
        points: the answer, inner.
        prior: the system's, or one for a system that was solved without.
        """
        from scipy.fft import irfft2

        frequency = 2 * np.pi * np.fft.fftfreq(IMPULSE)
        before = np.kron(prior.precision(frequency, frequency), prior.inverse)
        after = self._information(frequency, frequency) + before
        ruled_out = np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]
        pulled = prior.pull(self.mirrored(points), prior.precision(*self._frequencies))
        pull = self.inner(irfft2(pulled, s=self.padded, axes=(0, 1)))
        apart = points - prior.even
        lenslets = self.shape[0] * self.shape[1]
        return float(((left**2).sum() - (apart * pull).sum()) / lenslets + ruled_out.mean())

    @cached_property
    def impulse(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a pixel of superpixel l + d adds to the band values (mean over points) of lenslet l.

        Returns d (n, 2); h (n, band, pixel); and (band,) the variance that the prior leaves beside
        the noise of variance v.
        """
        frequency = 2 * np.pi * np.fft.fftfreq(IMPULSE)
        normal = self.normal(frequency, frequency)
        bands = self.unknowns // len(self.modes.kept)
        mean = np.kron(self.modes.mean[:, None], np.eye(bands))
        turned = np.linalg.solve(normal, np.broadcast_to(mean, (*normal.shape[:3], bands)))
        posterior = np.einsum("dk,rcdk->k", mean, turned).real / IMPULSE**2
        spread = np.fft.ifft2(turned, axes=(0, 1)).real  # (row, column, unknown, band)
        reach = int(np.abs(self.offsets).max()) + 1
        back = (self._look @ self._seen.T).reshape(len(self._look), len(self.offsets), -1)
        near = range(-reach, reach + 1)
        where = np.array([(i, j) for i in near for j in near])
        h = np.zeros((len(where), bands, len(self._look)))
        for d, (i, j) in enumerate(where):
            for k, (down, across) in enumerate(self.offsets):
                at = spread[(i - down) % IMPULSE, (j - across) % IMPULSE]
                h[d] += (back[:, k] @ at).T
        return where, h, posterior


def _inverted(normal: np.ndarray) -> np.ndarray:
    """Of matrices (row, column, unknown, unknown)."""
    try:
        return np.linalg.inv(normal)
    except np.linalg.LinAlgError:
        # unknowns that light does not tell apart, as of two bands alike: rounding alone is left
        size = np.trace(normal, axis1=2, axis2=3).real[..., None, None]
        least = 4 * np.finfo(np.float32).eps * size * np.eye(normal.shape[-1])
        return np.linalg.inv(normal + least.astype(np.float32))


def _beyond(count: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Which of `count` lenslets stands at each of `size` places from PAD before the first on, and
    whether it is mirrored there.
    """
    place = np.arange(-PAD, size - PAD) % (2 * count)
    turned = place >= count
    return np.where(turned, 2 * count - 1 - place, place), turned


def _stencil(gram: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A^T V^-1 A as a stencil: lenslets apart (n, 2), and (n, unknown, unknown) complex64.

    gram: (block * unknown, block * unknown).
    """
    apart, which = np.unique(
        (offsets[None] - offsets[:, None]).reshape(-1, 2), axis=0, return_inverse=True
    )
    count = len(offsets)
    products = gram.reshape(count, len(gram) // count, count, -1).swapaxes(1, 2)
    out = np.zeros((len(apart), *products.shape[2:]), np.complex64)
    np.add.at(out, which.ravel(), products.reshape(-1, *products.shape[2:]))
    return apart, out
