"""What predicts held-out pixels best: which of the solvers, and which planes, few where a camera's
lenslets tell little of depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.progress import bar
from plenocli.inverse.volume.lmmse import is_uneven, lmmse
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.richardson_lucy import iterate, richardson_lucy
from plenocli.inverse.volume.total_variation import total_variation
from plenocli.inverse.volume.volume import Trial, Volume

SOLVERS: dict[str, Callable[..., Volume]] = {
    "rl": richardson_lucy,
    "lmmse": lmmse,
    "tv": total_variation,
    "tikhonov": partial(lmmse, white=True),
}
"""By name: of a Problem, its Volume."""
COMPARED = ("rl", "lmmse", "tv")
"""What `auto` tries; the likelihood already lets lmmse take voxels for independent."""
TRIED = 200
"""Iterations of Richardson-Lucy by which planes are judged, at most: they stop by themselves. The
first ones prefer planes far from the focus, where they converge sooner.
"""
WORTH = 0.05
"""Share of the misfit that a further plane must take away."""


def volume_of(problem: Problem, method: str = "auto", like: np.ndarray | None = None) -> Volume:
    """The volume behind a measurement.

    problem: the measurement before its map.
    method: one of SOLVERS, or "auto": of COMPARED the one whose held-out pixels are predicted best.
    like: (plane, row, column) a volume of another colour that total variation, then the method of
        "auto", may tie this one to.

    Returns the volume; of "auto" its trace begins with what each method predicted.
    Raises KeyError for a method that is none, NumericsError where "auto" has nothing to judge by.
    """
    if like is not None:
        return total_variation(problem, like=like)
    if method != "auto":
        return SOLVERS[method](problem)
    if not problem.held.any():
        raise NumericsError(
            "no pixel was held out to choose a method by", None, "hold some out, or name a method"
        )
    best, tried = None, []
    for name in COMPARED:
        found = SOLVERS[name](problem)
        assert found.held_out is not None
        tried.append(Trial(name, 10 ** (-found.held_out.explained_db / 10)))
        if not tried[-1].misfit > min(trial.misfit for trial in tried):
            best = found
    assert best is not None
    return replace(best, trace=(*tried, *best.trace))


def as_before(other: Volume) -> Callable[[Problem, np.ndarray | None], Volume]:
    """What makes the volumes behind other parts of the same specimen, by the method of `other`;
    their error bars follow the specimen where those of `other` do, else they would jump from part
    to part.

    Returns a function of a part's problem and its `like`, as in volume_of.
    """
    method = other.method
    linear = {} if other.sigma is None else {"uneven": is_uneven(other.value)}

    def of(problem: Problem, like: np.ndarray | None) -> Volume:
        if like is not None:
            return total_variation(problem, like=like)
        return SOLVERS[method](problem, **linear)

    return of


def supported_planes(
    problem_of: Callable[[Sequence[int]], Problem], count: int, most: int
) -> tuple[list[int], tuple[Trial, ...]]:
    """The planes that predict held-out pixels best: one after the other, as long as one more helps,
    each then exchanged for its neighbours where these are better.

    problem_of: the problem with some of the planes alone, by their numbers, rising; the same pixels
        put aside in all.
    count: planes there are; most: how many are taken at the most.

    Returns their numbers, rising, and what was tried: planes and misfit of held-out pixels.
    """
    misfits: dict[tuple[int, ...], float] = {}

    def misfit(planes: set[int]) -> float:
        key = tuple(sorted(planes))
        if key not in misfits:
            misfits[key] = min(iterate(problem_of(key), TRIED).misfits)
        return misfits[key]

    chosen: set[int] = set()
    for _ in range(min(most, count)):
        others = [plane for plane in range(count) if plane not in chosen]
        found = min(bar(others, len(others), "planes"), key=lambda plane: misfit(chosen | {plane}))
        if chosen and misfit(chosen | {found}) > (1 - WORTH) * misfit(chosen):
            break
        chosen = _exchanged(chosen | {found}, count, misfit)
    trials = (Trial(f"planes {', '.join(map(str, key))}", value) for key, value in misfits.items())
    return sorted(chosen), tuple(trials)


def _exchanged(chosen: set[int], count: int, misfit: Callable[[set[int]], float]) -> set[int]:
    """The planes after each has moved to a neighbour as long as that is better."""
    for plane in sorted(chosen):
        for near in {plane - 1, plane + 1} & set(range(count)) - chosen:
            moved = chosen - {plane} | {near}
            if misfit(moved) < misfit(chosen):
                return _exchanged(moved, count, misfit)
    return chosen
