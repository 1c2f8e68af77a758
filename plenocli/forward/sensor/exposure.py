"""One exposure: source -> optics -> detector, from a scene to what the sensor records."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.scene.scenes import Polarised, Uniform
from plenocli.forward.scene.white_reference import WHITE_LEVEL
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels, SuperpixelGrid

if TYPE_CHECKING:
    from plenocli.forward.accuracy.field_nodes import FieldNodes
    from plenocli.forward.camera.model import Camera, Sensor
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.scene.scenes import Scene

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
    saturated: share of the pixels over full well, None in relative units.
    degree: (row, column) degree of polarisation on the points of reconstruction, None where light
        is not polarised.
    """

    capture: Capture
    scene: np.ndarray
    wavelengths: np.ndarray
    saturated: float | None
    degree: np.ndarray | None = None


def simulate_capture(
    camera: Camera,
    source: Quadrature,
    scene: Scene,
    options: ExposureOptions,
    *,
    matrices: Mapping[float, MatrixByPoints | StoredField] | None = None,
    name: str = "scene",
    band_m: float | None = None,
) -> SimulatedCapture:
    """One exposure of a scene.

    source: wavelengths of the light and their photons.
    scene: what is in front of the camera.
    options: how it is computed, the noise, the exposure.
    matrices: system matrices by wavelength (m); None: computed as the options ask.
    name: of the scene, for later stages and messages.
    band_m: centre of the narrow band that lights the scene, m, where there is one.

    Raises ConfigError where superpixels do not tile the sensor or no light reaches it,
    NumericsError where memory or accuracy do not suffice, InputError for a scene below zero.
    Berkner et al. 2013, section 2.
    """
    light = carry_light(camera, source, scene, options, matrices)
    capture, saturated = detect(camera, source, light, options, name, lamp=band_m is not None)
    return SimulatedCapture(
        capture=_described(capture, camera, light.scene, name, band_m),
        scene=light.scene,
        wavelengths=np.array(camera.light.wavelengths[: len(light.scene)]),
        saturated=saturated,
        degree=light.degree,
    )


def dark_capture(
    camera: Camera, options: ExposureOptions, name: str = "dark"
) -> SimulatedCapture | None:
    """The exposure without light, for which no optics are needed.

    options: the noise, the exposure.
    name: of the scene, for later stages and messages.

    Returns None where light of known strength and no exposure are given: how long a perfect white
    may shine decides, and the optics say that. The capture does not tell electrons_per_unit.
    Raises NumericsError where the noise is to be in proportion to the light.
    """
    count, pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    mosaic = np.zeros((count[0] * pixels[0], count[1] * pixels[1]))
    rng, saturated = _noise_source(options), None
    if options.snr_db is not None or options.noise == "none":
        capture = relative_capture(camera.sensor, mosaic, options, rng)
    else:
        seconds = options.exposure or camera.sensor.exposure
        if seconds is None and camera.light.strength is not None:
            return None
        exposure = ExposureScale(1.0, seconds or camera.light.white_exposure)
        capture, saturated = exposed_capture(camera.sensor, mosaic, exposure, name, rng)
        capture = replace(capture, metadata=replace(capture.metadata, electrons_per_unit=None))
    samples = camera.object.samples_per_lenslet
    grid = (count[0] * samples[0] * options.refine, count[1] * samples[1] * options.refine)
    scene = _truth(camera, Uniform(0.0), grid, options.refine)
    return SimulatedCapture(
        capture=_described(capture, camera, scene, name, None),
        scene=scene,
        wavelengths=np.array(camera.light.wavelengths[:1]),
        saturated=saturated,
    )


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


@dataclass(frozen=True, kw_only=True)
class SensorLight:
    """Relative light on a sensor tiled with superpixels, before detection.

    colours: letters of the colour filters.
    superpixels: (colour, lenslet_row, lenslet_column, pixel) of the scene.
    white: (colour, pixel) a superpixel of a uniform white object.
    scene: (band, row, column) reflectance of the object as sampled.
    degree: (row, column) its degree of polarisation, or None.
    """

    colours: tuple[str, ...]
    superpixels: np.ndarray
    white: np.ndarray
    scene: np.ndarray
    degree: np.ndarray | None


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


def require_memory_for(camera: Camera, options: ExposureOptions, where: str | Path) -> None:
    """Refuse, before any work, a sensor or an object larger than the memory granted: light,
    white and mosaic, float64, by colour.
    """
    from plenocli.base.budget import budget

    lenslets, pixels, points = (
        int(np.prod(n, dtype=object))
        for n in (
            camera.lenslet_array.count,
            camera.sensor.pixels_per_lenslet,
            camera.object.samples_per_lenslet,
        )
    )
    colours = 1 if camera.sensor.cfa == "mono" else 3
    needed = 8 * lenslets * (pixels * (2 * colours + 3) + 2 * points * options.refine**2)
    budget().require(
        needed,
        "the capture",
        where,
        "take fewer lenslets, pixels or points, a smaller --refine",
    )


def planned_accuracy(
    camera: Camera, options: ExposureOptions, wavelengths: np.ndarray
) -> AccuracyRecord:
    """The accuracy record of a capture that computes its own system matrices: that of the middle
    wavelength's plan. Says how long all will take.
    """
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.accuracy.explain import expectation
    from plenocli.forward.accuracy.field_nodes import PlansOfPlaces, field_nodes
    from plenocli.forward.camera.geometry import corner_ray

    request = _request(options) | {"wavelengths": (wavelengths[len(wavelengths) // 2],)}
    times = len(wavelengths) * options.refine**2
    if options.field_nodes is None:
        plan = plan_pif(camera, **request)
    else:
        plan_at = PlansOfPlaces(camera, **request)
        nodes = field_nodes(camera, plan_at, options.field_nodes)
        plan = nodes.told(plan_at(corner_ray(camera)))
        times *= len(nodes.numbers)
    expected = expectation(plan, times=times)
    if expected:
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
    matrix: Mapping[float, MatrixByPoints | StoredField] | None,
) -> SensorLight:
    """Light of the scene on every superpixel, band by band through the system matrix."""
    from plenocli.forward.sensor.cfa import sensitivity

    letters, efficiency = sensitivity(camera, source.wavelengths)
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    fine = (samples[0] * options.refine, samples[1] * options.refine)
    grid = (count[0] * fine[0], count[1] * fine[1])
    finer = camera.replace(**{"object.samples_per_lenslet": fine}) if options.refine > 1 else camera
    light, whites, picture = np.zeros(()), np.zeros(()), None
    degree = scene.degree_at(*grid) if isinstance(scene, Polarised) else None
    states: list[tuple[Camera, np.ndarray | float]] = [(finer, 1.0)]
    if degree is not None and len(polarisations(finer)) > 1:
        if matrix is not None:
            raise UsageError(
                "the system matrices are those of light that is not polarised",
                "--pif",
                "leave --pif out: each polarisation has matrices of its own",
            )
        # each state has half of the light of a white that is not polarised
        states = list(zip(polarisations(finer), ((1 + degree) / 2, (1 - degree) / 2)))
    for index, wavelength in enumerate(
        bar(source.wavelengths, len(source.wavelengths), "wavelengths")
    ):
        if not isinstance(scene, Uniform) and (picture is None or scene.spectral):
            picture = scene.at(wavelength, *grid)
        weight = (source.photons[index] * efficiency[:, index]).reshape(-1, 1) / options.refine**2
        for seen, share in states:
            system = matrix[wavelength] if matrix else _build(seen, wavelength, options)
            part = (
                scene.level
                if isinstance(scene, Uniform)
                else share * np.asarray(picture, np.float32)
            )
            carried, white = _carried(system, camera, part, fine)
            light = light + weight[:, :, None, None] * carried[None]
            whites = whites + weight * white[None] / len(states)
    return SensorLight(
        colours=letters,
        superpixels=light,
        white=whites,
        scene=_truth(camera, scene, grid, options.refine),
        degree=None if degree is None else _coarser(degree, options.refine),
    )


def _carried(
    system: MatrixByPoints | StoredField,
    camera: Camera,
    scene: np.ndarray | float,
    samples: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """As superpixel_light, of a picture or of an even object by its level."""
    from plenocli.base.budget import budget
    from plenocli.forward.sensor.irradiance import superpixel_light

    count, pixels = camera.lenslet_array.count, math.prod(camera.sensor.pixels_per_lenslet)
    picture = scene if isinstance(scene, np.ndarray) else None
    if isinstance(system, StoredField):
        grid = (count[0] * samples[0], count[1] * samples[1])
        whole = np.full(grid, scene) if picture is None else picture
        return _carried_over_the_field(system, camera, whole, samples)
    size = max(8, min(budget().memory, _MOST) // 16 // (8 * len(system.offsets) * pixels))
    carried, white = superpixel_light(system.blocks(size), system.offsets, picture, samples)
    if picture is None:
        carried = np.broadcast_to(scene * white, (*count, pixels))
    return carried, white


def _carried_over_the_field(
    system: StoredField, camera: Camera, picture: np.ndarray, samples: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """As superpixel_light, every object through the matrix of its own lenslet; white is that of the
    axis.
    """
    from plenocli.forward.sensor.irradiance import superpixel_light

    light: np.ndarray = np.zeros(())
    for matrix, weight in system.parts(camera):
        share = picture * np.kron(weight, np.ones(samples))
        light = light + superpixel_light(matrix.blocks(), matrix.offsets, share, samples)[0]
    axis = system.on_axis
    return light, superpixel_light(axis.blocks(), axis.offsets, None, samples)[1]


def _build(
    camera: Camera, wavelength: float, options: ExposureOptions
) -> MatrixByPoints | StoredField:
    from plenocli.forward.accuracy.dial import pif_builder
    from plenocli.forward.accuracy.field_nodes import PlansOfPlaces, lay_nodes
    from plenocli.forward.propagation.system_matrix import build_pif

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


def _truth(camera: Camera, scene: Scene, grid: tuple[int, int], refine: int) -> np.ndarray:
    """The object (band, row, column) on the grid that reconstruction uses: area
    averages of the finer one.
    """
    bands = camera.light.wavelengths if scene.spectral else camera.light.wavelengths[:1]
    return np.stack([_coarser(scene.at(w, *grid), refine) for w in bands])


def _coarser(picture: np.ndarray, refine: int) -> np.ndarray:
    """A picture on points that are `refine` times as wide, float32."""
    from plenocli.forward.scene.sample import block_mean

    return block_mean(picture, (refine, refine)).astype(np.float32)


def detect(
    camera: Camera,
    source: Quadrature,
    light: SensorLight,
    options: ExposureOptions,
    scene: str,
    *,
    lamp: bool = False,
) -> tuple[Capture, float | None]:
    """What the sensor reports of relative light, and the share of pixels over full well (None in
    relative units).

    source: the light.
    scene: its name, for messages.
    lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.
    """
    mosaic = _through_the_filters(camera, light)
    if not float(light.white.max()) > 0:
        raise ConfigError(
            "no light of this source reaches the sensor",
            "camera",
            "check filters, wavelengths and illuminant",
        )
    rng = _noise_source(options)
    if options.snr_db is not None or options.noise == "none":
        return relative_capture(camera.sensor, mosaic, options, rng), None
    brightest = float(light.white.max())
    electrons = exposure_scale(camera, source, brightest, options.exposure, lamp=lamp)
    return exposed_capture(camera.sensor, mosaic, electrons, scene, rng)


def _noise_source(options: ExposureOptions) -> np.random.Generator:
    return stream(options.seed, "capture-sim")


def _through_the_filters(camera: Camera, light: SensorLight) -> np.ndarray:
    """(row, column) light that the sensor's colour filters leave, relative."""
    from plenocli.base.tiling import to_plane
    from plenocli.forward.sensor.cfa import cfa_map

    shape = camera.sensor.pixels_per_lenslet
    planes = {c: to_plane(plane, shape) for c, plane in zip(light.colours, light.superpixels)}
    mosaic = next(iter(planes.values()))
    if camera.sensor.cfa == "mono":
        return mosaic
    where = cfa_map(mosaic.shape, camera.sensor.cfa)
    filtered = (np.where(where == colour, plane, 0.0) for colour, plane in planes.items())
    return sum(filtered, start=np.zeros(()))


def relative_capture(
    sensor: Sensor, mosaic: np.ndarray, options: ExposureOptions, rng: np.random.Generator
) -> Capture:
    """A capture in relative units, with white noise or none: with one wavelength and no colour
    the mosaic is A x itself.
    """
    from plenocli.forward.sensor.noise import Noise, add_white_noise

    noise = Noise()
    mosaic = mosaic / (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0)
    if options.snr_db is not None:
        mosaic, noise = add_white_noise(mosaic, options.snr_db, rng)
    return Capture(
        mosaic=mosaic.astype(np.float64),
        units="relative",
        cfa=sensor.cfa,
        noise=noise,
        metadata=CaptureMetadata(snr_db=options.snr_db, noise_from="--snr and --noise"),
    )


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


def exposed_capture(
    sensor: Sensor,
    mosaic: np.ndarray,
    exposure: ExposureScale,
    scene: str,
    rng: np.random.Generator,
) -> tuple[Capture, float]:
    """A capture in digital numbers, and the share of its pixels over full well."""
    from plenocli.forward.sensor.detector import SensorModel

    scale = exposure.electrons
    model = SensorModel.of(sensor)
    if not (mosaic.min() >= 0 and np.isfinite(mosaic).all()):
        raise InputError(
            "holds values below 0 or beyond all numbers, which no light has",
            scene,
            "clip it (reconstruct --clip), or use --noise none",
        )
    values = model.expose(mosaic * scale, rng, exposure.seconds)
    saturated = float(np.mean(mosaic * scale >= sensor.full_well))
    if saturated > 0.001:
        note(
            f"{saturated:.1%} of the pixels are over full well; a shorter "
            "--exposure would keep them"
        )
    capture = Capture(
        mosaic=values,
        cfa=sensor.cfa,
        levels=Levels(
            black=np.full((2, 2), float(sensor.black_level)),
            white=float(model.white_level),
            gain=sensor.gain,
        ),
        exposure_s=exposure.seconds,
        noise=model.noise(exposure.seconds),
        metadata=CaptureMetadata(
            noise_from="camera",
            electrons_per_unit=scale * (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0),
        ),
    )
    return capture, saturated


def _described(
    capture: Capture, camera: Camera, truth: np.ndarray, name: str, band_m: float | None
) -> Capture:
    """The capture with what later stages need to know beside the mosaic."""
    from plenocli.forward.sensor.cfa import colour_profile

    metadata = replace(
        capture.metadata,
        scene_shape=tuple(truth.shape[1:]),
        target=Path(name).name,
        illuminant=camera.light.illuminant,
        band_m=band_m,
    )
    grid = SuperpixelGrid.tiled(camera.lenslet_array.count, camera.sensor.pixels_per_lenslet)
    profile = colour_profile(camera)
    return replace(capture, grid=grid, metadata=metadata, profile=profile)
