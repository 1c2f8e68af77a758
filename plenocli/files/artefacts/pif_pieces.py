"""How a system matrix reaches its file: held whole, written superpixel by superpixel, or
split into shards.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import ahead, budget, one_thread
from plenocli.base.errors import NumericsError
from plenocli.forward.propagation import diagnosis

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.diagnosis import Diagnosis
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.propagation.system_matrix import SystemMatrix

WHOLE_BYTES = 1 << 27
"""A matrix up to this size is held in memory while it is computed; larger ones go to
the disk in pieces.
"""
ROOM = 3
"""Times its size that whoever reads a matrix in one piece should have: itself, and what is made of
it.
"""


@dataclass(frozen=True)
class Layout:
    """How a matrix is written.

    streamed: in pieces.
    groups: the superpixels of each shard, or None for one file.
    """

    streamed: bool
    groups: tuple[tuple[int, ...], ...] | None = None


def cost(plan: PifPlan) -> tuple[bool, int]:
    """(whether it is written in pieces, bytes of memory) of a PifPlan's matrix
    within the budget of this process.
    """
    bands, superpixels = plan.shape[:2]
    slab = plan.bytes // (bands * superpixels)
    work = max(0, plan.memory - plan.bytes) * plan.at_once
    streamed = plan.bytes > min(WHOLE_BYTES, budget().memory // 4)
    diagnosed = diagnosis.memory(plan.shape)
    if streamed:  # piece by piece, while the fields are there
        return streamed, 7 * slab + work + diagnosed
    return streamed, plan.bytes + max(work, diagnosed)


def layout(plan: PifPlan, where: object) -> Layout:
    """How a matrix is written within the budget of this process.

    plan: of the matrix.
    where: the camera's file, for the message.

    Returns held whole up to WHOLE_BYTES and a quarter of the memory; one file where another stage
    can read it within the same budget; else shards of an eighth of it.
    Raises NumericsError where not even one superpixel's part fits.
    """
    bands, superpixels = plan.shape[:2]
    slab = plan.bytes // (bands * superpixels)
    streamed, needed = cost(plan)
    budget().require(needed, "the matrix", where, "take fewer superpixels, points or wavelengths")
    if ROOM * plan.bytes <= budget().memory or superpixels == 1:
        return Layout(streamed)
    size = max(1, budget().memory // 8 // (bands * slab))
    return Layout(
        True,
        tuple(
            tuple(range(start, min(start + size, superpixels)))
            for start in range(0, superpixels, size)
        ),
    )


def refusal(plan: PifPlan, where: object) -> str | None:
    """What `layout` would say of a plan that does not fit, None for one that does."""
    try:
        layout(plan, where)
    except NumericsError as error:
        return str(error)
    return None


def stream_pif(
    camera: Camera,
    plan: PifPlan,
    output: str | os.PathLike,
    chosen: Layout,
    finish: Callable[[SystemMatrix, Diagnosis], Artefact],
    *,
    overwrite: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[SystemMatrix, Diagnosis]:
    """Compute a matrix piece by piece into files.

    camera, plan: as in build_pif.
    output: the file, or the index of shards.
    chosen: how it is written.
    finish: (matrix without A, its diagnosis) -> the Artefact of all but A.
    overwrite: whether the files may exist.
    progress: called with columns done and columns in all.

    Returns (matrix without A, its diagnosis).
    Raises as build_pif and write_artefact.
    """
    from plenocli.files.artefacts.shards import writing_pif
    from plenocli.forward.propagation.diagnosis import PiecewiseDiagnosis
    from plenocli.forward.propagation.system_matrix import described, pif_pieces

    diagnosis, tails, last = None, {}, None
    # what a piece is diagnosed with can be told to stay on one thread only once it is loaded
    importlib.import_module("scipy.linalg")
    with (
        one_thread(),
        writing_pif(
            output, plan.shape, np.dtype(plan.dtype), groups=chosen.groups, overwrite=overwrite
        ) as writer,
    ):
        pieces = ahead(pif_pieces(camera, plan, progress=progress))
        for builder, band, superpixel, slab in pieces:
            diagnosis = diagnosis or PiecewiseDiagnosis(
                len(plan.bands),
                builder.offsets,
                builder.pixel_shape,
                builder.object_shape,
                builder.symmetry,
            )
            diagnosis.add(band, superpixel, slab)
            writer.put(band, superpixel, slab)
            tails[band], last = builder.notes.field_tail, builder
        assert diagnosis is not None and last is not None  # there is a piece in any plan
        pif = described(plan, last, list(tails.values()), writer.energy)
        found = diagnosis.result(pif.column_energy)
        writer.close(finish(pif, found))
    return pif, found
