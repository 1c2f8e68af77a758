"""A large product M = sum_ab X_a K_ab X_b^T of known factors, compressed to its own rank
without being formed.

The range is found by random combinations of M's columns (Halko, Martinsson, Tropp 2011), which cost
as little as the factors have terms; what is seen of M through an orthonormal basis of it is a small
core, whose singular values say where to cut. Where factors have many more terms than M,
combinations of both rows and columns show first how many of them it takes, and which. All of this
is done where the device has its arrays; what goes in and comes out are NumPy's.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from threading import local
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from plenocli.base.device import CPU, Device, beside, namespace
from plenocli.base.errors import NumericsError
from plenocli.base.tiling import even_bands, spread_bands
from plenocli.forward.propagation.complex_matrices import (
    THREE_SERVE,
    Thirds,
    is_tall,
    product_of_thirds,
    tall_basis,
    tall_triangle,
    thirds,
)
from plenocli.forward.propagation.fresnel.spread_function import terms_within

if TYPE_CHECKING:
    from scipy.sparse import csr_array

    Matrix: TypeAlias = np.ndarray | csr_array

FILL = 0.85
"""Largest part of a sketch that the terms kept may fill."""
NARROW, OVER = (6, 3, 2), 2
"""A product is narrowed where its terms fit a sketch of its factors' over the last; over the first
they often do, at a tenth of the cost. Random combinations that this is told from, over that.
"""
TESTED = 16
"""Random columns, at the least, by which it is told what those before them leave."""
SMALL = 40
"""Terms of factors that are not worth narrowing."""
THIN = 1e-13
"""Entries of a coupling below this share of its largest are rounding of double precision."""
ROWS, DEPTH = 1024, 2048
"""Rows of a product that are made together, from so many of what it sums over: fresh pages for the
parts of large matrices take longer than what is moved.
"""
MAX_SKETCH = 2500
"""Columns of the largest sketch: beyond it the set-up takes minutes and the model is refused."""


class Product:
    """left, right: X_a and X_b side by side, (rows, terms of all) and (columns, terms of all);
    couplings: {(a, b): K_ab}, at least one for each factor;
    symmetric: whether M^T = M, with the same factors on both sides;
    device: where it is compressed;
    terms: how many each X_a and each X_b has; None: there is one of either.
    """

    def __init__(
        self,
        left: np.ndarray,
        right: np.ndarray,
        couplings: Mapping[tuple[int, int], Matrix],
        symmetric: bool,
        device: Device = CPU,
        terms: tuple[Sequence[int], Sequence[int]] | None = None,
    ) -> None:
        self.device, self.symmetric = device, symmetric
        self.left = device.put(left)
        self.right = self.left if right is left else device.put(right)
        self._places = [_places(n) for n in terms or ([left.shape[1]], [right.shape[1]])]
        self.couplings = {key: _put_thin(device, k) for key, k in couplings.items()}
        self.limit = min(len(left), len(right))
        self.rng = np.random.default_rng(20130701)

    def _through(self, side: int, seen: Any) -> Any:
        """The couplings times what the other side's factors see (term, t): (term, t) for this
        side's (0 left, 1 right).
        """
        mine, others = self._places[side], self._places[1 - side]
        through = [
            (pair[side], (k.T if side else k) @ seen[others[pair[1 - side]], :])
            for pair, k in self.couplings.items()
        ]
        sums = [sum(found for n, found in through if n == number) for number in range(len(mine))]
        return self.device.xp.concat(sums, axis=0)

    def _times(self, side: int, seen: Any) -> Any:
        """M (side 0) or M^T (1) times combinations of its columns, given as what the other
        side's factors make of them: (rows, combinations).
        """
        return _product(self.right if side else self.left, self._through(side, seen))

    def _mixed(self, side: int, count: int) -> Any:
        """X^T Omega for the factors X of a side, Omega (rows, count) random combinations of
        rows, every one of which goes into one of them.
        """
        factors = self.right if side else self.left
        rows = factors.shape[0]
        order, signs = self.rng.permutation(rows), self.rng.choice([-1.0, 1.0], rows)
        return _combined(factors, order, signs, count)

    def _through_basis(self, q: Any) -> Any:
        """What is seen of M through orthonormal columns q: X^T q* of the factors where M is
        symmetric, else M^T q*.
        """
        seen = self._seen(q)
        return seen if self.symmetric else self._times(1, seen)

    def _seen(self, q: Any) -> Any:
        """X^T q* of the factors."""
        return _product(self.left.T, q, conjugate=True)

    def _extend(self, q: Any | None, seen: Any | None, count: int) -> tuple[Any, Any]:
        """The basis q of M's range (None: not begun) with columns added up to `count`, and what
        is seen of M through it.
        """
        # with no room left the range is found anew: what would be added is rounding, and would not
        # be perpendicular to what is there
        if q is None or seen is None or count >= self.limit:
            q = orthonormal(self._times(0, self._mixed(1, count)))
            return q, self._through_basis(q)
        xp, columns = self.device.xp, self._times(0, self._mixed(1, count - q.shape[1]))
        new, _ = _beside_basis(q, columns)
        seen = xp.concat([seen, self._through_basis(new)], axis=1)
        return xp.concat([q, new], axis=1), seen

    def _core(self, seen: Any) -> Any:
        """K with Q Q^H M = Q K Q^T, of a symmetric M."""
        return seen.T @ self._through(0, seen)

    def _values(self, q: Any, seen: Any) -> tuple[Any, Any, Any, Any]:
        """(U, s, V, P): Q Q^H M = Q U diag(s) (P V)^T, P = Q where M is symmetric, else `seen`."""
        if self.symmetric:
            u, s, vh = self.device.xp.linalg.svd(self._core(seen), full_matrices=False)
            return u, s, vh.T, q
        # what is seen times conj(U) is as long as s
        u, s, _ = self.device.xp.linalg.svd(_only_triangle(seen).T, full_matrices=False)
        least = float(self.device.xp.finfo(s.dtype).smallest_normal)
        return u, s, self.device.xp.conj(u) / (s + least), seen

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
        if not self.symmetric and self.left.shape[0] > self.right.shape[0]:
            # the basis is made where it is shorter, and gone through once less
            turned = self._turned().factors(cut, count, None if worst is None else worst.T)
            return turned[1], turned[0]
        most, xp, home = min(self.limit, MAX_SKETCH), self.device.xp, self.device.get
        size, q, seen = min(count, most), None, None
        while True:
            q, seen = self._extend(q, seen, size)
            u, s, v, p = self._values(q, seen)
            root, terms = xp.sqrt(s), terms_within(home(s), cut)
            u, v = u * root, v * root
            if worst is not None:
                high, wide = home(_product(q, u)), home(_product(p, v))
                terms = max(terms, _terms_of_all(high, wide, worst))
            u, v = u[:, :terms], v[:, :terms]
            if size >= self.limit or (
                terms <= FILL * size and self._missed(q, u @ v.T, p) <= 2 * cut
            ):
                if worst is None:
                    return home(_product(q, u)), home(_product(p, v))
                return high[:, :terms], wide[:, :terms]
            if size >= MAX_SKETCH:
                raise _too_many(size)
            size = min(most, max(size + size // 4, int(terms / FILL) + 8))

    def _turned(self) -> Product:
        """The product's transpose."""
        turned = copy(self)
        turned.left, turned.right = self.right, self.left
        turned._places = self._places[::-1]
        turned.couplings = {(b, a): k.T for (a, b), k in self.couplings.items()}
        return turned

    def spanned(self, cut: float, count: int) -> tuple[np.ndarray, np.ndarray]:
        """The product through random combinations of its columns alone, M = H B^T with H
        orthonormal: some more terms than its own rank in half the work, for what is not used often.

        cut, count: as `factors`.

        Returns (H, B).
        Raises NumericsError where no sketch of MAX_SKETCH columns holds M.
        """
        most, xp = min(self.limit, MAX_SKETCH), self.device.xp
        size, q = min(count, most), None
        while True:
            if size >= self.limit:  # no room beside what is there: anew, as _extend
                q = None
            known = 0 if q is None else q.shape[1]
            columns = self._times(0, self._mixed(1, size - known))
            new, triangle = _triangle(columns) if q is None else _beside_basis(q, columns)
            q = new if q is None else xp.concat([q, new], axis=1)
            more = _explaining(self.device.get(triangle), cut)
            if more or size >= self.limit:
                q = q[:, : known + more if more else size]
                return self.device.get(q), self.device.get(self._times(1, self._seen(q)))
            if size >= MAX_SKETCH:
                raise _too_many(size)
            size = min(most, size + size // 4)

    def narrowed(self, cut: float) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """The product through far fewer columns than its factors have terms, M = X K Y^T.

        cut: root sum of squares that may be lost.

        Returns (X, Y, K), X orthonormal and Y = X where M is symmetric; None where M does not have
        so few terms, or its factors have few enough.
        """
        given, home = self.left.shape[1], self.device.get
        if given <= SMALL or given // NARROW[-1] >= self.limit:
            return None
        tried = (self._directions(cut, given // part) for part in NARROW)
        directions = next((found for found in tried if found is not None), None)
        if directions is None:
            return None
        x = orthonormal(self._times(0, directions))
        seen = self._through_basis(x)
        y, core = (x, self._core(seen)) if self.symmetric else (seen, _like(x, np.eye(x.shape[1])))
        if self._missed(x, core, y) > 2 * cut:
            return None
        here = home(x)
        return here, here if y is x else home(y), home(core)

    def _directions(self, cut: float, count: int) -> Any | None:
        """Combinations of M's columns that span its range up to `cut`, as X^T times them of the
        right factors; None where that takes nearly `count` or more. Found where M is small:
        through random combinations of its rows and of its columns, OVER times as many.
        """
        many = min(OVER * count, self.limit)
        right = self._mixed(1, many)
        left = right if self.symmetric else self._mixed(0, many)
        core = left.T @ self._through(0, right)
        # a step of a power iteration, which parts large values from small ones
        linalg = self.device.xp.linalg
        basis = orthonormal(core @ _like(core, self.rng.choice([-1.0, 1.0], (many, count))))
        basis = orthonormal(_adjoint(core) @ basis)
        image = core @ basis
        rest = float(linalg.matrix_norm(core - image @ _adjoint(basis)))
        _, s, vh = linalg.svd(_only_triangle(image), full_matrices=False)
        # the k largest also fit what is random here, so that less than all of the rest is seen
        share = 1 - np.arange(count) * (1 / many - 1 / self.limit)
        terms = terms_within(self.device.get(s), cut * share, rest)
        if terms > FILL * count:
            return None
        basis = basis @ _adjoint(vh[: min(count, int(terms / FILL) + 8), :])
        return right @ basis

    def _missed(self, x: Any, core: Any, y: Any) -> float:
        """Root sum of squares of M - X K Y^T, estimated on random entries."""
        xp, sides = self.device.xp, (self.left, self.right)
        rows, columns = (beside(x, self.rng.integers(0, side.shape[0], 64)) for side in sides)
        some = self._through(0, xp.take(self.right, columns, axis=0).T)
        exact = xp.take(self.left, rows, axis=0) @ some
        told = xp.take(x, rows, axis=0) @ core @ xp.take(y, columns, axis=0).T
        mean = float(xp.mean(xp.abs(exact - told) ** 2))
        return math.sqrt(mean * x.shape[0] * y.shape[0])


def _explaining(triangle: np.ndarray, cut: float) -> int:
    """How many of the random columns Q R, all but a few, leave no more than `cut` of M, by what
    they leave of the others; 0 where too many do.

    triangle: R.
    """
    count = len(triangle)
    # R below and right of an entry of the diagonal is what those before it leave of the others,
    # which together are as long as M
    left = np.cumsum((np.abs(triangle) ** 2).sum(axis=1)[::-1])[::-1]
    left *= count / np.arange(count, 0, -1)
    enough = np.flatnonzero(left[: max(1, count - TESTED)] <= cut**2)
    return max(1, int(enough[0])) if len(enough) else 0


def _too_many(size: int) -> NumericsError:
    return NumericsError(
        f"the exact field has more than {int(FILL * size)} separable terms",
        "model",
        "ask for a looser accuracy, fewer superpixels or the paraxial model",
    )


def _terms_of_all(high: np.ndarray, wide: np.ndarray, worst: np.ndarray) -> int:
    """Terms of high wide^T, its columns by falling singular values, which they hold on either side,
    that it takes until no point loses more than `worst` (row, column).
    """
    # what terms bring to a point: they are orthogonal over all points, and all but so over one
    rows, columns = (
        (np.abs(x.reshape(-1, n, x.shape[1])) ** 2).sum(axis=0).T
        for x, n in zip((high, wide), worst.shape)
    )
    lost = np.cumsum((rows[:, :, None] * columns[:, None, :])[::-1], axis=0)[::-1]
    return max(1, int(np.count_nonzero((lost > worst**2).any(axis=(1, 2)))))


def _places(terms: Sequence[int]) -> list[slice]:
    """Of each factor's terms among those of all."""
    ends = np.cumsum(terms).tolist()
    return [slice(end - n, end) for n, end in zip(terms, ends)]


def _product(x: Any, y: Any, conjugate: bool = False) -> Any:
    """x @ y, or x @ y*; large ones of NumPy by three real products, in blocks."""
    if (
        not isinstance(x, np.ndarray)
        or min(*x.shape, y.shape[1]) < THREE_SERVE
        or not (np.iscomplexobj(x) and np.iscomplexobj(y))
    ):
        return x @ (namespace(y).conj(y) if conjugate else y)
    out, places = np.empty((len(x), y.shape[1]), x.dtype), local()  # a thread's for its products
    for inner in even_bands(len(y), DEPTH):
        parts = thirds(y[inner])
        if conjugate:
            np.negative(parts[1], out=parts[1])
            np.add(parts[0], parts[1], out=parts[2])

        def work(rows: slice, inner: slice = inner, parts: Thirds = parts) -> None:
            if not hasattr(places, "own"):
                many = min(ROWS, len(x))
                places.own = np.empty((3, many, y.shape[1]), x.real.dtype)
                places.left = np.empty((3, many * min(DEPTH, len(y))), x.real.dtype)
            part, target = x[rows, inner], out[rows]
            real, imaginary = product_of_thirds(
                thirds(part, places.left), parts, places.own[:, : len(part)]
            )
            if inner.start:
                target.real += real
                target.imag += imaginary
            else:
                target.real, target.imag = real, imaginary

        spread_bands(len(x), ROWS, work)
    return out


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


def _put_thin(device: Device, matrix: Matrix) -> Any:
    """A coupling where a device has its arrays: `thin` in NumPy's, whole in those of others."""
    if device.xp is np:
        return thin(matrix)
    return device.put(matrix if isinstance(matrix, np.ndarray) else matrix.toarray())


def _combined(x: Any, order: np.ndarray, signs: np.ndarray, count: int) -> Any:
    """(term, combination): rows of x in an `order` and with `signs`, each `count`th added up.

    x: (row, term).
    """
    xp, rows = namespace(x), len(order)
    whole = -(-rows // count) * count
    signs, order = np.pad(signs, (0, whole - rows)), np.pad(order, (0, whole - rows))
    total: Any = 0
    for start in range(0, whole, count):
        some = slice(start, start + count)
        part = xp.take(x, beside(x, order[some]), axis=0)
        part *= _like(x, signs[some, None])
        part += total
        total = part
    return total.T


def _like(array: Any, values: np.ndarray) -> Any:
    """Values of NumPy where an array is, of its type."""
    return namespace(array).asarray(beside(array, values), dtype=array.dtype)


def _adjoint(matrix: Any) -> Any:
    return namespace(matrix).conj(matrix).T


def _beside_basis(q: Any, columns: Any) -> tuple[Any, Any]:
    """(an orthonormal basis of what an orthonormal q leaves of columns, R of what it leaves)."""
    for _ in range(2):
        columns = columns - q @ (_adjoint(q) @ columns)
    new, triangle = _triangle(columns)
    # what was numerically nothing is no direction of its own
    return orthonormal(new - q @ (_adjoint(q) @ new)), triangle


def orthonormal(columns: Any) -> Any:
    """An orthonormal basis of the columns, which may be overwritten."""
    return _triangle(columns)[0]


def _triangle(columns: Any) -> tuple[Any, Any]:
    """(Q, R) with columns = Q R, Q orthonormal, R triangular; columns may be overwritten."""
    if is_tall(columns):
        return tall_basis(columns)
    if not isinstance(columns, np.ndarray):
        return tuple(namespace(columns).linalg.qr(columns))
    from scipy.linalg import qr

    return qr(columns, mode="economic", check_finite=False)


def _only_triangle(columns: Any) -> Any:
    """R of `_triangle`, columns left as they are."""
    if is_tall(columns):
        return tall_triangle(columns)
    if not isinstance(columns, np.ndarray):
        return namespace(columns).linalg.qr(columns)[1]
    from scipy.linalg import qr

    (found,) = qr(columns, mode="r", check_finite=False)
    return found[: columns.shape[1]]
