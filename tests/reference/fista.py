"""The l1 problem by a first-order method, one of the kinds that the paper names: for checking."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from plenocli.inverse.sparse.l1.certificate import duality_gap
from plenocli.inverse.sparse.l1.problem import SparseCode, prepare


def fista(
    dictionary: ArrayLike,
    signals: ArrayLike,
    lam: float,
    *,
    weights: ArrayLike | None = None,
    free: Sequence[int] = (),
    tol: float = 1e-4,
    iterations: int = 300,
) -> SparseCode:
    """The same problem by accelerated proximal gradient with adaptive restart.

    On a plenoptic system matrix the gap stays near 1 for thousands of iterations, and says so.

    dictionary, signals, lam, weights, free: as of plenocli.inverse.sparse.l1.solve.sparse_code.
    tol: relative duality gap of every signal at which it stops.
    iterations: after which it stops at the latest.

    Returns the code; passes are iterations.
    Raises ValueError as `prepare`.
    Beck & Teboulle 2009; O'Donoghue & Candes 2015.
    """
    problem = prepare(dictionary, signals, lam, weights, free)
    gram = problem.d.T @ problem.d
    step = 1.0 / max(np.linalg.norm(gram, 2), np.finfo(float).tiny)
    c = np.zeros_like(problem.b)
    ahead, momentum = c, np.ones(len(c))
    objective, gap, _ = duality_gap(problem.d, problem.y, c, problem.threshold)
    done = 0
    while done < iterations and np.any(gap > tol):
        done += 1
        stepped = ahead - step * (ahead @ gram - problem.b)
        stepped = np.sign(stepped) * np.maximum(np.abs(stepped) - step * problem.threshold, 0)
        restart = np.einsum("ij,ij->i", ahead - stepped, stepped - c) > 0
        after = np.where(restart, 1.0, (1 + np.sqrt(1 + 4 * momentum**2)) / 2)
        pull = np.where(restart, 0.0, (momentum - 1) / after)
        ahead, c, momentum = stepped + pull[:, None] * (stepped - c), stepped, after
        if done % 10 == 0 or done == iterations:
            objective, gap, _ = duality_gap(problem.d, problem.y, c, problem.threshold)
    return SparseCode(
        c=problem.restore(c), objective=objective, gap=gap, passes=np.full(len(c), done)
    )
