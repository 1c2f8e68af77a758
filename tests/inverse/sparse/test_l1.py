"""Sparse coding: every solution carries its certificate, and the compiled and the
plain kernel agree.
"""

import itertools
import sys

import numpy as np
import pytest

from plenocli.inverse.sparse.l1 import solve as l1
from plenocli.inverse.sparse.l1.guess import guess
from tests.reference.fista import fista


def plenoptic_like(rows=30, atoms=40, signals=12, seed=0):
    """A dictionary with singular values over four decades, as A Phi has, and signals of a few of
    its atoms plus noise.
    """
    rng = np.random.default_rng(seed)
    u, _ = np.linalg.qr(rng.standard_normal((rows, rows)))
    d = (u * np.logspace(0, -4, rows)) @ rng.standard_normal((rows, atoms))
    c = np.where(rng.random((atoms, signals)) < 0.1, rng.standard_normal((atoms, signals)), 0)
    y = d @ c
    return d, y + 1e-4 * np.sqrt(np.mean(y**2)) * rng.standard_normal(y.shape)


def optimality(d, y, c, lam, weights=None):
    """Largest violation of the subgradient conditions, in units of lambda."""
    g = 2 * d.T @ (y - d @ c) / lam / (1 if weights is None else weights[:, None])
    return max(np.max(np.abs(g), initial=0) - 1, np.max(np.abs(g - np.sign(c))[c != 0], initial=0))


@pytest.mark.parametrize("lam", [1e-2, 1e-4, 1e-6])
def test_solution_meets_the_subgradient_conditions(lam):
    d, y = plenoptic_like()
    code = l1.sparse_code(d, y, lam, tol=1e-9)
    assert code.gap.max() <= 1e-8  # at the smallest lambda the Gram form has no more digits
    assert optimality(d, y, code.c, lam) < 1e-4
    np.testing.assert_allclose(
        code.objective,
        np.sum((y - d @ code.c) ** 2, axis=0) + lam * np.abs(code.c).sum(axis=0),
        rtol=1e-6,
    )


def best_of_all_sign_patterns(d, y, lam):
    """The minimum by trying every support and sign."""
    best, where = np.sum(y**2), np.zeros(d.shape[1])
    for signs in itertools.product((-1, 0, 1), repeat=d.shape[1]):
        s = np.array(signs)
        on = s != 0
        if on.any():
            part = d[:, on]
            x = np.linalg.solve(part.T @ part, part.T @ y - lam / 2 * s[on])
            if np.all(x * s[on] > 0):
                value = np.sum((y - part @ x) ** 2) + lam * np.abs(x).sum()
                if value < best:
                    best, where = value, np.zeros(d.shape[1])
                    where[on] = x
    return best, where


@pytest.mark.parametrize("lam", [0.02, 0.3, 2.0])
def test_against_every_sign_pattern(lam):
    rng = np.random.default_rng(8)
    d, y = (
        rng.standard_normal((7, 6)) @ np.diag([1, 0.5, 1, 0.1, 1, 0.3]),
        rng.standard_normal((7, 5)),
    )
    code = l1.sparse_code(d, y, lam, tol=1e-12)
    for k in range(5):
        best, where = best_of_all_sign_patterns(d, y[:, k], lam)
        assert code.objective[k] == pytest.approx(best, rel=1e-10)
        np.testing.assert_allclose(code.c[:, k], where, atol=1e-6)


@pytest.mark.parametrize("lam", [1e-6, 1e-8])
def test_small_lambda_goes_by_the_factored_form(lam):
    """Certified here in extended precision, down to 1e-10 of the largest useful lambda."""
    d, y = plenoptic_like(seed=2)
    d, y = d.astype(np.longdouble), y.astype(np.longdouble)
    code = l1.sparse_code(d, y, lam, tol=1e-7)
    c, threshold = code.c.astype(np.longdouble), lam / 2
    residual = y - d @ c
    primal = np.sum(residual**2, axis=0) + lam * np.abs(c).sum(axis=0)
    t = np.clip(
        np.sum(residual * y, axis=0) / np.sum(residual**2, axis=0),
        *(sign * threshold / np.abs(d.T @ residual).max(axis=0) for sign in (-1, 1)),
    )
    gap = 1 - (2 * t * np.sum(residual * y, axis=0) - t**2 * np.sum(residual**2, axis=0)) / primal
    assert gap.max() <= 1e-6 and np.all(np.abs(gap - code.gap) < 3e-7)
    assert (code.factored > 0) == (lam < 1e-7)


def test_lambda_path_equals_single_solutions():
    d, y = plenoptic_like()
    found = list(l1.lambda_path(d, y, [1e-5, 1e-3, 1e-4], free=[0], tol=1e-9))
    assert [lam for lam, _ in found] == [1e-3, 1e-4, 1e-5]
    for lam, code in found:
        np.testing.assert_allclose(
            code.objective, l1.sparse_code(d, y, lam, free=[0], tol=1e-9).objective, rtol=1e-8
        )


def test_a_warm_start_from_the_solution_has_nothing_to_do():
    d, y = plenoptic_like()
    code = l1.sparse_code(d, y, 1e-4, free=[3], tol=1e-9)
    again = l1.sparse_code(d, y, 1e-4, free=[3], tol=1e-8, start=code.c)
    assert not again.passes.any()
    np.testing.assert_allclose(again.c, code.c, rtol=1e-5, atol=1e-9)
    far = l1.sparse_code(
        d, y, 1e-4, free=[3], tol=1e-9, start=np.random.default_rng(0).standard_normal(code.c.shape)
    )
    np.testing.assert_allclose(far.objective, code.objective, rtol=1e-8)


def test_large_active_sets_outgrow_the_first_workspace():
    rng = np.random.default_rng(5)
    d, y = rng.standard_normal((500, 700)), rng.standard_normal((500, 2))
    code = l1.sparse_code(d, y, 1e-2, tol=1e-9)
    assert np.count_nonzero(code.c, axis=0).min() > 400
    assert code.gap.max() <= 1e-9 and optimality(d, y, code.c, 1e-2) < 1e-4


def test_factor_follows_atoms_that_come_and_go():
    kernel = pytest.importorskip("plenocli.inverse.sparse.l1.kernel", exc_type=ImportError)
    rng = np.random.default_rng(4)
    columns = rng.standard_normal((40, 30))
    gram, held, factor, scratch = columns.T @ columns, [], np.full((30, 30), np.nan), np.empty(30)
    for _ in range(120):
        n = len(held)
        if n and (n == 30 or rng.random() < 0.45):
            place = int(rng.integers(n))
            kernel._remove(factor, n, place, scratch)
            held.pop(place)
        else:
            new = int(rng.choice(np.setdiff1d(np.arange(30), held)))
            scratch[:n] = gram[new, held]
            kernel._append(factor, n, scratch, gram[new, new])
            held.append(new)
        n = len(held)
        upper = np.triu(factor[:n, :n], 1) + np.diag(1 / np.diag(factor[:n, :n]))
        np.testing.assert_allclose(upper.T @ upper, gram[np.ix_(held, held)], atol=1e-9)
        h, d = rng.standard_normal(n), np.empty(n)
        d[:] = h
        kernel._forward(factor, n, d)
        kernel._backward(factor, n, d)
        np.testing.assert_allclose(gram[np.ix_(held, held)] @ d, h, atol=1e-8)


def test_an_interior_point_method_agrees():
    pytest.importorskip("clarabel")
    from tests.reference.interior_point import interior_point

    d, y = plenoptic_like(signals=3)
    inner, newton = (
        interior_point(d, y, 1e-4, free=[0], tol=1e-8),
        l1.sparse_code(d, y, 1e-4, free=[0], tol=1e-10),
    )
    assert inner.gap.max() < 1e-6
    np.testing.assert_allclose(inner.objective, newton.objective, rtol=1e-6)


def test_interior_point_says_what_it_needs(monkeypatch):
    from plenocli.base.errors import InputError
    from tests.reference.interior_point import interior_point

    monkeypatch.setitem(sys.modules, "clarabel", None)
    with pytest.raises(InputError, match="Clarabel"):
        interior_point(np.eye(2), np.ones((2, 1)), 0.1)


def test_first_order_method_admits_that_it_has_not_converged():
    d, y = plenoptic_like()
    rough = fista(d, y, 1e-6, iterations=200)
    assert np.median(rough.gap) > 0.1


def test_one_atom_by_hand():
    # c = (d y - lam/2) / d^2, or 0
    code = l1.sparse_code(np.array([[2.0]]), np.array([[3.0, -3.0, 0.1]]), 1.0)
    np.testing.assert_allclose(code.c, [[5.5 / 4, -5.5 / 4, 0.0]])


def test_lambda_convention_has_no_half():
    d, y = plenoptic_like()
    edge = 2 * np.abs(d.T @ y).max(axis=0)
    assert not np.any(l1.sparse_code(d, y[:, :1], 1.001 * edge[0]).c)
    assert np.any(l1.sparse_code(d, y[:, :1], 0.999 * edge[0], tol=1e-12).c)


def test_fista_with_the_same_certificate_agrees():
    d, y = (
        np.random.default_rng(3).standard_normal((30, 40)),
        np.random.default_rng(4).standard_normal((30, 5)),
    )
    newton, first_order = (
        l1.sparse_code(d, y, 3.0, tol=1e-10),
        fista(d, y, 3.0, tol=1e-10, iterations=5000),
    )
    assert first_order.gap.max() <= 1e-10
    np.testing.assert_allclose(newton.c, first_order.c, atol=1e-4)
    np.testing.assert_allclose(newton.objective, first_order.objective, rtol=1e-9)


def test_the_gap_bounds_the_distance_from_the_optimum():
    d, y = (
        np.random.default_rng(3).standard_normal((30, 40)),
        np.random.default_rng(4).standard_normal((30, 5)),
    )
    best = l1.sparse_code(d, y, 3.0, tol=1e-12).objective
    rough = fista(d, y, 3.0, tol=0, iterations=20)
    assert np.all(rough.gap > 1e-8)
    assert np.all(rough.objective - best <= rough.gap * rough.objective * (1 + 1e-9))


def test_free_atoms_are_not_penalised():
    d, y = plenoptic_like()
    code = l1.sparse_code(d, y, 1e-3, free=[0, 7], tol=1e-9)
    residual = y - d @ code.c
    assert np.abs(d[:, [0, 7]].T @ residual).max() < 1e-10
    g = 2 * np.delete(d, [0, 7], 1).T @ residual / 1e-3
    assert np.abs(g).max() <= 1 + 1e-4


def test_weights_scale_lambda():
    d, y = plenoptic_like()
    w = np.linspace(0.5, 2, d.shape[1])
    np.testing.assert_allclose(
        l1.sparse_code(d, y, 1e-3, weights=w, tol=1e-10).c,
        l1.sparse_code(d / w, y, 1e-3, tol=1e-10).c / w[:, None],
        atol=1e-6,
    )


def duplicate(d, y):
    return np.concatenate([d, d[:, :10]], axis=1), y


def zeros(d, y):
    d, y = d.copy(), y.copy()
    d[:, 3], y[:, 2] = 0, 0
    return d, y


def rank_one(d, y):
    return np.outer(d[:, 0], np.linspace(0.5, 1, d.shape[1])), y


def few_directions(d, y):
    """Many more atoms than directions, all active at once: rounding alone must not make
    the factor blow up.
    """
    rng = np.random.default_rng(6)
    return rng.standard_normal((30, 8)) @ rng.standard_normal((8, 60)), y


@pytest.mark.parametrize("spoil", [duplicate, zeros, rank_one, few_directions])
def test_degenerate_dictionaries_keep_their_certificate(spoil):
    d, y = spoil(*plenoptic_like())
    code = l1.sparse_code(d, y, 1e-4, tol=1e-7)
    assert np.all(np.isfinite(code.c)) and code.gap.max() <= 1e-5


def test_workers_do_not_change_the_result():
    d, y = plenoptic_like()
    np.testing.assert_array_equal(
        l1.sparse_code(d, y, 1e-4, workers=1).c, l1.sparse_code(d, y, 1e-4, workers=2).c
    )


@pytest.mark.parametrize("spoil", [lambda d, y: (d, y), duplicate, zeros, few_directions])
def test_plain_numpy_gives_the_same(monkeypatch, spoil):
    pytest.importorskip("numba")
    d, y = spoil(*plenoptic_like())
    compiled = l1.sparse_code(d, y, 1e-5, tol=1e-9)
    monkeypatch.setitem(sys.modules, "plenocli.inverse.sparse.l1.kernel", None)
    monkeypatch.delattr("plenocli.inverse.sparse.l1.kernel", raising=False)
    plain = l1.sparse_code(d, y, 1e-5, tol=1e-9)
    assert plain.passes.sum() != compiled.passes.sum()  # another way to the same minimum
    np.testing.assert_allclose(plain.objective, compiled.objective, rtol=1e-8)
    # unique, even where c is not
    np.testing.assert_allclose(d @ plain.c, d @ compiled.c, atol=1e-7 * np.abs(y).max())


def test_bad_arguments():
    with pytest.raises(ValueError, match="lambda"):
        l1.sparse_code(np.eye(2), np.eye(2), 0.0)
    with pytest.raises(ValueError, match="weights"):
        l1.sparse_code(np.eye(2), np.eye(2), 1.0, weights=[1, 0])
    with pytest.raises(ValueError, match="finite"):
        l1.sparse_code(np.eye(2), np.array([[1.0], [np.nan]]), 1.0)
    with pytest.raises(ValueError, match="lambda"):
        list(l1.lambda_path(np.eye(2), np.eye(2), [1.0, -1.0]))


@pytest.mark.parametrize("weights", [None, np.linspace(0.5, 2, 40)])
def test_guess_is_mostly_right_and_changes_nothing_but_the_work(weights):
    d, y = plenoptic_like(signals=200)
    cold = l1.sparse_code(d, y, 1e-4, weights=weights, tol=1e-9, start=np.zeros((40, 200)))
    code = l1.sparse_code(d, y, 1e-4, weights=weights, tol=1e-9)
    assert max(code.gap.max(), cold.gap.max()) <= 1e-8
    np.testing.assert_allclose(code.objective, cold.objective, rtol=1e-7)
    problem = l1.prepare(d, y, 1e-4, weights, ())
    begin = guess(problem, problem.threshold)
    assert 3 < np.count_nonzero(begin) / 200 < 30
    chance = np.count_nonzero(cold.c) / cold.c.size / 2
    assert np.mean(np.sign(begin[begin != 0]) == np.sign(cold.c.T[begin != 0])) > 2 * chance


def test_guess_scales_with_the_problem():
    d, y = plenoptic_like(signals=60)
    problem, far = l1.prepare(d, y, 1e-4, None, ()), l1.prepare(1e90 * d, 1e60 * y, 1e146, None, ())
    begin, scaled = guess(problem, problem.threshold), guess(far, far.threshold)
    np.testing.assert_allclose(1e30 * scaled, begin, rtol=1e-3, atol=1e-3 * np.abs(begin).max())
    assert not guess(l1.prepare(d, 0 * y, 1e-4, None, ()), problem.threshold).any()
    assert not guess(l1.prepare(0 * d, y, 1e-4, None, ()), problem.threshold).any()
