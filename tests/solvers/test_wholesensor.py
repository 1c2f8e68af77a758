"""The proximal step against dense linear algebra, total variation against a general minimiser, plug and play against closed forms."""

import numpy as np
import pytest
from scipy.optimize import minimize

from plenocli.operators import BlockToeplitz, to_blocks, to_plane
from plenocli.solvers import linear, wholesensor

N, PIXELS, COUNT, SIGMA = 4, 25, (3, 2), 0.02
RING = np.array([[r, c] for r in (-1, 0, 1) for c in (-1, 0, 1)])


def sensor(coupled, seed=0):
    """(blocks, offsets, dense matrix over the array and the ring, y, truth over the array and the ring)."""
    rng = np.random.default_rng(seed)
    own = rng.random((PIXELS, N * N)) * np.logspace(0, -3, N * N)
    blocks, offsets = (np.stack([own if not o.any() else 0.01 * own @ rng.random((N * N, N * N)) / N for o in RING]), RING) if coupled else (own[None], np.zeros((1, 2), int))
    ring = int(coupled)
    count = tuple(n + 2 * ring for n in COUNT)
    op = BlockToeplitz(blocks, offsets, count)
    inner = tuple(slice(ring, n - ring) for n in count)
    matrix = np.stack([op.forward(e)[inner].ravel() for e in np.eye(op.domain.size).reshape(-1, *op.domain.shape)], axis=1)
    truth = rng.random(op.domain.shape)
    y = (matrix @ truth.ravel()).reshape(*COUNT, PIXELS) + SIGMA * rng.standard_normal((*COUNT, PIXELS))
    return blocks, offsets, matrix, y, truth


def term_of(blocks, offsets, y):
    own = blocks[len(blocks) // 2]
    return wholesensor.DataTerm(linear.decompose(own), blocks, offsets, (N, N), y, SIGMA, contrast=1e3)


@pytest.mark.parametrize("coupled", [False, True])
def test_proximal_is_the_normal_equations(coupled, monkeypatch):
    monkeypatch.setattr(wholesensor, "TOLERANCE", 1e-12)
    monkeypatch.setattr(wholesensor, "MOST", 400)
    blocks, offsets, matrix, y, truth = sensor(coupled)
    v = np.random.default_rng(1).random(truth.shape)
    alpha = (SIGMA / 0.3) ** 2
    expected = np.linalg.solve(matrix.T @ matrix + alpha * np.eye(matrix.shape[1]), matrix.T @ y.ravel() + alpha * v.ravel())
    found = to_blocks(term_of(blocks, offsets, y).proximal(to_plane(v, (N, N)), 0.3), (N, N))
    # pixels outside the range of the own block are not looked at, so that neighbours' light is seen through its range only
    if coupled:
        u = np.kron(np.eye(np.prod(COUNT)), linear.decompose(blocks[4]).u.T)
        seen, data = u @ matrix, u @ y.ravel()
        expected = np.linalg.solve(seen.T @ seen + alpha * np.eye(matrix.shape[1]), seen.T @ data + alpha * v.ravel())
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-7)


@pytest.mark.parametrize("coupled", [False, True])
def test_default_tolerance_is_enough(coupled):
    blocks, offsets, _, y, truth = sensor(coupled)
    term, v = term_of(blocks, offsets, y), to_plane(truth, (N, N)) + 0.1
    once = term.proximal(v, 0.3)
    twice = wholesensor.DataTerm(linear.decompose(blocks[len(blocks) // 2]), blocks, offsets, (N, N), y, SIGMA, contrast=1e3)
    old, wholesensor.TOLERANCE = wholesensor.TOLERANCE, 1e-12
    try:
        np.testing.assert_allclose(once, twice.proximal(v, 0.3), atol=3e-3)
    finally:
        wholesensor.TOLERANCE = old


def test_plug_and_play_is_its_rounds_and_crops_the_ring():
    blocks, offsets, _, y, _ = sensor(True)
    term, start = term_of(blocks, offsets, y), np.random.default_rng(2).random((COUNT[0] * N, COUNT[1] * N))
    seen = []

    def shrink(x, tau):
        seen.append((x.shape, tau))
        return x / (1 + tau)

    found = wholesensor.plug_and_play(term, start, shrink, [0.5, 0.2])
    x = term.proximal(np.pad(start, N, mode="edge") / 1.5, 0.5)
    np.testing.assert_allclose(found, term.proximal(x / 1.2, 0.2)[N:-N, N:-N], atol=1e-12)
    assert found.shape == start.shape and seen == [((20, 16), 0.5), ((20, 16), 0.2)]


def test_schedule_falls_with_the_error():
    one, two = wholesensor.schedule(0.1), wholesensor.schedule(0.2)
    assert np.all(np.diff(one) < 0) and len(one) == wholesensor.ROUNDS
    np.testing.assert_allclose(two, 2 * one)


def test_total_variation_is_the_minimum():
    blocks, offsets, matrix, _, _ = sensor(False)
    truth = np.zeros((12, 8))
    truth[3:, 2:] = 0.7
    rng = np.random.default_rng(3)
    y = (matrix @ to_blocks(truth, (N, N)).ravel()).reshape(*COUNT, PIXELS)
    y += SIGMA * rng.standard_normal(y.shape)
    error = 0.1
    weight = wholesensor.TV_WEIGHT / error
    index = to_blocks(np.arange(96).reshape(12, 8), (N, N)).ravel()

    def objective(flat, smooth=0.0):
        x = flat.reshape(12, 8)
        rest = matrix @ flat[index] - y.ravel()
        down, right = np.zeros_like(x), np.zeros_like(x)
        down[:-1], right[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
        size = np.sqrt(down**2 + right**2 + smooth**2)
        value = rest @ rest / (2 * SIGMA**2) + weight * size.sum()
        if not smooth:
            return value
        grad = np.zeros(96)
        grad[index] = matrix.T @ rest / SIGMA**2
        grad = grad.reshape(12, 8)
        down, right = weight * down / size, weight * right / size
        grad -= down + right
        grad[1:] += down[:-1]
        grad[:, 1:] += right[:, :-1]
        return value, grad.ravel()

    found = wholesensor.total_variation(term_of(blocks, offsets, y), np.full((12, 8), 0.3), error, rounds=120)
    best = np.full(96, 0.3)
    for smooth in (1e-1, 1e-2, 1e-3, 1e-4):
        best = minimize(objective, best, (smooth,), jac=True, method="L-BFGS-B", options={"maxiter": 1000, "maxfun": 1500, "ftol": 1e-14, "gtol": 1e-8}).x
    assert objective(found.ravel()) < objective(best) * 1.005
    assert objective(found.ravel()) < 0.5 * objective(np.full(96, 0.3))
