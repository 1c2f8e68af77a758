"""Linear maps: forward and adjoint belong together, and the block map equals the matrix
that it never forms.
"""

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.linear_maps import BlockCirculant, BlockToeplitz, product, torus_for
from tests.reference.adjoints import Dense, adjoint_gap

OFFSETS = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])


def block_map(count=(3, 4), dtype=float, seed=1):
    blocks = np.random.default_rng(seed).random((9, 5, 4)).astype(dtype)
    return BlockToeplitz(blocks, OFFSETS, count)


def planes(dtype=float, seed=4):
    """Two planes, the second one farther out: 4 and 3 points, reach 1 and 2, 5 pixels."""
    rng = np.random.default_rng(seed)
    far = np.array([[0, 0], [-2, 1], [2, -1], [1, 2]])
    return [
        (rng.random((9, 5, 4)).astype(dtype), OFFSETS),
        (rng.random((4, 5, 3)).astype(dtype), far),
    ]


def torus_map(count=(3, 4), torus=(5, 7), dtype=float):
    return BlockCirculant(planes(dtype), count, torus)


def round_the_torus(op, parts):
    """The matrix of a torus by its definition."""
    (rows, columns, unknowns), (seen_rows, seen_columns, pixels) = op.domain.shape, op.range.shape
    full = np.zeros((seen_rows, seen_columns, pixels, rows, columns, unknowns))
    first = 0
    for blocks, offsets in parts:
        for block, (dr, dc) in zip(blocks, offsets):
            for r in range(seen_rows):
                for c in range(seen_columns):
                    at = (r - dr) % rows, (c - dc) % columns
                    full[r, c, :, at[0], at[1], first : first + block.shape[1]] += block
        first += blocks.shape[2]
    return full.reshape(op.range.size, op.domain.size)


@pytest.mark.parametrize("torus", [(5, 6), (5, 7), (6, 8), (9, 10)])
def test_torus_is_the_full_matrix(torus):
    op, rng = torus_map(torus=torus), np.random.default_rng(5)
    full = round_the_torus(op, planes())
    x, y = rng.standard_normal(op.domain.shape), rng.standard_normal(op.range.shape)
    np.testing.assert_allclose(op.forward(x).ravel(), full @ x.ravel(), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(op.adjoint(y).ravel(), full.T @ y.ravel(), rtol=1e-12, atol=1e-12)
    whole = op.on_torus()
    assert whole.range.shape == (*torus, 5) and op.range.shape == (3, 4, 5)
    np.testing.assert_allclose(whole.forward(x)[:3, :4], op.forward(x), rtol=1e-12)


def test_torus_and_array_agree_where_nothing_is_outside():
    """An object on the lenslets' own fields only."""
    torus, count = torus_map(), (3, 4)
    x = np.zeros(torus.domain.shape)
    x[:3, :4] = np.random.default_rng(6).standard_normal((*count, 7))
    near, far = (BlockToeplitz(blocks, offsets, count) for blocks, offsets in planes())
    expected = near.forward(x[:3, :4, :4]) + far.forward(x[:3, :4, 4:])
    np.testing.assert_allclose(torus.forward(x), expected, rtol=1e-12, atol=1e-13)


def test_small_chunks_change_nothing(monkeypatch):
    whole = torus_map().spectrum
    monkeypatch.setattr("plenocli.base.linear_maps.CHUNK", 1)
    np.testing.assert_array_equal(torus_map().spectrum, whole)


def test_single_precision_stays_single():
    op, double = torus_map(dtype=np.float32), torus_map(dtype=np.float64)
    x = np.random.default_rng(7).standard_normal(op.domain.shape)
    assert op.spectrum.dtype == np.complex64 and double.spectrum.dtype == np.complex128
    assert op.forward(x).dtype == np.float32 and op.adjoint(op.forward(x)).dtype == np.float32
    np.testing.assert_allclose(op.forward(x), double.forward(x), atol=1e-5)
    assert BlockCirculant.needed(5, 7, (5, 7), 4)[0] == op.spectrum.nbytes


@pytest.mark.parametrize("torus", [(4, 9), (9, 5)])
def test_light_may_not_go_round(torus):
    with pytest.raises(ValueError, match="goes round"):
        torus_map(torus=torus)


def test_parts_of_a_torus_must_fit():
    (near, offsets), far = planes()
    with pytest.raises(ValueError, match="twice"):
        BlockCirculant([(near, 0 * offsets)], (3, 4), (9, 9))
    with pytest.raises(ValueError, match="pixels as the others"):
        BlockCirculant([far, (near[:, :3], offsets)], (3, 4), (9, 9))
    with pytest.raises(ValueError, match="at least one"):
        BlockCirculant([], (3, 4), (9, 9))


@pytest.mark.parametrize("beyond", [False, True])
@pytest.mark.parametrize(
    "count, reach", [((29, 29), (8, 11)), ((1, 3), (2, 2)), ((36, 47), (0, 7))]
)
def test_a_torus_has_room_and_is_quick_to_transform(count, reach, beyond):
    found = torus_for(count, reach, beyond)
    for size, n, r in zip(found, count, reach):
        least = n + (2 if beyond else 1) * r
        assert least <= size <= max(least + 3, 1.1 * least)
        rest = size
        for prime in (2, 3, 5, 7, 11):
            while rest % prime == 0:
                rest //= prime
        assert rest == 1


def brute_matrix(op):
    """The full matrix by its definition, superpixel by superpixel and block by block."""
    (rows, columns, points), pixels = op.domain.shape, op.range.shape[2]
    full = np.zeros((rows, columns, pixels, rows, columns, points))
    for block, (dr, dc) in zip(op.blocks, op.offsets):
        for r in range(rows):
            for c in range(columns):
                if 0 <= r + dr < rows and 0 <= c + dc < columns:
                    full[r + dr, c + dc, :, r, c, :] += block
    return full.reshape(op.range.size, op.domain.size)


@pytest.mark.parametrize("count", [(1, 1), (1, 3), (3, 4), (2, 2)])
def test_block_map_is_the_full_matrix(count):
    op = block_map(count)
    rng, full = np.random.default_rng(2), brute_matrix(op)
    x, y = rng.standard_normal(op.domain.shape), rng.standard_normal(op.range.shape)
    np.testing.assert_allclose(op.forward(x).ravel(), full @ x.ravel(), rtol=1e-12)
    np.testing.assert_allclose(op.adjoint(y).ravel(), full.T @ y.ravel(), rtol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "make",
    [
        lambda t: Dense(np.random.default_rng(0).random((30, 20)).astype(t)),
        lambda t: block_map(dtype=t),
        lambda t: torus_map(dtype=t),
        lambda t: torus_map(torus=(8, 6), dtype=t).on_torus(),
    ],
)
def test_adjoint_gap_is_small_for_a_pair(make, dtype):
    assert adjoint_gap(make(dtype)) < 100
    assert adjoint_gap(make(dtype), seed=5) < 100


def test_adjoint_gap_sees_a_wrong_adjoint():
    class Wrong(Dense):
        def adjoint(self, y):
            return 1.001 * super().adjoint(y)

    assert adjoint_gap(Wrong(np.random.default_rng(0).random((300, 200)).astype(np.float32))) > 100


def test_adjoint_gap_is_repeatable_and_scale_free():
    matrix = np.random.default_rng(0).random((30, 20))
    assert adjoint_gap(Dense(matrix)) == adjoint_gap(Dense(matrix))
    assert adjoint_gap(Dense(1e-100 * matrix)) < 100


def test_parts_of_the_block_map():
    op = block_map()
    x = np.random.default_rng(3).standard_normal(op.domain.shape)
    np.testing.assert_allclose(
        op.neighbours_only().forward(x)
        + x @ op.blocks[np.flatnonzero((op.offsets == 0).all(axis=1))[0]].T,
        op.forward(x),
        rtol=1e-12,
    )


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="lenslet_row"):
        block_map().forward(np.zeros((3, 4, 5)))
    with pytest.raises(ValueError, match="twice"):
        BlockToeplitz(np.zeros((2, 3, 3)), [[0, 0], [0, 0]], (2, 2))


@pytest.mark.parametrize("count", [1, 255, 257, 1000])
def test_products_are_the_same_on_any_number_of_threads(count):
    rng = np.random.default_rng(count)
    matrix, signals = rng.standard_normal((70, 90)), rng.standard_normal((count, 90))
    made = []
    for threads in (1, 3):
        with within(Budget(1 << 30, threads)):
            made.append(product(matrix, signals.T))
    np.testing.assert_allclose(made[0], np.einsum("pk,nk->pn", matrix, signals), atol=1e-12)
    assert made[0].tobytes() == made[1].tobytes()
