"""Active-set Newton method for one l1 problem in Gram form; compiled by numba where it is installed, else plain numpy.

Imported late (by plenocli.solvers.l1), because importing numba takes a second. The same statements run either way; only the
Cholesky factor and what goes with it have two spellings, loops for the compiler and whole arrays for numpy.
"""

import os

import numpy as np

try:
    import numba
except ImportError:
    numba = None
else:  # the one threading layer that ships with numba itself and does not share an OpenMP runtime with the BLAS
    if "NUMBA_THREADING_LAYER" not in os.environ:
        numba.config.THREADING_LAYER = "workqueue"

JITTER = 1e-12
"""Added to the diagonal, relative to it: more than rounding can take away, so that dependent atoms cannot break the factor. They
move far along the flat direction, and the line search stops them where one of them reaches zero and leaves."""

if numba is None:
    COMPILED = False
    prange = range

    def _jit(function):
        return function

    def _parallel(function):
        return function
else:
    COMPILED = True
    prange = numba.prange
    _jit = numba.njit(cache=True, fastmath={"reassoc", "contract"})
    _parallel = numba.njit(cache=True, fastmath={"reassoc", "contract"}, parallel=True)


def _factor_by_rows(matrix):
    """Lower Cholesky factor in place of matrix + JITTER diag (row-wise, dot products)."""
    n = matrix.shape[0]
    for i in range(n):
        row = matrix[i]
        diagonal = row[i] * (1.0 + JITTER)
        for j in range(i):
            other = matrix[j]
            total = row[j]
            for k in range(j):
                total -= row[k] * other[k]
            row[j] = total / other[j]
        total = diagonal
        for k in range(i):
            total -= row[k] * row[k]
        row[i] = np.sqrt(max(total, 0.5 * JITTER * diagonal))
    return matrix


def _factor_by_columns(matrix):
    """The same factor, one matrix-vector product a column."""
    for j in range(matrix.shape[0]):
        diagonal = matrix[j, j] * (1.0 + JITTER)
        column = matrix[j:, j] - matrix[j:, :j] @ matrix[j, :j]
        pivot = np.sqrt(max(column[0] + JITTER * matrix[j, j], 0.5 * JITTER * diagonal))
        matrix[j:, j] = column / pivot
        matrix[j, j] = pivot
    return matrix


def _solve_by_loops(factor, h):
    """d with L L^T d = h."""
    n = h.shape[0]
    d = np.empty(n)
    for i in range(n):
        row = factor[i]
        total = h[i]
        for k in range(i):
            total -= row[k] * d[k]
        d[i] = total / row[i]
    for i in range(n - 1, -1, -1):
        row = factor[i]
        value = d[i] / row[i]
        d[i] = value
        for k in range(i):
            d[k] -= value * row[k]
    return d


def _solve_by_lapack(factor, h):
    """The same solution."""
    from scipy.linalg import solve_triangular

    half = solve_triangular(factor, h, lower=True, check_finite=False)
    return solve_triangular(factor, half, lower=True, trans=1, check_finite=False)


def _gather_by_loops(gram, index):
    """gram[index][:, index]."""
    n = index.shape[0]
    block = np.empty((n, n))
    for i in range(n):
        row = gram[index[i]]
        for j in range(n):
            block[i, j] = row[index[j]]
    return block


def _gather_by_index(gram, index):
    """The same block."""
    return gram[np.ix_(index, index)]


if COMPILED:
    _factor, _solve_factored, _gather = _jit(_factor_by_rows), _jit(_solve_by_loops), _jit(_gather_by_loops)
else:
    _factor, _solve_factored, _gather = _factor_by_columns, _solve_by_lapack, _gather_by_index


@_jit
def relative_gap(b, q, x, index, signal_energy, threshold):
    """(P, gap / P) at c (values x at `index`), with the dual point that is the scaled residual.

    b = D^T y, q = D^T (y - D c), signal_energy = y^T y, threshold = lambda w_j / 2 per atom.
    P = |y - Dc|^2 + sum 2 threshold |c|;  u = t (y - Dc) with |D_j^T u| <= threshold_j;  dual = 2 t r^T y - t^2 r^T r.
    """
    fit = 0.0
    slope = 0.0
    penalty = 0.0
    for i in range(index.shape[0]):
        j = index[i]
        fit += x[i] * b[j]
        slope += x[i] * q[j]
        penalty += 2.0 * threshold[j] * abs(x[i])
    residual_energy = max(signal_energy - fit - slope, 0.0)
    objective = residual_energy + penalty
    if objective <= 0.0 or residual_energy <= 0.0:
        return objective, 0.0
    limit = 1.0 / max(np.max(np.abs(q) / threshold), 1e-300)
    t = min(max((signal_energy - fit) / residual_energy, -limit), limit)
    dual = 2.0 * t * (signal_energy - fit) - t * t * residual_energy
    return objective, max(objective - dual, 0.0) / objective


@_jit
def _step_length(x, d, h, threshold):
    """(alpha, zero): the minimum of the piecewise quadratic along x + alpha d, 0 < alpha <= 1; `zero` is the value that
    lands on 0 there, or -1.  h = G d, so that the slope at alpha with the first signs is 2 (alpha - 1) d^T h."""
    curvature = np.dot(d, h)
    crossing = np.full(x.shape[0], np.inf)
    for i in range(x.shape[0]):
        if x[i] * d[i] < 0.0:
            crossing[i] = -x[i] / d[i]
    order = np.argsort(crossing)
    jumps = 0.0
    for k in range(order.shape[0]):
        i = order[k]
        if crossing[i] >= 1.0:
            break
        if (crossing[i] - 1.0) * curvature + jumps >= 0.0:
            break
        jumps += 2.0 * threshold[i] * abs(d[i])
        if (crossing[i] - 1.0) * curvature + jumps >= 0.0:
            return crossing[i], i
    if curvature <= 0.0:
        return 1.0, -1
    return min(max(1.0 - jumps / curvature, 0.0), 1.0), -1


@_jit
def _settle(gram, b, threshold, index, x, sign, inner_limit):
    """Minimise over the atoms `index` from x: Newton steps, exact line search, atoms at zero leave. Returns (index, x, sign)."""
    for _ in range(inner_limit):
        n = index.shape[0]
        if n == 0:
            break
        block = _gather(gram, index)
        h = b[index] - threshold[index] * sign - np.dot(block, x)
        d = _solve_factored(_factor(block), h)
        keep = np.ones(n, np.bool_)
        rejected = False
        for i in range(n):
            if x[i] == 0.0 and d[i] * sign[i] <= 0.0:
                keep[i] = False
                rejected = True
        if not rejected:
            alpha, zero = _step_length(x, d, h, threshold[index])
            x = x + alpha * d
            if zero >= 0:
                x[zero] = 0.0
            settled = alpha == 1.0
            for i in range(n):
                if x[i] == 0.0:
                    keep[i] = False
                else:
                    new = 1.0 if x[i] > 0.0 else -1.0
                    if new != sign[i]:
                        settled = False
                    sign[i] = new
            index, x, sign = index[keep], x[keep], sign[keep]
            if settled:
                break
        else:
            index, x, sign = index[keep], x[keep], sign[keep]
    return index, x, sign


@_jit
def _newcomers(q, threshold, active, most):
    """Up to `most` atoms outside `active` whose |q| exceeds the threshold most."""
    ratio = np.abs(q) / threshold
    for i in range(active.shape[0]):
        ratio[active[i]] = 0.0
    candidate = np.flatnonzero(ratio > 1.0 + 1e-12)
    if candidate.shape[0] > most:
        value = ratio[candidate]
        cut = np.partition(value, value.shape[0] - most)[value.shape[0] - most]
        candidate = candidate[value >= cut]
    return candidate


@_jit
def solve_signal(gram, b, signal_energy, threshold, tol, outer_limit):
    """(c, objective, relative gap, passes) for one signal: min |y - Dc|^2 + sum_j 2 threshold_j |c_j|."""
    index = np.empty(0, np.int64)
    x = np.empty(0)
    sign = np.empty(0)
    q = b.copy()
    objective, gap = relative_gap(b, q, x, index, signal_energy, threshold)
    passes = 0
    stalled = 0
    while gap > tol and passes < outer_limit and stalled < 3:
        new = _newcomers(q, threshold, index, max(30, index.shape[0] // 2))
        passes += 1
        index = np.concatenate((index, new))
        x = np.concatenate((x, np.zeros(new.shape[0])))
        sign = np.concatenate((sign, np.sign(q[new])))
        index, x, sign = _settle(gram, b, threshold, index, x, sign, 1000)
        q = b.copy()
        for i in range(index.shape[0]):
            q -= x[i] * gram[index[i]]
        before = objective
        objective, gap = relative_gap(b, q, x, index, signal_energy, threshold)
        stalled = stalled + 1 if objective > before * (1.0 - 1e-9) else 0
    c = np.zeros(b.shape[0])
    for i in range(index.shape[0]):
        c[index[i]] = x[i]
    return c, objective, gap, passes


@_parallel
def solve_signals(gram, b, signal_energy, threshold, tol, outer_limit, c, objective, gap, passes):
    """solve_signal for every row of b (signal, atom), into c (signal, atom), objective, gap and passes (signal,)."""
    for i in prange(b.shape[0]):
        c[i], objective[i], gap[i], passes[i] = solve_signal(gram, b[i], signal_energy[i], threshold, tol, outer_limit)
