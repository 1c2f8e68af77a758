"""Which planes a capture can support: few, where a camera's lenslets tell little of depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from plenocli.base.progress import bar
from plenocli.inverse.volume.measurement import Problem
from plenocli.inverse.volume.richardson_lucy import iterate
from plenocli.inverse.volume.volume import Trial

TRIED = 25
"""Iterations of Richardson-Lucy by which planes are judged."""
WORTH = 0.02
"""Share of the misfit that a further plane must take away."""


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
    trials = (Trial(f"planes {_named(key)}", value) for key, value in misfits.items())
    return sorted(chosen), tuple(trials)


def _exchanged(chosen: set[int], count: int, misfit: Callable[[set[int]], float]) -> set[int]:
    """The planes after each has moved to a neighbour as long as that is better."""
    better = True
    while better:
        better = False
        for plane in sorted(chosen):
            for near in (plane - 1, plane + 1):
                moved = chosen - {plane} | {near}
                if 0 <= near < count and len(moved) == len(chosen):
                    if misfit(moved) < misfit(chosen):
                        chosen, better = moved, True
                        break
            if better:
                break
    return chosen


def _named(planes: tuple[int, ...]) -> str:
    return ", ".join(str(plane) for plane in planes)
