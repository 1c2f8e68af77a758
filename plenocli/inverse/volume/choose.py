"""The solvers by name, and the one that predicts held-out pixels best."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.inverse.volume.lmmse import lmmse
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.richardson_lucy import richardson_lucy
from plenocli.inverse.volume.total_variation import total_variation
from plenocli.inverse.volume.volume import Trial, Volume

SOLVERS: dict[str, Callable[[Problem], Volume]] = {
    "rl": richardson_lucy,
    "lmmse": lmmse,
    "tv": total_variation,
    "tikhonov": partial(lmmse, white=True),
}
"""By name: of a Problem, its Volume."""
COMPARED = ("rl", "lmmse", "tv")
"""What `auto` tries; the likelihood already lets lmmse take voxels for independent."""


def volume_of(problem: Problem, method: str = "auto") -> Volume:
    """The volume behind a measurement.

    problem: the measurement before its map.
    method: one of SOLVERS, or "auto": of COMPARED the one whose held-out pixels are predicted best.

    Returns the volume; of "auto" its trace begins with what each method predicted.
    Raises KeyError for a method that is none, NumericsError where "auto" has nothing to judge by.
    """
    if method != "auto":
        return SOLVERS[method](problem)
    if not problem.held.any():
        raise NumericsError(
            "no pixel was held out to choose a method by", None, "hold some out, or name a method"
        )
    best, tried = None, []
    for name in COMPARED:
        found = SOLVERS[name](problem)
        tried.append(Trial(name, _misfit(problem, found)))
        if tried[-1].misfit <= min(trial.misfit for trial in tried):
            best = found
    assert best is not None
    return replace(best, trace=(*tried, *best.trace))


def _misfit(problem: Problem, volume: Volume) -> float:
    held = volume.held_out
    assert held is not None
    light = np.zeros(problem.signal.shape)
    light[problem.held] = held.predicted - problem.measurement.offset[problem.held]
    return problem.misfit(light)
