"""Least squares for many superpixels at the speed of memory: responses factored once, captures carried by matrix products.

F = Q R by Householder reflections, once a calibration. A capture then needs, by superpixel, Q^T x, Q^T W Q and Q^T W r with
the residual r of the plain answer: products in single precision over blocks of lenslets that stay in the cache. Q is
orthonormal, so that these normal equations have the condition of the weights W, not the square of that of F, and R enters
in double precision (A. Bjorck, Numerical Methods for Least Squares Problems, 1996, sections 2.4 and 4.4). Superpixels that
lost so many pixels that this fails are said to be hard, and `plenocli.solvers.spectral.demultiplex` does them.
"""

from dataclasses import dataclass

import numpy as np

from plenocli.solvers.spectral import LARGEST_CONDITION, _masked

BLOCK_NUMBERS = 90_000  # pixels of a block: four arrays of it stay in a core's cache
FACTOR_NUMBERS = 1_000_000
HARD = 1e-3  # least eigenvalue of Q^T Q over the pixels left, below which single precision does not do


@dataclass(frozen=True)
class Factored:
    """q (lenslet or 1, band, pixel) float32 and r (lenslet or 1, band, band) of F = Q R. used (lenslet or 1, pixel): known in
    every band, None where all are; sound (lenslet or 1): condition number below 1e10."""

    q: np.ndarray
    r: np.ndarray
    used: np.ndarray | None
    sound: np.ndarray

    @property
    def shared(self):
        """Whether one response serves all lenslets."""
        return len(self.q) == 1

    def some(self, which):
        """The Factored of lenslets by their index."""
        if self.shared:
            return self
        return Factored(self.q[which], self.r[which], None if self.used is None else self.used[which], self.sound[which])


@dataclass(frozen=True)
class Sums:
    """What superpixels say about their radiances; c = R b are coordinates in the basis Q.

    plain c (lenslet, band): unweighted least squares; start (lenslet, band, band): its Q^T Q over the pixels there are; normal
    Q^T W Q, right Q^T W (x - Q c); spread Q^T W^-1 Q, or None; chi: sum of W (x - Q c)^2; count: pixels; hard (lenslet).
    """

    plain: np.ndarray
    start: np.ndarray
    normal: np.ndarray
    right: np.ndarray
    spread: np.ndarray | None
    chi: np.ndarray
    count: np.ndarray
    hard: np.ndarray


def factor(response, which=None):
    """Factored responses (pixel, band), or (..., pixel, band) at the places `which` (a tuple of index arrays, None: all, flattened).

    NaN in any band masks a pixel.
    """
    if response.ndim == 2:
        response, which = response[None], (np.zeros(1, int),)
    elif which is None:
        response = response.reshape(-1, *response.shape[-2:])
        which = (np.arange(len(response)),)
    total, (count, bands) = len(which[0]), response.shape[-2:]
    q, r = np.empty((total, bands, count), np.float32), np.empty((total, bands, bands))
    used = np.empty((total, count), bool)
    step = max(1, FACTOR_NUMBERS // (count * bands))
    for first in range(0, total, step):
        part = slice(first, first + step)
        f = _masked(response[tuple(w[part] for w in which)])
        used[part] = (f != 0).any(axis=-1)
        one, r[part] = np.linalg.qr(f)
        q[part] = np.swapaxes(one, -1, -2)
    singular = np.linalg.svd(r, compute_uv=False)
    return Factored(q, r, None if used.all() else used, singular[:, -1] > singular[:, 0] / LARGEST_CONDITION)


def collect(factored, cut, total, noise=None, response_variance=None, radiance=None, doubt=None, sandwich=False):
    """Sums of `total` superpixels.

    cut(part): values (lenslet, pixel) float32 of a slice of them, which may be overwritten; NaN masks a pixel. noise (gain, read
    variance): pixels weigh as 1 / (gain F b + read variance [+ b^2 response_variance (pixel, band)]), b being the plain answer, or
    `radiance` (lenslet, band); None: all weigh 1. doubt (pixel, band): variance of the response that counts in chi alone.
    sandwich: whether `spread` is wanted.
    """
    bands = factored.r.shape[-1]
    basis = (_One if factored.shared else _Each)(factored)
    variance = None if noise is None else _Variance(factored, noise, response_variance, doubt)
    square = (total, bands, bands)
    out = Sums(np.zeros((total, bands)), np.broadcast_to(np.eye(bands), square).copy(), np.empty(square), np.zeros((total, bands)),
               np.empty(square) if sandwich else None, np.zeros(total), np.full(total, factored.q.shape[-1]), np.zeros(total, bool))
    step = max(1, BLOCK_NUMBERS // factored.q.shape[-1])
    for first in range(0, total, step):
        part = slice(first, min(first + step, total))
        _block(factored, basis, part, cut(part), variance, None if radiance is None else radiance[part], out)
    return out


def _block(factored, basis, part, x, variance, radiance, out):
    """Fill `out` for one block of lenslets."""
    c = basis.project(part, x)
    holes = _holes(factored, basis, part, x, c, out)
    out.plain[part] = c
    mean = basis.picture(part, c.astype(np.float32))
    np.subtract(x, mean, out=x)
    if holes is not None:
        x[holes[0]] *= holes[1]
    if variance is None:
        out.normal[part] = out.start[part]
        out.chi[part] = np.vecdot(x, x)
        return
    spread = variance.of(basis, part, mean, c, radiance)
    if out.spread is not None:
        kept = spread
        if holes is not None:
            kept = spread.copy()
            kept[holes[0]] *= holes[1]
        out.spread[part] = basis.normal(part, kept)
    if variance.doubt is not None:
        out.chi[part] = np.vecdot(x / (spread + variance.doubtful(part, c, radiance)), x)
    weight = np.reciprocal(spread, out=spread)
    if holes is not None:
        weight[holes[0]] *= holes[1]
    out.normal[part] = basis.normal(part, weight)
    weight *= x
    out.right[part] = basis.project(part, weight)
    if variance.doubt is None:
        out.chi[part] = np.vecdot(weight, x)


def _holes(factored, basis, part, x, c, out):
    """(rows, their masks as numbers) of lenslets in this block that lack pixels, or None; x is 0 there, c and `out` made good."""
    lacking = np.isnan(c).any(axis=1)
    calibrated = None
    if factored.used is not None:
        calibrated = np.broadcast_to(factored.used[0], x.shape) if factored.shared else factored.used[part]
        some = ~calibrated.all(axis=1)
    if not lacking.any() and (calibrated is None or not some.any()):
        return None
    rows = np.flatnonzero(lacking if calibrated is None else lacking | some)
    mask = np.isfinite(x[rows])
    if calibrated is not None:
        mask &= calibrated[rows]
    x[rows] = np.where(mask, x[rows], 0)
    weight = mask.astype(np.float32)
    at = part.start + rows
    out.count[at] = mask.sum(axis=1)
    own = basis.rows(part, rows)
    start = own.normal(slice(None), weight)
    least = np.linalg.eigvalsh(start)[:, 0]
    out.start[at], out.hard[at] = start, least < HARD
    start[out.hard[at]] = np.eye(start.shape[-1])
    c[rows] = np.linalg.solve(start, own.project(slice(None), x[rows])[..., None])[..., 0]
    return rows, weight


class _One:
    """One basis for all lenslets: plain matrix products."""

    def __init__(self, factored):
        self.wide = factored.q[0]  # (band, pixel)
        self.tall = np.ascontiguousarray(self.wide.T)
        bands = len(self.wide)
        pairs = np.triu_indices(bands)
        self.products = np.ascontiguousarray((self.wide[pairs[0]] * self.wide[pairs[1]]).T)
        self.unfold = np.zeros((bands, bands), int)
        self.unfold[pairs] = self.unfold[pairs[::-1]] = np.arange(len(pairs[0]))
        self.buffer = np.zeros((0, self.wide.shape[1]), np.float32)

    def rows(self, part, rows):
        return self

    def project(self, part, x):
        """Q^T x (lenslet, band), float64."""
        return (x @ self.tall).astype(float)

    def picture(self, part, c):
        """Q c (lenslet, pixel), in a buffer that the next call overwrites."""
        if len(self.buffer) < len(c):
            self.buffer = np.empty((len(c), self.wide.shape[1]), np.float32)
        return np.matmul(c, self.wide, out=self.buffer[: len(c)])

    def normal(self, part, weight):
        """Q^T W Q (lenslet, band, band), float64."""
        return (weight @ self.products)[:, self.unfold].astype(float)


class _Each:
    """A basis for every lenslet: products lenslet by lenslet."""

    def __init__(self, factored):
        self.q = factored.q
        self.buffer = self.weighted = np.zeros(0, np.float32)

    def rows(self, part, rows):
        return _Each(Factored(self.q[part][rows], None, None, None))

    def project(self, part, x):
        return np.matmul(self.q[part], x[..., None])[..., 0].astype(float)

    def picture(self, part, c):
        q = self.q[part]
        if len(self.buffer) < len(c):
            self.buffer = np.empty((len(c), 1, q.shape[-1]), np.float32)
        return np.matmul(c[:, None], q, out=self.buffer[: len(c)])[:, 0]

    def normal(self, part, weight):
        q = self.q[part]
        if len(self.weighted) < len(q):
            self.weighted = np.empty(q.shape, np.float32)
        weighted = np.multiply(q, weight[:, None], out=self.weighted[: len(q)])
        return np.matmul(weighted, np.swapaxes(q, -1, -2)).astype(float)


class _Variance:
    """Variance of pixel values, in place of their mean."""

    def __init__(self, factored, noise, response_variance, doubt):
        self.r, self.inverse = factored.r, np.linalg.inv(np.where(factored.sound[:, None, None], factored.r, np.eye(factored.r.shape[-1])))
        self.gain, self.read = (np.float32(v) for v in noise)
        self.spread, self.doubt = (None if v is None else np.ascontiguousarray(np.nan_to_num(v).T, np.float32) for v in (response_variance, doubt))

    def of(self, basis, part, mean, c, radiance):
        """gain F b + read variance + b^2 var(F) (lenslet, pixel), at least the read variance; b from c, or `radiance` where given."""
        if radiance is not None:
            own = part if len(self.r) > 1 else slice(None)
            mean = basis.picture(part, (self.r[own] @ np.clip(radiance, 0, None)[..., None])[..., 0].astype(np.float32))
        mean *= self.gain
        mean += self.read
        if self.spread is not None:
            mean += self._square(part, c, radiance) @ self.spread
        return np.maximum(mean, max(self.read, np.float32(1e-12)), out=mean)

    def doubtful(self, part, c, radiance):
        """b^2 doubt (lenslet, pixel)."""
        return self._square(part, c, radiance) @ self.doubt

    def _square(self, part, c, radiance):
        own = part if len(self.r) > 1 else slice(None)
        b = (self.inverse[own] @ c[..., None])[..., 0] if radiance is None else radiance
        return np.square(np.clip(b, 0, None)).astype(np.float32)


# --- answers ------------------------------------------------------------------------------------------------------------

def answer(factored, sums, method, prior=None, weighed=True):
    """Radiances and their standard deviations, two (lenslet, band), of pinv, wls, lmmse or nnls; NaN where a superpixel has too few
    good pixels or a condition number above 1e10, and where it is hard.

    prior: (mean (band,), covariance (band, band)) for lmmse. weighed: whether `sums` are, by the noise; where they are not, it
    is estimated from the residual, one number a superpixel.
    """
    bands = factored.r.shape[-1]
    inverse = np.linalg.inv(np.where(factored.sound[:, None, None], factored.r, np.eye(bands)))
    known = factored.sound & ~sums.hard & (sums.count >= (0 if method == "lmmse" else bands))
    normal = np.where(known[:, None, None], sums.start if method == "pinv" else sums.normal, np.eye(bands))
    if not weighed:
        covariance, c = np.linalg.inv(normal) * (sums.chi / np.maximum(sums.count - bands, 1))[:, None, None], sums.plain
    elif method == "pinv":
        back = np.linalg.inv(normal)
        covariance, c = back @ np.where(known[:, None, None], sums.spread, 0) @ back, sums.plain
    elif method == "lmmse":
        mean, given = (np.asarray(p, float) for p in prior)
        pull = np.swapaxes(inverse, -1, -2) @ np.linalg.inv(given) @ inverse
        covariance = np.linalg.inv(normal + pull)
        c = sums.plain + (covariance @ (sums.right + (pull @ (factored.r @ mean - sums.plain)[..., None])[..., 0])[..., None])[..., 0]
    else:
        covariance = np.linalg.inv(normal)
        c = sums.plain + (covariance @ sums.right[..., None])[..., 0]
    b = (inverse @ c[..., None])[..., 0]
    sigma = np.sqrt(np.diagonal(inverse @ covariance @ np.swapaxes(inverse, -1, -2), axis1=-2, axis2=-1))
    if method == "nnls":
        b = _non_negative(np.broadcast_to(factored.r, normal.shape), normal, c, b)
    return np.where(known[:, None], b, np.nan), np.where(known[:, None], sigma, np.nan)


def _non_negative(r, normal, c, b):
    """min |L^T (R b - c)| with b >= 0, L L^T = Q^T W Q, where the free answer b has a negative part."""
    from scipy.optimize import nnls

    b = np.array(b)
    for i in np.flatnonzero((b < 0).any(axis=-1) & np.isfinite(b).all(axis=-1)):
        root = np.linalg.cholesky(normal[i]).T
        b[i] = nnls(root @ r[i], root @ c[i])[0]
    return b
