"""What lenslets record of opaque layers: nearer ones hide parts of the pupil from those behind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.plan import VolumePlan
from plenocli.forward.volume.rays import RayPlane
from plenocli.forward.volume.recording import Recording, places_along, plane_light, require_room

RAYS = 3
"""Across a pixel, from each point that is hidden in part."""
SLAB = 1 << 21
"""Rays that are followed at a time."""


@dataclass(frozen=True)
class Layer:
    """A flat thing: (row, column) light of its voxels, and their opacity, 0 to 1."""

    light: np.ndarray
    opacity: np.ndarray


def record_layers(
    optics: VolumeOptics,
    plan: VolumePlan,
    count: tuple[int, int],
    layers: Sequence[Layer],
    refine: int,
    progress: Callable[[int], None] | None = None,
) -> Recording:
    """Light of opaque layers on the superpixels of `count` lenslets about the axis.

    optics, plan: one plane a layer, from the nearest on; voxels `refine` times finer a side than
        those of the volume that is returned.
    layers: on the lattice of the plan's voxels, which all planes share as seen from the pupil's
        middle; beyond it they go on as at its border.
    progress: called with 1 for every layer that is done.

    Returns the light, and what of each layer is seen: its light times its opacity times the share
    of the pupil from which nothing hides it.
    Raises NumericsError where memory does not suffice.

    Points that all of the pupil sees have the plan's kernels; those that some of it sees are
    followed by rays, diffraction left out. docs/model.md, "Volumes".
    """
    if len(layers) != len(plan.reach):
        raise NumericsError(f"{len(layers)} layers need as many planes, not {len(plan.reach)}")
    require_room(optics, plan, count)
    light, seen = np.zeros((*count, optics.pixels[0] * optics.pixels[1])), []
    for number, layer in enumerate(layers):
        glow = layer.light * layer.opacity
        clear, hidden = _sight(optics, plan, layers, number)
        visible = clear.astype(float)
        light += plane_light(optics, plan, number, count, glow * clear) / refine**2
        part = np.argwhere(~clear & ~hidden)
        if len(part):
            traced, share = _traced(optics, plan, count, layers, number, part)
            light += traced / refine**2
            visible[tuple(part.T)] = share
        rows, columns = (n // refine for n in glow.shape)
        seen.append((glow * visible).reshape(rows, refine, columns, refine).mean((1, 3)))
        if progress:
            progress(1)
    return Recording(light=light, volume=np.array(seen))


def _sight(
    optics: VolumeOptics, plan: VolumePlan, layers: Sequence[Layer], number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where all of the pupil sees a layer, and where none of it does, (row, column) both."""
    from scipy.ndimage import maximum_filter, minimum_filter

    clear = np.ones(layers[number].opacity.shape, bool)
    hidden = np.zeros_like(clear)
    for nearer in range(number):
        apart = abs(optics.depths[number] - optics.depths[nearer]) * optics.aperture
        # a nearer layer's share of a point's cone, and a voxel more
        size = [2 * int(apart / (optics.object_pitch / n) + 1) + 1 for n in plan.samples]
        opacity = layers[nearer].opacity
        clear &= maximum_filter(opacity, size, mode="nearest") == 0
        hidden |= minimum_filter(opacity, size, mode="nearest") == 1
    return clear, hidden


def _traced(
    optics: VolumeOptics,
    plan: VolumePlan,
    count: tuple[int, int],
    layers: Sequence[Layer],
    number: int,
    points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Light on every superpixel of a layer's `points` (point, 2), and the share of the pupil that
    sees each.
    """
    from scipy.ndimage import map_coordinates

    plane, *before = (RayPlane(optics, optics.depths[n], 0, RAYS) for n in (number, *range(number)))
    layer = layers[number]
    shape = count[0] * optics.pixels[0], count[1] * optics.pixels[1]
    light, share = np.zeros(shape[0] * shape[1]), np.empty(len(points))
    axes = [places_along(n, s, optics.object_pitch) for n, s in zip(count, plan.samples)]
    # the places of lenslets' middles are whole pitches from that of the first one
    first = [(n - 1) / 2 * optics.object_pitch for n in count]
    steps = [optics.object_pitch / n for n in plan.samples]
    several = max(1, SLAB // len(plane.weight))
    for low in range(0, len(points), several):
        some = points[low : low + several]
        through = np.broadcast_to(plane.weight, (len(some), len(plane.weight))).copy()
        places = [axis[some[:, n]][:, None] for n, axis in enumerate(axes)]
        for nearer, other in zip(layers, before):
            crossed = [
                (places[n] + plane.away[n] - other.away[n] - axes[n][0]) / steps[n] for n in (0, 1)
            ]
            through *= 1 - map_coordinates(nearer.opacity, crossed, order=1, mode="nearest")
        share[low : low + several] = through.sum(axis=1)
        landed = [plane.landed(places[n] + first[n], n) for n in (0, 1)]
        kept = landed[0].kept & landed[1].kept
        for n in (0, 1):
            kept &= (landed[n].pixel >= 0) & (landed[n].pixel < shape[n])
        glow = (layer.light * layer.opacity)[tuple(some.T)]
        flat = landed[0].pixel * shape[1] + landed[1].pixel
        light += np.bincount(flat[kept], (through * glow[:, None])[kept], len(light))
    blocks = light.reshape(count[0], optics.pixels[0], count[1], optics.pixels[1])
    return blocks.transpose(0, 2, 1, 3).reshape(*count, -1), share
