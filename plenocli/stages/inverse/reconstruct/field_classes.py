"""reconstruct over a whole array: classes of lenslets, squares of neighbours, each inverted with
the matrix of its middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.progress import collected_notes, note
from plenocli.execution.pool import Pool
from plenocli.files.read.captures import describe_capture
from plenocli.inverse.picture.diagnosis import Seen
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.footprint import require_reconstruction
from plenocli.inverse.picture.lenslet_model import Whole
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.tiles import EVERY, Source, Tile, side_of, survey
from plenocli.stages.inverse.reconstruct.in_tiles import (
    error_that_counts,
    matrix_that_serves,
    true_objects,
)
from plenocli.stages.inverse.reconstruct.recipe import Recipe, estimators_of, field_of, source_of
from plenocli.stages.inverse.reconstruct.solved import Solved
from plenocli.stages.inverse.reconstruct.tiles import (
    SolvedTile,
    bench_of,
    keep,
    put_together,
    solve_all,
)

if TYPE_CHECKING:
    from plenocli.files.read.system_matrices import FieldMatrix
    from plenocli.forward.accuracy.field_nodes import Place

LEAST = 3
"""Lenslets along a class's side, at least."""
MARGIN = 6
"""Lenslets around a class that are looked at with it."""


def picture_by_class(
    recipe: Recipe, capture: Path, source: Source, pool: Pool, target: Path | None
) -> Solved:
    """The picture of a capture by the matrices of a whole array, each class of lenslets by that of
    its middle; the one in the middle of the array chooses the method.

    target: as of bench_of.

    Raises UsageError where a camera is to be fitted.
    """
    settings, field, on_axis = recipe.settings, field_of(recipe), estimators_of(recipe)
    assert field is not None
    if settings.fit:
        raise UsageError(
            "a camera is fitted by the matrix of one lenslet, not by those of a whole array",
            "--fit",
            "leave it out, or fit the camera first with fit-camera",
        )
    count, most, system = source.count, side_of(on_axis.system), on_axis.system
    is_small = count[0] * count[1] <= most**2
    sample = source.cut(*(EVERY if is_small else survey(system, source, most)[1].own))
    _, limits = matrix_that_serves(recipe, "told", sample)
    tolerance = max(0.0 if limits is None else limits.noise, field.nodes.error)
    classes, change = _fewest(field, count, tolerance, most)
    off, method = error_that_counts(limits), METHODS[settings.method]
    note(f"{len(classes)} classes of lenslets, each by the matrix of its middle")
    require_reconstruction(
        on_axis,
        max(math.prod(part.stop - part.start for part in each.around) for each in classes),
        sample.sigma,
        capture,
        method.all_phases,
        joint=method.makes_joint_estimate(on_axis),
    )
    task = _ClassTask(
        recipe=recipe,
        capture=capture,
        target=target,
        count=count,
        method=settings.method,
        model_error=math.hypot(off, change) if change > tolerance else off,
    )
    places = [math.hypot(*place_of(each, count, 1.0)) for each in classes]
    middle = int(np.argmin(places))
    found, seen = task.estimated(source, classes[middle])
    task, about = replace(task, method=found.method), describe_capture(capture)
    bench = bench_of(target, recipe, about, classes)
    keep(bench, middle, SolvedTile.of(found, classes[middle]), clip=settings.clip)
    solve_all(pool, task, classes, bench, clip=settings.clip)
    declared = sample.saturated is not None
    return put_together(
        found, bench, classes, system, declared=declared, capture=about, seen=seen, limits=limits
    )


@dataclass(frozen=True, kw_only=True)
class _ClassTask:
    """The task of a class, in any process.

    count: lenslets (rows, columns) of the array.
    method: by which.
    target, model_error: as of tiles.
    """

    recipe: Recipe
    capture: Path
    target: Path | None
    count: tuple[int, int]
    method: str
    model_error: float

    def __call__(self, job: tuple[int, Tile]) -> SolvedTile:
        """A class; what there is to say was said of that in the middle."""
        recipe, method = self.recipe, METHODS[self.method]
        with collected_notes():
            source = source_of(recipe, self.capture, method.each_pixel, self.target, verify=False)
            return SolvedTile.of(self.estimated(source, job[1])[0], job[1])

    def estimated(self, source: Source, each: Tile) -> tuple[Reconstruction, Seen | None]:
        """The picture of a class and its margin, and what is seen of it."""
        field = field_of(self.recipe)
        assert field is not None
        own = estimators_of(self.recipe).with_matrix(
            field.at(place_of(each, self.count, field.pitch))
        )
        data = replace(source.cut(*each.around, each.within), whole=Whole({}))
        truth, off = true_objects(self.recipe, source, each.around), self.model_error
        return estimate(own, METHODS[self.method], data, truth, model_error=off, guard=False)


def place_of(each: Tile, count: tuple[int, int], pitch: float) -> Place:
    """Of a class's middle, m from the middle of the array of `count` lenslets (rows, columns)."""
    row, column = ((part.start + part.stop - n) / 2 * pitch for part, n in zip(each.own, count))
    return row, column


def _fewest(
    field: FieldMatrix, count: tuple[int, int], tolerance: float, largest: int
) -> tuple[list[Tile], float]:
    """The fewest classes, of `largest` lenslets on a side at most, that hold no more than the
    tolerance at the array's corner, where matrices change most, and what they hold.
    """
    least = -(-max(count) // largest)
    most, change = max(least, max(count) // LEAST), 0.0
    for side in range(least, most + 1):
        classes = _classes(count, side)
        middle = place_of(classes[0], count, field.pitch)
        edge = tuple(-(n - 1) / 2 * field.pitch for n in count)
        here, there = field.at(middle).own, field.at((edge[0], edge[1])).own
        change = float(np.linalg.norm(there - here) / np.linalg.norm(here))
        if change <= tolerance:
            return classes, change
    note(
        f"even classes of {LEAST}x{LEAST} lenslets hold changes of {change:.1g} of a matrix, more "
        f"than {tolerance:.1g}"
    )
    return classes, change


def _classes(count: tuple[int, int], side: int) -> list[Tile]:
    """`side` classes along the longer side of the array, row by row."""
    size = -(-max(count) // side)
    ends = [np.rint(np.linspace(0, n, -(-n // size) + 1)).astype(int).tolist() for n in count]
    lines = [
        [
            (slice(low, high), slice(max(0, low - MARGIN), min(n, high + MARGIN)))
            for low, high in zip(edges, edges[1:])
        ]
        for edges, n in zip(ends, count)
    ]
    return [
        Tile((rows, columns), (near, beside))
        for rows, near in lines[0]
        for columns, beside in lines[1]
    ]
