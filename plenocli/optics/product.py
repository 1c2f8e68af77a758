"""A large product M = sum_ab X_a K_ab X_b^T of known factors, compressed to its own rank without being formed.

The range is found by random combinations of M's columns (Halko, Martinsson, Tropp 2011), which cost as little as the factors
have terms; the factors seen through an orthonormal basis of it give a small core, whose singular values say where to cut.
"""

import numpy as np

from plenocli.errors import NumericsError

FILL = 0.85
"""Largest part of a sketch that the terms kept may fill."""
THIN = 1e-13
"""Entries of a coupling below this share of its largest are rounding of double precision."""
MAX_SKETCH = 2500
"""Columns of the largest sketch: beyond it the set-up takes minutes and the model is refused."""


class Product:
    """left, right: lists of X_a (rows, terms) and X_b (columns, terms); couplings: {(a, b): K_ab}, at least one for each factor; symmetric: whether M^T = M,
    with the same factors on both sides."""

    def __init__(self, left, right, couplings, symmetric):
        self.left, self.right = left, right
        self.couplings, self.symmetric = {key: thin(k) for key, k in couplings.items()}, symmetric
        self.rng = np.random.default_rng(20130701)

    def _through(self, side, blocks):
        """The couplings times blocks (terms, t) of the other side's factors: list of (terms, t) for this side's (0 left, 1 right)."""
        if side == 0:
            return [sum(k @ blocks[b] for (i, b), k in self.couplings.items() if i == a) for a in range(len(self.left))]
        return [sum(k.T @ blocks[a] for (a, i), k in self.couplings.items() if i == b) for b in range(len(self.right))]

    def _sketch(self, side, count):
        """`count` random combinations of the columns of M (side 0) or of M^T (1), every one of which goes into one of them."""
        mine, other = (self.left, self.right) if side == 0 else (self.right, self.left)
        order = self.rng.permutation(len(other[0]))
        signs = self.rng.choice(np.array([-1, 1], other[0].real.dtype), len(order))
        mixed = []
        for x in other:
            total = np.zeros((count, x.shape[1]), x.dtype)
            for start in range(0, len(order), count):
                some = slice(start, start + count)
                total[:len(order[some])] += x[order[some]] * signs[some, None]
            mixed.append(total.T)
        out = np.zeros((len(mine[0]), count), mine[0].dtype)
        for x, y in zip(mine, self._through(side, mixed)):
            _add_product(out, x, y)
        return out

    def _extend(self, side, count, basis, inner):
        """A basis of the range of M (side 0) or M^T (1) with `count` more columns, and X^T times it for each factor of that side."""
        columns = self._sketch(side, count)
        if basis is not None:
            for _ in range(2):
                columns -= basis @ (basis.conj().T @ columns)
        new = orthonormal(columns)
        if basis is not None:
            # what was numerically nothing is no direction of its own
            new = orthonormal(new - basis @ (basis.conj().T @ new))
        turned = new.conj()
        seen = [x.T @ turned for x in (self.right if side else self.left)]
        if basis is None:
            return new, seen
        return np.hstack([basis, new]), [np.hstack(pair) for pair in zip(inner, seen)]

    def factors(self, cut, count):
        """(H, B) with M = H B^T up to `cut` (root sum of squares), from a sketch of `count` columns or more.

        NumericsError where no sketch of MAX_SKETCH columns holds M.
        """
        limit = min(len(self.left[0]), len(self.right[0]))
        add, q, p, outer, inner = min(count, limit, MAX_SKETCH), None, None, None, None
        while True:
            q, outer = self._extend(0, add, q, outer)
            p, inner = (q, outer) if self.symmetric else self._extend(1, add, p, inner)
            size = q.shape[1]
            core = sum(o.T @ c for o, c in zip(outer, self._through(0, inner)))
            u, s, vh = np.linalg.svd(core)
            tails = np.sqrt(np.cumsum(s.astype(float)[::-1] ** 2)[::-1])
            terms = max(1, int(np.count_nonzero(tails > cut)))
            root = np.sqrt(s[:terms])
            high, wide = q @ (u[:, :terms] * root), p @ (vh[:terms].T * root)
            if size >= limit or (terms <= FILL * size and self._missed(high, wide) <= 2 * cut):
                return high, wide
            if size >= MAX_SKETCH:
                raise NumericsError(
                    f"the exact field has more than {int(FILL * size)} separable terms",
                    "model", "ask for a looser accuracy, fewer superpixels or the paraxial model")
            add = min(MAX_SKETCH, limit, max(size // 4, int(terms / FILL) - size + 8) + size) - size

    def _missed(self, high, wide):
        """Root sum of squares of M - H B^T, estimated on random entries."""
        rows, columns = (self.rng.integers(0, len(x[0]), 64) for x in (self.left, self.right))
        exact = sum(x[rows] @ c for x, c in zip(self.left, self._through(0, [x[columns].T for x in self.right])))
        difference = exact - high[rows] @ wide[columns].T
        return float(np.sqrt((np.abs(difference) ** 2).mean() * len(high) * len(wide)))


def _add_product(out, x, y):
    """out += x @ y, all row by row in memory, without an array between."""
    from scipy.linalg.blas import get_blas_funcs

    multiply = get_blas_funcs("gemm", (out,))
    # columns of the transposed arrays lie together, as BLAS has them
    done = multiply(1, np.ascontiguousarray(y, out.dtype).T, x.T, beta=1, c=out.T, overwrite_c=True)
    if not np.shares_memory(done, out):
        out[:] = done.T


def thin(matrix):
    """The matrix with its entries below rounding left out, sparse where few are left: couplings of singular vectors are all but diagonal."""
    from scipy import sparse

    if sparse.issparse(matrix):
        return matrix
    size = np.abs(matrix)
    keep = size > THIN * size.max()
    return sparse.csr_array(np.where(keep, matrix, 0)) if np.count_nonzero(keep) < matrix.size / 16 else matrix


def orthonormal(columns):
    """An orthonormal basis of the columns."""
    from scipy.linalg import qr

    return qr(columns, mode="economic", check_finite=False)[0]
