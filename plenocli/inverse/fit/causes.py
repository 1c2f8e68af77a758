"""What is likely to be wrong with a camera's description: a glance, where a fit is a search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.inverse.fit.ascent import Ascent, Point
from plenocli.inverse.fit.problem import CapturedLenslets, fit_problem

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

LENSLETS = 4
"""Lenslets a side that are looked at."""
LOOKED_AT = 3
"""Parameters, by what the slopes promise, for which the way is tried."""
FAR = 1.0
"""Most tolerances that a parameter is moved."""
EITHER_WAY = (("focus", 0.25), ("shift, rows", 1 / 3), ("shift, columns", 1 / 3))
"""Parameters that are tried both ways, and how many tolerances: slopes vanish in focus, and mislead
where light is off by more than its finest detail.
"""
HELPS = 0.9
"""Times the noise that was likely before: a cause must explain so much."""


def likeliest_cause(
    camera: Camera, capture: CapturedLenslets, pictures: Sequence[np.ndarray], *, seed: int = 0
) -> str | None:
    """Which parameter alone explains most of what the described camera does not, a sentence.

    By the slopes of the evidence and its curvature at the description, and one step along the
    parameters that promise most; some are tried either way. A hint and no measurement: paraxial,
    of the LENSLETS x LENSLETS lenslets in the middle.

    camera, capture, pictures, seed: as in fit_camera.

    Returns None where no parameter helps.
    Raises as fit_camera does.
    """
    problem = fit_problem(camera, [capture], pictures, lenslets=LENSLETS, seed=seed)
    family = problem.family
    ascent = Ascent(family, problem.evidence, tolerance=problem.tolerance)
    start = ascent.point(np.zeros(len(family.parameters)))
    slopes = ascent.slopes(start)
    rise, curvature = slopes.rise, np.diag(slopes.curvature(start, start.factor))
    step = np.clip(rise / curvature, -FAR, FAR)
    promise = rise * step - 0.5 * curvature * step**2
    tries = [(int(k), float(step[k])) for k in np.argsort(-promise)[:LOOKED_AT]]
    for name, length in EITHER_WAY:
        if family.has(name):
            tries += [(family.place(name), side * length) for side in (-1, 1)]
    best: tuple[Point, int] = (start, -1)
    for place, length in tries:
        x = np.zeros(len(family.parameters))
        x[place] = length
        found = ascent.point(x)
        if found.factor < best[0].factor:
            best = (found, place)
    at, place = best
    if place < 0 or at.factor > HELPS * start.factor:
        return None
    name, unit = family.parameters[place].name, family.parameters[place].unit
    before, after = float(family.start[place]), float(ascent.values(at.x)[place])
    moved = f"{after - before:+.2g} px"
    if unit == "m":
        size = max(abs(before), abs(after))
        units = (("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))
        unit, scale = next((n, u) for n, u in units if size >= u or n == "nm")
        moved = f"{after / scale:.5g} {unit} for {before / scale:.5g} {unit}"
    return (
        f"of its parameters the {name} alone explains most ({moved}: what is left over is "
        f"{at.factor:.2g} times the noise instead of {start.factor:.2g})"
    )
