"""What is likely to be wrong with a camera's description: a glance, where a fit is a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.text import by
from plenocli.forward.camera.geometry import geometry
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
SHOWN = 0.5
"""Of what is left over beyond the noise, that finer points may leave at most to be the cause."""
FINE, FINEST = 1.3, 40
"""Points a side for each diffraction cell of a field, from which on finer ones show nothing more
(docs/model.md); and as many as are tried, at most.
"""


def likeliest_cause(
    camera: Camera,
    capture: CapturedLenslets,
    pictures: Sequence[np.ndarray],
    *,
    seed: int = 0,
) -> str | None:
    """What explains most of what the described camera does not, and what to do, a sentence: one of
    its parameters alone, or detail of the objects that is finer than its points.

    By the slopes of the evidence and its curvature at the description, and one step along the
    parameters that promise most; some are tried either way. A hint and no measurement: paraxial,
    of the LENSLETS x LENSLETS lenslets in the middle.

    camera, capture, pictures, seed: as in fit_camera.

    Returns None where nothing helps.
    Raises as fit_camera does.
    """
    cells = geometry(camera, camera.light.wavelengths[0]).diffraction_cells
    if cells > FINEST and min(camera.object.samples_per_lenslet) < cells / 2:
        return coarse_points(camera)  # no camera with such points explains anything
    problem = fit_problem(camera, [capture], pictures, lenslets=LENSLETS, seed=seed)
    family = problem.family
    ascent = Ascent(family, problem.evidence, tolerance=problem.tolerance)
    start = ascent.point(np.zeros(len(family.parameters)))
    place, at = _best_step(ascent, start)
    detail = detail_beyond_points(
        camera, [capture], pictures, left=at.factor, described=start.factor, seed=seed
    )
    if detail is not None or at.factor > HELPS * start.factor:
        return detail
    return f"{_said(ascent, start, at, place)}; --fit finds the camera that fits"


def detail_beyond_points(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    left: float,
    described: float,
    seed: int = 0,
) -> str | None:
    """Whether objects have detail finer than the points of a camera, and what to do, a sentence;
    None where finer points do not explain more than what else was found.

    camera, captures, pictures, seed: as in fit_camera.
    left, described: times the noise, what the best camera with these points leaves over, and what
        the described one does.

    Raises as fit_camera does.
    """
    finer = _finely(camera)
    if finer is None:
        return None
    problem = fit_problem(finer, captures, pictures, lenslets=LENSLETS, seed=seed)
    ascent = Ascent(problem.family, problem.evidence, tolerance=problem.tolerance)
    found = ascent.point(np.zeros(len(problem.family.parameters))).factor
    most = min(left, HELPS * described, 1 + SHOWN * (described - 1))
    if found > most:
        return None
    return (
        f"objects have detail finer than {by(camera.object.samples_per_lenslet)} points a lenslet: "
        f"by finer ones what is left over is {found:.2g} times the noise instead of "
        f"{described:.2g} ({_advised(finer.object.samples_per_lenslet)})"
    )


def coarse_points(camera: Camera) -> str | None:
    """That points are fewer than a field's diffraction cells, and what to do, a sentence; None
    where they are not. Nothing is measured.
    """
    cells = geometry(camera, camera.light.wavelengths[0]).diffraction_cells
    known = camera.object.samples_per_lenslet
    if min(known) >= cells:
        return None
    return (
        f"the capture may show detail finer than {by(known)} points a lenslet, whose field holds "
        f"{cells:.0f} diffraction cells each way ({_advised(_fine_points(camera))})"
    )


def _advised(points: tuple[int, int]) -> str:
    rows, columns = points
    return f"a pif with object.samples_per_lenslet = [{rows}, {columns}]"


def _fine_points(camera: Camera) -> tuple[int, int]:
    """Points (rows, columns) so fine that finer ones show nothing more."""
    cells = geometry(camera, camera.light.wavelengths[0]).diffraction_cells
    rows, columns = camera.object.samples_per_lenslet
    least = math.ceil(FINE * cells)
    return max(rows, least), max(columns, least)


def _finely(camera: Camera) -> Camera | None:
    """The camera with such points, or as fine as are tried; None where it has them."""
    known = camera.object.samples_per_lenslet
    samples = tuple(max(n, min(m, FINEST)) for n, m in zip(known, _fine_points(camera)))
    return None if samples == known else camera.replace(**{"object.samples_per_lenslet": samples})


def _best_step(ascent: Ascent, start: Point) -> tuple[int, Point]:
    """(number of the parameter, the Point) of the step that leaves least; (-1, start) if none."""
    family = ascent.family
    slopes = ascent.slopes(start)
    rise, curvature = slopes.rise, np.diag(slopes.curvature(start, start.factor))
    step = np.clip(rise / curvature, -FAR, FAR)
    promise = rise * step - 0.5 * curvature * step**2
    tries = [(int(k), float(step[k])) for k in np.argsort(-promise)[:LOOKED_AT]]
    for name, length in EITHER_WAY:
        if family.has(name):
            tries += [(family.place(name), side * length) for side in (-1, 1)]
    best = (-1, start)
    for place, length in tries:
        x = np.zeros(len(family.parameters))
        x[place] = length
        found = ascent.point(x)
        if found.factor < best[1].factor:
            best = (place, found)
    return best


def _said(ascent: Ascent, start: Point, at: Point, place: int) -> str:
    """What a step along one parameter explains."""
    family = ascent.family
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
