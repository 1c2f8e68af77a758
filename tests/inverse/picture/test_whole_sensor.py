"""The proximal step against dense linear algebra, total variation against a general minimiser,
plug and play against closed forms.
"""

import numpy as np
import pytest
from scipy.optimize import minimize

from plenocli.base.tiling import to_blocks, to_plane
from plenocli.inverse.picture.solvers import least_squares as linear
from plenocli.inverse.picture.solvers import whole_sensor as wholesensor

N, PIXELS, COUNT, SIGMA = 4, 25, (3, 2), 0.02


@pytest.fixture(scope="module")
def sensor():
    """(svd, matrix of the whole sensor, y, truth) for lenslets that each see their own object."""
    rng = np.random.default_rng(0)
    own = rng.random((PIXELS, N * N)) * np.logspace(0, -3, N * N)
    truth = rng.random((*COUNT, N * N))
    y = truth @ own.T + SIGMA * rng.standard_normal((*COUNT, PIXELS))
    return linear.decompose(own), np.kron(np.eye(int(np.prod(COUNT))), own), y, truth


@pytest.mark.parametrize("tau", [0.01, 0.3, 30.0])
def test_proximal_is_the_normal_equations(sensor, tau):
    svd, matrix, y, truth = sensor
    v, alpha = np.random.default_rng(1).random(truth.shape), (SIGMA / tau) ** 2
    expected = np.linalg.solve(
        matrix.T @ matrix + alpha * np.eye(matrix.shape[1]),
        matrix.T @ y.ravel() + alpha * v.ravel(),
    )
    exact = wholesensor.DataTerm(svd, (N, N), y, SIGMA, contrast=1e6).proximal(
        to_plane(v, (N, N)), tau
    )
    np.testing.assert_allclose(to_blocks(exact, (N, N)).ravel(), expected, rtol=1e-6, atol=1e-8)
    short = wholesensor.DataTerm(svd, (N, N), y, SIGMA, contrast=0.5)
    assert len(short.s) < N * N
    if tau <= 0.3:
        np.testing.assert_allclose(short.proximal(to_plane(v, (N, N)), tau), exact, atol=0.05)


def test_held_lenslets_stay_and_rounds_are_what_they_say(sensor):
    svd, _, y, truth = sensor
    held = np.zeros(COUNT, bool)
    held[0, 1] = True
    term = wholesensor.DataTerm(svd, (N, N), y, SIGMA, held=(held, truth))
    start, taus = np.random.default_rng(2).random((COUNT[0] * N, COUNT[1] * N)), []

    def shrink(x, tau):
        taus.append(tau)
        return x / (1 + tau)

    found = wholesensor.plug_and_play(term, start, shrink, [0.5, 0.2])
    np.testing.assert_allclose(
        found, term.proximal(term.proximal(start / 1.5, 0.5) / 1.2, 0.2), atol=1e-12
    )
    np.testing.assert_array_equal(to_blocks(found, (N, N))[0, 1], truth[0, 1])
    assert taus == [0.5, 0.2]


def test_schedule_falls_with_the_error():
    one, two = wholesensor.schedule(0.1), wholesensor.schedule(0.2)
    assert np.all(np.diff(one) < 0) and len(one) == wholesensor.ROUNDS
    np.testing.assert_allclose(two, 2 * one)


def test_total_variation_is_the_minimum(sensor):
    svd, matrix, _, _ = sensor
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

    found = wholesensor.total_variation(
        wholesensor.DataTerm(svd, (N, N), y, SIGMA, contrast=1e3),
        np.full((12, 8), 0.3),
        error,
        rounds=range(120),
    )
    best = np.full(96, 0.3)
    for smooth in (1e-1, 1e-2, 1e-3, 1e-4):
        best = minimize(
            objective,
            best,
            (smooth,),
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 1000, "maxfun": 1500, "ftol": 1e-14, "gtol": 1e-8},
        ).x
    assert objective(found.ravel()) < objective(best) * 1.005
    assert objective(found.ravel()) < 0.5 * objective(np.full(96, 0.3))
