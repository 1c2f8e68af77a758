"""Active-set Newton method for l1 problems in Gram form, compiled by numba: one Cholesky factor a
signal, updated, never rebuilt.

Imported late (by plenocli.inverse.sparse.l1.solve), because importing numba takes a second; without
numba plenocli.inverse.sparse.l1.uncompiled does the work. The problem of one signal is min c^T G c
- 2 b^T c + 2 sum_j threshold_j |c_j|, with q = b - G c, half the downhill slope.

Three nested sets of atoms keep the cost down: all (q from whole rows of G, a few times a signal), a
working set of those with the largest |q| / threshold, which grows (its block of G is copied close
together), and the active ones, where the factor lives. The first passes use a raised threshold,
which finds most of the support while the active set is small. Loops run over slices that start at
0: a variable offset in an index keeps the compiler from vectorising.
"""

from collections import namedtuple

import numpy as np

from plenocli.inverse.compiled import compiled

JITTER = 1e-12
"""Added to the diagonal, relative to it: more than rounding can take away, so that dependent atoms
cannot break the factor. They move far along the flat direction, and the line search stops them
where one of them reaches zero and leaves.
"""

JOINING = 48
"""Atoms that join the working set in a pass; at least half as many as are active."""

CAPACITY = 288
"""Of the first workspace; doubled when the working set outgrows it."""

LOWERING = 0.1
"""The threshold starts at this fraction of the largest |b|, and falls by as much from pass to
pass until it is the true one.
"""

_FLAGS = {"reassoc", "contract", "nsz"}
_jit = compiled(fastmath=_FLAGS, forceinline=True)

Work = namedtuple("Work", "factor block x sign h d v crossing local active working")
"""Scratch of one thread, `capacity` long or square. factor: upper triangular U with U^T U = G over
the active atoms in the order of `local` (their places in the working set); its diagonal holds 1 /
U_kk, since divisions would dominate. block: G over `working`, the atoms of the working set. h = q -
threshold sign, over active atoms.
"""


@_jit
def _workspace(capacity: int) -> Work:
    return Work(
        np.empty((capacity, capacity)),
        np.empty((capacity, capacity)),
        np.empty(capacity),
        np.empty(capacity),
        np.empty(capacity),
        np.empty(capacity),
        np.empty(capacity),
        np.empty(capacity),
        np.empty(capacity, np.int64),
        np.empty(capacity, np.bool_),
        np.empty(capacity, np.int64),
    )


@_jit
def _copy(values: np.ndarray, n: int, target: np.ndarray) -> None:
    for i in range(n):
        target[i] = values[i]


@_jit
def _scatter(values: np.ndarray, index: np.ndarray, target: np.ndarray) -> None:
    """target[index] = values, zero elsewhere."""
    for i in range(target.shape[0]):
        target[i] = 0.0
    for i in range(index.shape[0]):
        target[index[i]] = values[i]


@_jit
def _forward(factor: np.ndarray, n: int, d: np.ndarray) -> None:
    """d <- factor^-T d, four rows at a time."""
    k = 0
    while k + 4 <= n:
        a0 = d[k] * factor[k, k]
        a1 = (d[k + 1] - a0 * factor[k, k + 1]) * factor[k + 1, k + 1]
        a2 = (d[k + 2] - a0 * factor[k, k + 2] - a1 * factor[k + 1, k + 2]) * factor[k + 2, k + 2]
        a3 = (
            d[k + 3] - a0 * factor[k, k + 3] - a1 * factor[k + 1, k + 3] - a2 * factor[k + 2, k + 3]
        ) * factor[k + 3, k + 3]
        d[k], d[k + 1], d[k + 2], d[k + 3] = a0, a1, a2, a3
        rest = d[k + 4 : n]
        r0, r1, r2, r3 = (
            factor[k, k + 4 : n],
            factor[k + 1, k + 4 : n],
            factor[k + 2, k + 4 : n],
            factor[k + 3, k + 4 : n],
        )
        for i in range(n - k - 4):
            rest[i] -= a0 * r0[i] + a1 * r1[i] + a2 * r2[i] + a3 * r3[i]
        k += 4
    while k < n:
        d[k] *= factor[k, k]
        for i in range(k + 1, n):
            d[i] -= d[k] * factor[k, i]
        k += 1


@_jit
def _backward(factor: np.ndarray, n: int, d: np.ndarray) -> None:
    """d <- factor^-1 d, four rows at a time."""
    k = n
    while k >= 4:
        k -= 4
        rest = d[k + 4 : n]
        r0, r1, r2, r3 = (
            factor[k, k + 4 : n],
            factor[k + 1, k + 4 : n],
            factor[k + 2, k + 4 : n],
            factor[k + 3, k + 4 : n],
        )
        t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
        for i in range(n - k - 4):
            value = rest[i]
            t0 += r0[i] * value
            t1 += r1[i] * value
            t2 += r2[i] * value
            t3 += r3[i] * value
        d[k + 3] = (d[k + 3] - t3) * factor[k + 3, k + 3]
        d[k + 2] = (d[k + 2] - t2 - factor[k + 2, k + 3] * d[k + 3]) * factor[k + 2, k + 2]
        d[k + 1] = (
            d[k + 1] - t1 - factor[k + 1, k + 2] * d[k + 2] - factor[k + 1, k + 3] * d[k + 3]
        ) * factor[k + 1, k + 1]
        d[k] = (
            d[k]
            - t0
            - factor[k, k + 1] * d[k + 1]
            - factor[k, k + 2] * d[k + 2]
            - factor[k, k + 3] * d[k + 3]
        ) * factor[k, k]
    for back in range(k):
        r = k - 1 - back
        total = 0.0
        for i in range(r + 1, n):
            total += factor[r, i] * d[i]
        d[r] = (d[r] - total) * factor[r, r]


@_jit
def _append(factor: np.ndarray, n: int, column: np.ndarray, diagonal: float) -> None:
    """One more atom at the end: `column` (overwritten) is G between it and the n others,
    `diagonal` its own entry.
    """
    _forward(factor, n, column)
    total = diagonal * (1.0 + JITTER)
    for k in range(n):
        factor[k, n] = column[k]
        total -= column[k] * column[k]
    factor[n, n] = 1.0 / np.sqrt(max(total, 0.5 * JITTER * diagonal))


@_jit
def _remove(factor: np.ndarray, n: int, place: int, v: np.ndarray) -> None:
    """Atom `place` of n out: its column goes, and rotations work its row into those below (an
    update, so always stable).
    """
    below = n - 1 - place
    for i in range(place):
        row = factor[i, place:n]
        for j in range(below):
            row[j] = row[j + 1]
    last = factor[place, place + 1 : n]
    for j in range(below):
        v[j] = last[j]
    for k in range(below):
        row, target, rest = (
            factor[place + 1 + k, place + 1 + k : n],
            factor[place + k, place + k : n],
            v[k:below],
        )
        top = 1.0 / row[0]
        target[0] = 1.0 / np.sqrt(top * top + rest[0] * rest[0])
        cosine, sine = top * target[0], rest[0] * target[0]
        for j in range(1, below - k):
            a, b = row[j], rest[j]
            target[j] = cosine * a + sine * b
            rest[j] = cosine * b - sine * a


@_jit
def _drop(w: Work, n: int, place: int) -> None:
    """Forget active atom `place` of n."""
    w.active[w.local[place]] = False
    _remove(w.factor, n, place, w.v)
    for k in range(place, n - 1):
        w.local[k], w.x[k], w.sign[k], w.h[k], w.d[k] = (
            w.local[k + 1],
            w.x[k + 1],
            w.sign[k + 1],
            w.h[k + 1],
            w.d[k + 1],
        )


@_jit
def _subtract(q: np.ndarray, x: np.ndarray, n: int, gram: np.ndarray, place: np.ndarray) -> None:
    """q -= sum_k x_k gram[place_k], four rows at a time."""
    k = 0
    while k + 4 <= n:
        x0, x1, x2, x3 = x[k], x[k + 1], x[k + 2], x[k + 3]
        r0, r1, r2, r3 = gram[place[k]], gram[place[k + 1]], gram[place[k + 2]], gram[place[k + 3]]
        for j in range(q.shape[0]):
            q[j] -= x0 * r0[j] + x1 * r1[j] + x2 * r2[j] + x3 * r3[j]
        k += 4
    while k < n:
        row = gram[place[k]]
        for j in range(q.shape[0]):
            q[j] -= x[k] * row[j]
        k += 1


@_jit
def relative_gap(
    b: np.ndarray,
    q: np.ndarray,
    x: np.ndarray,
    index: np.ndarray,
    signal_energy: float,
    threshold: np.ndarray,
) -> tuple[float, float]:
    """How far coefficients c of one signal are from the best ones.

    The dual point is u = t (y - Dc) with |D_j^T u| <= threshold_j; dual = 2 t r^T y - t^2 r^T r.

    b: (atom,) D^T y.
    q: (atom,) D^T (y - D c).
    x: (n,) values of c that are not zero.
    index: (n,) atoms that they belong to.
    signal_energy: y^T y.
    threshold: (atom,) lambda w_j / 2.

    Returns (P = |y - Dc|^2 + sum 2 threshold |c|, gap / P).
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
def _step_length(w: Work, n: int, threshold: np.ndarray) -> tuple[float, int]:
    """(alpha, zero): the minimum of the piecewise quadratic along x + alpha d, 0 < alpha <= 1;
    `zero` is the value that lands on 0 there, or -1. h = G d, so that the slope at alpha with the
    first signs is 2 (alpha - 1) d^T h.
    """
    curvature, left = 0.0, 0
    for i in range(n):
        curvature += w.d[i] * w.h[i]
        w.crossing[i] = np.inf
        if w.x[i] * w.d[i] < 0.0 and abs(w.x[i]) < abs(w.d[i]):
            w.crossing[i] = -w.x[i] / w.d[i]
            left += 1
    jumps = 0.0
    while left > 0:
        nearest = np.argmin(w.crossing[:n])
        alpha = w.crossing[nearest]
        if (alpha - 1.0) * curvature + jumps >= 0.0:
            break
        jumps += 2.0 * threshold[w.local[nearest]] * abs(w.d[nearest])
        if (alpha - 1.0) * curvature + jumps >= 0.0:
            return alpha, int(nearest)
        w.crossing[nearest] = np.inf
        left -= 1
    if curvature <= 0.0:
        return 1.0, -1
    return min(max(1.0 - jumps / curvature, 0.0), 1.0), -1


@_jit
def _settle(w: Work, n: int, threshold: np.ndarray, limit: int) -> int:
    """Minimise over the n active atoms: Newton steps, exact line search, atoms at zero leave.

    Returns how many are left.
    """
    for _ in range(limit):
        if n == 0:
            break
        _copy(w.h, n, w.d)
        _forward(w.factor, n, w.d)
        _backward(w.factor, n, w.d)
        before = n
        for k in range(before):  # new atoms that would move against their sign
            i = before - 1 - k
            if w.x[i] == 0.0 and w.d[i] * w.sign[i] <= 0.0:
                _drop(w, n, i)
                n -= 1
        if n < before:
            continue
        alpha, zero = _step_length(w, n, threshold)
        settled = alpha == 1.0
        for i in range(n):
            w.x[i] += alpha * w.d[i]
            w.h[i] *= 1.0 - alpha
        if zero >= 0:
            w.x[zero] = 0.0
        for k in range(before):
            i = before - 1 - k
            if w.x[i] == 0.0:
                _drop(w, n, i)
                n -= 1
            elif w.x[i] * w.sign[i] < 0.0:
                w.sign[i] = -w.sign[i]
                w.h[i] -= 2.0 * threshold[w.local[i]] * w.sign[i]
                settled = False
        if settled:
            break
    return n


@_jit
def _enter(w: Work, n: int, q: np.ndarray, threshold: np.ndarray, newcomers: np.ndarray) -> int:
    """Atoms `newcomers` of the working set become active at zero. Returns how many are."""
    for i in range(n):
        w.h[i] = q[w.local[i]] - threshold[w.local[i]] * w.sign[i]
    for j in newcomers:
        for i in range(n):
            w.v[i] = w.block[j, w.local[i]]
        _append(w.factor, n, w.v, w.block[j, j])
        w.local[n], w.active[j], w.x[n], w.sign[n] = j, True, 0.0, np.sign(q[j])
        w.h[n] = q[j] - threshold[j] * w.sign[n]
        n += 1
    return n


@_jit
def _kth_largest(values: np.ndarray, k: int) -> float:
    """The k-th largest of `values` (k from 1), by quickselect on a copy.

    (np.partition would take the compiler ten seconds.)
    """
    a = values.copy()
    low, high, wanted = 0, a.shape[0] - 1, k - 1
    while low < high:
        pivot = a[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while a[i] > pivot:
                i += 1
            while a[j] < pivot:
                j -= 1
            if i <= j:
                a[i], a[j] = a[j], a[i]
                i += 1
                j -= 1
        if wanted <= j:
            high = j
        elif wanted >= i:
            low = i
        else:
            break
    return a[wanted]


@_jit
def _newcomers(
    w: Work, size: int, q: np.ndarray, threshold: np.ndarray, most: int, tol: float
) -> np.ndarray:
    """Up to `most` atoms outside the active set whose |q| exceeds the threshold most."""
    ratio = np.abs(q) / threshold
    for j in range(size):
        if w.active[j]:
            ratio[j] = 0.0
    candidate = np.flatnonzero(ratio > 1.0 + tol)
    if candidate.shape[0] > most:
        value = ratio[candidate]
        candidate = candidate[value >= _kth_largest(value, most)]
    return candidate


@_jit
def _solve_working_set(
    w: Work, n: int, b: np.ndarray, q: np.ndarray, threshold: np.ndarray, tol: float
) -> int:
    """Solve the problem of the working set (slices of b, q, threshold) from the n active atoms.

    Returns how many there are.
    """
    size = b.shape[0]
    for rounds in range(200):
        new = _newcomers(w, size, q, threshold, max(10, n // 10), tol)
        if rounds > 0 and new.shape[0] == 0:
            break
        n = _enter(w, n, q, threshold, new)
        n = _settle(w, n, threshold, 1000)
        _copy(b, size, q)
        _subtract(q, w.x, n, w.block, w.local)
    return n


@_jit
def _extend(w: Work, size: int, gram: np.ndarray, ratio: np.ndarray, more: int) -> int:
    """`more` atoms of the largest ratios join the `size` of the working set. Returns its size."""
    for j in w.working[:size]:
        ratio[j] = -1.0
    bound, first = _kth_largest(ratio, more), size
    spare = more - np.count_nonzero(ratio > bound)
    for j in range(ratio.shape[0]):
        if ratio[j] > bound or (ratio[j] == bound and spare > 0):
            if ratio[j] == bound:
                spare -= 1
            w.working[size], w.active[size] = j, False
            size += 1
    for i in range(first, size):
        row = gram[w.working[i]]
        for j in range(i + 1):
            w.block[i, j] = w.block[j, i] = row[w.working[j]]
    return size


@_jit
def _resume(w: Work, gram: np.ndarray, index: np.ndarray, value: np.ndarray) -> None:
    """Working set, factor and values of the active set `index` from its coefficients."""
    for n in range(index.shape[0]):
        w.working[n] = index[n]
        for i in range(n + 1):
            w.block[n, i] = w.block[i, n] = gram[index[n], index[i]]
            w.v[i] = w.block[n, i]
        _append(w.factor, n, w.v, w.block[n, n])
        w.local[n], w.active[n], w.x[n], w.sign[n] = n, True, value[n], np.sign(value[n])


@_jit
def solve_signal(
    gram: np.ndarray,
    b: np.ndarray,
    signal_energy: float,
    threshold: np.ndarray,
    tol: float,
    pass_limit: int,
    c: np.ndarray,
    w: Work,
) -> tuple[bool, float, float, int]:
    """Solve the problem of one signal.

    gram: (atom, atom) D^T D.
    b: (atom,) D^T y.
    signal_energy: y^T y.
    threshold: (atom,) lambda w_j / 2.
    tol: relative duality gap to reach.
    pass_limit: passes allowed; the last one is not judged: objective and gap are those before it.
    c: (atom,) to begin with; overwritten by the solution.
    w: scratch of this thread.

    Returns (finished, objective, relative gap, passes). Not finished: the workspace is too small
    for the working set; call again with a larger one.
    """
    index = np.flatnonzero(c)
    n = size = index.shape[0]
    passes, stalled, raised = 0, 0, 1.0
    if size > w.x.shape[0]:
        return False, 0.0, 1.0, 0
    _resume(w, gram, index, c[index])
    # the coefficients given are a guess: make the best of its atoms before looking at others
    if n > 0:
        near = b[index]
        _subtract(near, w.x, n, w.block, w.local)
        n = _solve_working_set(w, n, b[index], near, threshold[index], 0.25 * tol)
        index = w.working[w.local[:n]]
        _scatter(w.x, index, c)
    q = b.copy()
    _subtract(q, w.x, n, gram, index)
    objective, gap = relative_gap(b, q, w.x, index, signal_energy, threshold)
    if n == 0:
        raised = max(1.0, LOWERING * np.max(np.abs(q) / threshold))
    while gap > tol and passes < pass_limit and stalled < 3:
        passes += 1
        more = min(c.shape[0] - size, max(JOINING, n // 2))
        if size + more > w.x.shape[0]:
            return False, objective, gap, passes
        if more > 0:
            size = _extend(w, size, gram, np.abs(q) / threshold, more)
        working = w.working[:size]
        n = _solve_working_set(
            w, n, b[working], q[working], raised * threshold[working], 0.25 * tol
        )
        index = working[w.local[:n]]
        _scatter(w.x, index, c)
        if passes == pass_limit:
            break
        _copy(b, q.shape[0], q)
        _subtract(q, w.x, n, gram, index)
        if raised == 1.0:
            before = objective
            objective, gap = relative_gap(b, q, w.x, index, signal_energy, threshold)
            stalled = stalled + 1 if objective > before * (1.0 - 1e-9) else 0
        raised = max(1.0, raised * LOWERING)
    return True, objective, gap, passes


@compiled(fastmath=_FLAGS, nogil=True)
def solve_signals(
    gram: np.ndarray,
    b: np.ndarray,
    signal_energy: np.ndarray,
    threshold: np.ndarray,
    tol: float,
    pass_limit: int,
    c: np.ndarray,
    objective: np.ndarray,
    gap: np.ndarray,
    passes: np.ndarray,
) -> None:
    """solve_signal for every signal, in one thread with no lock held.

    gram, threshold, tol, pass_limit: as of solve_signal.
    b, c: (signal, atom).
    signal_energy: (signal,) y^T y.
    objective, gap, passes: (signal,), filled.
    """
    w = _workspace(min(c.shape[1], CAPACITY))
    for i in range(b.shape[0]):
        while True:
            finished, objective[i], gap[i], passes[i] = solve_signal(
                gram, b[i], signal_energy[i], threshold, tol, pass_limit, c[i], w
            )
            if finished:
                break
            w = _workspace(min(c.shape[1], 2 * w.x.shape[0]))
