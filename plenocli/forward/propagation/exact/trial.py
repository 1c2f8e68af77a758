"""Columns of a few points by the exact model, as plenocli.forward.propagation.fresnel.trial_columns
has them by the paraxial one: what little light points between lenslets have is another one where
lenses are fast, and so are its fringes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.propagation.exact.open_fields import OpenFields, offset_of, residual_of
from plenocli.forward.propagation.fresnel.trial_columns import (
    CHEAP,
    VALUES,
    Hashed,
    Trial,
    TrialColumns,
    near_window,
    trial_columns,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

KEPT = 256
"""Differences of models that are kept for the next plan of the same camera."""
CUTS = 1e-8, 1e-7
"""What is left out of fields: of the spread function, and of the kernel."""


class ExactTrial(Trial):
    """A Trial by the exact model."""

    @property
    def cost(self) -> float:
        """As of Trial: each term of the kernel is twice as much as the paraxial model."""
        own = offset_of(self.geometry, (0, 0), (0, 0))
        try:
            terms = len(residual_of(self.geometry, own, CUTS[1]).core)
        except NumericsError:
            return math.inf
        return 2 * super().cost * terms

    def fields(
        self, camera: Camera, points: list[tuple[int, int]]
    ) -> Iterator[tuple[int, np.ndarray]]:
        """As of Trial."""
        behind = OpenFields(camera, self.geometry, self.half, CUTS, self.window, np.dtype(complex))
        rows, columns = np.array(points).T
        for place in self.places:
            nodes = [self.nodes(axis, at) for axis, at in enumerate(place)]
            step = max(1, VALUES // math.prod(len(v) for v, _ in nodes))
            for start in range(0, len(points), step):
                some = slice(start, start + step)
                yield from enumerate(behind.on(place, nodes, rows[some], columns[some]), start)


class _Beside(ExactTrial):
    """The paraxial model on the nodes of an ExactTrial."""

    fields = Trial.fields


def paraxial_off(
    camera: Camera, geometry: Geometry, grid: tuple[int, int], window: int | None, symmetric: bool
) -> tuple[float, float] | None:
    """The least and the most that the relative L2 difference of the worst paraxial column on the
    axis from the exact one can be, as columns by both tell: the same where they are all that there
    are; None where they would take too long.

    Parameters as those of trial_columns.
    """
    on_axis = replace(geometry, chief=(0.0, 0.0))
    return _off(Hashed(camera), on_axis, grid, near_window(geometry, window), symmetric)


@lru_cache(maxsize=KEPT)
def _off(
    hashed: Hashed, geometry: Geometry, grid: tuple[int, int], window: int | None, symmetric: bool
) -> tuple[float, float] | None:
    asked = hashed.camera, geometry, grid, window, symmetric
    exact, paraxial = (trial_columns(*asked, kind) for kind in (ExactTrial, _Beside))
    if exact is None or paraxial is None:
        return None
    missed = np.linalg.norm(paraxial.pixels - exact.pixels, axis=1)
    worst = float((missed / np.linalg.norm(exact.pixels, axis=1)).max())
    return worst, exact.beyond * worst


def exact_trial_columns(
    camera: Camera,
    geometry: Geometry,
    grid: tuple[int, int],
    window: int | None,
    symmetric: bool,
) -> TrialColumns | None:
    """As trial_columns, by the exact model where it tries all columns in time; else what both the
    paraxial model of more of them, and of neighbours that join, and the exact one ask for.

    Neighbours join by the exact model where few pixels make that little work: fringes of far ones
    are elsewhere than paraxial waves have them, which many pixels even out.
    """
    on_axis = replace(geometry, chief=(0.0, 0.0))
    joined = window if _join_quickly(on_axis, grid, window, symmetric) else None
    exact = trial_columns(camera, on_axis, grid, joined, symmetric, ExactTrial)
    if window == joined and exact and exact.whole:
        return exact
    paraxial = trial_columns(camera, geometry, grid, window, symmetric)
    if paraxial is None or exact is None:
        return paraxial
    return replace(paraxial, others=(*paraxial.others, exact))


def _join_quickly(
    geometry: Geometry, grid: tuple[int, int], window: int | None, symmetric: bool
) -> bool:
    """Whether all columns are tried with their neighbours in little time."""
    trial = ExactTrial(geometry, grid, window, symmetric, 1, None)
    return trial.whole and trial.cost * len(trial.points) <= CHEAP
