"""Large complex matrices: products by three real products in place of four (N. J. Higham, SIAM
Journal on Matrix Analysis and Applications 13, 1992), a sixth less time, errors of like size; and
orthonormal bases of tall ones by Cholesky factors of what columns have in common, after a small
sketch of the rows has made them all but orthonormal (A. J. Higgins et al., arXiv 2309.05868, 2023):
two thirds of the time of reflections, rows at a time, and no second matrix of that size. All of it
by NumPy, whose products let other threads work; SciPy's do not.
"""

from __future__ import annotations

from collections.abc import Iterable
from threading import local
from typing import Any

import numpy as np

from plenocli.base.tiling import spread_bands

THREE_SERVE = 60
"""Rows, columns and terms from which on three real products take less time than four."""
TALL = 12
"""Rows a column from which on bases by Cholesky factors take less time."""
OVER = 2
"""Rows of the sketch a column: lengths of combinations of columns differ by ten times at the most
then."""
ROWS = 1024
"""Rows of a matrix that are worked on together."""
EVEN = 0.1
"""Least over largest number of a triangle whose inverse leaves columns orthonormal up to rounding.
"""
TRIES = 3
"""Times that columns are made more even before reflections are taken."""
DEPENDENT = 8.0
"""Of rounding, that over which columns depend on each other."""

Thirds = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Real and imaginary part of a complex matrix and their sum."""


def thirds(matrix: np.ndarray, places: np.ndarray | None = None) -> Thirds:
    """Thirds of a matrix, laid out as it is.

    places: (3, its size or more), where they are put; None: in arrays of their own.
    """
    if places is None:
        real, imaginary = matrix.real.copy("K"), matrix.imag.copy("K")
        return real, imaginary, real + imaginary
    turned = abs(matrix.strides[0]) < abs(matrix.strides[-1])  # its columns lie together
    shape = matrix.shape[::-1] if turned else matrix.shape
    flat = (place[: matrix.size].reshape(shape) for place in places)
    real, imaginary, both = (part.T if turned else part for part in flat)
    real[:], imaginary[:] = matrix.real, matrix.imag
    np.add(real, imaginary, out=both)
    return real, imaginary, both


def product_of_thirds(
    left: Iterable[np.ndarray], right: Iterable[np.ndarray], out: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(real part, imaginary part) of a product of matrices of which `thirds` are known.

    out: (3, row, column), for the three products and what is made of them.
    """
    for a, b, product in zip(left, right, out):
        np.matmul(a, b, out=product)
    first, second, both = out
    both -= first
    both -= second
    first -= second
    return first, both


def is_tall(columns: Any) -> bool:
    """Whether `tall_basis` serves: complex and of NumPy, with many more rows than columns."""
    return (
        isinstance(columns, np.ndarray)
        and np.iscomplexobj(columns)
        and columns.shape[1] >= THREE_SERVE
        and len(columns) >= TALL * columns.shape[1]
    )


def tall_basis(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(Q, R) with columns = Q R, Q orthonormal, R triangular.

    columns: (row, column), overwritten.
    """
    triangle = step = _sketched(columns)
    if not _independent(triangle):
        return _reflected(columns)
    for _ in range(TRIES):
        found = _root(_divided(columns, step, columns))
        if found is None:
            break
        step, triangle = found, found @ triangle
        if _evenness(step) > EVEN:
            _divided(columns, step, columns, last=True)
            return columns, triangle
    q, step = _reflected(columns)
    return q, step @ triangle


def tall_triangle(columns: np.ndarray) -> np.ndarray:
    """R of `tall_basis`, columns left as they are."""
    from scipy.linalg import qr

    triangle = _sketched(columns)
    if _independent(triangle):
        found = _root(_divided(columns, triangle))
        if found is not None and _evenness(found) > EVEN:
            return found @ triangle
    (found,) = qr(columns, mode="r", check_finite=False)
    return found[: columns.shape[1]]


def _reflected(columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.linalg import qr

    return qr(columns, mode="economic", check_finite=False)


def _sketched(columns: np.ndarray) -> np.ndarray:
    """R of random sums of rows."""
    from scipy.linalg import qr

    rows, count = columns.shape
    rng, many = np.random.default_rng(20150401), OVER * count
    order, signs = rng.permutation(rows), rng.choice([-1.0, 1.0], (rows, 1))
    signs = signs.astype(columns.real.dtype)
    sums = np.zeros((many, count), columns.dtype)
    for start in range(0, rows, many):
        part = columns[order[start : start + many]]
        part *= signs[start : start + many]
        sums[: len(part)] += part
    (found,) = qr(sums, mode="r", overwrite_a=True, check_finite=False)
    return found[:count]


def _evenness(triangle: np.ndarray) -> float:
    """Least over largest number of the diagonal."""
    size = np.abs(np.diag(triangle))
    return float(size.min() / size.max()) if size.max() > 0 else 0.0


def _independent(triangle: np.ndarray) -> bool:
    """Whether columns of this triangle are, up to rounding."""
    return _evenness(triangle) > DEPENDENT * np.finfo(triangle.dtype).eps


def _divided(
    columns: np.ndarray,
    triangle: np.ndarray,
    out: np.ndarray | None = None,
    last: bool = False,
) -> np.ndarray:
    """Q^H Q of Q = columns R^-1.

    out: where Q is put, `columns` too; None: nowhere.
    last: whether that is all, and nothing is returned that has a meaning.
    """
    rows, count = columns.shape
    inverse, real, places = thirds(np.linalg.inv(triangle)), columns.real.dtype, local()
    grams: dict[int, np.ndarray] = {}
    middle = count // 2

    def work(band: slice) -> None:
        if not hasattr(places, "left"):
            most = min(ROWS, rows)
            places.left = np.empty((3, most * count), real)
            places.first = np.empty((3, most, middle), real)
            places.second = np.empty((3, most, count - middle), real)
        left = thirds(columns[band], places.left)
        lefts, length = [part[:, :middle] for part in left], band.stop - band.start
        # nothing is below the diagonal
        halves = [
            product_of_thirds(
                lefts, [part[:middle, :middle] for part in inverse], places.first[:, :length]
            ),
            product_of_thirds(
                left, [part[:, middle:] for part in inverse], places.second[:, :length]
            ),
        ]
        q = left[0], left[1]  # they have been used
        for part, (first, second) in zip(q, zip(*halves)):
            part[:, :middle], part[:, middle:] = first, second
        if out is not None:
            out[band].real, out[band].imag = q
        if not last:
            grams[band.start] = _overlaps(*q)

    spread_bands(rows, ROWS, work)
    # in the order of rows, whoever was first
    total: Any = sum(grams[key] for key in sorted(grams))
    return total


def _overlaps(real: np.ndarray, imaginary: np.ndarray) -> np.ndarray:
    """Q^H Q of real and imaginary part of Q."""
    cross = real.T @ imaginary
    found = np.empty(cross.shape, np.result_type(real, 1j))
    found.real = real.T @ real + imaginary.T @ imaginary
    found.imag = cross - cross.T
    return found


def _root(gram: np.ndarray) -> np.ndarray | None:
    """Cholesky's R of R^H R; None where there is none."""
    try:
        return np.linalg.cholesky(gram).conj().T
    except np.linalg.LinAlgError:
        return None
