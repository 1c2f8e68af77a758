"""Least squares for many superpixels at the speed of memory: responses factored once, captures
carried by matrix products.

F = Q R, once a calibration. A capture then needs, by superpixel, Q^T x, Q^T W Q and Q^T W r with
the residual r of the plain answer: products in single precision over blocks of lenslets that stay
in the cache. Q is orthonormal, so that these normal equations have the condition of the weights W,
not the square of that of F, and R enters in double precision (A. Bjorck, Numerical Methods for
Least Squares Problems, 1996, sections 2.4 and 4.4). Superpixels that lost so many pixels that this
fails are said to be hard, and `plenocli.inverse.spectra.demultiplex.demultiplex` does them.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.inverse.spectra.demultiplex import LARGEST_CONDITION

if TYPE_CHECKING:
    from plenocli.forward.sensor.noise import Noise
    from plenocli.inverse.calibration.calibration import MadeResponses

BLOCK_NUMBERS = 270_000, 45_000
"""Pixels of a block, one basis for all or one each: what belongs to it stays in a core's cache."""
FACTOR_NUMBERS = 250_000
"""Numbers of responses that are factored together."""
TILE_NUMBERS = 4_000_000
"""Of a tile, of its pixels or of responses of their own: what belongs to it is held at a time."""
SMALL_PRODUCT = 1_000_000
"""Multiplications of a matrix product up to which OpenBLAS reads the matrices where they are; for
larger ones it copies them first, which takes twice as long where the result has few columns.
"""
FEWEST_ROWS = 8
"""Of such a product: below, the copies cost less than the calls."""
HARD = 1e-3
"""Least eigenvalue of Q^T Q over the pixels left, below which single precision does not do."""
Cut = Callable[[slice], np.ndarray]
"""Values (lenslet, pixel) float32 of a slice of superpixels, which may be overwritten; NaN masks a
pixel.
"""


@dataclass(frozen=True, kw_only=True)
class FactoredResponses:
    """Responses as F = Q R, of one lenslet each or one for all.

    q: (lenslet or 1, band, pixel) float32, Q transposed.
    r: (lenslet or 1, band, band).
    used: (lenslet or 1, pixel), which are known in every band; None: all.
    sound: (lenslet or 1,), condition number below 1e10.
    """

    q: np.ndarray
    r: np.ndarray
    used: np.ndarray | None
    sound: np.ndarray

    @property
    def shared(self) -> bool:
        """Whether one response serves all lenslets."""
        return len(self.r) == 1

    @cached_property
    def inverse(self) -> np.ndarray:
        """R^-1 (lenslet or 1, band, band), of a unit matrix where F is not sound."""
        return np.linalg.inv(np.where(self.sound[:, None, None], self.r, np.eye(self.r.shape[-1])))

    @cached_property
    def blank(self) -> tuple[np.ndarray, np.ndarray] | None:
        """(lenslets, their pixels) that are not used, ordered by lenslet; None where all are."""
        if self.used is None:
            return None
        rows, pixels = np.nonzero(~self.used)
        return rows, pixels

    def blanks(self, part: slice) -> tuple[np.ndarray | slice, np.ndarray] | None:
        """Pixels that are not used in a block of lenslets.

        part: the lenslets of the block.

        Returns indices into (lenslet, pixel) of the block; None: there are none.
        """
        if self.blank is None:
            return None
        rows, pixels = self.blank
        if self.shared:
            return slice(None), pixels
        first, last = np.searchsorted(rows, (part.start, part.stop))
        return rows[first:last] - part.start, pixels[first:last]

    def some(self, which: np.ndarray | slice) -> FactoredResponses:
        """The responses of lenslets by their index."""
        if self.shared:
            return self
        return FactoredResponses(
            q=self.q[which],
            r=self.r[which],
            used=None if self.used is None else self.used[which],
            sound=self.sound[which],
        )


@dataclass(frozen=True, kw_only=True)
class NormalEquations:
    """What superpixels x say about their radiances b; c = R b are coordinates in the basis Q, and W
    the weights of the pixels.

    unweighted: (lenslet, band), c by unweighted least squares.
    unweighted_normal: (lenslet, band, band), Q^T Q over the pixels there are.
    normal: (lenslet, band, band), Q^T W Q.
    right: (lenslet, band), Q^T W (x - Q c).
    spread: (lenslet, band, band), Q^T W^-1 Q, or None.
    chi: (lenslet,), sum of W (x - Q c)^2.
    count: (lenslet,), pixels.
    hard: (lenslet,), whether single precision does not do.
    """

    unweighted: np.ndarray
    unweighted_normal: np.ndarray
    normal: np.ndarray
    right: np.ndarray
    spread: np.ndarray | None
    chi: np.ndarray
    count: np.ndarray
    hard: np.ndarray

    @classmethod
    def unfilled(cls, total: int, bands: int, pixels: int, sandwich: bool) -> NormalEquations:
        """Of `total` superpixels, to be filled in; sandwich: with `spread`."""
        square = (total, bands, bands)
        return cls(
            unweighted=np.zeros((total, bands)),
            unweighted_normal=np.broadcast_to(np.eye(bands), square).copy(),
            normal=np.empty(square),
            right=np.zeros((total, bands)),
            spread=np.empty(square) if sandwich else None,
            chi=np.zeros(total),
            count=np.full(total, pixels),
            hard=np.zeros(total, bool),
        )


def factor(
    response: np.ndarray | MadeResponses,
    which: tuple[np.ndarray, ...] | None = None,
    threads: int = 1,
) -> FactoredResponses:
    """Responses factored; the result does not depend on `threads`.

    response: (pixel, band), or (..., pixel, band); NaN in any band masks a pixel.
    which: places in its leading axes; None: all, flattened.
    """
    if response.ndim == 2:
        response, which = response[None], (np.zeros(1, int),)
    elif which is None:
        assert isinstance(response, np.ndarray)  # made ones come with their places
        response = response.reshape(-1, *response.shape[-2:])
        which = (np.arange(len(response)),)
    total, (count, bands) = len(which[0]), response.shape[-2:]
    q, r = np.empty((total, bands, count), np.float32), np.empty((total, bands, bands))
    used = np.empty((total, count), bool)
    step = max(1, FACTOR_NUMBERS // (count * bands))

    def work(first: int) -> None:
        part = slice(first, first + step)
        f = np.ascontiguousarray(
            np.swapaxes(response[tuple(w[part] for w in which)], -1, -2), float
        )
        good = np.isfinite(f).all(axis=1)
        if not good.all():
            f = np.where(good[:, None], f, 0)
        used[part] = (f != 0).any(axis=1)
        q[part], r[part] = _orthogonal(f)

    firsts = range(0, total, step)
    if threads == 1 or len(firsts) < 2:
        for first in firsts:
            work(first)
    else:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, firsts))
    singular = np.linalg.svd(r, compute_uv=False)
    return FactoredResponses(
        q=q,
        r=r,
        used=None if used.all() else used,
        sound=singular[:, -1] > singular[:, 0] / LARGEST_CONDITION,
    )


def _orthogonal(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Q^T, R) of F^T (lenslet, band, pixel): Cholesky factors of Q^T Q twice (Y. Yamamoto et al.,
    ETNA 44, 2015), which is as good as Householder's reflections up to condition numbers of 1e7;
    those where F is worse.
    """
    size = np.sqrt(np.vecdot(f, f))
    q = f / np.where(size > 0, size, 1)[..., None]
    gram = q @ np.swapaxes(q, -1, -2)
    easy = np.linalg.eigvalsh(gram)[:, 0] > 1e-8
    r = np.zeros_like(gram)
    if easy.any():
        rows = slice(None) if easy.all() else easy
        first = np.linalg.cholesky(gram[rows])
        once = np.linalg.inv(first) @ q[rows]
        second = np.linalg.cholesky(once @ np.swapaxes(once, -1, -2))
        q[rows] = np.linalg.inv(second) @ once
        r[rows] = np.swapaxes(first @ second, -1, -2) * size[rows][:, None]
    if not easy.all():
        tall, r[~easy] = np.linalg.qr(np.swapaxes(f[~easy], -1, -2))
        q[~easy] = np.swapaxes(tall, -1, -2)
    return q, r


def tile_of(response: np.ndarray | MadeResponses) -> int:
    """Lenslets that are demultiplexed together: whole blocks, whose rounding tiles do not change.

    response: (pixel, band) for all, or (..., pixel, band).
    """
    own, (pixels, bands) = response.ndim > 2, response.shape[-2:]
    block = max(1, BLOCK_NUMBERS[own] // pixels)
    return block * max(1, TILE_NUMBERS // (block * pixels * (bands if own else 1)))


def normal_equations(
    factored: FactoredResponses,
    cut: Cut,
    total: int,
    noise: Noise | None = None,
    response_variance: np.ndarray | None = None,
    radiance: np.ndarray | None = None,
    doubt: np.ndarray | None = None,
    sandwich: bool = False,
) -> NormalEquations:
    """Normal equations of superpixels.

    factored: their responses.
    cut: gives their values.
    total: how many there are.
    noise: of the values: pixels weigh as 1 / (gain F b + read variance [+ b^2 response_variance]),
        b being the unweighted answer, or `radiance`; None: all weigh 1.
    response_variance: (pixel, band), of the response.
    radiance: (lenslet, band), or None.
    doubt: (pixel, band), variance of the response that counts in chi alone.
    sandwich: whether `spread` is wanted.
    """
    bands = factored.r.shape[-1]
    basis = (_SharedBasis if factored.shared else _OwnBases)(factored.q)
    variance = None if noise is None else _PixelVariance(factored, noise, response_variance, doubt)
    out = NormalEquations.unfilled(total, bands, factored.q.shape[-1], sandwich)
    if factored.used is not None:
        out.count[:] = factored.used.sum(axis=1)
    step = max(1, BLOCK_NUMBERS[not factored.shared] // factored.q.shape[-1])
    for first in range(0, total, step):
        part = slice(first, min(first + step, total))
        given = None if radiance is None else radiance[part]
        _block(factored, basis, part, cut(part), variance, given, out)
    return out


def _block(
    factored: FactoredResponses,
    basis: _SharedBasis | _OwnBases,
    part: slice,
    x: np.ndarray,
    variance: _PixelVariance | None,
    radiance: np.ndarray | None,
    out: NormalEquations,
) -> None:
    """Fill `out` for one block of lenslets."""
    blank = factored.blanks(part)
    if blank is not None:
        x[blank] = 0
    c = basis.project(part, x)
    holes = _holes(factored, basis, part, x, c, blank, out) if np.isnan(c).any() else None
    out.unweighted[part] = c
    mean = basis.subtract(part, c, x)
    if holes is not None:
        x[holes[0]] *= holes[1]
    if variance is None:
        out.normal[part] = out.unweighted_normal[part]
        out.chi[part] = np.vecdot(x, x)
        return
    weight = variance.of(basis, part, c, mean, radiance)
    if out.spread is not None:
        kept = weight
        if holes is not None:
            kept = weight.copy()
            kept[holes[0]] *= holes[1]
        out.spread[part] = basis.normal(part, kept)
    if variance.doubt is not None:
        out.chi[part] = np.vecdot(
            x / (weight + variance.squared_radiances(part, c, radiance) @ variance.doubt), x
        )
    np.divide(np.float32(1), weight, out=weight)
    if holes is not None:
        weight[holes[0]] *= holes[1]
    out.normal[part] = basis.normal(part, weight)
    weight *= x
    out.right[part] = basis.project(part, weight)
    if variance.doubt is None:
        out.chi[part] = np.vecdot(weight, x)


def _holes(
    factored: FactoredResponses,
    basis: _SharedBasis | _OwnBases,
    part: slice,
    x: np.ndarray,
    c: np.ndarray,
    blank: Any,
    out: NormalEquations,
) -> tuple[np.ndarray, np.ndarray]:
    """(rows, their masks as numbers) of lenslets in this block that lack pixels; x is 0 there, c
    and `out` made good.
    """
    rows = np.flatnonzero(np.isnan(c).any(axis=1))
    mask = np.isfinite(x)
    if blank is not None:
        mask[blank] = False
    mask = mask[rows]
    x[rows] = np.where(mask, x[rows], 0)
    weight = mask.astype(np.float32)
    at = part.start + rows
    out.count[at] = mask.sum(axis=1)
    own = basis.rows(part, rows)
    start = own.normal(slice(None), weight)
    out.unweighted_normal[at], out.hard[at] = start, np.linalg.eigvalsh(start)[:, 0] < HARD
    start[out.hard[at]] = np.eye(start.shape[-1])
    c[rows] = np.linalg.solve(start, own.project(slice(None), x[rows])[..., None])[..., 0]
    return rows, weight


def _add(target: np.ndarray, factor: float, left: np.ndarray, right: np.ndarray) -> None:
    """target += factor * left @ right in one pass, all float32 (n, k), (k, m), (n, m)."""
    from scipy.linalg.blas import sgemm

    # BLAS counts along columns
    done = sgemm(factor, right.T, left.T, 1.0, target.T, overwrite_c=True)
    if not np.shares_memory(done, target):
        target[:] = done.T


def _narrow(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """left (n, pixel) @ right.T (pixel, few), as many rows at a time as make a SMALL_PRODUCT."""
    most = SMALL_PRODUCT // right.size
    if most < FEWEST_ROWS or len(left) <= most:
        return left @ right.T
    step = -(-len(left) // -(-len(left) // most))
    return np.concatenate([left[i : i + step] @ right.T for i in range(0, len(left), step)])


class _SharedBasis:
    """One basis for all lenslets: plain matrix products."""

    def __init__(self, q: np.ndarray) -> None:
        self.wide = q[0]  # (band, pixel)
        bands = len(self.wide)
        pairs = np.triu_indices(bands)
        self.products = self.wide[pairs[0]] * self.wide[pairs[1]]  # (pair, pixel)
        self.unfold = np.zeros((bands, bands), int)
        self.unfold[pairs] = self.unfold[pairs[::-1]] = np.arange(len(pairs[0]))
        self.buffer = np.zeros((0, self.wide.shape[1]), np.float32)
        self.terms: np.ndarray | None = None

    def rows(self, part: slice, rows: np.ndarray) -> _SharedBasis:
        return self

    def project(self, part: slice, x: np.ndarray) -> np.ndarray:
        """Q^T x (lenslet, band), float64."""
        return _narrow(x, self.wide).astype(float)

    def subtract(self, part: slice, c: np.ndarray, x: np.ndarray) -> None:
        """x - Q c in place of x; Q c was not formed."""
        _add(x, -1.0, c.astype(np.float32), self.wide)

    def mixed(
        self,
        part: slice,
        c: np.ndarray,
        mean: np.ndarray | None,
        weights: np.ndarray,
        patterns: np.ndarray,
    ) -> np.ndarray:
        """Q c + weights (lenslet, n) @ patterns (n, pixel), in a buffer that the
        next call overwrites.
        """
        if len(self.buffer) < len(c):
            self.buffer = np.empty((len(c), self.wide.shape[1]), np.float32)
        if self.terms is None:
            self.terms = np.concatenate([self.wide, patterns])
        return np.matmul(
            np.concatenate([c, weights], axis=1, dtype=np.float32, casting="same_kind"),
            self.terms,
            out=self.buffer[: len(c)],
        )

    def normal(self, part: slice, weight: np.ndarray) -> np.ndarray:
        """Q^T W Q (lenslet, band, band), float64."""
        return _narrow(weight, self.products)[:, self.unfold].astype(float)


class _OwnBases:
    """A basis for every lenslet: products lenslet by lenslet."""

    def __init__(self, q: np.ndarray) -> None:
        self.q = q
        self.buffer = self.weighted = np.zeros(0, np.float32)

    def rows(self, part: slice, rows: np.ndarray) -> _OwnBases:
        return _OwnBases(self.q[part][rows])

    def project(self, part: slice, x: np.ndarray) -> np.ndarray:
        return np.vecdot(self.q[part], x[:, None]).astype(float)

    def subtract(self, part: slice, c: np.ndarray, x: np.ndarray) -> np.ndarray:
        """x - Q c in place of x; returns Q c."""
        mean = self._picture(part, c)
        np.subtract(x, mean, out=x)
        return mean

    def mixed(
        self,
        part: slice,
        c: np.ndarray,
        mean: np.ndarray | None,
        weights: np.ndarray,
        patterns: np.ndarray,
    ) -> np.ndarray:
        if mean is None:
            mean = self._picture(part, c)
        _add(mean, 1.0, weights.astype(np.float32), patterns)
        return mean

    def _picture(self, part: slice, c: np.ndarray) -> np.ndarray:
        q = self.q[part]
        if len(self.buffer) < len(c):
            self.buffer = np.empty((len(c), 1, q.shape[-1]), np.float32)
        return np.matmul(c.astype(np.float32)[:, None], q, out=self.buffer[: len(c)])[:, 0]

    def normal(self, part: slice, weight: np.ndarray) -> np.ndarray:
        q = self.q[part]
        if len(self.weighted) < len(q):
            self.weighted = np.empty(q.shape, np.float32)
        weighted = np.multiply(q, weight[:, None], out=self.weighted[: len(q)])
        return np.matmul(weighted, np.swapaxes(q, -1, -2)).astype(float)


class _PixelVariance:
    """Variance of pixel values: gain F b + read variance + b^2 var(F), at least
    the read variance.
    """

    def __init__(
        self,
        factored: FactoredResponses,
        noise: Noise,
        response_variance: np.ndarray | None,
        doubt: np.ndarray | None,
    ) -> None:
        self.factored = factored
        self.gain = noise.gain
        self.read = np.float32(max(noise.without_signal, 1e-12))
        self.known, self.doubt = (
            None if v is None else np.ascontiguousarray(np.nan_to_num(v).T, np.float32)
            for v in (response_variance, doubt)
        )
        constant = np.full((1, factored.q.shape[-1]), self.read)
        self.patterns = constant if self.known is None else np.concatenate([constant, self.known])

    def of(
        self,
        basis: _SharedBasis | _OwnBases,
        part: slice,
        c: np.ndarray,
        mean: np.ndarray | None,
        radiance: np.ndarray | None,
    ) -> np.ndarray:
        """(lenslet, pixel) in the buffer of `basis`; b from c, whose picture `mean` may be, or
        `radiance` where given.
        """
        weights = np.ones((len(c), 1))
        if self.known is not None:
            weights = np.concatenate([weights, self.squared_radiances(part, c, radiance)], axis=1)
        if radiance is not None:
            c, mean = (
                (self._own(self.factored.r, part) @ np.clip(radiance, 0, None)[..., None])[..., 0],
                None,
            )
        if mean is not None:
            mean *= np.float32(self.gain)
        out = basis.mixed(part, self.gain * c, mean, weights, self.patterns)
        # the same as maximum of a scalar, and np.reciprocal, in a third and half of the time
        return np.clip(out, self.read, np.float32(np.inf), out=out)

    def squared_radiances(
        self, part: slice, c: np.ndarray, radiance: np.ndarray | None
    ) -> np.ndarray:
        """b^2 (lenslet, band) float32, negative radiances counting as 0."""
        b = (
            (self._own(self.factored.inverse, part) @ c[..., None])[..., 0]
            if radiance is None
            else radiance
        )
        return np.square(np.clip(b, 0, None)).astype(np.float32)

    def _own(self, matrices: np.ndarray, part: slice) -> np.ndarray:
        return matrices[part] if len(matrices) > 1 else matrices


# --- answers --------------------------------------------------------------------------------------


def solve(
    factored: FactoredResponses,
    sums: NormalEquations,
    method: str,
    prior: tuple[np.ndarray, np.ndarray] | None = None,
    weighed: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Radiances and their standard deviations.

    factored, sums: of the superpixels.
    method: pinv, wls, lmmse or nnls.
    prior: mean (band,) and covariance (band, band), for lmmse.
    weighed: whether `sums` are, by the noise; where they are not, it is estimated from the
        residual, one number a superpixel.

    Returns two (lenslet, band), NaN where a superpixel has too few good pixels or a condition
    number above 1e10, and where it is hard.
    """
    bands = factored.r.shape[-1]
    inverse = factored.inverse
    known = factored.sound & ~sums.hard & (sums.count >= (0 if method == "lmmse" else bands))
    normal = np.where(
        known[:, None, None],
        sums.unweighted_normal if method == "pinv" else sums.normal,
        np.eye(bands),
    )
    if not weighed:
        covariance, c = (
            np.linalg.inv(normal) * (sums.chi / np.maximum(sums.count - bands, 1))[:, None, None],
            sums.unweighted,
        )
    elif method == "pinv":
        assert sums.spread is not None
        back = np.linalg.inv(normal)
        covariance, c = (
            back @ np.where(known[:, None, None], sums.spread, 0) @ back,
            sums.unweighted,
        )
    elif method == "lmmse":
        assert prior is not None
        mean, given = (np.asarray(p, float) for p in prior)
        pull = np.swapaxes(inverse, -1, -2) @ np.linalg.inv(given) @ inverse
        covariance = np.linalg.inv(normal + pull)
        c = (
            sums.unweighted
            + (
                covariance
                @ (sums.right + (pull @ (factored.r @ mean - sums.unweighted)[..., None])[..., 0])[
                    ..., None
                ]
            )[..., 0]
        )
    else:
        covariance = np.linalg.inv(normal)
        c = sums.unweighted + (covariance @ sums.right[..., None])[..., 0]
    b = (inverse @ c[..., None])[..., 0]
    sigma = np.sqrt(
        np.diagonal(inverse @ covariance @ np.swapaxes(inverse, -1, -2), axis1=-2, axis2=-1)
    )
    if method == "nnls":
        b = _non_negative(np.broadcast_to(factored.r, normal.shape), normal, c, b)
    return np.where(known[:, None], b, np.nan), np.where(known[:, None], sigma, np.nan)


def _non_negative(r: np.ndarray, normal: np.ndarray, c: np.ndarray, b: np.ndarray) -> np.ndarray:
    """min |L^T (R b - c)| with b >= 0, L L^T = Q^T W Q, where the free answer b
    has a negative part.
    """
    from scipy.optimize import nnls

    b = np.array(b)
    for i in np.flatnonzero((b < 0).any(axis=-1) & np.isfinite(b).all(axis=-1)):
        root = np.linalg.cholesky(normal[i]).T
        b[i] = nnls(root @ r[i], root @ c[i])[0]
    return b
