"""The l1 problem by an interior-point method, the other kind of solver that the paper names: for
checking, not for work.

Clarabel (extra `bench`) solves the cone program min r^T r + lambda w^T t, D c + r = y, -t <= c <=
t, signal by signal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from plenocli.inverse.sparse.l1.certificate import duality_gap
from plenocli.inverse.sparse.l1.problem import SparseCode, prepare


def interior_point(
    dictionary: ArrayLike,
    signals: ArrayLike,
    lam: float,
    *,
    weights: ArrayLike | None = None,
    free: Sequence[int] = (),
    tol: float = 1e-6,
) -> SparseCode:
    """Solve the l1 problem of plenocli.inverse.sparse.l1.solve.sparse_code by Clarabel.

    Each signal is solved twice: the solver's tolerances are absolute as well as relative, so the
    second time everything is scaled by the first objective.

    dictionary, signals, lam, weights, free: as of sparse_code.
    tol: relative duality gap to reach.

    Returns a code whose coefficients are small where they should be zero, never exactly zero;
    passes are Newton steps.
    Raises InputError without Clarabel, ValueError as `prepare`.
    """
    problem = prepare(dictionary, signals, lam, weights, free)
    c, steps = np.zeros_like(problem.b), np.zeros(len(problem.b), int)
    for i, y in enumerate(problem.y.T):
        scale = np.linalg.norm(y)
        for _ in range(2):
            if scale > 0:
                found, used = _solve(problem.d, y / scale, problem.threshold / scale, tol)
                c[i], steps[i] = scale * found, steps[i] + used
                scale = np.sqrt(
                    duality_gap(problem.d, y[:, None], c[i : i + 1], problem.threshold)[0][0]
                )
    objective, gap, _ = duality_gap(problem.d, problem.y, c, problem.threshold)
    return SparseCode(c=problem.restore(c), objective=objective, gap=gap, passes=steps)


def _solve(
    d: np.ndarray, y: np.ndarray, threshold: np.ndarray, tol: float
) -> tuple[np.ndarray, int]:
    """(c, Newton steps) of one scaled signal."""
    from plenocli.base.errors import InputError

    try:
        import clarabel
    except ImportError:
        raise InputError(
            "the interior-point method needs Clarabel", fix="pip install clarabel"
        ) from None
    from scipy.sparse import block_array, csc_array, diags_array, eye_array

    rows, atoms = d.shape
    one, unit = eye_array(atoms), eye_array(rows)
    quadratic = csc_array(diags_array(np.concatenate([np.zeros(2 * atoms), np.full(rows, 2.0)])))
    constraints = csc_array(
        block_array([[csc_array(d), None, unit], [one, -one, None], [-one, -one, None]])
    )
    linear = np.concatenate([np.zeros(atoms), 2 * threshold, np.zeros(rows)])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tol / 100
    cones = [clarabel.ZeroConeT(rows), clarabel.NonnegativeConeT(2 * atoms)]
    solver = clarabel.DefaultSolver(
        quadratic, linear, constraints, np.concatenate([y, np.zeros(2 * atoms)]), cones, settings
    )
    solution = solver.solve()
    return np.array(solution.x[:atoms]), solution.iterations
