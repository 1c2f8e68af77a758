"""What lenslets record of a volume, plane by plane: no more kernels than one plane's at a time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.linear_maps import BlockCirculant, torus_for
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.phantoms import Sampler
from plenocli.forward.volume.plan import BOX, VolumePlan, plan_volume
from plenocli.forward.volume.stack import plane_kernels


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Light on every superpixel, and the volume that gave it.

    light: (row, column, pixel) of cells, of superpixels on a square lattice: sum of a voxel's value
        and the share of its light.
    volume: (plane, row, column) mean values of the voxels that are inverted.
    """

    light: np.ndarray
    volume: np.ndarray


def finer(
    optics: VolumeOptics, samples: tuple[int, int], refine: int, accuracy: float, model: str
) -> tuple[VolumeOptics, VolumePlan]:
    """Optics and plan of a volume with `refine` planes and voxels a side for each.

    optics: with the planes that are inverted.
    samples: voxels (rows, columns) of a lenslet that are inverted.
    """
    depths = fine_depths(optics.depths, refine)
    fine = replace(optics, depths=depths, places=depths, scales=(1.0,) * len(depths))
    many = (samples[0] * refine, samples[1] * refine)
    # a voxel is a box: points of the finer ones stand for it
    box = max(1, round(BOX / refine))
    return fine, plan_volume(fine, many, accuracy=accuracy, model=model, box=box)


def fine_depths(depths: tuple[float, ...], refine: int) -> tuple[float, ...]:
    """Planes that divide the layer about each of `depths` (m, rising) into `refine`."""
    if refine == 1 or len(depths) == 1:
        return depths
    layers = np.gradient(np.array(depths))
    inside = (np.arange(refine) + 0.5) / refine - 0.5
    return tuple((np.array(depths)[:, None] + layers[:, None] * inside).ravel().tolist())


def record(
    optics: VolumeOptics,
    plan: VolumePlan,
    count: tuple[int, int],
    specimen: Sampler,
    refine: int,
    progress: Callable[[int], None] | None = None,
) -> Recording:
    """Light of a specimen on `count` cells of the array about the axis, lenslets of a square one.

    optics, plan: from `finer`.
    specimen: light at places from the axis, m.
    progress: called with 1 for every plane that is done.

    Raises NumericsError where memory does not suffice.
    """
    require_room(optics, plan, count)
    along = zip(count, plan.samples, optics.object_cell)
    places = tuple(places_along(n, s, size) for n, s, size in along)
    light = np.zeros((*count, math.prod(optics.cell_pixels)))
    planes, layers = len(plan.reach), 1 if len(plan.reach) == 1 else refine
    shape = tuple(n * s // refine for n, s in zip(count, plan.samples))
    volume = np.zeros((planes // layers, *shape))
    for number, depth in enumerate(optics.depths):
        seen = specimen(depth, *places)
        coarse = seen.reshape(shape[0], refine, shape[1], refine).mean((1, 3))
        volume[number // layers] += coarse / layers
        if seen.any():
            light += plane_light(optics, plan, number, count, seen) / (refine**2 * layers)
        if progress:
            progress(1)
    return Recording(light=light, volume=volume)


def require_room(optics: VolumeOptics, plan: VolumePlan, count: tuple[int, int]) -> None:
    """NumericsError where memory does not suffice to record before `count` cells."""
    pixels = math.prod(optics.cell_pixels)
    many = plan.samples[0] * plan.samples[1]
    widest = torus_for(count, (max(plan.reach),) * 2)
    per_plane = 4 * pixels * many * (2 * max(plan.reach) + 1) ** 2
    budget().require(
        4 * per_plane + sum(BlockCirculant.needed(pixels, many, widest)),
        "recording this volume",
        "lenslet_array.count",
        "take fewer lenslets or voxels",
    )


def places_along(count: int, samples: int, pitch: float) -> np.ndarray:
    """Places (m) of all voxels along an axis.

    count: of cells; samples: voxels of each; pitch: of the cells' images, m.
    """
    return ((np.arange(count * samples) + 0.5) / samples - count / 2) * pitch


def plane_light(
    optics: VolumeOptics, plan: VolumePlan, number: int, count: tuple[int, int], seen: np.ndarray
) -> np.ndarray:
    """Light of one plane on every cell, (row, column, pixel).

    number: of the plane; seen: (row, column) light of its voxels.
    """
    kernels, offsets = plane_kernels(optics, plan, number)
    rows, columns = np.abs(offsets).max(axis=0).tolist()
    torus = torus_for(count, (rows, columns))
    x = np.zeros((*torus, kernels.shape[2]), np.float32)
    s, t = plan.samples
    x[: count[0], : count[1]] = (
        seen.reshape(count[0], s, count[1], t).transpose(0, 2, 1, 3).reshape(*count, -1)
    )
    return BlockCirculant([(kernels, offsets)], count, torus).forward(x)
