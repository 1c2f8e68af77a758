"""The l1 problem as its solvers take it, without its free atoms, and what they give back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, kw_only=True)
class SparseCode:
    """Coefficients of signals, and how good they are.

    c: (atom, signal) float64.
    objective: (signal,) P, of the part of y outside the free atoms' span.
    gap: (signal,) relative duality gap in [0, 1], from the residual itself.
    passes: (signal,) outer passes (active set) or iterations (FISTA).
    factored: number of signals that needed the factored form.
    """

    c: np.ndarray
    objective: np.ndarray
    gap: np.ndarray
    passes: np.ndarray
    factored: int = 0


@dataclass(frozen=True, kw_only=True)
class Problem:
    """The problem without its free atoms.

    d: (M, penalised atom) D outside the free atoms' span.
    y: (M, signal) outside it.
    b: (signal, penalised atom) y^T d.
    threshold: (penalised atom,) lambda w / 2.
    penalised, free: columns of D that are penalised, and that are not.
    free_factor: triangular factor of the free columns.
    free_part: (free atom, signal) of Y along the basis.
    free_overlap: (free atom, penalised atom) of D along the basis.
    """

    d: np.ndarray
    y: np.ndarray
    b: np.ndarray
    threshold: np.ndarray
    penalised: np.ndarray
    free: np.ndarray
    free_factor: np.ndarray
    free_part: np.ndarray
    free_overlap: np.ndarray

    def restore(self, c: np.ndarray) -> np.ndarray:
        """Coefficients of all atoms.

        c: (signal, penalised atom).

        Returns (atom, signal), with the free atoms' coefficients filled in.
        """
        full = np.empty((len(c), len(self.penalised) + len(self.free)))
        full[:, as_slice(self.penalised)] = c
        if len(self.free):
            full[:, self.free] = np.linalg.solve(
                self.free_factor, self.free_part - self.free_overlap @ c.T
            ).T
        return full.T


def prepare(
    dictionary: ArrayLike,
    signals: ArrayLike,
    lam: float,
    weights: ArrayLike | None,
    free: Sequence[int],
) -> Problem:
    """The problem with its free atoms projected out.

    dictionary, signals, lam, weights, free: as of plenocli.inverse.sparse.l1.solve.sparse_code.

    Raises ValueError, which says what is wrong with the arguments.
    """
    d, y = np.asarray(dictionary, float), np.asarray(signals, float)
    if d.ndim != 2 or y.ndim != 2 or d.shape[0] != y.shape[0]:
        raise ValueError(f"dictionary {d.shape} and signals {y.shape} must be (M, L) and (M, B)")
    check_lambda(lam)
    if not (np.all(np.isfinite(d)) and np.all(np.isfinite(y))):
        raise ValueError("dictionary and signals must be finite")
    w = np.ones(d.shape[1]) if weights is None else np.asarray(weights, float)
    unpenalised = np.unique(np.asarray(free, dtype=int))
    penalised = np.setdiff1d(np.arange(d.shape[1]), unpenalised)
    if np.any(w[penalised] <= 0):
        raise ValueError("weights must be positive; name the unpenalised atoms in `free`")
    basis, factor = np.linalg.qr(d[:, unpenalised])
    rest = d[:, penalised]
    part, overlap = basis.T @ y, basis.T @ rest
    rest, y = rest - basis @ overlap, y - basis @ part
    b = np.ascontiguousarray(y.T @ rest)
    return Problem(
        d=rest,
        y=y,
        b=b,
        threshold=lam * w[penalised] / 2,
        penalised=penalised,
        free=unpenalised,
        free_factor=factor,
        free_part=part,
        free_overlap=overlap,
    )


def check_lambda(lam: float) -> None:
    """Raises ValueError unless lambda is positive and finite."""
    if not lam > 0 or not np.isfinite(lam):
        raise ValueError(f"lambda must be positive and finite, not {lam}")


def as_slice(index: np.ndarray) -> slice | np.ndarray:
    """Rising indices as a slice where they leave none out: a view instead of a copy."""
    return (
        slice(index[0], index[-1] + 1)
        if len(index) and index[-1] - index[0] == len(index) - 1
        else index
    )
