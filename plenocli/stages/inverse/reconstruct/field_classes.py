"""reconstruct over a whole array: classes of lenslets, squares of neighbours, each inverted with
the matrix of its middle.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.progress import bar, note
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.methods.registry import METHODS

if TYPE_CHECKING:
    from plenocli.files.read.system_matrices import FieldMatrix
    from plenocli.forward.accuracy.field_nodes import Place
    from plenocli.inverse.picture.diagnosis import Seen
    from plenocli.inverse.picture.estimators import Estimators
    from plenocli.inverse.picture.lenslet_model import Superpixels
    from plenocli.inverse.picture.methods.method import Method
    from plenocli.inverse.picture.reconstruction import Reconstruction

LEAST = 3
"""Lenslets along a class's side, at least."""
MARGIN = 6
"""Lenslets around a class that are looked at with it."""


@dataclass(frozen=True)
class _Class:
    """A square of lenslets: `own` (rows, columns) of the array, `around` with its margin, and
    `within` those its own are found again.
    """

    own: tuple[slice, slice]
    around: tuple[slice, slice]
    within: tuple[slice, slice]

    def place(self, count: tuple[int, int], pitch: float) -> Place:
        """Of its middle, m from the middle of the array."""
        row, column = ((part.start + part.stop - n) / 2 * pitch for part, n in zip(self.own, count))
        return row, column


def estimate_by_class(
    field: FieldMatrix,
    estimators: Estimators,
    method: Method,
    data: Superpixels,
    truth: np.ndarray | None,
    *,
    tolerance: float,
    model_error: float,
) -> tuple[Reconstruction, Seen | None]:
    """As estimate, every class of lenslets by the matrix of its middle; the one in the middle of
    the array chooses the method.

    estimators: of the matrix on the axis.
    tolerance: relative change of a matrix that a class may hold.
    """
    count = data.y.shape[0], data.y.shape[1]
    side, change = _fewest(field, count, tolerance)
    off = math.hypot(model_error, change) if change > tolerance else model_error
    classes = list(_classes(count, side))
    note(f"{len(classes)} classes of lenslets, each by the matrix of its middle")
    classes.sort(key=lambda c: np.hypot(*c.place(count, 1.0)))
    whole: Reconstruction | None = None
    seen: Seen | None = None
    for each in bar(classes, len(classes), "classes of lenslets"):
        own = estimators.with_matrix(field.at(each.place(count, field.pitch)))
        part = None if truth is None else truth[each.around]
        found, sees = estimate(own, method, _cut(data, each), part, model_error=off, guard=False)
        if whole is None:
            method, seen = METHODS[found.method], sees
            shape = (*count, found.value.shape[2])
            sigma = None if found.sigma is None else np.empty(shape)
            whole = replace(found, value=np.empty(shape), sigma=sigma)
        whole.value[each.own] = found.value[each.within]
        if whole.sigma is not None and found.sigma is not None:
            whole.sigma[each.own] = found.sigma[each.within]
    assert whole is not None
    return whole, seen


def _fewest(field: FieldMatrix, count: tuple[int, int], tolerance: float) -> tuple[int, float]:
    """The fewest classes along an axis that hold no more than the tolerance at the array's corner,
    where matrices change most, and what they hold.
    """
    most, change = max(1, max(count) // LEAST), 0.0
    for side in range(1, most + 1):
        corner = next(_classes(count, side))
        middle = corner.place(count, field.pitch)
        edge = tuple(-(n - 1) / 2 * field.pitch for n in count)
        here, there = field.at(middle).own, field.at((edge[0], edge[1])).own
        change = float(np.linalg.norm(there - here) / np.linalg.norm(here))
        if change <= tolerance:
            return side, change
    note(
        f"even classes of {LEAST}x{LEAST} lenslets hold changes of {change:.1g} of a matrix, more "
        f"than {tolerance:.1g}"
    )
    return most, change


def _classes(count: tuple[int, int], side: int) -> Iterator[_Class]:
    """`side` classes along the longer side of the array, the corner's first."""
    size = -(-max(count) // side)
    ends = [np.rint(np.linspace(0, n, -(-n // size) + 1)).astype(int).tolist() for n in count]
    lines = [
        [_line(low, high, n) for low, high in zip(edges, edges[1:])]
        for edges, n in zip(ends, count)
    ]
    for rows in lines[0]:
        for columns in lines[1]:
            yield _Class(*zip(rows, columns))


def _line(low: int, high: int, count: int) -> tuple[slice, slice, slice]:
    """(own, around, within) along one axis."""
    start = max(0, low - MARGIN)
    around = slice(start, min(count, high + MARGIN))
    return slice(low, high), around, slice(low - start, high - start)


def _cut(data: Superpixels, each: _Class) -> Superpixels:
    saturated, variance = (
        None if values is None else values[each.around]
        for values in (data.saturated, data.variance)
    )
    return replace(data, y=data.y[each.around], saturated=saturated, variance=variance)
