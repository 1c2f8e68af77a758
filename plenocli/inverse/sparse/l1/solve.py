"""Sparse coding: min_c |y - D c|^2 + lambda sum_j w_j |c_j|, each signal with a certificate
of how close it is.

No factor 1/2: lambda is the paper's (Berkner et al. 2013, section 2-3-2); sklearn's and SPAMS's is
lambda / 2, up to their 1/M. A signal is certified by its relative duality gap (P - dual) / P,
computed in float64. First-order methods are hopeless on a plenoptic system matrix (its Gram matrix
spans more than ten decades), so the working solver is an active-set Newton method (after the
feature-sign search of Lee et al., NIPS 2006, with many atoms entering at a time).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plenocli.inverse.sparse.l1.certificate import duality_gap
from plenocli.inverse.sparse.l1.problem import Problem, SparseCode, as_slice, check_lambda, prepare


def sparse_code(
    dictionary: ArrayLike,
    signals: ArrayLike,
    lam: float,
    *,
    weights: ArrayLike | None = None,
    free: Sequence[int] = (),
    tol: float = 1e-6,
    passes: int = 300,
    start: np.ndarray | None = None,
    workers: int | None = None,
) -> SparseCode:
    """Solve the l1 problem for every column of `signals` by the active-set Newton method.

    dictionary: (M, L) D = A Phi.
    signals: (M, B) Y.
    lam: weight of |c|_1, above 0.
    weights: (L,) w_j > 0, default 1.
    free: columns without penalty (they are projected out exactly, then solved for).
    tol: relative duality gap to reach; what was reached is in the result.
    passes: outer passes allowed a signal.
    start: (L, B) coefficients to begin with (default: guessed by a ridge regression where that
        pays).
    workers: threads over signals (compiled code only; default all cores); the result does not
        depend on it.

    Returns the code; zero columns get a zero coefficient.
    Raises ValueError as `prepare`.
    """
    problem = prepare(dictionary, signals, lam, weights, free)
    return _active_set(
        problem, problem.d.T @ problem.d, problem.threshold, tol, passes, start, workers
    )


def lambda_path(
    dictionary: ArrayLike,
    signals: ArrayLike,
    lams: Iterable[float],
    *,
    weights: ArrayLike | None = None,
    free: Sequence[int] = (),
    tol: float = 1e-6,
    passes: int = 300,
    workers: int | None = None,
) -> Iterator[tuple[float, SparseCode]]:
    """Codes for several weights of |c|_1, each solved from the solution before; D^T D is formed
    once.

    lams: weights above 0.
    dictionary, signals, weights, free, tol, passes, workers: as of sparse_code.

    Returns (yields) (lambda, code) from the largest lambda down.
    Raises ValueError as `prepare`.
    """
    problem = prepare(dictionary, signals, 1.0, weights, free)
    gram, code = problem.d.T @ problem.d, None
    for lam in sorted({float(lam) for lam in lams}, reverse=True):
        check_lambda(lam)
        code = _active_set(
            problem,
            gram,
            lam * problem.threshold,
            tol,
            passes,
            None if code is None else code.c,
            workers,
        )
        yield lam, code


BLOCK = 1024
"""Signals certified together: bounds the memory of residuals and slopes."""


@dataclass(frozen=True, kw_only=True)
class _ActiveSet:
    """The active-set method at work on a prepared problem; its last four arrays are filled in.

    problem: see there.
    gram: (atom, atom) D^T D.
    threshold: (atom,) lambda w / 2.
    tol: relative duality gap to reach.
    workers: threads over signals, None for all cores.
    c: (signal, atom) coefficients, to begin with a guess.
    done: (signal,) outer passes.
    objective, gap: (signal,) as in SparseCode.
    """

    problem: Problem
    gram: np.ndarray
    threshold: np.ndarray
    tol: float
    workers: int | None
    c: np.ndarray
    done: np.ndarray
    objective: np.ndarray
    gap: np.ndarray

    def certify(self, which: slice | np.ndarray) -> None:
        """Into objective and gap of the signals `which` (a slice, or indices), BLOCK at a time."""
        index, y = np.arange(len(self.c))[which], self.problem.y
        for first in range(0, len(index), BLOCK):
            part = as_slice(index[first : first + BLOCK])
            self.objective[part], self.gap[part], _ = duality_gap(
                self.problem.d, y[:, part], self.c[part], self.threshold
            )

    def solve_one(self, signal: int, passes: int, *, factored: bool = False) -> None:
        """One signal without the compiled kernel; factored: not through D^T D."""
        from plenocli.inverse.sparse.l1 import uncompiled

        self.done[signal] += uncompiled.solve_signal(
            self.problem.d,
            self.problem.y[:, signal],
            None if factored else self.gram,
            self.threshold,
            self.tol,
            passes,
            self.c[signal],
        )

    def solve_compiled(
        self, kernel: Callable[..., None], which: slice | np.ndarray, passes: int
    ) -> None:
        """The signals `which` (a slice, or indices), in threads; each signal is solved by itself,
        so the result does not depend on how they are dealt out.
        """
        import os
        from concurrent.futures import ThreadPoolExecutor

        y, b = self.problem.y[:, which], self.problem.b[which]
        found, steps = self.c[which], self.done[which]
        count = len(found)
        energy, unused = np.einsum("ij,ij->j", y, y), np.empty((2, count))
        before = steps.copy()

        def solve(part: slice) -> None:
            kernel(
                self.gram,
                b[part],
                energy[part],
                self.threshold,
                float(self.tol),
                int(passes),
                found[part],
                unused[0, part],
                unused[1, part],
                steps[part],
            )

        workers = max(1, min(int(self.workers or os.cpu_count() or 1), count))
        size = max(1, min(64, -(-count // workers)))
        with ThreadPoolExecutor(workers) as pool:
            list(pool.map(solve, [slice(first, first + size) for first in range(0, count, size)]))
        steps += before
        if not isinstance(which, slice):  # indices gave copies
            self.c[which], self.done[which] = found, steps

    def solve_all(self, passes: int) -> None:
        """Every signal through D^T D, and its certificate."""
        everything = slice(0, len(self.c))
        try:
            from plenocli.inverse.sparse.l1.kernel import solve_signals
        except ImportError:  # no numba: many times slower, the same result
            for signal in range(len(self.c)):
                self.solve_one(signal, passes)
            self.certify(everything)
            return
        # from a good start one pass nearly always does; the certificate tells, for less
        # than the kernel's own
        first = min(passes, 1) if self.c.any() else passes
        self.solve_compiled(solve_signals, everything, first)
        self.certify(everything)
        again = np.flatnonzero(~(self.gap <= self.tol)) if first < passes else np.arange(0)
        if len(again):
            self.solve_compiled(solve_signals, again, passes - first)
            self.certify(again)


def _active_set(
    problem: Problem,
    gram: np.ndarray,
    threshold: np.ndarray,
    tol: float,
    passes: int,
    start: np.ndarray | None,
    workers: int | None,
) -> SparseCode:
    """SparseCode of a prepared problem: Gram form for all signals, then the factored form for
    those it could not certify.
    """
    from plenocli.inverse.sparse.l1.guess import guess

    count = len(problem.b)
    run = _ActiveSet(
        problem=problem,
        gram=gram,
        threshold=threshold,
        tol=tol,
        workers=workers,
        c=guess(problem, threshold)
        if start is None
        else np.ascontiguousarray(np.asarray(start, float)[problem.penalised].T),
        done=np.zeros(count, np.int64),
        objective=np.empty(count),
        gap=np.empty(count),
    )
    run.solve_all(passes)
    missed = np.flatnonzero(~(run.gap <= tol)).tolist() if passes > 0 else []
    for signal in missed:
        y = problem.y[:, signal]
        if run.objective[signal] > y @ y:
            run.c[signal] = 0
        run.solve_one(signal, passes, factored=True)
        run.certify(slice(signal, signal + 1))
    return SparseCode(
        c=problem.restore(run.c),
        objective=run.objective,
        gap=run.gap,
        passes=run.done,
        factored=len(missed),
    )
