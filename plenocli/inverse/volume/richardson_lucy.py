"""Richardson-Lucy, accelerated, until held-out pixels are predicted no better."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.progress import bar
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.volume import Trial, Volume

PATIENCE, GAIN = 6, 0.02
"""Iterations that must make the held-out error smaller by this share, or else are the last."""
VANISHED = 1e-12
"""Share of the mean below which a voxel is zero: numbers below 1e-38 are slow to compute with."""
UNSEEN = 1e-3
"""Share of its light that a voxel must have on pixels that count to be asked for."""


@dataclass(frozen=True)
class Steps:
    """Where iterations went.

    x: (lenslet_row, lenslet_column, unknown), the best by held-out pixels.
    prediction: A x, like the signal.
    likelihoods: of every point that a step was taken from, up to a constant.
    misfits: of held-out pixels there.
    """

    x: np.ndarray
    prediction: np.ndarray
    likelihoods: tuple[float, ...]
    misfits: tuple[float, ...]


def richardson_lucy(problem: Problem, iterations: int = 200, accelerated: bool = True) -> Volume:
    """The volume of the largest Poisson likelihood that stops before it fits noise.

    problem: pixels that do not count are left out of all sums.
    iterations: at most; without held-out pixels, exactly.
    accelerated: extrapolate along the last step.

    Returns a volume without sigma.
    Raises NumericsError where memory is lacking.
    Richardson 1972; Lucy 1974; Biggs and Andrews 1997 (acceleration).
    """
    shape = problem.op.domain.shape
    budget().require(12 * 4 * prod(shape), "Richardson-Lucy", fewer="take fewer planes")
    steps = iterate(problem, iterations, accelerated)
    trace = tuple(Trial(f"{i + 1} iterations", m) for i, m in enumerate(steps.misfits))
    return Volume(
        value=problem.inside(steps.x),
        sigma=None,
        method="rl",
        trace=trace,
        background=float(problem.measurement.offset.mean()),
        prior=None,
        held_out=problem.judged(steps.prediction),
        margin=problem.margin,
    )


def iterate(problem: Problem, iterations: int, accelerated: bool = True) -> Steps:
    """The iterations of richardson_lucy.

    x <- x A'(m y / (A x + b)) / A'm. Read noise is taken for photons of the same variance that are
    known to be there, in y and in b (Snyder et al. 1995); without photon noise b is the
    background alone.
    """
    op, measurement = problem.op, problem.measurement
    seen = op.adjoint(problem.counts.astype(op.dtype))
    b = np.maximum(measurement.offset, 0).astype(op.dtype)
    if measurement.gain > 0:
        b += op.dtype.type(measurement.read_variance / measurement.gain)
    y = np.where(problem.counts, np.maximum(problem.signal + b, 0), 0)
    light = op.spectrum[0].real.sum(axis=0)
    asked = seen > UNSEEN * light
    seen = np.where(asked, seen, 1)
    level = max(float(problem.signal[problem.counts].mean()), 1e-6 * float(y.max()) + 1e-30)
    start = level / max(float(problem.light_on_pixels.mean()), 1e-30)
    x = np.where(asked, op.dtype.type(start), 0)
    walk = _Walk(x, VANISHED * start)
    likelihoods: list[float] = []
    misfits: list[float] = []
    best_x, best_light = x, np.zeros_like(y)
    for _ in bar(range(iterations), iterations, "Richardson-Lucy"):
        predicted = op.forward(walk.point)
        likelihood = _likelihood(problem, y, predicted, b)
        if likelihoods and likelihood < likelihoods[-1]:
            walk.back()
            predicted = op.forward(walk.point)
            likelihood = _likelihood(problem, y, predicted, b)
        likelihoods.append(likelihood)
        misfits.append(problem.misfit(predicted))
        if not misfits[-1] > min(misfits):  # also where there is none
            best_x, best_light = walk.point, predicted
        if len(misfits) > PATIENCE and misfits[-1] > (1 - GAIN) * misfits[-1 - PATIENCE]:
            break
        ratio = np.divide(y, predicted + b, out=np.zeros_like(y), where=predicted + b > 0)
        walk.step(walk.point * op.adjoint(ratio) / seen, accelerated)
    return Steps(best_x, best_light, tuple(likelihoods), tuple(misfits))


class _Walk:
    """The point that the next step is taken from: beyond the last result, along the last change,
    as far as the last two steps point the same way.
    """

    def __init__(self, x: np.ndarray, least: float) -> None:
        self.point = self.result = x
        self._least = least
        self._step: np.ndarray | None = None

    def step(self, result: np.ndarray, accelerated: bool) -> None:
        """Take in what became of `point`."""
        result = np.where(result > self._least, result, 0)
        step, last = result - self.point, self._step
        change, self.result, self._step = result - self.result, result, step
        self.point = result
        if accelerated and last is not None:
            share = float(np.vdot(step, last)) / max(float(np.vdot(last, last)), 1e-300)
            if share > 0:
                point = result + result.dtype.type(min(share, 0.999)) * change
                self.point = np.maximum(point, 0)

    def back(self) -> None:
        """The extrapolation did harm: go on from the last result."""
        self.point, self._step = self.result, None


def _likelihood(problem: Problem, y: np.ndarray, predicted: np.ndarray, b: np.ndarray) -> float:
    at = problem.counts
    light = np.maximum(predicted[at] + b[at], np.finfo(np.float32).tiny).astype(float)
    return float(np.sum(y[at] * np.log(light) - light))
