"""Non-negative least squares: optimality, and the early stop."""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.inverse.picture.solvers import nnls


@pytest.fixture(scope="module")
def problem():
    rng = np.random.default_rng(0)
    a = rng.random((30, 20)) * np.logspace(0, -2, 20)
    return a, rng.standard_normal((30, 6)) + a.sum(axis=1)[:, None]


def test_converged_is_optimal_and_unbeaten(problem):
    a, z = problem
    found = nnls.converged(a, z)
    g = a.T @ (a @ found.x - z)
    assert (
        found.x.min() >= 0
        and np.any(found.x == 0)
        and g.min() > -1e-10
        and np.abs(g[found.x > 0]).max() < 1e-10
    )
    rng = np.random.default_rng(1)
    for _ in range(50):
        other = np.maximum(found.x + 0.1 * rng.standard_normal(found.x.shape), 0)
        assert np.all(
            np.sum((a @ other - z) ** 2, axis=0) >= np.sum((a @ found.x - z) ** 2, axis=0)
        )


def test_the_plain_solution_where_it_is_positive():
    a = np.random.default_rng(0).random((10, 4)) + np.eye(10, 4) * 3
    x = np.array([[1.0, 2], [3, 4], [5, 6], [7, 8]])
    np.testing.assert_allclose(nnls.converged(a, a @ x).x, x, rtol=1e-10)


def test_gradient_steps_approach_the_converged_solution(problem):
    a, z = problem
    best = np.sum((a @ nnls.converged(a, z).x - z) ** 2)
    excess = [
        np.sum((a @ nnls.projected_gradient(a, z, n).x - z) ** 2) - best for n in (10, 100, 5000)
    ]
    assert excess[0] > excess[1] > excess[2] >= -1e-9 and excess[2] < 1e-2 * excess[0]
    assert nnls.projected_gradient(a, z, 10).iterations == 10


def test_violation_is_reported(problem):
    a, z = problem
    assert nnls.projected_gradient(a, z, 3).kkt.max() > 1e-3
    with pytest.raises(NumericsError, match="optimality"):
        nnls.converged(a, z, tol=-1.0)
