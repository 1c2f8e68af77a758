"""Linear minimum mean square error (Wiener) reconstruction with the statistics of natural images.

One covariance does not describe a photograph: sky and foliage differ a hundredfold in variance. So
the second-order model is a Gaussian scale mixture (Portilla, Strela, Wainwright, Simoncelli, IEEE
Trans. Image Processing 12 (2003) 1338): every lenslet's field has its own brightness, about which
nothing is assumed, and its own contrast, the square root of a scale that multiplies the covariance
and is estimated from the lenslet's own data.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.linear_maps import product
from plenocli.inverse.picture.lenslet_model import Common, Keep, alone, work_out
from plenocli.inverse.picture.solvers.least_squares import Svd

SCALES = np.geomspace(1e-3, 30, 60)
"""Scales of the covariance that are tried."""

ROUNDS = 10
"""Rounds of expectation and maximisation for the distribution of the scale over the lenslets."""


TOGETHER = 200
"""Directions of A that are looked at together; after so many that hold no signal there is none."""
LEVEL_SURE = 10
"""A brightness about which nothing is assumed must stand so many times above the noise; else it
belongs to the field.
"""


def mean_scale(probability: np.ndarray) -> np.ndarray:
    """(signal,) the mean of the logarithm of each one's scale, as a scale; probability: (scale,
    signal) of each of SCALES.
    """
    return np.exp(np.log(SCALES) @ probability)


@dataclass(frozen=True, kw_only=True)
class Lmmse:
    """Everything that `prepare` works out once. Points of several bands stand one band after the
    other.

    levels: (level, pixel) y to brightnesses, one a band that can be told apart.
    even: (point, level) fields of brightness one.
    mean, variance: (point,) of a field about its brightness.
    offset, analysis: (k,) and (k, pixel), y to uncorrelated coordinates.
    power: (k,) their variance at scale 1.
    gain: (point, k) back to the field.
    noise: (k,) variance of the noise in each coordinate.
    sigma: noise of a pixel, in the brightness.
    """

    levels: np.ndarray
    even: np.ndarray
    mean: np.ndarray
    offset: np.ndarray
    analysis: np.ndarray
    power: np.ndarray
    gain: np.ndarray
    variance: np.ndarray
    noise: np.ndarray
    sigma: float

    def apply(
        self,
        y: np.ndarray,
        scale: float | np.ndarray = 1.0,
        coordinates: np.ndarray | None = None,
    ) -> np.ndarray:
        """(pixel, signal) -> (point, signal), with the covariance times `scale`, a
        number or one a signal; coordinates: those of y, where they are known.
        """
        w = self.coordinates(y) if coordinates is None else coordinates
        return (
            self.even @ (self.levels @ y) + self.mean[:, None] + self.gain @ self.shrunk(w, scale)
        )

    def likely(self, y: np.ndarray, common: Common = alone) -> np.ndarray:
        """The same, each signal with a scale of its own (see `scales`)."""
        w = self.coordinates(y)
        return self.apply(y, mean_scale(self.contrast(w, common)), w)

    def likely_detail(self, y: np.ndarray) -> np.ndarray:
        """What `gain` takes to the field of it, (k, signal)."""
        w = self.coordinates(y)
        return self.shrunk(w, mean_scale(self.contrast(w)))

    def shrunk(self, w: np.ndarray, scale: float | np.ndarray) -> np.ndarray:
        """What `gain` takes back to the field, (k, signal), of coordinates w (k, signal)."""
        noise = self.noise[:, None] / np.broadcast_to(scale, w.shape[1:])
        return w / (self.power[:, None] + noise)

    def adaptive(
        self, y: np.ndarray, common: Common = alone
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(x, sigma, scale) of y (pixel, signal) with a scale for each signal (see `scales`): the
        estimates and their predicted standard deviations (point, signal), the scales (signal,).
        """
        w = self.coordinates(y)
        scale = mean_scale(self.contrast(w, common))
        left = self.gain**2 @ (1 / (self.power[:, None] + self.noise[:, None] / scale))
        left = scale * np.maximum(self.variance[:, None] - left, 0)
        # the patterns are orthogonal
        level = (self.even**2 @ np.sum(self.levels**2, axis=1))[:, None]
        return self.apply(y, scale, w), np.sqrt(left + self.sigma**2 * level), scale

    def whitening(self) -> np.ndarray:
        """What of superpixels the estimate looks at, brightness first, weighted so that all of its
        noise is that of a pixel, (row, pixel).
        """
        level = self.levels / np.linalg.norm(self.levels, axis=1)[:, None]
        return np.concatenate([level, self.analysis * (self.sigma / np.sqrt(self.noise))[:, None]])

    def brightness(self, y: np.ndarray) -> np.ndarray:
        """Mean over its points and bands of each field behind y (pixel, signal), (signal,)."""
        return self.even.mean(axis=0) @ (self.levels @ y)

    def common_scale(self, y: np.ndarray) -> float:
        """The one of SCALES that makes all signals y (pixel, signal) together most likely."""
        return float(SCALES[np.argmax(self._likelihood(self.coordinates(y)).sum(axis=1))])

    def _likelihood(self, w: np.ndarray) -> np.ndarray:
        """Logarithm of the likelihood of coordinates w (k, signal) at each scale, (scale,
        signal), but for a constant.
        """
        expected = np.outer(SCALES, self.power) + self.noise
        return -0.5 * (np.log(expected).sum(axis=1)[:, None] + (1 / expected) @ w**2)

    def coordinates(self, y: np.ndarray) -> np.ndarray:
        """Uncorrelated coordinates (k, signal) of y (pixel, signal)."""
        return product(self.analysis, y) - self.offset[:, None]

    def scales(self, y: np.ndarray, common: Common = alone) -> np.ndarray:
        """The scale of each signal: the posterior mean of its logarithm (see `contrast`).

        y: (pixel, signal).

        Returns (signal,).
        """
        return mean_scale(self.contrast(self.coordinates(y), common))

    def contrast(self, w: np.ndarray, common: Common = alone) -> np.ndarray:
        """Probability of each of SCALES, (scale, signal), for each signal.

        Coordinates have variance scale power + noise. The prior of log scale is normal, with the
        mean and the deviation (at least 0.2) that make all signals together most likely; one signal
        alone says little where noise is strong.

        w: (k, signal) coordinates.
        common: gives that prior, of signals that are a part.
        """
        likelihood = self._likelihood(w)
        likelihood = np.exp(likelihood - likelihood.max(axis=0))
        which = (self.sigma, float(self.noise.sum()))
        prior = common("contrasts", lambda: usual(likelihood, SCALES, 0.2), which)
        return given(prior, likelihood)

    def degrees(self, y: np.ndarray) -> float:
        """Degrees of freedom that the estimate has of an object, the mean over the signals: the
        trace of its influence matrix, d(A x)/dy at its contrast, brightness included.

        y: (pixel, signal).
        """
        stronger = np.outer(self.power, self.scales(y))
        return len(self.levels) + float(
            np.mean(np.sum(stronger / (stronger + self.noise[:, None]), axis=0))
        )


def usual(likelihood: np.ndarray, scales: np.ndarray, least: float) -> np.ndarray:
    """Probabilities of scales beforehand, (scale,): their logarithm normal, with the mean and the
    deviation (at least `least`) that make all signals together most likely.

    likelihood: (scale, signal).
    """
    logs, prior = np.log(scales), np.full(len(scales), 1 / len(scales))
    for _ in range(ROUNDS - 1):
        prior = given(prior, likelihood).mean(axis=1)
        middle = prior @ logs
        deviation = max(np.sqrt(prior @ (logs - middle) ** 2), least)
        prior = np.maximum(np.exp(-((logs - middle) ** 2) / (2 * deviation**2)), 1e-30)
    return prior


def given(prior: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    """Probabilities (scale, signal), from those beforehand (scale,)."""
    posterior = likelihood * prior[:, None]
    posterior /= posterior.sum(axis=0)
    return posterior


def require_noise(sigma: float) -> None:
    """NumericsError unless the noise of a pixel is positive."""
    from plenocli.base.errors import NumericsError

    if not sigma > 0:
        raise NumericsError(
            f"LMMSE needs a positive noise level, not {sigma}",
            fix="give --noise-sigma, or use --method tikhonov",
        )


def prepare(
    svd: Svd,
    mean: np.ndarray,
    covariance: np.ndarray,
    sigma: float,
    bands: np.ndarray | Sequence[Sequence[float]] = ((1.0,),),
    *,
    matrix: Sequence[np.ndarray] = (),
    keep: Keep = work_out,
) -> Lmmse:
    """The LMMSE estimator for y = A x + n, n white, x = level + t with any level and t of the given
    statistics at an unknown scale.

    Fields have the covariance kron(bands, covariance). Their brightness, one a band, is taken out
    here, as the superpixel measures it: level(x) = F^+ A x, F = A times fields of ones. What is
    left of y, (I - F F^+) y, depends on t alone, and t = m + C A^T (A C A^T + sigma^2/scale I)^-1
    (y - A m) is worked out in the eigenvectors of the signal's covariance: of directions of A whose
    signal is below 0.3 % of the noise (of the power of two below it), and of eigenvectors below 1 %
    of it, nothing is kept. Bands
    that the superpixel hardly tells apart (LEVEL_SURE) have no free brightness of their own: there
    it is part of t.

    svd: of A, whose points are those of one band after the other.
    mean, covariance: (point,) and (point, point) of fields of natural photographs.
    sigma: noise of a pixel, > 0.
    bands: (band, band) covariance of the bands at a point, its diagonal about 1.
    matrix: what `svd` depends on.
    keep: of what does not depend on the noise, but for the power of two below it.

    Raises NumericsError where sigma is not positive.
    Kay, Estimation Theory, 1993, section 12.3, for one scale; docs/model.md, "Spatial
    reconstruction".
    """
    require_noise(sigma)
    bands = np.asarray(bands, float)
    variance = float(np.mean(np.diag(covariance)))
    levels, even = _levels(svd, bands, variance, sigma)
    least = 2.0 ** np.floor(np.log2(sigma))  # one for all noises up to twice it
    shown = keep(
        "lmmse",
        [*matrix, mean, covariance, bands, levels, np.array(least)],
        lambda: _shown(svd, mean, covariance, bands, levels, even, least),
    )
    expected, offset, analysis, power, gain, variances = shown
    first = int(np.searchsorted(power, 1e-4 * sigma**2, side="right"))
    power = power[first:]
    return Lmmse(
        levels=levels,
        even=even,
        mean=expected,
        offset=offset[first:],
        analysis=analysis[first:],
        power=power,
        gain=np.ascontiguousarray(gain[:, first:]),
        variance=variances,
        noise=np.full(len(power), float(sigma) ** 2),
        sigma=float(sigma),
    )


def _shown(
    svd: Svd,
    mean: np.ndarray,
    covariance: np.ndarray,
    bands: np.ndarray,
    levels: np.ndarray,
    even: np.ndarray,
    sigma: float,
) -> tuple[np.ndarray, ...]:
    """(mean, offset, analysis, power, gain, variance) of Lmmse, weakest first, as far as what is
    shown stands above noise sigma.
    """
    left = levels / np.linalg.norm(levels, axis=1)[:, None]
    weight = (levels @ svd.u * svd.s) @ svd.vt
    mean = np.tile(mean, len(bands))
    mean = mean - even @ (weight @ mean)
    pulled = _times(bands, covariance, weight.T)

    def covary(v: np.ndarray) -> np.ndarray:
        """Covariance of t times v (point, n)."""
        v = v - weight.T @ (even.T @ v)
        return _times(bands, covariance, v) - even @ (pulled.T @ v)

    used, cross = _audible(svd, covary, sigma)
    seen = svd.s[used, None] * svd.vt[used]
    data = seen @ cross
    power, vectors = np.linalg.eigh((data + data.T) / 2)
    kept = power > 1e-4 * sigma**2
    power, vectors = power[kept], vectors[:, kept]
    analysis = vectors.T @ svd.u[:, used].T
    analysis = analysis - (analysis @ left.T) @ left
    variance = np.kron(np.diag(bands), np.diag(covariance)) - np.sum(
        even * (2 * pulled - even @ (weight @ pulled)), axis=1
    )
    return mean, vectors.T @ (seen @ mean), analysis, power, cross @ vectors, variance


def _audible(
    svd: Svd, covary: Callable[[np.ndarray], np.ndarray], sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """(directions of A whose signal stands above the noise, covariance (point, direction) of the
    field with it).

    covary: the field's covariance times v (point, n).
    """
    used, cross = [], []
    for first in range(0, len(svd.s), TOGETHER):
        rows = svd.s[first : first + TOGETHER, None] * svd.vt[first : first + TOGETHER]
        along = covary(rows.T)
        loud = np.flatnonzero(np.einsum("ij,ji->i", rows, along) > 1e-5 * sigma**2)
        if not len(loud):
            break  # what follows is weaker still
        used.append(first + loud)
        cross.append(along[:, loud])
    nothing = np.zeros((svd.vt.shape[1], 0))
    return np.concatenate([*used, np.zeros(0, int)]), np.concatenate([*cross, nothing], axis=1)


def _levels(
    svd: Svd, bands: np.ndarray, variance: float, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """(levels (level, pixel), even (point, level)) of Lmmse: orthogonal rows that measure
    brightnesses, and the fields they stand for.
    """
    values, vectors = np.linalg.eigh(bands)
    ones = np.kron(
        vectors * np.sqrt(np.maximum(values, 0)), np.ones((svd.vt.shape[1] // len(bands), 1))
    )
    u, s, vt = np.linalg.svd(svd.s[:, None] * (svd.vt @ ones), full_matrices=False)
    kept = s * np.sqrt(variance) > LEVEL_SURE * sigma
    kept[0] = True
    return (svd.u @ u[:, kept] / s[kept]).T, ones @ vt[kept].T


def _times(bands: np.ndarray, covariance: np.ndarray, v: np.ndarray) -> np.ndarray:
    """kron(bands, covariance) v, v (point, n), points of one band after the other."""
    parts = v.reshape(len(bands), -1, v.shape[1])
    return np.tensordot(bands, np.stack([covariance @ part for part in parts]), 1).reshape(v.shape)
