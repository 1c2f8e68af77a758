"""One exposure: source -> optics -> detector, from a scene to what the sensor records."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.base.tiling import InParts, bands, mirrored
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.scene.sample import ALL
from plenocli.forward.scene.scenes import Polarised, Uniform
from plenocli.forward.scene.white_reference import WHITE_LEVEL
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels, SuperpixelGrid
from plenocli.forward.sensor.noise import Noise, white_noise

if TYPE_CHECKING:
    from plenocli.forward.accuracy.field_nodes import FieldNodes
    from plenocli.forward.camera.model import Camera, Sensor
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.scene.scenes import Scene
    from plenocli.forward.sensor.detector import SensorModel

BAND = 5 << 19
"""Pixels that are exposed together, as whole rows of lenslets, at most: what a larger sensor
records is worked out, and its noise drawn, in bands of rows. Noise depends on it.
"""
_MOST = 8 << 30
"""Bytes of memory above which parts of a matrix grow no further: the order of sums, and with it
the last digits, are the same on all larger machines.
"""


@dataclass(frozen=True, kw_only=True)
class ExposureOptions:
    """How an exposure is computed.

    refine: object points per side for each point of the camera description.
    superpixels: (rows, columns) that one lenslet's light may reach, or "auto".
    coherent_ring: lenslets whose light interferes, or "auto".
    accuracy: relative, None as the noise needs.
    model: of the propagation, "auto", "ray", "fresnel" or "exact".
    snr_db: of white noise instead of the sensor's own, dB.
    noise: "sensor" or "none".
    exposure: s, None for the camera's own.
    field_nodes: places of the field along an axis whose matrices stand for all lenslets, None for
        the axis alone.
    seed: of the noise.
    """

    refine: int = 1
    superpixels: str | tuple[int, int] = "auto"
    coherent_ring: str | int = "auto"
    accuracy: float | None = None
    model: str = "auto"
    snr_db: float | None = None
    noise: str = "sensor"
    exposure: float | None = None
    field_nodes: int | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class SimulatedCapture:
    """What a simulated sensor records, and the truth.

    capture: what it records.
    scene: (band, row, column) reflectance of the object on the points of reconstruction.
    wavelengths: (band,) m, of the scene's bands.
    tally: of the pixels; of a mosaic InParts it grows with the parts.
    degree: (row, column) degree of polarisation on the points of reconstruction, None where light
        is not polarised.
    """

    capture: Capture
    scene: np.ndarray | InParts
    wavelengths: np.ndarray
    tally: Tally
    degree: np.ndarray | None = None

    @property
    def saturated(self) -> float | None:
        """Share of the pixels over full well, None in relative units."""
        return self.tally.saturated if self.tally.counted else None

    def in_memory(self) -> SimulatedCapture:
        """The same without InParts."""
        mosaic = self.capture.mosaic
        if not isinstance(mosaic, InParts):
            return self
        assert isinstance(self.scene, InParts)
        capture = replace(self.capture, mosaic=mosaic.whole())
        return replace(self, capture=capture, scene=self.scene.whole())


@dataclass
class Tally:
    """Pixels of a capture as far as they were recorded.

    counted: whether full well means something.
    peak: the largest value.
    full: pixels over full well, of `pixels`.
    """

    counted: bool
    peak: float = -np.inf
    full: int = 0
    pixels: int = 0

    @property
    def saturated(self) -> float:
        """Share of the pixels over full well."""
        return self.full / max(1, self.pixels)

    def add(self, values: np.ndarray, full: int = 0) -> None:
        """Count the pixels of a band, `full` of them over full well."""
        self.peak = max(self.peak, float(values.max()))
        self.full += full
        self.pixels += values.size


def simulate_capture(
    camera: Camera,
    source: Quadrature,
    scene: Scene,
    options: ExposureOptions,
    *,
    matrices: Mapping[float, AnyMatrix] | None = None,
    build: Build | None = None,
    name: str = "scene",
    band_m: float | None = None,
    in_parts: bool = False,
) -> SimulatedCapture:
    """One exposure of a scene.

    source: wavelengths of the light and their photons.
    scene: what is in front of the camera.
    options: how it is computed, the noise, the exposure.
    matrices: system matrices by wavelength (m); None: computed as the options ask.
    build: computes them, default build_matrix.
    name: of the scene, for later stages and messages.
    band_m: centre of the narrow band that lights the scene, m, where there is one.
    in_parts: whether mosaic and scene of a sensor of more than BAND pixels are InParts, worked out
        while they are written.

    Raises ConfigError where superpixels do not tile the sensor or no light reaches it,
    NumericsError where memory or accuracy do not suffice, InputError for a scene below zero, which
    a mosaic InParts raises when it is worked out.
    Berkner et al. 2013, section 2.
    """
    # shares of polarised light are those of the whole
    rows = [slice(0, camera.lenslet_array.count[0])]
    rows = rows if isinstance(scene, Polarised) else _bands(camera)
    if len(rows) > 1 and matrices is None:
        make = build or build_matrix
        matrices = {w: _held(camera, options, make(camera, w, options)) for w in source.wavelengths}

    def lit(part: slice) -> SensorLight:
        return carry_light(camera, source, scene, options, matrices, part, build=build)

    first = lit(rows[0])
    if not float(first.white.max()) > 0:
        raise ConfigError(
            "no light of this source reaches the sensor",
            "camera",
            "check filters, wavelengths and illuminant",
        )
    recorder = _recorder(camera, source, first.white, options, name, lamp=band_m is not None)
    truth = _truth(camera, scene, options.refine, rows)
    if len(rows) == 1:
        recorder.measure([first.mosaic])
        mosaic: np.ndarray | InParts = recorder.band(0, first.mosaic)
    else:
        recorder.measure(lit(part).mosaic for part in rows)
        mosaic = _in_bands(camera, rows, lit, recorder)
    found = SimulatedCapture(
        capture=_described(recorder.capture(mosaic), camera, truth.shape, name, band_m),
        scene=truth if len(rows) > 1 else truth.whole(),
        wavelengths=np.array(camera.light.wavelengths[: truth.shape[0]]),
        tally=recorder.tally,
        degree=_degree(camera, scene, options.refine),
    )
    return found if in_parts else found.in_memory()


def _degree(camera: Camera, scene: Scene, refine: int) -> np.ndarray | None:
    """Degree of polarisation (row, column) on the points of reconstruction, or None."""
    if not isinstance(scene, Polarised):
        return None
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    grid = (count[0] * samples[0] * refine, count[1] * samples[1] * refine)
    return _coarser(scene.degree_at(*grid), refine)


def _bands(camera: Camera) -> list[slice]:
    """Rows of lenslets that are exposed together."""
    (rows, columns), pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    return bands(rows, BAND // (columns * pixels[0] * pixels[1]))


def _in_bands(
    camera: Camera,
    rows: Sequence[slice],
    lit: Callable[[slice], SensorLight],
    recorder: _Recorder,
) -> InParts:
    """The mosaic of a sensor that is exposed band by band."""
    count, pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    # what pixels of the next lenslets pass on
    near = 1 if recorder.spreads else 0

    def parts() -> Iterator[np.ndarray]:
        recorder.begin(len(rows))
        for number, part in enumerate(bar(rows, len(rows), "bands of lenslets")):
            around = slice(max(0, part.start - near), min(count[0], part.stop + near))
            own = slice(
                (part.start - around.start) * pixels[0], (part.stop - around.start) * pixels[0]
            )
            yield recorder.band(number, lit(around).mosaic, own)
        recorder.tell()

    shape = (count[0] * pixels[0], count[1] * pixels[1])
    return InParts(shape=shape, dtype=recorder.dtype, parts=parts)


def dark_capture(
    camera: Camera, options: ExposureOptions, name: str = "dark", *, in_parts: bool = False
) -> SimulatedCapture | None:
    """The exposure without light, for which no optics are needed.

    options: the noise, the exposure.
    name: of the scene, for later stages and messages.
    in_parts: as of simulate_capture.

    Returns None where light of known strength and no exposure are given: how long a perfect white
    may shine decides, and the optics say that. The capture does not tell electrons_per_unit.
    Raises NumericsError where the noise is to be in proportion to the light.
    """
    count, pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    rows, exposure = _bands(camera), None
    if options.snr_db is None and options.noise != "none":
        seconds = options.exposure or camera.sensor.exposure
        if seconds is None and camera.light.strength is not None:
            return None
        exposure = ExposureScale(1.0, seconds or camera.light.white_exposure)
    recorder = _Recorder(camera.sensor, options, name, exposure)

    def dark(part: slice) -> np.ndarray:
        return np.zeros(((part.stop - part.start) * pixels[0], count[1] * pixels[1]))

    def parts() -> Iterator[np.ndarray]:
        recorder.begin(len(rows))
        for number, part in enumerate(rows):
            yield recorder.band(number, dark(part))

    recorder.measure(map(dark, rows))
    shape = (count[0] * pixels[0], count[1] * pixels[1])
    capture = recorder.capture(InParts(shape=shape, dtype=recorder.dtype, parts=parts))
    capture = replace(capture, metadata=replace(capture.metadata, electrons_per_unit=None))
    scene = _truth(camera, Uniform(0.0), options.refine, rows)
    found = SimulatedCapture(
        capture=_described(capture, camera, scene.shape, name, None),
        scene=scene,
        wavelengths=np.array(camera.light.wavelengths[:1]),
        tally=recorder.tally,
    )
    return found if in_parts and len(rows) > 1 else found.in_memory()


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


def require_tiling(camera: Camera, where: str | Path) -> None:
    """ConfigError unless superpixels of whole pixels tile the sensor."""
    if camera.lenslet_array.lattice != "square":
        raise ConfigError(
            "capture-sim tiles a sensor with superpixels, which a hexagonal lattice does not allow",
            where,
            'set lenslet_array.lattice = "square"',
        )
    drift = max(abs(m) * n / 2 for m, n in zip(camera.pixel_mismatch, camera.lenslet_array.count))
    if drift > 0.05:
        rows, columns = camera.sensor.pixels_per_lenslet
        raise ConfigError(
            (
                "the superpixel pitch is "
                f"{camera.superpixel_pitch / camera.sensor.pixel_pitch:.4f} pixels, not {rows} x "
                f"{columns}: at the array's edge superpixels would be {drift:.2f} pixels off"
            ),
            where,
            (
                "set lenslet_array.superpixel_pitch = "
                f'"{rows * camera.sensor.pixel_pitch * 1e6:.6g} um" instead of pitch'
            ),
        )


def require_memory_for(
    camera: Camera,
    options: ExposureOptions,
    where: str | Path,
    *,
    in_parts: bool = False,
    polarised: bool = False,
) -> None:
    """Refuse, before any work, a sensor or an object larger than the memory granted: light, white
    and mosaic, float64, by colour, of what is exposed together.

    in_parts: whether mosaic and scene are written as they come, and never all in memory.
    polarised: whether the scene is.
    """
    from plenocli.base.budget import budget

    rows = [slice(0, camera.lenslet_array.count[0])] if polarised else _bands(camera)
    count, lenslets = camera.lenslet_array.count, int(np.prod(camera.lenslet_array.count))
    pixels, points = (
        int(np.prod(n, dtype=object))
        for n in (camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet)
    )
    colours = 1 if camera.sensor.cfa == "mono" else 3
    together = (rows[0].stop - rows[0].start) * count[1]
    needed = 8 * together * (pixels * (2 * colours + 3) + 2 * points * options.refine**2)
    if len(rows) > 1 and not in_parts:
        needed += 8 * lenslets * (2 * pixels + points)
    budget().require(
        needed,
        "the capture",
        where,
        "take fewer lenslets, pixels or points, a smaller --refine",
    )


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

    request = _request(options) | {"wavelengths": (wavelengths[len(wavelengths) // 2],)}
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


def _request(options: ExposureOptions) -> dict[str, Any]:
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


def _held(camera: Camera, options: ExposureOptions, made: AnyMatrix) -> AnyMatrix:
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
        return pif_builder(camera, wavelength, **_request(options))
    plan_at = PlansOfPlaces(camera, wavelengths=(wavelength,), **_request(options))
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


def _truth(camera: Camera, scene: Scene, refine: int, rows: Sequence[slice]) -> InParts:
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
                yield _coarser(_strip(scene, wavelength, fine, cut), refine)

    shape = (len(wavelengths), count[0] * samples[0], count[1] * samples[1])
    return InParts(shape=shape, dtype=np.float32, parts=parts)


def _coarser(picture: np.ndarray, refine: int) -> np.ndarray:
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


def _recorder(
    camera: Camera,
    source: Quadrature,
    white: np.ndarray,
    options: ExposureOptions,
    scene: str,
    *,
    lamp: bool,
) -> _Recorder:
    """What records relative light whose white is (colour, pixel) `white`.

    scene: its name, for messages.
    lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.
    """
    exposure = None
    if options.snr_db is None and options.noise != "none":
        brightest = float(white.max())
        exposure = exposure_scale(camera, source, brightest, options.exposure, lamp=lamp)
    return _Recorder(camera.sensor, options, scene, exposure)


class _Recorder:
    """What a sensor reports of relative light, band of rows by band of rows.

    tally: of the pixels.
    dtype: of what it reports.
    """

    def __init__(
        self,
        sensor: Sensor,
        options: ExposureOptions,
        scene: str,
        exposure: ExposureScale | None,
        stage: str = "capture-sim",
    ) -> None:
        """scene: its name, for messages.

        exposure: None for relative units.
        stage: whose random numbers the noise is.
        """
        from plenocli.forward.sensor.detector import SensorModel

        self.sensor, self.options, self.scene, self.exposure = sensor, options, scene, exposure
        self.model = SensorModel.of(sensor)
        self.tally = Tally(counted=exposure is not None)
        self.dtype = np.float64 if exposure is None else np.uint16
        self.spreads = exposure is not None and bool(self.model.crosstalk)
        self._noise, self._count, self._stage = Noise(), 1, stage

    def measure(self, mosaics: Iterable[np.ndarray]) -> None:
        """Look at the light of all bands before they are recorded, where noise is in proportion to
        it.
        """
        if self.exposure is None and self.options.snr_db is not None:
            self._noise = white_noise(map(self._relative, mosaics), self.options.snr_db)

    def begin(self, count: int) -> None:
        """Record `count` bands from the first one on."""
        self._count, self.tally.peak, self.tally.full, self.tally.pixels = count, -np.inf, 0, 0

    def _relative(self, mosaic: np.ndarray) -> np.ndarray:
        return mosaic / (self.sensor.quantum_efficiency if self.sensor.cfa == "mono" else 1.0)

    def band(self, number: int, mosaic: np.ndarray, own: slice = ALL) -> np.ndarray:
        """What is reported of a band.

        mosaic: (row, column) relative light of it and of rows beside it.
        own: its rows of them.
        """
        rng = stream(self.options.seed, self._stage, number)
        if self.exposure is None:
            values = self._relative(mosaic[own]).astype(np.float64, copy=False)
            if self._noise.sigma:
                values = values + rng.normal(0.0, self._noise.sigma, values.shape)
            self.tally.add(values)
            return values
        if not (mosaic.min() >= 0 and np.isfinite(mosaic).all()):
            raise InputError(
                "holds values below 0 or beyond all numbers, which no light has",
                self.scene,
                "clip it (reconstruct --clip), or use --noise none",
            )
        electrons, model = mosaic * self.exposure.electrons, self.model
        full = int(np.count_nonzero(electrons[own] >= self.sensor.full_well))
        if self._count > 1:
            electrons, model = self._apart(electrons, own)
        values = model.expose(electrons, rng, self.exposure.seconds, number)
        self.tally.add(values, full)
        return values

    def _apart(self, electrons: np.ndarray, own: slice) -> tuple[np.ndarray, SensorModel]:
        """(electrons of the band's own rows, the model of what is left to be done to them): of what
        concerns more than one band.
        """
        from plenocli.forward.sensor.detector import spread_to_neighbours

        if self.spreads:
            electrons = spread_to_neighbours(electrons, self.model.crosstalk)
        drift = stream(self.options.seed, self._stage, self._count).normal()
        black = self.model.black_level + drift * self.model.black_drift
        model = replace(self.model, crosstalk=0.0, black_drift=0.0, black_level=black)
        return electrons[own], model

    def tell(self) -> None:
        """A note where many pixels are over full well."""
        if self.tally.counted and self.tally.saturated > 0.001:
            note(
                f"{self.tally.saturated:.1%} of the pixels are over full well; a shorter "
                "--exposure would keep them"
            )

    def capture(self, mosaic: Any) -> Capture:
        """The capture with what the recorder knows of it; mosaic: an array, or InParts."""
        if not isinstance(mosaic, InParts):
            self.tell()
        if self.exposure is None:
            return Capture(
                mosaic=mosaic,
                units="relative",
                cfa=self.sensor.cfa,
                noise=self._noise,
                metadata=CaptureMetadata(
                    snr_db=self.options.snr_db, noise_from="--snr and --noise"
                ),
            )
        seconds, mono = self.exposure.seconds, self.sensor.cfa == "mono"
        electrons = self.exposure.electrons * (self.sensor.quantum_efficiency if mono else 1.0)
        return Capture(
            mosaic=mosaic,
            cfa=self.sensor.cfa,
            levels=Levels(
                black=np.full((2, 2), float(self.sensor.black_level)),
                white=float(self.model.white_level),
                gain=self.sensor.gain,
            ),
            exposure_s=seconds,
            noise=self.model.noise(seconds),
            metadata=CaptureMetadata(noise_from="camera", electrons_per_unit=electrons),
        )


def recorded(
    sensor: Sensor,
    mosaic: np.ndarray,
    options: ExposureOptions,
    scene: str,
    exposure: ExposureScale | None,
    stage: str,
) -> tuple[Capture, float | None]:
    """What a sensor reports of relative light (row, column), all at once, and the share of its
    pixels over full well, None in relative units.

    scene, exposure, stage: as of _Recorder.
    """
    recorder = _Recorder(sensor, options, scene, exposure, stage)
    recorder.measure([mosaic])
    capture = recorder.capture(recorder.band(0, mosaic))
    return capture, recorder.tally.saturated if recorder.tally.counted else None


@dataclass(frozen=True)
class ExposureScale:
    """How long the sensor is exposed, and to what.

    electrons: photo-electrons of a unit of relative light at a quantum efficiency of 1.
    seconds: s.
    """

    electrons: float
    seconds: float


def exposure_scale(
    camera: Camera,
    source: Quadrature,
    brightest: float,
    seconds: float | None,
    *,
    lamp: bool = False,
) -> ExposureScale:
    """Electrons and time of an exposure.

    Light of known strength gives photons in proportion to time; without a time, it lasts until a
    perfect white fills the brightest pixel to WHITE_LEVEL of full well. Without a strength that is
    what `light.white_exposure` does, and other times are relative to it.
    source: the light.
    brightest: relative light, quantum efficiency included, of the brightest pixel under a perfect
        white, above 0.
    seconds: exposure, None for the camera's own.
    lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.

    Raises ConfigError where the light's strength is one that its wavelengths do not have.
    docs/model.md, "From radiance to electrons".
    """
    from plenocli.forward.camera.geometry import point_etendue
    from plenocli.forward.scene.light import photon_radiance

    full = WHITE_LEVEL * camera.sensor.full_well / brightest
    own = camera.sensor.exposure
    asked = own if seconds is None else seconds
    if lamp or camera.light.strength is None:
        base = own or camera.light.white_exposure
        taken = asked or base
        return ExposureScale(full * taken / base, taken)
    rate = photon_radiance(camera, source) * point_etendue(camera)
    if asked is None:
        note(
            f"exposed for {full / rate * 1e3:.3g} ms, in which a perfect white fills the brightest "
            f"pixel to {WHITE_LEVEL:.0%} of full well"
        )
    taken = full / rate if asked is None else asked
    return ExposureScale(rate * taken, taken)


def _described(
    capture: Capture,
    camera: Camera,
    truth: tuple[int, ...],
    name: str,
    band_m: float | None,
) -> Capture:
    """The capture with what later stages need to know beside the mosaic.

    truth: shape (band, row, column) of the object as sampled.
    """
    from plenocli.forward.sensor.cfa import colour_profile

    metadata = replace(
        capture.metadata,
        scene_shape=tuple(truth[1:]),
        target=Path(name).name,
        illuminant=camera.light.illuminant,
        band_m=band_m,
    )
    grid = SuperpixelGrid.tiled(camera.lenslet_array.count, camera.sensor.pixels_per_lenslet)
    profile = colour_profile(camera)
    return replace(capture, grid=grid, metadata=metadata, profile=profile)
