"""A volume with its error bars, and how well it foretells pixels that it was not made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.tiling import bands

BARS = 1.959964
"""Standard deviations that hold 95 % of normal errors."""
AT_ONCE = 1 << 18
"""Pixels that are worked on together: temporary arrays are no larger."""
ROUNDS = 8
"""Of reweighting, after which a law of variance stands still."""


@dataclass(frozen=True, kw_only=True)
class HeldOut:
    """Pixels that were put aside, and what was predicted of them.

    index: (n, 3) lenslet row, lenslet column, pixel.
    measured, predicted: (n,), units of the signal.
    sigma: (n,) standard deviation of their difference, noise included: read off the other half of
        the pixels, as it grows with brightness.
    """

    index: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    sigma: np.ndarray

    @property
    def explained_db(self) -> float:
        """Of the pixels' variance."""
        error = np.mean((self.measured - self.predicted) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            return float(10 * np.log10(np.var(self.measured) / error))

    @property
    def z_rms(self) -> tuple[float, ...]:
        """Root mean square of error over sigma by quartile of predicted brightness."""
        return tuple(float(np.sqrt(_mean(z**2))) for z in self._by_quartile())

    @property
    def held_by_bars(self) -> tuple[float, ...]:
        """Share of the pixels within their 95 % bars, by quartile of predicted brightness."""
        return tuple(_mean(np.abs(z) < BARS) for z in self._by_quartile())

    def _by_quartile(self) -> list[np.ndarray]:
        with np.errstate(divide="ignore", invalid="ignore"):  # bars of no width
            z = (self.measured - self.predicted) / self.sigma
        return np.array_split(z[np.argsort(self.predicted, kind="stable")], 4)


def all_known(numbers: Sequence[float]) -> list[float] | None:
    """Figures of held-out pixels; None where these were too few, or without any error, to say."""
    return list(numbers) if np.isfinite(numbers).all() else None


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if values.size else float("nan")


def predictive_sigma(measured: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Standard deviation of predictions, each half of the pixels by the errors of the other one:
    variance a + b p + c p^2 with no coefficient below zero, p the prediction above the darkest.

    measured, predicted: (n,).
    """
    darkest = float(np.quantile(predicted, 0.01))
    sigma = np.empty(len(measured), np.result_type(measured, predicted))

    def law(some: slice) -> np.ndarray:
        level = np.maximum(predicted[some].astype(float) - darkest, 0)
        return np.stack([np.ones_like(level), level, level**2], axis=1)

    halves = slice(0, None, 2), slice(1, None, 2)
    for half, other in (halves, halves[::-1]):
        square = (measured[other].astype(float) - predicted[other]) ** 2
        sigma[half] = np.sqrt(law(half) @ variance_law(law(other), square))
    return sigma


def variance_law(law: np.ndarray, square: np.ndarray) -> np.ndarray:
    """Non-negative coefficients of a variance, by least squares weighted with the variance.

    law: (n, term) values of the terms.
    square: (n,) squared errors.
    """
    unit = float(square.mean()) if len(square) else 0.0
    if not unit:
        return np.zeros(law.shape[1])
    scale = np.maximum(law.max(axis=0), np.finfo(float).tiny)
    variance = np.ones(len(square))
    some = bands(len(square), AT_ONCE)
    for _ in range(ROUNDS):
        gram, along = np.zeros((len(scale), len(scale))), np.zeros(len(scale))
        for part in some:
            terms = law[part] / scale / variance[part, None]
            gram += terms.T @ terms
            along += terms.T @ (square[part] / unit / variance[part])
        found, least = _non_negative(gram, along), 1e-3 * variance.mean()
        for part in some:
            variance[part] = np.maximum(law[part] / scale @ found, least)
    return unit * found / scale


def _non_negative(gram: np.ndarray, along: np.ndarray) -> np.ndarray:
    """x >= 0 of the least |B x - y|, by B' B (term, term) and B' y (term,)."""
    from scipy.optimize import nnls

    values, vectors = np.linalg.eigh(gram)
    told = values > np.finfo(float).eps * values[-1]
    root = np.sqrt(np.where(told, values, 0))
    right = np.divide(vectors.T @ along, root, out=np.zeros_like(along), where=told)
    return nnls(root[:, None] * vectors.T, right)[0]


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Of a Gaussian volume: covariance `variance` exp(-r / `correlation_length`).

    correlation_length: m; 0 where voxels are independent.
    variance: of a voxel.
    noise_variance: mean over pixels, model error included.
    mean: of a voxel.
    """

    correlation_length: float
    variance: float
    noise_variance: float
    mean: float


@dataclass(frozen=True)
class Likeness:
    """How a volume goes with one of another colour.

    factor: times the other one, which is taken off before variation is counted; 0: not at all.
    share: of the total variation, that is gone then.
    """

    factor: float
    share: float


@dataclass(frozen=True)
class Trial:
    """One thing that was tried: which, and the mean square error of held-out pixels over their
    variance.
    """

    what: str
    misfit: float


@dataclass(frozen=True, kw_only=True)
class Volume:
    """A specimen, plane by plane.

    value: (plane, row, column) on the fine lattice.
    sigma: like value, its standard deviation; None where the method has none.
    method: that made it.
    trace: what was tried, in order.
    background: signal that was taken for none of the specimen's, mean over pixels.
    prior: that was assumed; None where none was.
    held_out: pixels that were put aside, predicted; None where none were.
    margin: lenslets from the border on which light of some voxels was not seen.
    likeness: to the volume that it was to be like; None where none was named.
    """

    value: np.ndarray
    sigma: np.ndarray | None
    method: str
    trace: tuple[Trial, ...]
    background: float
    prior: Prior | None
    held_out: HeldOut | None
    margin: int
    likeness: Likeness | None = None
