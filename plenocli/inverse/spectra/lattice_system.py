"""Least squares over a lattice of lenslets that all answer alike: y_l = sum_o F_o b_(l-o) + noise.

With stationary weights 1/v the normal equations are a convolution, and a Fourier transform over
lenslets leaves one small system for each frequency. Beyond the array lenslets are taken to be
mirrored. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

PAD = 4
"""Mirrored lenslets on each side, at least."""
IMPULSE = 16
"""Lenslets a side of the lattice on which what one pixel does to the answer is computed."""
FAINT = 1e-4
"""Of the strongest direction of a superpixel, over the noise: fainter ones are not looked along."""


@dataclass(frozen=True, kw_only=True)
class PointPrior:
    """Values of object points that are alike where they are near: normal, of mean `mean` and
    covariance C rho^(points apart down + across).

    mean: (band,).
    inverse: (band, band), of C.
    rho: correlation of neighbouring points.
    points: of a lenslet, a side.
    """

    mean: np.ndarray
    inverse: np.ndarray
    rho: float
    points: int

    def precision(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Inverse covariance at frequencies (n,) and (m,), radians a lenslet: (n, m, unknown,
        unknown) complex64.
        """
        down, across = (self._axis(one).astype(np.complex64) for one in (rows, columns))
        bands = np.einsum("ckl,ab->ckalb", across, self.inverse.astype(np.float32))
        out = down[:, None, :, None, None, :, None, None] * bands[None, :, None, :, :, None]
        size = self.points**2 * len(self.mean)
        return out.reshape(len(rows), len(columns), size, size)

    def _axis(self, frequency: np.ndarray) -> np.ndarray:
        """Precision of one axis at frequencies (n,) in radians a lenslet: (n, point, point)."""
        count, rho = self.points, self.rho
        out = np.zeros((len(frequency), count, count), complex)
        index = np.arange(count)
        out[:, index, index] = 1 + rho**2
        out[:, index[1:], index[:-1]] -= rho
        out[:, index[:-1], index[1:]] -= rho
        out[:, 0, -1] -= rho * np.exp(-1j * frequency)
        out[:, -1, 0] -= rho * np.exp(1j * frequency)
        return out / (1 - rho**2)

    def pull(self, b: np.ndarray) -> np.ndarray:
        """Precision times (mean - b) on a periodic lattice; b (rows, columns, point * band)."""
        rows, columns = b.shape[:2]
        n = self.points
        x = (self.mean - b.reshape(rows, columns, n, n, -1)).swapaxes(1, 2)
        x = x.reshape(rows * n, columns * n, -1)
        for axis in (0, 1):
            x = (1 + self.rho**2) * x - self.rho * (np.roll(x, 1, axis) + np.roll(x, -1, axis))
            x = x / (1 - self.rho**2)
        x = (x @ self.inverse).reshape(rows, n, columns, n, -1)
        return x.swapaxes(1, 2).reshape(b.shape)


class LatticeSystem:
    """The system of one array; arrays `inner` are (lenslet_row, lenslet_column, ...), padded ones
    go on beyond.

    blocks: F_o (block, pixel, unknown).
    offsets: (block, 2), o: superpixels from the lenslet.
    variance: v (pixel,), inf where a pixel says nothing.
    shape: rows and columns of lenslets.
    prior: of the unknowns, points times bands; None: one value a band, and no prior.
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
        self.points = 1 if prior is None else prior.points
        self.padded = tuple(next_fast_len(n + 2 * PAD, real=True) for n in shape)
        there = np.concatenate(list(blocks.swapaxes(1, 2)))
        gram = (there / variance) @ there.T
        self._there = there.astype(np.float32)
        self._apart, self._products = _stencil(gram, offsets)
        power, turn = np.linalg.eigh(gram)
        strong = power > FAINT**2 * power[-1]
        turn, size = turn[:, strong], np.sqrt(power[strong])
        self._seen = (turn * size).astype(np.float32)
        self._look = (there.T / variance[:, None] @ (turn / size)).astype(np.float32)

    def mirrored(self, inner: np.ndarray) -> np.ndarray:
        """Unknowns (rows, columns, unknown) as a padded array, object points mirrored."""
        n, (rows, columns) = self.points, self.shape
        margins = [
            (PAD * n, (size - count - PAD) * n) for size, count in zip(self.padded, self.shape)
        ]
        x = inner.reshape(rows, columns, n, n, -1).swapaxes(1, 2).reshape(rows * n, columns * n, -1)
        x = np.pad(x, [*margins, (0, 0)], mode="symmetric")
        x = x.reshape(self.padded[0], n, self.padded[1], n, -1).swapaxes(1, 2)
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
        return out if self.prior is None else out + self.prior.precision(rows, columns)

    def _information(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        phases = [
            np.exp(-1j * np.multiply.outer(k, self._apart[:, axis]))
            for axis, k in enumerate((rows, columns))
        ]
        phase = (phases[0][:, None] * phases[1][None]).astype(np.complex64)
        out = phase @ self._products.reshape(len(self._apart), -1)
        return out.reshape(len(rows), len(columns), self.unknowns, self.unknowns)

    @cached_property
    def _inverse(self) -> np.ndarray:
        """Of `normal`, at the frequencies of the padded array: every step takes it, and what its
        rounding leaves, the next one finds.
        """
        rows, columns = self.padded
        normal = self.normal(2 * np.pi * np.fft.fftfreq(rows), 2 * np.pi * np.fft.rfftfreq(columns))
        try:
            return np.linalg.inv(normal)
        except np.linalg.LinAlgError:
            # unknowns that light does not tell apart, as of two bands alike: rounding alone is left
            size = np.trace(normal, axis1=2, axis2=3).real[..., None, None]
            least = 4 * np.finfo(np.float32).eps * size * np.eye(self.unknowns)
            return np.linalg.inv(normal + least.astype(np.float32))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """N^-1 of a padded array."""
        from scipy.fft import irfft2, rfft2

        spectrum = rfft2(right.astype(np.float32), axes=(0, 1))
        found = (self._inverse @ spectrum[..., None])[..., 0]
        return irfft2(found, s=self.padded, axes=(0, 1)).astype(float)

    def step(self, left: np.ndarray, b: np.ndarray) -> np.ndarray:
        """What unknowns b, padded, lack: inner.

        left: of the superpixels' directions.
        """
        right = self.back(left)
        if self.prior is not None:
            right = right + self.prior.pull(b)
        return self.inner(self.solve(right))

    def surprise(self, left: np.ndarray, points: np.ndarray, prior: PointPrior) -> float:
        """-2 ln of the evidence a lenslet (but for what all systems of a capture share): what is
        left over of the data, how far the answer is from its prior, and how much of the prior the
        data rule out.

        left: of the superpixels, over the noise's standard deviation.
        points: the answer, inner.
        prior: the system's, or one for a system that was solved without.
        """
        frequency = 2 * np.pi * np.fft.fftfreq(IMPULSE)
        before = prior.precision(frequency, frequency).astype(complex)
        after = self._information(frequency, frequency) + before
        ruled_out = np.linalg.slogdet(after)[1] - np.linalg.slogdet(before)[1]
        pull = self.inner(prior.pull(self.mirrored(points)))
        apart = points - np.tile(prior.mean, prior.points**2)
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
        bands = self.unknowns // self.points**2
        mean = np.tile(np.eye(bands), (self.points**2, 1)) / self.points**2
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
