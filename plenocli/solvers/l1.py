"""Sparse coding: min_c |y - D c|^2 + lambda sum_j w_j |c_j|, each signal with a certificate of how close it is.

No factor 1/2: lambda is the paper's (Berkner et al. 2013, section 2-3-2); sklearn's and SPAMS's is lambda / 2, up to their
1/M. A signal is certified by its relative duality gap (P - dual) / P, computed in float64. First-order methods are
hopeless on a plenoptic system matrix (its Gram matrix spans more than ten decades), so the working solver is an active-set
Newton method (after the feature-sign search of Lee et al., NIPS 2006, with many atoms entering at a time); `fista` is kept
for comparison and carries the same certificate.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SparseCode:
    """c: (atom, signal) float64.  objective: P per signal, of the part of y outside the free atoms' span.
    gap: relative duality gap per signal, in [0, 1].  passes: outer passes (active set) or iterations (FISTA) per signal."""

    c: np.ndarray
    objective: np.ndarray
    gap: np.ndarray
    passes: np.ndarray


def sparse_code(dictionary, signals, lam, *, weights=None, free=(), tol=1e-6, passes=300, workers=None):
    """Solve the l1 problem for every column of `signals` by the active-set Newton method.

    dictionary: D = A Phi, (M, L).  signals: Y, (M, B).  lam > 0.  weights: w_j > 0, (L,), default 1.
    free: columns without penalty (they are projected out exactly, then solved for).  tol: relative duality gap to reach;
    what was reached is in the result.  Zero columns get a zero coefficient.
    workers: threads over signals (compiled code only; default all cores); the result does not depend on it.
    """
    problem = _prepare(dictionary, signals, lam, weights, free)
    from plenocli.solvers import l1_kernel

    count, atoms = problem.b.shape
    c, objective, gap = np.empty((count, atoms)), np.empty(count), np.empty(count)
    done = np.empty(count, np.int64)
    gram = problem.d.T @ problem.d
    if workers is not None and l1_kernel.COMPILED:
        l1_kernel.numba.set_num_threads(max(1, min(int(workers), l1_kernel.numba.config.NUMBA_NUM_THREADS)))
    l1_kernel.solve_signals(gram, problem.b, problem.energy, problem.threshold, float(tol), int(passes), c, objective, gap, done)
    return SparseCode(problem.restore(c), objective, gap, done)


def fista(dictionary, signals, lam, *, weights=None, free=(), tol=1e-4, iterations=300):
    """The same problem by accelerated proximal gradient with adaptive restart (Beck & Teboulle 2009; O'Donoghue & Candes 2015).

    Arguments and result as in `sparse_code`; stops when every signal's gap is <= tol or after `iterations`.
    """
    problem = _prepare(dictionary, signals, lam, weights, free)
    gram = problem.d.T @ problem.d
    step = 1.0 / max(np.linalg.norm(gram, 2), np.finfo(float).tiny)
    c = np.zeros_like(problem.b)
    ahead, momentum = c, np.ones(len(c))
    objective, gap = duality_gap(gram, problem.b, problem.energy, problem.threshold, c)
    done = 0
    while done < iterations and np.any(gap > tol):
        done += 1
        moved = ahead - step * (ahead @ gram - problem.b)
        moved = np.sign(moved) * np.maximum(np.abs(moved) - step * problem.threshold, 0)
        restart = np.einsum("ij,ij->i", ahead - moved, moved - c) > 0
        after = np.where(restart, 1.0, (1 + np.sqrt(1 + 4 * momentum**2)) / 2)
        pull = np.where(restart, 0.0, (momentum - 1) / after)
        ahead, c, momentum = moved + pull[:, None] * (moved - c), moved, after
        if done % 10 == 0 or done == iterations:
            objective, gap = duality_gap(gram, problem.b, problem.energy, problem.threshold, c)
    return SparseCode(problem.restore(c), objective, gap, np.full(len(c), done))


def duality_gap(gram, b, energy, threshold, c):
    """(P, relative gap) per signal; b and c are (signal, atom), energy is y^T y (signal,), threshold lambda w / 2 (atom,).

    The dual point is the residual scaled into |D_j^T u| <= threshold_j.
    """
    q = b - c @ gram
    fit, slope = np.einsum("ij,ij->i", c, b), np.einsum("ij,ij->i", c, q)
    residual = np.maximum(energy - fit - slope, 0)
    objective = residual + 2 * np.abs(c) @ threshold
    limit = 1 / np.maximum(np.max(np.abs(q) / threshold, axis=1), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.clip((energy - fit) / residual, -limit, limit)
        gap = np.maximum(objective - (2 * t * (energy - fit) - t**2 * residual), 0) / objective
    return objective, np.where((objective <= 0) | (residual <= 0), 0.0, gap)


def largest_lambda(dictionary, signals, *, weights=None, free=()):
    """The smallest lambda per signal for which c = 0 (outside `free`): 2 max_j |D_j^T y| / w_j."""
    problem = _prepare(dictionary, signals, 1.0, weights, free)
    return 2 * np.max(np.abs(problem.b) / (2 * problem.threshold), axis=1)


@dataclass
class _Problem:
    d: np.ndarray
    b: np.ndarray
    energy: np.ndarray
    threshold: np.ndarray
    penalised: np.ndarray
    free: np.ndarray
    free_basis: np.ndarray
    free_factor: np.ndarray
    free_part: np.ndarray
    free_overlap: np.ndarray

    def restore(self, c):
        """(signal, penalised atom) -> (atom, signal), with the free atoms' coefficients filled in."""
        full = np.zeros((len(self.penalised) + len(self.free), len(c)))
        full[self.penalised] = c.T
        if len(self.free):
            right = self.free_part - self.free_overlap @ c.T
            full[self.free] = np.linalg.solve(self.free_factor, right)
        return full


def _prepare(dictionary, signals, lam, weights, free):
    d, y = np.asarray(dictionary, float), np.asarray(signals, float)
    if d.ndim != 2 or y.ndim != 2 or d.shape[0] != y.shape[0]:
        raise ValueError(f"dictionary {d.shape} and signals {y.shape} must be (M, L) and (M, B)")
    if not lam > 0 or not np.isfinite(lam):
        raise ValueError(f"lambda must be positive and finite, not {lam}")
    w = np.ones(d.shape[1]) if weights is None else np.asarray(weights, float)
    free = np.unique(np.asarray(free, dtype=int))
    penalised = np.setdiff1d(np.arange(d.shape[1]), free)
    if np.any(w[penalised] <= 0):
        raise ValueError("weights must be positive; name the unpenalised atoms in `free`")
    basis, factor = np.linalg.qr(d[:, free])
    rest = d[:, penalised]
    part, overlap = basis.T @ y, basis.T @ rest
    rest, y = rest - basis @ overlap, y - basis @ part
    b = np.ascontiguousarray(y.T @ rest)
    energy = np.einsum("ij,ij->j", y, y)
    return _Problem(rest, b, energy, lam * w[penalised] / 2, penalised, free, basis, factor, part, overlap)
