"""What is likely to be wrong with a camera's description: a glance, where a fit is a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.text import by
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.fit.ascent import Ascent, Point
from plenocli.inverse.fit.problem import CapturedLenslets, FitProblem, fit_problem

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
ALL = 1.1
"""Times the noise, all of what is left over but chance."""
SHOWN = 0.5
"""Of what is left over beyond the noise, that finer points may leave at most to be the cause."""
DIM = 0.1
"""Of the noise, below which neighbours' light explains nothing."""
FEW, SOME, ROUGH, GLANCE = 8, 0.6, 0.05, 3.0
"""Points a side, and for each diffraction cell of a field, of neighbours' even light, its accuracy,
and seconds (at nominal rates) that it may take.
"""
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
    its parameters alone, detail of the objects that is finer than its points, or light of the
    neighbouring lenslets.

    By the slopes of the evidence and its curvature at the description, and one step along the
    parameters that promise most; some are tried either way. A hint and no measurement: paraxial,
    of the LENSLETS x LENSLETS lenslets in the middle.

    camera, capture, pictures, seed: as in fit_camera.

    Returns None where nothing helps.
    Raises as fit_camera does.
    """
    cells = _cells(camera)
    if cells > FINEST and min(camera.object.samples_per_lenslet) < cells / 2:
        return coarse_points(camera)  # no camera with such points explains anything
    ascent, start = _start(fit_problem(camera, [capture], pictures, lenslets=LENSLETS, seed=seed))
    left, other = beyond_parameters(
        camera, [capture], pictures, described=start.factor, seed=seed
    ) or (math.inf, None)
    if left <= ALL:  # and no parameter can say more
        return other
    place, at = _best_step(ascent, start)
    if left <= at.factor:
        return other
    if at.factor > HELPS * start.factor:
        return None
    return f"{_said(ascent, start, at, place)}; --fit finds the camera that fits"


def beyond_parameters(
    camera: Camera,
    captures: Sequence[CapturedLenslets],
    pictures: Sequence[np.ndarray],
    *,
    described: float,
    seed: int = 0,
) -> tuple[float, str] | None:
    """What explains most of captures that is no parameter of a camera: detail of the objects that
    is finer than its points, or light of the neighbouring lenslets.

    camera, captures, pictures, seed: as in fit_camera.
    described: times the noise, what the described camera leaves over.

    Returns (times the noise that it leaves over, it and what to do, a sentence); None where neither
        explains enough. Raises as fit_camera does.
    """

    def left_over(camera: Camera, captures: Sequence[CapturedLenslets]) -> float:
        problem = fit_problem(camera, captures, pictures, lenslets=LENSLETS, seed=seed)
        return _start(problem)[1].factor

    found, finer = [], _finely(camera)
    if finer is not None:
        told = (
            f"objects have detail finer than {by(camera.object.samples_per_lenslet)} points a "
            "lenslet: by finer ones what is left over is {0:.2g} times the noise instead of {1:.2g}"
            f" ({_advised(finer.object.samples_per_lenslet)})"
        )
        found.append((left_over(finer, captures), told))
    alone = [without_neighbours(camera, capture) for capture in captures]
    if None not in alone:
        told = (
            "light of the neighbouring lenslets explains most (without it what is left over is "
            "{0:.2g} times the noise instead of {1:.2g}): it takes a pif of --superpixels 3x3"
        )
        found.append((left_over(camera, [one for one in alone if one is not None]), told))
    least, told = min(found, default=(math.inf, ""))
    return None if least > _most(described) else (least, told.format(least, described))


def _most(described: float) -> float:
    """Times the noise that a cause may leave over where the described camera leaves so much."""
    return min(HELPS * described, 1 + SHOWN * (described - 1))


def _start(problem: FitProblem) -> tuple[Ascent, Point]:
    """Where a fit begins: at the described camera."""
    ascent = Ascent(problem.family, problem.evidence, tolerance=problem.tolerance)
    return ascent, ascent.point(np.zeros(len(problem.family.parameters)))


def _cells(camera: Camera) -> float:
    """Diffraction cells of a lenslet's field, a side."""
    return geometry(camera, camera.light.wavelengths[0]).diffraction_cells


def without_neighbours(camera: Camera, capture: CapturedLenslets) -> CapturedLenslets | None:
    """A capture of a camera, in which lenslets see their neighbours' light, without it as far as
    even objects behind each lenslet throw it; beyond the array the border goes on.

    Returns None where that light is far below the noise, or takes long to know.
    """
    points = min(max(FEW, math.ceil(SOME * _cells(camera))), FINEST)
    few = camera.replace(**{"object.samples_per_lenslet": (points, points)})
    try:
        plan = plan_pif(few, superpixels=(3, 3), accuracy=ROUGH)
    except NumericsError:
        return None
    if plan.chosen.seconds() > GLANCE:
        return None
    built = build_pif(few, plan)
    if built.A is None:
        return None
    even = built.A[0].mean(axis=2, keepdims=True, dtype=float)
    level = np.nan_to_num(capture.y.sum(axis=2, keepdims=True)) / even.sum()
    around = np.pad(level, ((1, 1), (1, 1), (0, 0)), mode="edge")
    array = BlockToeplitz(even, built.lenslet_offset, around.shape[:2])
    light = array.neighbours_only().forward(around)[1:-1, 1:-1]
    if np.sqrt(np.mean(light**2)) < DIM * capture.sigma:
        return None
    return replace(capture, y=capture.y - light)


def coarse_points(camera: Camera) -> str | None:
    """That points are fewer than a field's diffraction cells, and what to do, a sentence; None
    where they are not. Nothing is measured.
    """
    cells = _cells(camera)
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
    rows, columns = camera.object.samples_per_lenslet
    least = math.ceil(FINE * _cells(camera))
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
