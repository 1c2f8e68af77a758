"""The kernels of a volume, A(z): where the light of a voxel of each plane lands, the same for all
lenslets.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from plenocli.base.budget import budget, spread
from plenocli.base.errors import NumericsError
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.plan import VolumePlan, between_planes, unique_places
from plenocli.forward.volume.shaped import ShapedPlane
from plenocli.forward.volume.waves import near

SUM_SLACK = 5e-3
"""By which a column may exceed the light that enters the lenslets."""
SPILLED = 0.02
"""Share of the light that may be spread beyond the last superpixel."""
RAY_SLACK = 0.05
"""As SUM_SLACK, of a grid of rays."""


@dataclass(frozen=True, kw_only=True)
class Stack:
    """Kernels of a volume.

    A: (entry, pixel, point) float32, share of a voxel's light that lands on a pixel.
    plane: (entry,) number of the plane; ascending.
    lenslet_offset: (entry, 2) superpixel (row, column) relative to the voxel's own lenslet; of
        cells where these are two lenslets.
    depth: (plane,) m from the focused plane, away from the objective; of a photographic camera
        from its main lens.
    spacing: (plane, 2) m between voxels (rows, columns).
    pixel_shape, point_shape: pixels of a superpixel, voxels of a lenslet (rows, columns); of a
        cell's two, one below the other, on a hexagonal lattice.
    wavelength: m.
    column_energy: (plane, point) share of the light on the superpixels kept.
    accuracy: how accurate the kernels are.
    lattice: of the lenslets, "square" or "hexagonal".
    """

    A: np.ndarray
    plane: np.ndarray
    lenslet_offset: np.ndarray
    depth: np.ndarray
    spacing: np.ndarray
    pixel_shape: tuple[int, int]
    point_shape: tuple[int, int]
    wavelength: float
    column_energy: np.ndarray
    accuracy: AccuracyRecord
    lattice: str = "square"

    @property
    def lenslets(self) -> int:
        """Of a cell."""
        return 2 if self.lattice == "hexagonal" else 1

    @property
    def reach(self) -> tuple[int, int]:
        """Farthest offsets (rows, columns)."""
        rows, columns = np.abs(self.lenslet_offset).max(axis=0).tolist()
        return rows, columns

    def even(self) -> np.ndarray:
        """(pixel,) light of an even object in the plane nearest to the focus, the one that lights
        the fewest superpixels.
        """
        most = np.bincount(self.plane)
        return self.A[self.plane == np.argmin(most)].sum((0, 2), dtype=float)

    def only(self, planes: Sequence[int]) -> Stack:
        """Some of the planes, by their numbers, rising."""
        kept = np.isin(self.plane, planes)
        return replace(
            self,
            A=self.A[kept],
            plane=np.searchsorted(planes, self.plane[kept]),
            lenslet_offset=self.lenslet_offset[kept],
            depth=self.depth[list(planes)],
            spacing=self.spacing[list(planes)],
            column_energy=self.column_energy[list(planes)],
        )

    def parts(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """(kernels (offset, pixel, point), offsets (offset, 2)) plane by plane, as views."""
        ends = np.searchsorted(self.plane, np.arange(len(self.depth) + 1))
        some = [slice(*both) for both in pairwise(ends.tolist())]
        return [(self.A[part], self.lenslet_offset[part]) for part in some]


def build_stack(
    optics: VolumeOptics, plan: VolumePlan, progress: Callable[[int], None] | None = None
) -> Stack:
    """Compute the kernels of all planes.

    progress: called with 1 for every plane that is done.

    Raises NumericsError where memory does not suffice, or where a voxel's light on the sensor is
    not what entered its lenslets.
    """
    budget().require(
        2 * plan.bytes + _working(optics, plan),
        "the kernels of this volume",
        "object.planes",
        "take fewer planes, pixels or voxels",
    )
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def one(number: int) -> None:
        found[number] = plane_kernels(optics, plan, number)
        if progress:
            progress(1)

    spread([(number,) for number in range(len(plan.reach))], one)
    planes = [found[number] for number in range(len(plan.reach))]
    voxel = [size / n for size, n in zip(optics.object_cell, plan.samples)]
    return Stack(
        A=np.concatenate([kernels for kernels, _ in planes]),
        plane=np.repeat(np.arange(len(planes)), [len(kernels) for kernels, _ in planes]),
        lenslet_offset=np.concatenate([offsets for _, offsets in planes]),
        depth=np.array(optics.places),
        spacing=np.outer(optics.scales, voxel),
        pixel_shape=optics.cell_pixels,
        point_shape=plan.samples,
        wavelength=optics.wavelength,
        column_energy=np.stack([kernels.sum((0, 1), dtype=float) for kernels, _ in planes]),
        accuracy=AccuracyRecord(
            asked=plan.asked,
            estimated=plan.error,
            model=plan.model,
            rung=plan.rung,
            by_source={
                "light beyond the superpixels kept": max(plan.lost),
                "halfway between planes": between_planes(optics, plan),
            },
        ),
        lattice=optics.lattice,
    )


def plane_kernels(
    optics: VolumeOptics, plan: VolumePlan, number: int
) -> tuple[np.ndarray, np.ndarray]:
    """Kernels of one plane: points at the unique places, the others by symmetry, averaged over the
    voxels' boxes and the band.

    number: of the plane.

    Returns (entry, pixel, point) and lenslet offsets (entry, 2), as Stack has them.
    Raises NumericsError where a point's light on the sensor is not what entered its lenslets.
    """
    lines = [plan.plane(o, number) for o in optics.lines]
    fine = tuple(n * plan.box for n in plan.samples)
    # voxels as well as places follow from a few
    wanted, sums = set(unique_places(optics, plan.samples, 1)), dict[tuple[int, int], np.ndarray]()
    for i, j in unique_places(optics, plan.samples, plan.box):
        cell = zip((i, j), fine, optics.object_cell)
        places = [((k + 0.5) / n - 0.5) * size for k, n, size in cell]
        column, entered = lines[0].column(*places)
        for line in lines[1:]:
            other, also = line.column(*places)
            column, entered = column + other, entered + also
        column, entered = column / len(lines), entered / len(lines)
        _guard(optics, number, float(column.sum(dtype=float)), entered, plan)
        for (a, b), image in _images((i, j), column, fine, optics).items():
            voxel = a // plan.box, b // plan.box
            if voxel in wanted:
                sums[voxel] = sums.get(voxel, 0) + image
    kept = near(plan.reach[number], optics)
    offsets = np.argwhere(kept) - np.array(kept.shape) // 2
    kernels = np.empty((len(offsets), *optics.cell_pixels, *plan.samples), np.float32)
    for voxel, total in sums.items():
        for (a, b), image in _images(voxel, total, plan.samples, optics).items():
            kernels[..., a, b] = image.transpose(0, 2, 1, 3)[kept] / plan.box**2
    return kernels.reshape(len(offsets), math.prod(optics.cell_pixels), -1), offsets


def _images(
    place: tuple[int, int], column: np.ndarray, fine: tuple[int, ...], optics: VolumeOptics
) -> dict[tuple[int, int], np.ndarray]:
    """The column at a place (row, column), and those that symmetry makes of it, by place."""
    found = {place: column}
    if not optics.round:
        return found
    (i, j), (rows, columns) = place, fine
    if optics.lattice == "hexagonal":
        return found | {(rows - 1 - i, columns - 1 - j): column[::-1, ::-1, ::-1, ::-1]}
    found |= {(rows - 1 - i, j): column[::-1, ::-1]}
    found |= {(a, columns - 1 - b): c[:, :, ::-1, ::-1] for (a, b), c in found.items()}
    if rows == columns and optics.turnable:
        # a place on the diagonal is its own image
        turned = {(b, a): c.transpose(2, 3, 0, 1) for (a, b), c in found.items()}
        found = turned | found
    return found


def _guard(
    optics: VolumeOptics, number: int, light: float, entered: float, plan: VolumePlan
) -> None:
    """NumericsError where the light on the sensor is not what entered the lenslets."""
    expected = entered * optics.pixel_width**2
    away = light / expected - 1
    slack = max(SUM_SLACK, plan.error) if plan.model == "fresnel" else RAY_SLACK
    # pixels in part blind miss fringes, light is spread beyond the last superpixel, and in gaps
    # between lenslets some is lost
    whole = optics.pixel_width == 1 and optics.gapless
    least = 1 - plan.lost[number] - slack - SPILLED
    if away > slack or (whole and (away < -slack - SPILLED or entered < least)):
        raise NumericsError(
            f"of a point in plane {number} {light:.4f} of the light reaches the pixels, where "
            f"{expected:.4f} enters the lenslets, and at least {least:.4f} should",
            "object.planes",
            "ask for a finer accuracy, or check sensor.distance and the lenslets' focal_length",
        )


def _working(optics: VolumeOptics, plan: VolumePlan) -> int:
    """Bytes at work on the deepest plane, beside the kernels."""
    lenslets = 2 * max(plan.reach) + 1
    rows, columns = (lenslets * n * plan.pixel_nodes for n in optics.pixels)
    if optics.separable:
        wide = (lenslets + 2 * plan.neighbours) * max(plan.terms, 1)
        fields = 8 * (2 * rows * wide + 2 * wide**2 + rows * optics.pixels[1] * plan.pixel_nodes)
    else:
        fields = 32 * ShapedPlane(optics, 0.0, max(plan.reach), plan.pixel_nodes).places
    columns_of_plane = 4 * near(max(plan.reach), optics).size * math.prod(optics.cell_pixels)
    voxels = len(unique_places(optics, plan.samples, 1)) + plan.samples[0] * plan.samples[1]
    return budget().threads * (fields + (2 + voxels) * columns_of_plane)
