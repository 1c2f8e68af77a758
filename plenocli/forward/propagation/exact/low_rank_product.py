"""A large product M = sum_ab X_a K_ab X_b^T of known factors, compressed to its own rank
without being formed.

The range is found by random combinations of M's columns (Halko, Martinsson, Tropp 2011), which cost
as little as the factors have terms; what is seen of M through an orthonormal basis of it is a small
core, whose singular values say where to cut. Where factors have many more terms than M,
combinations of both rows and columns show first how many of them it takes, and which.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.propagation.fresnel.spread_function import terms_within

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    Matrix: TypeAlias = np.ndarray | csr_array

FILL = 0.85
"""Largest part of a sketch that the terms kept may fill."""
NARROW, OVER = 2, 2
"""A product is narrowed where its terms fit a sketch of its factors' over the first; random
combinations that this is told from, over that.
"""
SMALL = 40
"""Terms of factors that are not worth narrowing."""
THIN = 1e-13
"""Entries of a coupling below this share of its largest are rounding of double precision."""
MAX_SKETCH = 2500
"""Columns of the largest sketch: beyond it the set-up takes minutes and the model is refused."""


class Product:
    """left, right: lists of X_a (rows, terms) and X_b (columns, terms);
    couplings: {(a, b): K_ab}, at least one for each factor;
    symmetric: whether M^T = M, with the same factors on both sides.
    """

    def __init__(
        self,
        left: list[np.ndarray],
        right: list[np.ndarray],
        couplings: Mapping[tuple[int, int], Matrix],
        symmetric: bool,
    ) -> None:
        self.left, self.right = left, right
        self.couplings, self.symmetric = {key: thin(k) for key, k in couplings.items()}, symmetric
        self.limit = min(len(left[0]), len(right[0]))
        self.rng = np.random.default_rng(20130701)

    def _through(self, side: int, blocks: list[np.ndarray]) -> list[np.ndarray]:
        """The couplings times blocks (terms, t) of the other side's factors: list of (terms, t)
        for this side's (0 left, 1 right).
        """
        if side == 0:
            return [
                sum(k @ blocks[b] for (i, b), k in self.couplings.items() if i == a)
                for a in range(len(self.left))
            ]
        return [
            sum(k.T @ blocks[a] for (a, i), k in self.couplings.items() if i == b)
            for b in range(len(self.right))
        ]

    def _times(self, side: int, seen: list[np.ndarray]) -> np.ndarray:
        """M (side 0) or M^T (1) times combinations of its columns, given as what the other
        side's factors make of them: (rows, combinations).
        """
        mine = self.right if side else self.left
        out = np.zeros((len(mine[0]), seen[0].shape[1]), mine[0].dtype)
        for x, y in zip(mine, self._through(side, seen)):
            _add_product(out, x, y)
        return out

    def _mixed(self, side: int, count: int) -> list[np.ndarray]:
        """X^T Omega for each factor X of a side, Omega (rows, count) random combinations of
        rows, every one of which goes into one of them.
        """
        from scipy import sparse

        factors = self.right if side else self.left
        rows = len(factors[0])
        order, signs = (
            self.rng.permutation(rows),
            self.rng.choice(np.array([-1, 1], factors[0].real.dtype), rows),
        )
        combine = sparse.csr_array((signs, (np.arange(rows) % count, order)), (count, rows))
        return [(combine @ x).T for x in factors]

    def _through_basis(self, q: np.ndarray) -> list[np.ndarray]:
        """What is seen of M through orthonormal columns q: X_a^T q* for each factor where M is
        symmetric, else M^T q* alone.
        """
        turned = q.conj()
        seen = [x.T @ turned for x in self.left]
        return seen if self.symmetric else [self._times(1, seen)]

    def _extend(
        self, q: np.ndarray | None, seen: list[np.ndarray] | None, count: int
    ) -> tuple[np.ndarray, list[np.ndarray]]:
        """The basis q of M's range (None: not begun) with columns added up to `count`, and what
        is seen of M through it.
        """
        # with no room left the range is found anew: what would be added is rounding, and would not
        # be perpendicular to what is there
        if q is None or seen is None or count >= self.limit:
            q = orthonormal(self._times(0, self._mixed(1, count)))
            return q, self._through_basis(q)
        columns = self._times(0, self._mixed(1, count - q.shape[1]))
        for _ in range(2):
            columns -= q @ (q.conj().T @ columns)
        new = orthonormal(columns)
        # what was numerically nothing is no direction of its own
        new = orthonormal(new - q @ (q.conj().T @ new))
        return np.hstack([q, new]), [
            np.hstack(pair) for pair in zip(seen, self._through_basis(new))
        ]

    def _core(self, q: np.ndarray, seen: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """(P, K) with Q Q^H M = Q K P^T, P orthonormal and Q where M is symmetric."""
        if self.symmetric:
            return q, sum(o.T @ c for o, c in zip(seen, self._through(0, seen)))
        p, triangle = _triangle(seen[0])
        return p, triangle.T

    def factors(
        self, cut: float, count: int, worst: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """The product compressed to its own rank, M = H B^T.

        cut: root sum of squares that may be lost;
        count: columns of the first sketch;
        worst: (row, column) root sum of squares that each object point may lose, M's rows and
            columns running fastest over those along both axes; None: as much as all together.

        Returns (H, B).
        Raises NumericsError where no sketch of MAX_SKETCH columns holds M.
        """
        most = min(self.limit, MAX_SKETCH)
        size, q, seen = min(count, most), None, None
        while True:
            q, seen = self._extend(q, seen, size)
            p, core = self._core(q, seen)
            u, s, vh = np.linalg.svd(core)
            root = np.sqrt(s)
            high, wide = q @ (u * root), p @ (vh.T * root)
            terms = max(terms_within(s, cut), _terms_of_all(high, wide, worst))
            u, v = u[:, :terms] * root[:terms], vh[:terms].T * root[:terms]
            if size >= self.limit or (
                terms <= FILL * size and self._missed(q, u @ v.T, p) <= 2 * cut
            ):
                return high[:, :terms].copy(), wide[:, :terms].copy()
            if size >= MAX_SKETCH:
                raise NumericsError(
                    f"the exact field has more than {int(FILL * size)} separable terms",
                    "model",
                    "ask for a looser accuracy, fewer superpixels or the paraxial model",
                )
            size = min(most, max(size + size // 4, int(terms / FILL) + 8))

    def narrowed(self, cut: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """The product through far fewer columns than its factors have terms, M = X K Y^T.

        cut: root sum of squares that may be lost.

        Returns (X, Y, K), X orthonormal and Y = X where M is symmetric; None where M does not have
        so few terms, or its factors have few enough.
        """
        given = sum(x.shape[1] for x in self.left)
        count = given // NARROW
        if given <= SMALL or count >= self.limit:
            return None
        directions, terms = self._directions(cut, count)
        if terms > FILL * count:
            return None
        x = orthonormal(self._times(0, directions))
        seen = self._through_basis(x)
        y, core = (
            self._core(x, seen) if self.symmetric else (seen[0], np.eye(x.shape[1], dtype=x.dtype))
        )
        return (x, y, core) if self._missed(x, core, y) <= 2 * cut else None

    def _directions(self, cut: float, count: int) -> tuple[list[np.ndarray], int]:
        """Combinations of M's columns that span its range up to `cut`, as X_b^T times them for each
        factor, and the terms that M has; no more than `count` of either. Found where M is small:
        through random combinations of its rows and of its columns, OVER times as many.
        """
        many = min(OVER * count, self.limit)
        right = self._mixed(1, many)
        left = right if self.symmetric else self._mixed(0, many)
        core = sum(m.T @ c for m, c in zip(left, self._through(0, right)))
        # a step of a power iteration, which parts large values from small ones
        basis = orthonormal(
            core @ self.rng.choice(np.array([-1, 1], core.real.dtype), (many, count))
        )
        basis = orthonormal(core.conj().T @ basis)
        image = core @ basis
        rest = np.linalg.norm(core - image @ basis.conj().T)
        _, s, vh = np.linalg.svd(_triangle(image)[1])
        # the k largest also fit what is random here, so that less than all of the rest is seen
        share = 1 - np.arange(count) * (1 / many - 1 / self.limit)
        terms = terms_within(s, cut * share, rest)
        basis = basis @ vh[: int(terms / FILL) + 8].conj().T
        return [m @ basis for m in right], terms

    def _missed(self, x: np.ndarray, core: np.ndarray, y: np.ndarray) -> float:
        """Root sum of squares of M - X K Y^T, estimated on random entries."""
        rows, columns = (self.rng.integers(0, len(x[0]), 64) for x in (self.left, self.right))
        exact = sum(
            a[rows] @ c
            for a, c in zip(self.left, self._through(0, [b[columns].T for b in self.right]))
        )
        difference = exact - x[rows] @ core @ y[columns].T
        return float(np.sqrt((np.abs(difference) ** 2).mean() * len(x) * len(y)))


def _terms_of_all(high: np.ndarray, wide: np.ndarray, worst: np.ndarray | None) -> int:
    """Terms of high wide^T, its columns by falling singular values, which they hold on either side,
    that it takes until no point loses more than `worst` (row, column).
    """
    if worst is None:
        return 1
    # what terms bring to a point: they are orthogonal over all points, and all but so over one
    rows, columns = (
        (np.abs(x.reshape(-1, n, x.shape[1])) ** 2).sum(axis=0).T
        for x, n in zip((high, wide), worst.shape)
    )
    lost = np.cumsum((rows[:, :, None] * columns[:, None, :])[::-1], axis=0)[::-1]
    return max(1, int(np.count_nonzero((lost > worst**2).any(axis=(1, 2)))))


def _add_product(out: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """out += x @ y, all row by row in memory, without an array between."""
    from scipy.linalg.blas import get_blas_funcs

    multiply = get_blas_funcs("gemm", (out,))
    # columns of the transposed arrays lie together, as BLAS has them
    done = multiply(1, np.ascontiguousarray(y, out.dtype).T, x.T, beta=1, c=out.T, overwrite_c=True)
    if not np.shares_memory(done, out):
        out[:] = done.T


def thin(matrix: np.ndarray) -> Matrix:
    """A matrix without its entries below rounding, sparse where few are left: couplings of singular
    vectors are all but diagonal.
    """
    from scipy import sparse

    if sparse.issparse(matrix):
        return matrix
    size = np.abs(matrix)
    keep = size > THIN * size.max()
    return (
        sparse.csr_array(np.where(keep, matrix, 0))
        if np.count_nonzero(keep) < matrix.size / 16
        else matrix
    )


def orthonormal(columns: np.ndarray) -> np.ndarray:
    """An orthonormal basis of the columns."""
    return _triangle(columns)[0]


def _triangle(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Q, R) with columns = Q R, Q orthonormal, R triangular."""
    from scipy.linalg import qr

    return qr(columns, mode="economic", check_finite=False)
