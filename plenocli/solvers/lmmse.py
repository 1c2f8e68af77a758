"""Linear minimum mean square error (Wiener) reconstruction with the statistics of natural images."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Lmmse:
    """x = mean + gain (y - A mean), and the error it expects: mean (point,), seen A mean (pixel,), gain (point, pixel),
    sigma (point,) predicted standard deviation of the error, in the units of x."""

    mean: np.ndarray
    seen: np.ndarray
    gain: np.ndarray
    sigma: np.ndarray

    def apply(self, y):
        """(pixel, signal) -> (point, signal)."""
        return self.mean[:, None] + self.gain @ (y - self.seen[:, None])


def prepare(svd, mean, covariance, sigma, *, floor=None):
    """The LMMSE estimator for y = A x + n, x ~ (mean, covariance), n white with standard deviation `sigma`.

    x = mean + C A^T (A C A^T + sigma^2 I)^-1 (y - A mean), worked out in the singular directions of A (`svd`) that matter:
    one whose signal can nowhere exceed a thousandth of the noise (s^2 largest eigenvalue of C < 1e-6 sigma^2) is left
    out; `floor` sets the least relative singular value instead.  sigma > 0.  Source: Berkner et al. 2013 gives least
    squares only; this is the linear optimum under the same second-order model (Kay, Estimation Theory, 1993, section 12.3).
    """
    from scipy.linalg import cho_factor, cho_solve

    from plenocli.errors import NumericsError

    if not sigma > 0:
        raise NumericsError(f"LMMSE needs a positive noise level, not {sigma}", fix="give --noise-sigma, or use --method tikhonov")
    if floor is None:
        largest = np.max(np.sum(np.abs(covariance), axis=1))
        used = max(1, int(np.count_nonzero(svd.s**2 * largest > 1e-6 * sigma**2)))
    else:
        used = svd.rank(floor)
    seen = svd.s[:used, None] * svd.vt[:used]
    cross = covariance @ seen.T
    data = seen @ cross
    data[np.diag_indices(used)] += sigma**2
    gain = cho_solve(cho_factor(data, lower=True), cross.T).T
    variance = np.diag(covariance) - np.einsum("ij,ij->i", gain, cross)
    return Lmmse(mean, svd.u[:, :used] @ (seen @ mean), gain @ svd.u[:, :used].T, np.sqrt(np.maximum(variance, 0)))
