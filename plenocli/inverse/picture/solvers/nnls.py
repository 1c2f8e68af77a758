"""Non-negative least squares: min |y - A x|^2, x >= 0; converged, or stopped
early and saying where.

"Non-linear least squares" is not one result: on a plenoptic system matrix the picture first
improves and then drowns in noise as the iterations go on, so every result carries its stopping
rule. A converged solution is checked against the optimality (KKT) conditions of the problem; the
early-stopped one is the accelerated projected gradient method.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NonNegative:
    """A solution x >= 0.

    x: (point, signal).
    kkt: (signal,) how far from optimal, see `kkt_violation`.
    iterations: of the gradient method, 0 for the active-set one.
    """

    x: np.ndarray
    kkt: np.ndarray
    iterations: int


def kkt_violation(matrix: np.ndarray, z: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Largest violation of the optimality conditions per signal, relative to the gradient at x = 0.

    With g = A^T (A x - z): max_j of |g_j| where x_j > 0 and of max(-g_j, 0) where x_j = 0,
    over max_j |A^T z|_j.

    matrix: A (row, point).
    z: (row, signal).
    x: (point, signal) >= 0.

    Returns (signal,).
    """
    g = matrix.T @ (matrix @ x - z)
    wrong = np.where(x > 0, np.abs(g), np.maximum(-g, 0)).max(axis=0)
    return wrong / np.maximum(np.abs(matrix.T @ z).max(axis=0), np.finfo(float).tiny)


def converged(matrix: np.ndarray, z: np.ndarray, *, tol: float = 1e-10) -> NonNegative:
    """The solution for each signal, about 2 s of CPU for one of 1600 points at 60 dB.

    matrix: (row, point); S V^T and U^T y serve as well as A and y, and are smaller.
    z: (row, signal).
    tol: how far the optimality conditions may be violated (`kkt_violation`).

    Raises NumericsError where they are violated by more.
    Lawson and Hanson 1974, the active-set method.
    """
    from scipy.optimize import nnls

    from plenocli.base.errors import NumericsError

    matrix, z = np.ascontiguousarray(matrix, float), np.asarray(z, float)
    x = np.stack([nnls(matrix, column, maxiter=20 * matrix.shape[1])[0] for column in z.T], axis=1)
    kkt = kkt_violation(matrix, z, x)
    if not np.all(kkt <= tol):
        raise NumericsError(
            (
                f"non-negative least squares reached {kkt.max():.1e} of the optimality "
                f"conditions, not {tol:.1e}"
            ),
            fix="use --nnls-iterations, or --method tikhonov",
        )
    return NonNegative(x, kkt, 0)


def projected_gradient(
    matrix: np.ndarray, z: np.ndarray, iterations: int, norm: float | None = None
) -> NonNegative:
    """The iterate of the accelerated projected gradient method (FISTA with x >= 0) from x = 0; step
    1/|A|_2^2, momentum restarted per signal where it points uphill.

    matrix: A (row, point).
    z: (row, signal).
    iterations: steps.
    norm: |A|_2, if known.
    """
    matrix, z = np.asarray(matrix, float), np.asarray(z, float)
    gram, target = matrix.T @ matrix, matrix.T @ z
    step = 1 / (np.linalg.norm(matrix, 2) if norm is None else norm) ** 2
    x = np.zeros_like(target)
    ahead, momentum = x, np.ones(z.shape[1])
    for _ in range(iterations):
        stepped = np.maximum(ahead - step * (gram @ ahead - target), 0)
        restart = np.einsum("ij,ij->j", ahead - stepped, stepped - x) > 0
        after = np.where(restart, 1.0, (1 + np.sqrt(1 + 4 * momentum**2)) / 2)
        pull = np.where(restart, 0.0, (momentum - 1) / after)
        ahead, x, momentum = stepped + pull * (stepped - x), stepped, after
    return NonNegative(x, kkt_violation(matrix, z, x), iterations)
