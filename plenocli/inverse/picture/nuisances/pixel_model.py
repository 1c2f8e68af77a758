"""What LMMSE believes of the pixels of a superpixel, each given the others: the one model from
which defective pixels, saturated pixels and a veil are told.

Under LMMSE of a lenslet a superpixel is normal with any brightness, y = F m + W w + n, w of the
variances scale power; F and W have orthonormal columns, W W^T times scale power is the covariance
of the signal. So y less its prediction is (I - H) y with the symmetric

    H = F F^T + W diag(power / (power + sigma^2 / scale)) W^T,

(I - H) / sigma^2 is the inverse covariance of the pixels, and all that is asked here can be read
off it (docs/model.md, "Spatial reconstruction").
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plenocli.inverse.picture.solvers.lmmse import SCALES, Lmmse

CHUNK = 256
"""Lenslets that are looked at together, so that memory stays small."""
ROUNDS = 5
"""Rounds of contrast and pixels in turn, at most."""
LEAST = 1e-6
"""Share of a pixel, or of an even light, that the others must leave open to tell anything of it."""
HELD = 1e-12
"""What is added to the diagonal of I - H, which signals that nothing measures make singular."""


@dataclass(frozen=True, kw_only=True)
class Rest:
    """What is left of superpixels.

    value: (pixel, signal) y less its prediction.
    open: (pixel, signal) share of each pixel that the others do not tell: its variance is
        sigma^2 times that.
    scale: (signal,) index into SCALES of each contrast.
    offset, offset_variance: (signal,) even light on top of A x, and how surely that is known.
    """

    value: np.ndarray
    open: np.ndarray
    scale: np.ndarray
    offset: np.ndarray
    offset_variance: np.ndarray


@dataclass(frozen=True, kw_only=True)
class PixelModel:
    """The normal distribution of a superpixel, but for its contrast.

    free: (pixel, level) orthonormal patterns of any strength: those of even objects.
    patterns: (pixel, k) orthonormal, orthogonal to these.
    mean, power: (k,) of their strengths at contrast 1.
    sigma: noise of a pixel.
    veiled: whether an even light of any strength may lie over the superpixel.
    """

    free: np.ndarray
    patterns: np.ndarray
    mean: np.ndarray
    power: np.ndarray
    sigma: float
    veiled: bool = True
    free_variance: float = np.inf

    @property
    def free_share(self) -> float:
        """Of the strength of a free pattern that is believed."""
        return 1 / (1 + self.sigma**2 / self.free_variance)

    @classmethod
    def of(cls, lmmse: Lmmse, sigma: float, *, veiled: bool = True) -> PixelModel:
        """That of an estimator, with noise `sigma`, at least that it was prepared for."""
        length = np.linalg.norm(lmmse.levels, axis=1)
        return cls(
            free=(lmmse.levels / length[:, None]).T,
            patterns=lmmse.analysis.T,
            mean=lmmse.offset,
            power=lmmse.power,
            sigma=sigma,
            veiled=veiled,
        )

    @cached_property
    def veil(self) -> tuple[np.ndarray, np.ndarray]:
        """An even light as the patterns see it, (k,), and what they do not see of it, (pixel,)."""
        even = np.ones(len(self.free))
        seen = self.patterns.T @ even
        return seen, even - self.free @ (self.free.T @ even) - self.patterns @ seen

    def share(self, scale: np.ndarray | int) -> np.ndarray:
        """Of a pattern's strength that is believed, (k, ..), at indices `scale` (..)."""
        variance = np.multiply.outer(self.power, SCALES[scale])
        return variance / (variance + self.sigma**2)

    @cached_property
    def _by_scale(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of each scale: (pixel, scale) share open, (pixel, scale) what is left of an even light,
        (scale,) its sum, 0 where it tells nothing.
        """
        share = self.share(np.arange(len(SCALES)))
        left = 1 - np.sum(self.free**2, axis=1)[:, None] - self.patterns**2 @ share
        seen, unseen = self.veil
        even = unseen[:, None] + self.patterns @ (seen[:, None] * (1 - share))
        total = even.sum(axis=0)
        total = np.where(self.veiled & (total > LEAST * len(even)), total, 0.0)
        taken = np.divide(even**2, total, out=np.zeros_like(even), where=total > 0)
        return np.maximum(left - taken, LEAST), even, total

    def rest(self, y: np.ndarray, scale: np.ndarray | None = None) -> Rest:
        """What is left of y (pixel, signal), contrast and even light of each as likely as they
        are; scale: (signal,) indices where the contrasts are known.
        """
        seen, unseen = self.veil
        found = self.patterns.T @ y - self.mean[:, None]
        outside = unseen @ y
        if scale is None:
            scale = self._contrast(found, outside)
        left, even, total = self._by_scale
        lost = 1 - self.share(scale)
        value = (
            y
            - self.free @ (self.free.T @ y)
            - self.patterns @ (found * (1 - lost) + self.mean[:, None])
        )
        total = total[scale]
        offset = np.divide(
            outside + (seen[:, None] * lost * found).sum(axis=0),
            total,
            out=np.zeros_like(outside),
            where=total > 0,
        )
        value -= even[:, scale] * offset
        variance = np.full(total.shape, np.inf)
        np.divide(self.sigma**2, total, out=variance, where=total > 0)
        return Rest(
            value=value,
            open=left[:, scale],
            scale=scale,
            offset=offset,
            offset_variance=variance,
        )

    def _contrast(self, found: np.ndarray, outside: np.ndarray) -> np.ndarray:
        """Index of the contrast of each signal, (signal,): the posterior mean of its logarithm, all
        of SCALES equally likely beforehand, the even light integrated out.

        found: (k, signal) coordinates; outside: (signal,) of the even light.
        """
        seen, unseen = self.veil
        variance = np.outer(SCALES, self.power) + self.sigma**2
        likelihood = -0.5 * (np.log(variance).sum(axis=1)[:, None] + (1 / variance) @ found**2)
        weight = (unseen @ unseen) / self.sigma**2 + (1 / variance) @ seen**2
        if self.veiled and weight.min() * self.sigma**2 > LEAST * len(unseen):
            even = outside / self.sigma**2 + (1 / variance) @ (seen[:, None] * found)
            likelihood += 0.5 * (even**2 / weight[:, None] - np.log(weight)[:, None])
        likelihood = np.exp(likelihood - likelihood.max(axis=0))
        mean = (np.arange(len(SCALES)) @ likelihood) / likelihood.sum(axis=0)
        return np.rint(mean).astype(int)

    def root(self, scale: int, pixels: np.ndarray | slice = slice(None)) -> np.ndarray:
        """B (chosen pixel, n) with B B^T = H at these pixels, even light included."""
        _, even, total = self._by_scale
        columns = [
            self.free[pixels] * np.sqrt(self.free_share),
            self.patterns[pixels] * np.sqrt(self.share(scale)),
        ]
        if total[scale] > 0:
            columns.append(even[pixels, scale, None] / np.sqrt(total[scale]))
        return np.concatenate(columns, axis=1)

    def at(self, scale: int) -> AtContrast:
        """The same at one contrast."""
        root = self.root(scale)
        return AtContrast(root, self.patterns @ self.mean)

    def impute(self, y: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """The pixels that do not exist as the others tell them, so that LMMSE of the result is
        LMMSE without them: (I - H)_mm (y - c)_m = H_mo (y - c)_o.

        y: (pixel, signal), the missing ones with any value.
        missing: (pixel, signal).

        Returns y (pixel, signal).
        """
        y, concerned = np.where(missing, 0.0, y), np.flatnonzero(missing.any(axis=0))
        scale = np.full(len(concerned), -1)
        for _ in range(ROUNDS):  # the contrast needs the pixels, they need the contrast
            rest = self.rest(y[:, concerned])
            moved = rest.scale != scale
            if not moved.any():
                break
            scale = rest.scale
            for column, left, index in zip(concerned[moved], rest.value.T[moved], scale[moved]):
                lost = np.flatnonzero(missing[:, column])
                y[lost, column] -= Open.of(self.root(int(index), lost)).solve(left[lost])
        return y

    def uncertainty(self, y: np.ndarray, missing: np.ndarray) -> np.ndarray:
        """Standard deviation (pixel, signal) of what `impute` made, 0 of all other pixels.

        y: (pixel, signal) as imputed.
        missing: (pixel, signal).
        """
        sigma, concerned = np.zeros(y.shape), np.flatnonzero(missing.any(axis=0))
        for column, index in zip(concerned, self.rest(y[:, concerned]).scale):
            lost = np.flatnonzero(missing[:, column])
            spread = Open.of(self.root(int(index), lost)).diagonal()
            sigma[lost, column] = self.sigma * np.sqrt(spread)
        return sigma


@dataclass(frozen=True)
class AtContrast:
    """A model at one contrast.

    root: (pixel, n) B with B B^T = H.
    centre: (pixel,) mean of y.
    """

    root: np.ndarray
    centre: np.ndarray

    def rest(self, y: np.ndarray) -> np.ndarray:
        """(I - H) (y - c) of y (pixel,)."""
        far = y - self.centre
        return far - self.root @ (self.root.T @ far)

    def step(self, lost: np.ndarray, left: np.ndarray) -> np.ndarray:
        """(I - H)^-1 between the pixels `lost` (m,) times `left` (m,)."""
        return Open.of(self.root[lost]).solve(left)


@dataclass(frozen=True)
class Open:
    """I - B B^T of some pixels, factored on its shorter side; what is fully open is held by HELD.

    root: (m, n) B.
    factor: Cholesky factor, lower, of I - B B^T or of I - B^T B.
    """

    root: np.ndarray
    factor: np.ndarray

    @classmethod
    def of(cls, root: np.ndarray) -> Open:
        """From B."""
        from scipy.linalg import cholesky

        short = root if root.shape[0] <= root.shape[1] else root.T
        return cls(root, cholesky((1 + HELD) * np.eye(len(short)) - short @ short.T, lower=True))

    def solve(self, left: np.ndarray) -> np.ndarray:
        """The inverse times `left` (m,)."""
        from scipy.linalg import cho_solve

        if len(self.factor) == len(left):
            return cho_solve((self.factor, True), left)
        return left + self.root @ cho_solve((self.factor, True), self.root.T @ left)

    def diagonal(self) -> np.ndarray:
        """Of the inverse, (m,)."""
        from scipy.linalg import solve_triangular

        if len(self.factor) == len(self.root):
            inverse = solve_triangular(self.factor, np.eye(len(self.root)), lower=True)
            return np.sum(inverse**2, axis=0)
        return 1 + np.sum(solve_triangular(self.factor, self.root.T, lower=True) ** 2, axis=0)
