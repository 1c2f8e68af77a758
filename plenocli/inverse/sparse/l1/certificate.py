"""How far a sparse code is from the best one: the duality gap."""

import numpy as np


def duality_gap(
    d: np.ndarray, y: np.ndarray, c: np.ndarray, threshold: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far coefficients are from the best ones, from the residual itself: y^T y - 2 b^T c + c^T
    G c would cancel. The dual point is the residual scaled into |D_j^T u| <= threshold_j.

    d: (M, atom) D.
    y: (M, signal).
    c: (signal, atom).
    threshold: (atom,) lambda w / 2.

    Returns (P (signal,), relative gap (signal,), q = D^T (y - D c) (signal, atom)).
    """
    residual = y - d @ c.T
    q = residual.T @ d
    energy, along = np.einsum("ij,ij->j", residual, residual), np.einsum("ij,ij->j", residual, y)
    objective = energy + 2 * np.abs(c) @ threshold
    limit = 1 / np.maximum(np.max(np.abs(q) / threshold, axis=1, initial=0), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.clip(along / energy, -limit, limit)
        gap = np.maximum(objective - (2 * t * along - t**2 * energy), 0) / objective
    return (
        objective,
        np.where((objective <= 0) | (energy <= 0), np.where(objective > energy, 1.0, 0.0), gap),
        q,
    )
