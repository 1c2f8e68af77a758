"""System matrices that carry the light of an exposure: from a file, or computed as needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from plenocli.base.progress import note
from plenocli.forward.sensor.exposure.options import ExposureOptions

if TYPE_CHECKING:
    from plenocli.forward.accuracy.field_nodes import FieldNodes
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord


class MatrixByPoints(Protocol):
    """A system matrix at one wavelength that comes in blocks of object points."""

    @property
    def offsets(self) -> np.ndarray:
        """(lenslet offset, 2) lenslets, rows and columns."""
        ...

    def blocks(self, size: int | None = None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Pairs (object points, (lenslet offset, pixel, point)) of at most `size` points each."""
        ...


@dataclass(frozen=True)
class StoredMatrix:
    """The system matrix of a pif artefact at one of its wavelengths, in one block.

    matrix: (lenslet offset, pixel, point).
    offsets: (lenslet offset, 2).
    """

    matrix: np.ndarray
    offsets: np.ndarray

    def blocks(self, size: int | None = None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """All points at once: they are in memory."""
        yield np.arange(self.matrix.shape[2]), self.matrix


@dataclass(frozen=True)
class StoredField:
    """The system matrices of a whole array at one wavelength, those of places of the field.

    nodes: the places.
    matrices: (lenslet offset, pixel, point) by row and column of the places.
    offsets: (lenslet offset, 2).
    """

    nodes: FieldNodes
    matrices: Mapping[tuple[int, int], np.ndarray]
    offsets: np.ndarray

    def parts(self, camera: Camera) -> Iterator[tuple[StoredMatrix, np.ndarray]]:
        """Each place's matrix and its weight for the lenslets, (lenslet_row, lenslet_column)."""
        count, pitch = camera.lenslet_array.count, camera.lenslet_array.pitch
        down, across = (
            self.nodes.weights(axis, (np.arange(n) - (n - 1) / 2) * pitch)
            for axis, n in enumerate(count)
        )
        for (i, j), matrix in self.matrices.items():
            yield StoredMatrix(matrix, self.offsets), np.outer(down[:, i], across[:, j])

    @property
    def on_axis(self) -> StoredMatrix:
        """The matrix of the middle of the array."""
        rows, columns = (len(line) // 2 for line in (self.nodes.rows, self.nodes.columns))
        return StoredMatrix(self.matrices[rows, columns], self.offsets)


AnyMatrix = MatrixByPoints | StoredField


Build = Callable[["Camera", float, ExposureOptions], AnyMatrix]
"""As build_matrix."""


def planned_accuracy(
    camera: Camera, options: ExposureOptions, wavelengths: np.ndarray, missing: int
) -> AccuracyRecord:
    """The accuracy record of a capture that computes its own system matrices: that of the middle
    wavelength's plan. Says how long the `missing` ones of them will take.
    """
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.accuracy.explain import expectation
    from plenocli.forward.accuracy.field_nodes import PlansOfPlaces, field_nodes
    from plenocli.forward.camera.geometry import corner_ray

    request = dial_request(options) | {"wavelengths": (wavelengths[len(wavelengths) // 2],)}
    times = missing * options.refine**2
    if options.field_nodes is None:
        plan = plan_pif(camera, **request)
    else:
        plan_at = PlansOfPlaces(camera, **request)
        nodes = field_nodes(camera, plan_at, options.field_nodes)
        plan = nodes.told(plan_at(corner_ray(camera)))
        times *= len(nodes.numbers)
    expected = expectation(plan, times=times)
    if expected and missing:
        note(expected)
    return plan.accuracy_record()


def dial_request(options: ExposureOptions) -> dict[str, Any]:
    """What the dial is asked: with --snr its noise stands in for the sensor's where no
    accuracy is named.
    """
    from plenocli.forward.accuracy.scene_needs import SceneNeeds

    needs = (
        None
        if options.snr_db is None or options.accuracy is not None
        else SceneNeeds(noise=10 ** (-options.snr_db / 20), source="--snr")
    )
    return dict(
        superpixels=options.superpixels,
        coherent_ring=options.coherent_ring,
        accuracy=options.accuracy,
        model=options.model,
        needs=needs,
    )


def held_matrix(camera: Camera, options: ExposureOptions, made: AnyMatrix) -> AnyMatrix:
    """The matrix of one wavelength, worked out once for all bands; NumericsError where there is no
    room for it.
    """
    from plenocli.base.budget import budget

    if isinstance(made, (StoredField, StoredMatrix)):
        return made
    pixels = camera.sensor.pixels_per_lenslet[0] * camera.sensor.pixels_per_lenslet[1]
    points = int(np.prod(camera.object.samples_per_lenslet)) * options.refine**2
    budget().require(
        8 * len(made.offsets) * pixels * points,
        "the system matrix of a sensor that is exposed in bands",
        "capture-sim",
        "take a smaller --refine",
    )
    return in_memory(made, pixels, points)


def in_memory(made: MatrixByPoints, pixels: int, points: int) -> StoredMatrix:
    """All of a matrix of so many pixels and object points."""
    matrix = np.empty((len(made.offsets), pixels, points))
    for some, block in made.blocks():
        matrix[..., some] = block
    return StoredMatrix(matrix, made.offsets)


def build_matrix(camera: Camera, wavelength: float, options: ExposureOptions) -> AnyMatrix:
    """The system matrix at a wavelength (m), as the options ask. Raises as build_pif."""
    from plenocli.forward.accuracy.dial import pif_builder
    from plenocli.forward.accuracy.field_nodes import PlansOfPlaces, lay_nodes
    from plenocli.forward.propagation.system_matrix import build_pif

    if options.refine > 1:
        points = (n * options.refine for n in camera.object.samples_per_lenslet)
        camera = camera.replace(**{"object.samples_per_lenslet": tuple(points)})
    if options.field_nodes is None:
        return pif_builder(camera, wavelength, **dial_request(options))
    plan_at = PlansOfPlaces(camera, wavelengths=(wavelength,), **dial_request(options))
    nodes = lay_nodes(camera, options.field_nodes, plan_at((0.0, 0.0)).superpixels)
    made = [build_pif(camera, plan_at(place)) for place in nodes.places]
    shapes = made[0].pixel_shape, made[0].object_shape
    blocks = [one.A[0] for one in made if one.A is not None]
    return stored_field(nodes, blocks, made[0].lenslet_offset, shapes)


def stored_field(
    nodes: FieldNodes,
    matrices: Sequence[np.ndarray],
    offsets: np.ndarray,
    shapes: tuple[Sequence[int], Sequence[int]],
) -> StoredField:
    """The StoredField of the matrices that `nodes` number; arguments as turned_blocks."""
    from plenocli.forward.accuracy.field_nodes import turned_blocks

    found = {
        (i, j): turned_blocks(matrices[int(nodes.file[i, j])], offsets, shapes, nodes.turn_at(i, j))
        for i, j in np.ndindex(nodes.file.shape)
    }
    return StoredField(nodes, found, offsets)
