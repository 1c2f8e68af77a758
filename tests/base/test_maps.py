"""Linear maps: forward and adjoint belong together, and the block map equals the matrix
that it never forms.
"""

import numpy as np
import pytest

from plenocli.base.linear_maps import BlockToeplitz, Dense, adjoint_gap

OFFSETS = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])


def block_map(count=(3, 4), dtype=float, seed=1):
    blocks = np.random.default_rng(seed).random((9, 5, 4)).astype(dtype)
    return BlockToeplitz(blocks, OFFSETS, count)


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
