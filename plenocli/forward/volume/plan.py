"""How finely the light of a volume is followed: the dial of its kernels.

Rungs are tried on points against settings much finer than theirs; the cheapest that meets the
accuracy is taken. Errors are shares of a column's light that is elsewhere, half the L1 distance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from plenocli.base.errors import NumericsError, UsageError
from plenocli.forward.accuracy.machine_rate import product_rate
from plenocli.forward.propagation.plan import NOMINAL_RATE
from plenocli.forward.volume.arriving import ArrivingField
from plenocli.forward.volume.lenslets import sampling, terms_for
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.rays import RayPlane
from plenocli.forward.volume.shaped import ShapedPlane
from plenocli.forward.volume.waves import WavePlane, WaveSettings, near

WAVES = ((1, 2), (2, 3), (3, 4), (4, 4), (6, 5), (9, 7))
"""Rungs of wave optics: neighbours on each side whose fields interfere, nodes across a pixel."""
FINEST = (12, 9)
"""What rungs are held against."""
SHAPED, SHAPED_FINEST = (2, 3, 4, 6), 9
"""Places across a pixel, of rungs behind lenslets that are no squares, and what these are held
against.
"""
RAYS = 8
"""Rays across a pixel."""
LEAST_LOST = 5e-3
"""Share of a point's light beyond the superpixels kept, at the least: it falls off with the reach
alone, as round an Airy disc.
"""
MOST_REACH = 80
"""Superpixels on each side of a point's own."""
TRIED_BLUR = 4.0
"""Lenslets on each side that the deepest point that is tried lights."""
DEEPER = 1.6
"""Error of deeper points over that of the deepest that is tried (measured to 17 lenslets)."""
COARSE, SPANNED = 1.1, 2.0
"""Voxels over what a lens resolves, up to which they are as fine; voxels that the light of a plane
from all of the pupil meets, from which on coarser ones do.
"""
BOX = 2
"""Points along each side of a voxel that stand for it, its light being their mean."""
OVERHEAD = 1.9
"""Time over that of the products."""
SHAPED_PRODUCTS = 150.0
"""Of a place of ShapedPlane's torus, for each doubling of their number."""


@dataclass(frozen=True, kw_only=True)
class VolumePlan:
    """How the kernels of a volume are computed.

    model: "ray" or "fresnel".
    neighbours, pixel_nodes, terms: as WaveSettings; nodes are rays across a pixel for rays, places
        where neighbours are all (0).
    reach: (plane,) superpixels on each side of a point's own.
    lost: (plane,) share of light beyond them, as expected.
    error: share of a column's light that is elsewhere among the superpixels kept, as tried.
    asked: the same, asked for.
    samples: voxels (rows, columns) of a cell, of a lenslet where that is one; box: points (rows,
        columns) that stand for one.
    seconds, nominal_seconds: of one core of this machine, and of one at the nominal rate.
    bytes: of the kernels.
    considered: (rung, error) of all that were tried.
    """

    model: str
    neighbours: int
    pixel_nodes: int
    terms: int
    reach: tuple[int, ...]
    lost: tuple[float, ...]
    error: float
    asked: float
    samples: tuple[int, int]
    box: int
    seconds: float
    nominal_seconds: float
    bytes: int
    considered: tuple[tuple[str, float], ...]

    @property
    def rung(self) -> str:
        """Name of what was chosen."""
        if self.model == "ray":
            return "rays"
        if self.neighbours == 0:
            return f"waves, {self.pixel_nodes} places across a pixel"
        return f"waves, {self.neighbours} neighbours on each side"

    def settings(self, plane: int) -> WaveSettings:
        """Of the plane with this number."""
        return WaveSettings(
            neighbours=self.neighbours,
            pixel_nodes=self.pixel_nodes,
            terms=self.terms,
            reach=self.reach[plane],
        )

    def plane(self, optics: VolumeOptics, number: int) -> WavePlane | ShapedPlane | RayPlane:
        """Columns of the plane with this number."""
        depth, reach = optics.depths[number], self.reach[number]
        if self.model == "ray":
            return RayPlane(optics, depth, reach, self.pixel_nodes)
        if not optics.separable:
            return ShapedPlane(optics, depth, reach, self.pixel_nodes)
        return WavePlane(optics, depth, self.settings(number))


def plan_volume(
    optics: VolumeOptics,
    samples: tuple[int, int],
    *,
    accuracy: float = 5e-3,
    model: str = "auto",
    box: int = BOX,
) -> VolumePlan:
    """The cheapest plan that meets an accuracy.

    samples: voxels (rows, columns) of a lenslet.
    accuracy: share of a column's light that may be elsewhere.
    model: "auto", "ray" or "fresnel".
    box: points along each side of a voxel that stand for it.

    Raises NumericsError where no rung meets it, or light is spread too far; UsageError for rays
    behind lenslets that are no squares.
    """
    if model == "ray" and not optics.separable:
        raise UsageError(
            f"rays are followed behind square lenslets on a square lattice, not {optics.opening}s "
            f"on a {optics.lattice} one",
            "--model",
            "take fresnel or auto",
        )
    spread = [_reach(optics, depth, max(accuracy, LEAST_LOST)) for depth in optics.depths]
    reach = tuple(r for r, _ in spread)
    if max(reach) > MOST_REACH:
        raise NumericsError(
            f"the light of a point in the deepest plane is spread over {max(reach)} superpixels "
            f"on each side, more than {MOST_REACH}",
            "object.planes",
            "keep to planes nearer the focus, or ask for less accuracy",
        )
    # the shortest waves need the most
    terms = max(terms_for(line, min(1e-3, accuracy / 10)) for line in optics.lines)
    considered: list[tuple[str, float]] = []
    found = None
    for name, candidate in _rungs(optics, model):
        error = max(_error(optics, candidate, depth) for depth in _tried(optics))
        considered.append((name, error))
        if error <= accuracy or (model == "ray"):
            found = candidate, error
            break
    if found is None:
        raise NumericsError(
            f"no wave model meets {accuracy:g}: the finest is within {considered[-1][1]:.1g}",
            "--accuracy",
            f"ask for {considered[-1][1] * 1.1:.1g}",
        )
    (nodes, neighbours), error = found
    plan = VolumePlan(
        model="ray" if neighbours == 0 and optics.separable else "fresnel",
        neighbours=neighbours,
        pixel_nodes=nodes,
        terms=terms,
        reach=reach,
        lost=tuple(lost for _, lost in spread),
        error=error,
        asked=accuracy,
        samples=(len(optics.sites) * samples[0], samples[1]),
        box=box,
        seconds=0.0,
        nominal_seconds=0.0,
        bytes=4
        * math.prod((*optics.cell_pixels, len(optics.sites), *samples))
        * sum(int(near(r, optics).sum()) for r in reach),
        considered=tuple(considered),
    )
    return replace(
        plan,
        seconds=_seconds(optics, plan, product_rate(False)),
        nominal_seconds=_seconds(optics, plan, NOMINAL_RATE[False]),
    )


def _rungs(optics: VolumeOptics, model: str) -> list[tuple[str, tuple[int, int]]]:
    """Names, and (nodes across a pixel, neighbours; 0: rays), cheapest first."""
    if not optics.separable:
        return [(f"waves, {n} places a pixel", (n, 0)) for n in SHAPED]
    rays = [("rays", (RAYS, 0))]
    waves = [(f"waves, {j} neighbours", (nodes, j)) for j, nodes in WAVES]
    return {"auto": rays + waves, "ray": rays, "fresnel": waves}[model]


def _tried(optics: VolumeOptics) -> list[float]:
    """Depths at which rungs are tried: nearest to the focus, and with some blur, where errors are
    nearly as large as deeper and a point costs less.
    """
    nearest, deepest = min(optics.depths, key=abs), max(optics.depths, key=abs)
    blur = _blur(optics, deepest) / optics.object_pitch
    return sorted({nearest, deepest * min(1.0, TRIED_BLUR / blur) if blur > 0 else deepest})


def _blur(optics: VolumeOptics, depth: float) -> float:
    """Radius (m, on the object's side) of the geometric blur of a point at `depth`."""
    s = np.linspace(0, optics.aperture, 400)
    return float(np.abs(np.gradient(optics.path(s, depth), s)).max())


def _error(optics: VolumeOptics, candidate: tuple[int, int], depth: float) -> float:
    """Of a rung for one point, against the finest."""
    deepest = max(_blur(optics, z) for z in optics.depths)
    deeper = DEEPER if deepest > 1.01 * TRIED_BLUR * optics.object_pitch else 1.0
    reach = math.ceil(_blur(optics, depth) / optics.object_pitch) + 2
    tried = _column(optics, candidate, depth, reach)
    finest = (FINEST[1], FINEST[0]) if optics.separable else (SHAPED_FINEST, 0)
    truth = _column(optics, finest, depth, reach)
    return deeper * float(0.5 * np.abs(tried - truth).sum(dtype=float))


@lru_cache(maxsize=4)
def _column(optics: VolumeOptics, rung: tuple[int, int], depth: float, reach: int) -> np.ndarray:
    """Light of a point off a lenslet's middle by a rung."""
    nodes, neighbours = rung
    place = 0.31 * optics.object_pitch, 0.17 * optics.object_pitch
    if not optics.separable:
        return ShapedPlane(optics, depth, reach, nodes).column(*place)[0]
    if neighbours == 0:
        return RayPlane(optics, depth, reach, nodes).column(*place)[0]
    settings = WaveSettings(
        neighbours=neighbours, pixel_nodes=nodes, terms=terms_for(optics, 1e-5), reach=reach
    )
    return WavePlane(optics, depth, settings).column(*place)[0]


def between_planes(optics: VolumeOptics, plan: VolumePlan) -> float:
    """Share of a point's light that is elsewhere, halfway between the planes nearest to the focus,
    than what is between those planes' light: there it changes most. 0 of one plane.
    """
    depths = np.sort(optics.depths)
    if len(depths) == 1:
        return 0.0
    k = int(np.argmin(np.abs(depths[1:] + depths[:-1])))
    low, high = depths[k : k + 2].tolist()
    reach = math.ceil(max(_blur(optics, z) for z in (low, high)) / optics.object_pitch) + 2
    rung = plan.pixel_nodes, plan.neighbours
    first, middle, last = (_column(optics, rung, z, reach) for z in (low, (low + high) / 2, high))
    return float(0.5 * np.abs(middle - (first + last) / 2).sum(dtype=float))


def coarse_planes(optics: VolumeOptics, samples: Sequence[int]) -> list[int]:
    """Numbers of the planes whose light, from all of the pupil, meets less than SPANNED voxels of
    `samples` (rows, columns) a lenslet that are coarser than what the lens resolves: what is there
    is taken for something in front of it or behind (docs/results.md, "Volumes").
    """
    voxel = optics.object_pitch / min(samples)
    if voxel <= COARSE * optics.resolved:
        return []
    return [n for n, z in enumerate(optics.depths) if 2 * _blur(optics, z) < SPANNED * voxel]


def _reach(optics: VolumeOptics, depth: float, lost: float) -> tuple[int, float]:
    """Superpixels on each side that hold all light of a point but the share `lost`, and the share
    that is lost then.
    """
    pitch = optics.object_pitch
    near = math.ceil(_blur(optics, depth) / pitch)
    if near > MOST_REACH:
        return near, 1.0
    reach = _blur(optics, depth) / pitch + 2
    while True:
        field = ArrivingField(optics, depth, (reach + 1) * pitch, error=1e-4)
        for tried in range(near, math.floor(reach) + 1):
            kept = field.kept(max(tried, 0.5) * pitch)
            if 1 - kept <= lost:
                return tried, 1 - kept
        if reach > MOST_REACH:
            return math.ceil(reach), 1 - kept
        reach *= 1.5


def unique_places(
    optics: VolumeOptics, samples: tuple[int, int], box: int
) -> list[tuple[int, int]]:
    """Points (row, column) of a cell, of samples x box along each axis, from which symmetry
    gives all others.
    """
    rows, columns = (n * box for n in samples)
    if not optics.round:
        return [(i, j) for i in range(rows) for j in range(columns)]
    if optics.lattice == "hexagonal":
        # half a turn
        return [(i, j) for i in range(rows // 2) for j in range(columns)]
    turn = rows == columns and optics.turnable
    return [
        (i, j)
        for i in range((rows + 1) // 2)
        for j in range((columns + 1) // 2)
        if not turn or j <= i
    ]


def _seconds(optics: VolumeOptics, plan: VolumePlan, rate: float) -> float:
    """Of one core that does so many products a second."""
    places = len(unique_places(optics, plan.samples, plan.box))
    if plan.model == "ray":
        count = (plan.pixel_nodes * max(optics.pixels) + 1) ** 2
        per_plane = places * count * 4e-7
        return len(optics.lines) * per_plane * len(plan.reach)
    if not optics.separable:
        torus = [ShapedPlane(optics, 0.0, r, plan.pixel_nodes).places for r in plan.reach]
        steps = sum(n * math.log2(n) for n in torus)
        return len(optics.lines) * SHAPED_PRODUCTS * places * steps / rate
    modes = sampling(optics, plan.terms)[2].shape[1]
    window = (2 * plan.neighbours + 1) * modes
    rows, columns = (n * plan.pixel_nodes for n in optics.pixels)
    total = 0.0
    for reach in plan.reach:
        lenslets, about = int(near(reach, optics).sum()), 2 * plan.neighbours * (2 * reach + 1)
        total += 8.0 * rows * window * ((lenslets + about) * modes + lenslets * columns)
    return len(optics.lines) * OVERHEAD * places * total / rate
