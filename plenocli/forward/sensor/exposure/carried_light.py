"""Light of a scene on the sensor, through system matrices and the sensor's colour filters."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.progress import bar
from plenocli.base.tiling import InParts, mirrored
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.scene.sample import ALL
from plenocli.forward.scene.scenes import Polarised, Uniform
from plenocli.forward.sensor.exposure.matrices import AnyMatrix, Build, StoredField, build_matrix
from plenocli.forward.sensor.exposure.options import ExposureOptions

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.scene.scenes import Scene

_MOST = 8 << 30
"""Bytes of memory above which parts of a matrix grow no further: the order of sums, and with it
the last digits, are the same on all larger machines.
"""


@dataclass(frozen=True, kw_only=True)
class SensorLight:
    """Relative light on rows of a sensor tiled with superpixels, before detection.

    colours: letters of the colour filters.
    superpixels: (colour, lenslet_row, lenslet_column, pixel) of the scene.
    white: (colour, pixel) a superpixel of a uniform white object.
    mosaic: (row, column) light that the sensor's colour filters leave.
    """

    colours: tuple[str, ...]
    superpixels: np.ndarray
    white: np.ndarray
    mosaic: np.ndarray


def carry_light(
    camera: Camera,
    source: Quadrature,
    scene: Scene,
    options: ExposureOptions,
    matrix: Mapping[float, AnyMatrix] | None,
    rows: slice = ALL,
    *,
    build: Build | None = None,
) -> SensorLight:
    """Light of the scene on the superpixels of some rows of lenslets, band by band through the
    system matrix.
    """
    from plenocli.base.budget import budget
    from plenocli.forward.sensor.cfa import sensitivity
    from plenocli.forward.sensor.irradiance import reach_of, superpixel_light

    letters, efficiency = sensitivity(camera, source.wavelengths)
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    fine = (samples[0] * options.refine, samples[1] * options.refine)
    grid = (count[0] * fine[0], count[1] * fine[1])
    rows = slice(*rows.indices(count[0])[:2])
    some = (rows.stop - rows.start, count[1])
    pixels = camera.sensor.pixels_per_lenslet[0] * camera.sensor.pixels_per_lenslet[1]
    states = _states(camera, scene, grid, matrix is None)
    light, whites = np.zeros(()), np.zeros(())
    around: dict[tuple[int, int], np.ndarray] = {}
    for index, wavelength in enumerate(
        bar(source.wavelengths, len(source.wavelengths), "wavelengths")
    ):
        weight = (source.photons[index] * efficiency[:, index]).reshape(-1, 1) / options.refine**2
        if scene.spectral:
            around.clear()
        for seen, share in states:
            system = (
                matrix[wavelength] if matrix else (build or build_matrix)(seen, wavelength, options)
            )
            reach, picture = reach_of(system.offsets), None
            if not isinstance(scene, Uniform) or isinstance(system, StoredField):
                if reach not in around:
                    at = partial(_strip, scene, wavelength, grid)
                    around[reach] = _around(at, reach, rows, count, fine)
                picture = around[reach]
            if share is not None and picture is not None:
                picture = picture * _around(share.__getitem__, reach, rows, count, fine)
            if isinstance(system, StoredField):
                assert picture is not None
                carried, white = _carried_over_the_field(system, camera, picture, rows, fine)
            else:
                room = min(budget().memory, _MOST) // 16
                size = max(8, room // (8 * len(system.offsets) * pixels))
                blocks = system.blocks(size)
                carried, white = superpixel_light(blocks, system.offsets, picture, fine)
                if isinstance(scene, Uniform):
                    carried = np.broadcast_to(scene.level * white, (*some, pixels))
            light = light + weight[:, :, None, None] * carried[None]
            whites = whites + weight * white[None] / len(states)
    return SensorLight(
        colours=letters,
        superpixels=light,
        white=whites,
        mosaic=_through_the_filters(camera, letters, light, rows.start),
    )


def _states(
    camera: Camera, scene: Scene, grid: tuple[int, int], built: bool
) -> list[tuple[Camera, np.ndarray | None]]:
    """The camera for each polarisation of light, and its share (row, column) of the light on `grid`
    points of the array; None for all.

    built: whether matrices are worked out; UsageError where they are not, and each state needs its
        own.
    """
    if not isinstance(scene, Polarised) or len(polarisations(camera)) == 1:
        return [(camera, None)]
    if not built:
        raise UsageError(
            "the system matrices are those of light that is not polarised",
            "--pif",
            "leave --pif out: each polarisation has matrices of its own",
        )
    degree = scene.degree_at(*grid)
    # each state has half of the light of a white that is not polarised
    return list(zip(polarisations(camera), ((1 + degree) / 2, (1 - degree) / 2)))


def _strip(scene: Scene, wavelength: float, grid: tuple[int, int], part: slice) -> np.ndarray:
    """Rows of a scene on `grid` points."""
    if isinstance(scene, Uniform):
        return np.full((part.stop - part.start, grid[1]), scene.level)
    some = () if part == slice(0, grid[0]) else (part,)
    return np.asarray(scene.at(wavelength, *grid, *some), np.float32)


def _around(
    at: Callable[[slice], np.ndarray],
    reach: tuple[int, int],
    rows: slice,
    count: tuple[int, int],
    samples: tuple[int, int],
) -> np.ndarray:
    """Values (row, column) at the objects of some rows of lenslets, and of `reach` lenslets more on
    every side of them; beyond the array they go on mirrored.

    at: gives rows of points of the whole array.
    count: lenslets (rows, columns) of the array.
    samples: object points (rows, columns) of a lenslet.
    """
    down, across = (r * n for r, n in zip(reach, samples))
    wanted = mirrored(
        slice(rows.start * samples[0], rows.stop * samples[0]), down, count[0] * samples[0]
    )
    first = int(wanted.min())
    picture = at(slice(first, int(wanted.max()) + 1))
    return np.pad(picture[wanted - first], ((0, 0), (across, across)), mode="symmetric")


def _carried_over_the_field(
    system: StoredField,
    camera: Camera,
    around: np.ndarray,
    rows: slice,
    samples: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """As superpixel_light, every object through the matrix of its own lenslet; white is that of the
    axis.
    """
    from plenocli.forward.sensor.irradiance import reach_of, superpixel_light

    count, reach, light = camera.lenslet_array.count, reach_of(system.offsets), np.zeros(())
    down, across = mirrored(rows, reach[0], count[0]), np.arange(count[1])
    across = np.pad(across, reach[1], mode="symmetric")
    for matrix, weight in system.parts(camera):
        share = around * np.kron(weight[np.ix_(down, across)], np.ones(samples))
        light = light + superpixel_light(matrix.blocks(), matrix.offsets, share, samples)[0]
    axis = system.on_axis
    return light, superpixel_light(axis.blocks(), axis.offsets, None, samples)[1]


def sampled_object(camera: Camera, scene: Scene, refine: int, rows: Sequence[slice]) -> InParts:
    """The object (band, row, column) on the grid that reconstruction uses: area averages of the
    finer one, in bands of `rows` of lenslets.
    """
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    fine = (count[0] * samples[0] * refine, count[1] * samples[1] * refine)
    wavelengths = camera.light.wavelengths if scene.spectral else camera.light.wavelengths[:1]

    def parts() -> Iterator[np.ndarray]:
        for wavelength in wavelengths:
            for part in rows:
                cut = slice(part.start * samples[0] * refine, part.stop * samples[0] * refine)
                yield coarser(_strip(scene, wavelength, fine, cut), refine)

    shape = (len(wavelengths), count[0] * samples[0], count[1] * samples[1])
    return InParts(shape=shape, dtype=np.float32, parts=parts)


def coarser(picture: np.ndarray, refine: int) -> np.ndarray:
    """A picture on points that are `refine` times as wide, float32."""
    from plenocli.forward.scene.sample import block_mean

    return block_mean(picture, (refine, refine)).astype(np.float32)


def _through_the_filters(
    camera: Camera, colours: Sequence[str], superpixels: np.ndarray, row: int
) -> np.ndarray:
    """(row, column) light that the sensor's colour filters leave, relative.

    superpixels: (colour, lenslet_row, lenslet_column, pixel).
    row: of lenslets, that of the first of them on the sensor.
    """
    from plenocli.base.tiling import to_plane
    from plenocli.forward.sensor.cfa import cfa_map

    shape = camera.sensor.pixels_per_lenslet
    planes = {c: to_plane(plane, shape) for c, plane in zip(colours, superpixels)}
    mosaic = next(iter(planes.values()))
    if camera.sensor.cfa == "mono":
        return mosaic
    where = cfa_map(mosaic.shape, camera.sensor.cfa, (row * shape[0], 0))
    filtered = (np.where(where == colour, plane, 0.0) for colour, plane in planes.items())
    return sum(filtered, start=np.zeros(()))
