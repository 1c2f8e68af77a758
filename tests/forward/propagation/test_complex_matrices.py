"""Bases of tall matrices by Cholesky factors, against what makes a basis; products in blocks,
against one product.
"""

import numpy as np
import pytest

from plenocli.base.budget import on_threads
from plenocli.forward.propagation import complex_matrices
from plenocli.forward.propagation.complex_matrices import (
    THREE_SERVE,
    is_tall,
    tall_basis,
    tall_triangle,
    thirds,
)
from plenocli.forward.propagation.exact import low_rank_product

WIDE = 64


def tall(decades, kind=np.complex64, rows=3000):
    """Columns whose combinations fall over so many decades, rows of very different lengths."""
    rng = np.random.default_rng(3)
    shape = (rows, WIDE)
    columns = rng.normal(size=shape) + 1j * rng.normal(size=shape)
    columns *= np.logspace(0, -3, rows)[rng.permutation(rows), None]
    mixed = columns @ np.diag(np.logspace(0, -decades, WIDE)) @ rng.normal(size=(WIDE, WIDE))
    return mixed.astype(kind)


@pytest.mark.parametrize("kind, decades", [("F", 0), ("F", 4), ("D", 5), ("D", 11)])
def test_a_tall_basis_is_orthonormal_and_spans_the_columns(kind, decades, monkeypatch):
    monkeypatch.setattr(complex_matrices, "ROWS", 700)
    monkeypatch.setattr(complex_matrices, "_reflected", None)
    columns = tall(decades, kind)
    given, rounding = columns.astype(complex), np.finfo(kind).eps
    kept = columns.copy()
    triangle = tall_triangle(kept)
    assert is_tall(columns) and (kept == columns).all()
    q, r = tall_basis(columns)
    assert q.dtype == kind and not np.tril(r, -1).any()
    assert np.abs(q.conj().T @ q - np.eye(WIDE)).max() < 30 * rounding
    assert np.linalg.norm(q.astype(complex) @ r - given) < 60 * rounding * np.linalg.norm(given)
    # unique up to signs: as reflections have it, each row as far as rounding leaves it
    least = np.abs(np.diag(np.linalg.qr(given)[1]))
    for found in (r, triangle):
        size = np.abs(np.diag(found))
        assert (np.abs(size - least) < 1e-3 * least + 60 * rounding * least.max()).all()


@pytest.mark.parametrize("columns", ["none", "alike", "a third of them"])
def test_columns_that_depend_on_each_other_have_a_basis(columns):
    """Reflections serve where there is no inverse."""
    given = tall(0)
    if columns == "none":
        given[:] = 0
    elif columns == "alike":
        given[:, 1:] = given[:, :1]
    else:
        given[:, ::3] = 0
    whole = given.copy()
    triangle = tall_triangle(given)
    q, r = tall_basis(given)
    assert np.abs(q.conj().T @ q - np.eye(WIDE)).max() < 1e-5
    size = np.linalg.norm(whole)
    assert np.linalg.norm(q @ r - whole) <= 1e-5 * size
    gram = triangle.conj().T @ triangle
    assert np.linalg.norm(gram - whole.conj().T @ whole) <= 1e-4 * size**2


def test_matrices_that_are_not_tall_are_left_to_reflections():
    columns = tall(0)
    assert not is_tall(columns[: 8 * WIDE]) and not is_tall(columns.real)
    assert not is_tall(columns[:, : THREE_SERVE - 1])


@pytest.mark.parametrize("conjugate", [False, True])
@pytest.mark.parametrize("turned", [False, True])
def test_large_products_in_blocks_are_one_product(conjugate, turned, monkeypatch):
    monkeypatch.setattr(low_rank_product, "ROWS", 90)
    monkeypatch.setattr(low_rank_product, "DEPTH", 70)
    rng = np.random.default_rng(5)
    x, y = (
        rng.normal(size=shape) + 1j * rng.normal(size=shape) for shape in ((203, 251), (251, 77))
    )
    left = np.asfortranarray(x) if turned else x
    found = low_rank_product._product(left, y, conjugate=conjugate)
    whole = x @ (y.conj() if conjugate else y)
    np.testing.assert_allclose(found, whole, rtol=1e-12, atol=1e-12 * np.abs(whole).max())
    with on_threads(3):
        assert (low_rank_product._product(left, y, conjugate=conjugate) == found).all()


def test_thirds_in_given_places_are_laid_out_as_the_matrix():
    rng = np.random.default_rng(6)
    matrix, places = rng.normal(size=(5, 7)) + 1j * rng.normal(size=(5, 7)), np.empty((3, 40))
    for given in (matrix, matrix.T, matrix[1:4, 2:5], matrix[1:4, 2:5].T):
        found = thirds(given, places)
        assert all(np.shares_memory(part, places) for part in found)
        for part, other in zip(found, thirds(given)):
            assert (part == other).all() and part.flags.c_contiguous == other.flags.c_contiguous
