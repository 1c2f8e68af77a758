"""Regularised least squares from one singular value decomposition: Tikhonov and truncated, for
all lenslets at once.

y = A x + n with A = U diag(s) V^T. Only z = U^T y meets the unknown; what is left of y is pure
noise, and measures it. All estimates are linear: they may leave [0, 1], and
nothing is clipped here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.linear_maps import product


@dataclass(frozen=True)
class Svd:
    """A = u diag(s) vt.

    u: (pixel, k), k = min(pixel, point).
    s: (k,) falling.
    vt: (k, point).
    """

    u: np.ndarray
    s: np.ndarray
    vt: np.ndarray

    def compress(self, y: np.ndarray) -> np.ndarray:
        """z = U^T y, (k, signal), from y (pixel, signal): no estimate that fits by least squares
        can tell z from y.
        """
        return self.u.T @ y

    def shown(self, x: np.ndarray) -> np.ndarray:
        """What of A x is compressed, (k, signal), from x (point, signal)."""
        return self.s[:, None] * (self.vt @ x)

    def rank(self, relative: float | None = None) -> int:
        """Number of singular values above `relative` times the largest (default: machine precision
        times the larger side).
        """
        floor = (
            max(self.u.shape[0], self.vt.shape[1]) * np.finfo(float).eps
            if relative is None
            else relative
        )
        return int(np.count_nonzero(self.s > floor * self.s[0]))


def decompose(matrix: np.ndarray) -> Svd:
    """Singular value decomposition in float64.

    matrix: A (pixel, point).

    Raises NumericsError where it is zero or not finite.
    """
    from plenocli.base.errors import NumericsError

    a = np.asarray(matrix, float)
    if not np.all(np.isfinite(a)):
        raise NumericsError(
            "the system matrix holds values that are not finite", fix="rebuild it with simulate-pif"
        )
    u, s, vt = np.linalg.svd(a, full_matrices=False)
    if s[0] == 0:
        raise NumericsError(
            "the system matrix is zero: no light of the object reaches these pixels"
        )
    return Svd(u, s, vt)


def estimate_noise(svd: Svd, y: np.ndarray) -> float:
    """Standard deviation of the noise, from the part of the signals that A cannot produce.

    Directions with s < 1e-6 s_0 count as such too. It is too large when the model is wrong
    (neighbours' light left out, for instance), since that also shows up outside the range of A: a
    sound scale for the discrepancy rule, not a photometric figure.

    svd: of A.
    y: (pixel, signal).

    Raises NumericsError where A reaches every direction.
    """
    from plenocli.base.errors import NumericsError

    reached = svd.rank(1e-6)
    left = y.shape[0] - reached
    if left < 1:
        raise NumericsError(
            "the noise cannot be estimated: the system matrix reaches every pixel pattern",
            fix="give --noise-sigma",
        )
    reach = svd.u[:, :reached]
    residual = y - product(reach, product(reach.T, y))
    return float(np.sqrt(np.sum(residual**2) / (left * y.shape[1])))


def resolution(svd: Svd, sigma: float, contrast: float) -> np.ndarray:
    """Diagonal of A^T A (A^T A + (sigma/contrast)^2)^-1: 1 where noise lets a point be seen apart,
    0 in the null space. Its mean is the share of the object's directions that the sensor sees.

    svd: of A.
    sigma: noise of a pixel.
    contrast: standard deviation of a point about its surroundings; points are taken to be
        independent, as the sensor cannot know better.

    Returns (point,).
    """
    share = (
        svd.s**2 / (svd.s**2 + (sigma / contrast) ** 2)
        if sigma > 0
        else (svd.s > 1e-14 * svd.s[0]).astype(float)
    )
    return np.einsum("kj,k,kj->j", svd.vt, share, svd.vt)


def tikhonov(svd: Svd, z: np.ndarray, alpha: float) -> np.ndarray:
    """argmin |y - Ax|^2 + alpha |x|^2.

    svd: of A.
    z: U^T y (k, signal).
    alpha: in units of s^2.

    Returns (point, signal).
    """
    return svd.vt.T @ ((svd.s / (svd.s**2 + alpha))[:, None] * z)


def truncated(svd: Svd, z: np.ndarray, rank: int) -> np.ndarray:
    """Least squares in the `rank` strongest directions, (point, signal), from z = U^T y (k,
    signal).
    """
    return svd.vt[:rank].T @ (z[:rank] / svd.s[:rank, None])


def power_of(z: np.ndarray) -> np.ndarray:
    """Mean square (k,) of each direction over signals z (k, signal)."""
    return np.mean(z**2, axis=1)


def discrepancy_alpha(svd: Svd, power: np.ndarray, sigma: float) -> float:
    """alpha for which the residual of all signals together is what noise leaves in z.

    Morozov's rule: sum |z - S V^T x|^2 = (number of entries of z) sigma^2; it rises with alpha, and
    is found by bisection in log alpha between 1e-18 and 1e6 times s_0^2 (an end is returned where
    the rule cannot be met).

    svd: of A.
    power: (k,) `power_of` z = U^T y.
    sigma: standard deviation of the noise.
    """
    target = len(power) * sigma**2

    def residual(alpha: float) -> float:
        return np.sum((alpha / (svd.s**2 + alpha)) ** 2 * power)

    low, high = 1e-18 * svd.s[0] ** 2, 1e6 * svd.s[0] ** 2
    if residual(low) >= target:
        return low
    if residual(high) <= target:
        return high
    for _ in range(80):
        middle = np.sqrt(low * high)
        low, high = (middle, high) if residual(middle) < target else (low, middle)
    return float(np.sqrt(low * high))


def best_rank(svd: Svd, power: np.ndarray, sigma: float) -> int:
    """The truncation with the least estimated mean square error of x, all signals together.

    An unbiased estimate in the manner of Stein and Mallows: direction k costs 2 sigma^2 / s_k^2 of
    noise and saves z_k^2 / s_k^2 of picture, on average. (Morozov's rule keeps far too many
    directions here: it asks the cut to explain the weak ones too.)

    svd: of A.
    power: (k,) `power_of` z = U^T y.
    sigma: standard deviation of the noise in y.

    Returns how many directions are kept.
    """
    top = svd.rank()
    change = (2 * sigma**2 - power[:top]) / svd.s[:top] ** 2
    return int(np.argmin(np.cumsum(change))) + 1


def shared_with(svd: Svd, z: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Mean product (k,) of each direction of signals z (k, signal) and of the truth (point, signal)
    behind them.
    """
    return np.mean(z * (svd.vt @ truth), axis=1)


def oracle_alpha(svd: Svd, power: np.ndarray, cross: np.ndarray) -> float:
    """The alpha with the least mean square error. It needs the truth: a bound, not a method.

    svd: of A.
    power: (k,) mean square of the signals, see `power_of`.
    cross: (k,) what they share with the truth, see `shared_with`.

    Returns alpha in the square of A's unit, for `tikhonov`.
    """
    from scipy.optimize import minimize_scalar

    def error(log_alpha: float) -> float:
        gain = svd.s / (svd.s**2 + 10.0**log_alpha * svd.s[0] ** 2)
        return float(gain**2 @ power - 2 * gain @ cross)

    coarse = np.arange(-14.0, 2.01, 0.5)
    best = coarse[np.argmin([error(a) for a in coarse])]
    found = minimize_scalar(
        error, bounds=(best - 0.5, best + 0.5), method="bounded", options={"xatol": 1e-3}
    )
    return float(10.0**found.x * svd.s[0] ** 2)


def oracle_rank(svd: Svd, power: np.ndarray, cross: np.ndarray) -> int:
    """The truncation with the least mean square error. It needs the truth: a bound, not a method.

    Arguments as of oracle_alpha.

    Returns how many directions are kept, for `truncated`.
    """
    top = svd.rank()
    gain = 1 / svd.s[:top]
    change = gain**2 * power[:top] - 2 * gain * cross[:top]
    return int(np.argmin(np.cumsum(change))) + 1
