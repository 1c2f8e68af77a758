"""Active-set Newton method for one l1 problem in plain numpy: the whole solver where numba is
missing, and the exact one elsewhere.

Residual and slopes always come from D itself. Newton steps come from the Gram matrix, or, where
that has lost the digits that matter (small lambda: |y - Dc|^2 sinks below the rounding of y^T y,
and the condition of D is squared), from a QR factorisation of the active columns: corrected
semi-normal equations (Bjorck, Linear Algebra Appl. 88/89, 31 (1987)).
"""

import numpy as np

JITTER = 1e-12
"""Added to the Gram matrix's diagonal, relative to it: dependent atoms must
not break the factor.
"""

RIDGE = 1e-10
"""The same for the factored form, relative to the norm of each column."""


def solve_signal(
    d: np.ndarray,
    y: np.ndarray,
    gram: np.ndarray | None,
    threshold: np.ndarray,
    tol: float,
    pass_limit: int,
    c: np.ndarray,
) -> int:
    """min |y - D c|^2 + sum_j 2 threshold_j |c_j|.

    Stops at the gap wanted, after the passes allowed, or after three that no longer lower the
    objective.

    d: (row, atom) D.
    y: (row,).
    gram: (atom, atom) D^T D, or None for the factored form.
    threshold: (atom,).
    tol: relative duality gap to reach.
    pass_limit: passes allowed.
    c: (atom,) to begin with; overwritten by the solution.

    Returns the outer passes done.
    """
    from plenocli.inverse.sparse.l1.certificate import duality_gap

    index = np.flatnonzero(c)
    x, sign = c[index], np.sign(c[index])
    passes = stalled = 0
    objective, gap, q = duality_gap(d, y[:, None], c[None], threshold)
    while gap[0] > tol and passes < pass_limit and stalled < 3:
        passes += 1
        new = _newcomers(q[0], threshold, index, max(30, len(index) // 2))
        index, x, sign = (
            np.concatenate([index, new]),
            np.concatenate([x, np.zeros(len(new))]),
            np.concatenate([sign, np.sign(q[0, new])]),
        )
        index, x, sign = _settle(d, y, gram, threshold, index, x, sign)
        before = objective
        trial = np.zeros_like(c)
        trial[index] = x
        objective, trial_gap, q = duality_gap(d, y[:, None], trial[None], threshold)
        if trial_gap[0] < gap[0] or objective[0] < before[0]:
            c[:], gap = trial, trial_gap
        stalled = stalled + 1 if objective[0] > before[0] * (1 - 1e-9) else 0
    return passes


def _newcomers(q: np.ndarray, threshold: np.ndarray, active: np.ndarray, most: int) -> np.ndarray:
    """Up to `most` atoms outside `active` whose |q| exceeds the threshold most."""
    ratio = np.abs(q) / threshold
    ratio[active] = 0
    candidate = np.flatnonzero(ratio > 1 + 1e-12)
    return candidate[np.argsort(-ratio[candidate], kind="stable")[:most]]


def _settle(
    d: np.ndarray,
    y: np.ndarray,
    gram: np.ndarray | None,
    threshold: np.ndarray,
    index: np.ndarray,
    x: np.ndarray,
    sign: np.ndarray,
    limit: int = 1000,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Minimise over the atoms `index` from x: Newton steps, exact line search, atoms at zero leave.

    Returns (index, x, sign).
    """
    for _ in range(limit):
        if not len(index):
            break
        columns = d[:, index]
        h = columns.T @ (y - columns @ x) - threshold[index] * sign
        step = (
            _from_columns(columns, h) if gram is None else _from_gram(gram[np.ix_(index, index)], h)
        )
        keep = (x != 0) | (step * sign > 0)
        settled = False
        if keep.all():
            alpha, zero = _step_length(x, step, h, threshold[index])
            x = x + alpha * step
            x[zero] = 0
            keep = x != 0
            settled = alpha == 1 and bool(np.all(np.sign(x[keep]) == sign[keep]))
            sign = np.where(keep, np.sign(x), sign)
        index, x, sign = index[keep], x[keep], sign[keep]
        if settled:
            break
    return index, x, sign


def _from_gram(block: np.ndarray, h: np.ndarray) -> np.ndarray:
    from scipy.linalg import cho_factor, cho_solve

    diagonal = np.diag(block).copy()
    np.fill_diagonal(block, diagonal * (1 + JITTER))
    return cho_solve(
        cho_factor(block, lower=True, overwrite_a=True, check_finite=False), h, check_finite=False
    )


def _from_columns(columns: np.ndarray, h: np.ndarray) -> np.ndarray:
    """G^-1 h with G = columns^T columns, from the triangular factor of the columns; one
    correction by G itself.
    """
    from scipy.linalg import solve_triangular

    ridge = np.diag(RIDGE * np.linalg.norm(columns, axis=0))
    factor = np.linalg.qr(np.concatenate([columns, ridge]), mode="r")

    def solve(right):
        half = solve_triangular(factor, right, trans=1, check_finite=False)
        return solve_triangular(factor, half, check_finite=False)

    step = solve(h)
    return step + solve(h - columns.T @ (columns @ step))


def _step_length(
    x: np.ndarray, step: np.ndarray, h: np.ndarray, threshold: np.ndarray
) -> tuple[float, list[int]]:
    """(alpha, zero): the minimum of the piecewise quadratic along x + alpha step, 0 < alpha <= 1;
    `zero`, a list, is the value that lands on 0 there, if one does. h = G step, so that the slope
    at alpha with the first signs is 2 (alpha - 1) step^T h.
    """
    curvature, jumps = step @ h, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        crossing = np.where(x * step < 0, -x / step, np.inf)
    for i in np.argsort(crossing):
        if crossing[i] >= 1 or (crossing[i] - 1) * curvature + jumps >= 0:
            break
        jumps += 2 * threshold[i] * abs(step[i])
        if (crossing[i] - 1) * curvature + jumps >= 0:
            return crossing[i], [i]
    return (min(max(1 - jumps / curvature, 0.0), 1.0) if curvature > 0 else 1.0), []
