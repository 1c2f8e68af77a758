"""capture-sim: source -> optics -> detector, one exposure of a plenoptic camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.files.read.scenes import Chart, Scene, Uniform, read_scene
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE, WHITE_LEVEL
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels, SuperpixelGrid

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature


_MOST = 8 << 30
"""Bytes of memory above which parts of a matrix grow no further: the order of sums, and with it
the last digits, are the same on all larger machines.
"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line says beyond the files.

    target: "white", "dark", "mono:450nm" or "colorchecker", None where there is a scene.
    sampling: "fit" or "crop", of a photograph.
    refine: object points per side for each point of the camera description.
    bandwidth: of the light, m.
    spectral_step: m, None as the light needs.
    superpixels: (rows, columns) that one lenslet's light may reach, or "auto".
    coherent_ring: lenslets whose light interferes, or "auto".
    accuracy: relative, None as the noise needs.
    model: of the propagation, "auto" or a rung.
    snr_db: of white noise instead of the sensor's own, dB.
    noise: "sensor" or "none".
    exposure: s, None for the camera's white exposure.
    seed: of the noise.
    """

    target: str | None = None
    sampling: str = "fit"
    refine: int = 1
    bandwidth: float = 0.0
    spectral_step: float | None = None
    superpixels: str | tuple[int, int] = "auto"
    coherent_ring: str | int = "auto"
    accuracy: float | None = None
    model: str = "auto"
    snr_db: float | None = None
    noise: str = "sensor"
    exposure: float | None = None
    seed: int = 0


@dataclass(frozen=True, kw_only=True)
class SensorLight:
    """Relative light on a sensor tiled with superpixels, before detection.

    colours: letters of the colour filters.
    superpixels: (colour, lenslet_row, lenslet_column, pixel) of the scene.
    white: (colour, pixel) a superpixel of a uniform white object.
    scene: (band, row, column) reflectance of the object as sampled.
    """

    colours: tuple[str, ...]
    superpixels: np.ndarray
    white: np.ndarray
    scene: np.ndarray


@dataclass(frozen=True, kw_only=True)
class CaptureSummary:
    """What capture-sim wrote.

    output: the file.
    rows, columns: of its mosaic.
    wavelengths: how many the light was computed at.
    units: of the mosaic.
    peak: its largest value.
    noise_sigma: standard deviation of the noise, None where the sensor's noise is simulated.
    saturated: share of the pixels over full well, None in relative units.
    exposure_s: s, None in relative units.
    """

    output: Path
    rows: int
    columns: int
    wavelengths: int
    units: str
    peak: float | int
    noise_sigma: float | None = None
    saturated: float | None = None
    exposure_s: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary for `--json`; what does not apply is left out."""
        named = {
            "units": self.units,
            "noise_sigma": self.noise_sigma,
            "peak": self.peak,
            "saturated": self.saturated,
            "exposure_s": self.exposure_s,
            "output": str(self.output),
            "rows": self.rows,
            "columns": self.columns,
            "wavelengths": self.wavelengths,
        }
        return {name: value for name, value in named.items() if value is not None}


def run_capture_sim(
    camera_path: str | Path,
    output: str | Path,
    settings: Settings,
    *,
    scene: str | Path | None = None,
    pif: str | Path | None = None,
    scene_out: str | Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CaptureSummary:
    """Simulate one capture and write it.

    camera_path: description of the camera, .toml.
    output: .h5, .exr or .dng.
    scene: what read_scene takes; None where the settings have a target.
    pif: artefact whose system matrix is used instead of a computed one.
    scene_out: also write the object as sampled, .h5 or .exr.
    overwrite: replace files that are there.
    command: for the provenance.

    Returns what was written.
    Raises ConfigError where the camera does not tile the sensor, UsageError for contradicting
    options, InputError for files, OutputError where one cannot be written.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.images.mosaic import write_capture
    from plenocli.files.read.cameras import camera_files, read_camera

    output = Path(output)
    if output.suffix not in (".h5", ".exr", ".dng"):
        raise UsageError(
            f"a capture is written as .h5, .exr or .dng, not {output.suffix or 'without a suffix'}",
            output,
            "change the suffix of OUT",
        )
    if output.suffix == ".dng" and (settings.snr_db is not None or settings.noise == "none"):
        raise UsageError(
            "a DNG holds whole numbers of a sensor; --snr and --noise none give real numbers",
            output,
            "write .h5 or .exr",
        )
    check_output(output, overwrite=overwrite, inputs=[camera_path, pif, scene])
    if scene_out:
        check_output(
            scene_out,
            overwrite=overwrite,
            inputs=[camera_path, pif, scene],
            suffixes=(".h5", ".exr"),
        )
    camera = read_camera(camera_path)
    _check_tiling(camera, camera_path)
    _check_memory(camera, settings, camera_path)
    source, what = _source(camera, settings, scene)
    matrix, accuracy = (
        _read_pif(pif, camera, settings, source.wavelengths, camera_path)
        if pif
        else (None, _accuracy(camera, settings, source.wavelengths))
    )
    light = _carry(camera, source, what, settings, matrix)
    capture, saturated = _detect(camera, light, settings, scene)
    capture = _described(capture, camera, settings, light.scene, scene)
    roles = camera_files(camera_path, camera) | {
        "pif": pif,
        "scene": scene if scene and Path(scene).is_file() else None,
    }
    provenance = Provenance(
        command=command,
        inputs=describe_inputs(roles),
        seed=settings.seed,
        config=to_toml(camera),
        accuracy=accuracy,
    )
    bands = np.array(camera.light.wavelengths[: len(light.scene)])
    write_capture(
        output, capture, provenance, scene=light.scene, wavelengths=bands, overwrite=overwrite
    )
    if scene_out:
        _write_scene(scene_out, light.scene, bands, provenance, overwrite)
    return _summary(output, capture, len(source.wavelengths), saturated)


def _summary(
    output: Path, capture: Capture, wavelengths: int, saturated: float | None
) -> CaptureSummary:
    peak, relative = capture.mosaic.max(), saturated is None
    return CaptureSummary(
        output=output,
        rows=capture.shape[0],
        columns=capture.shape[1],
        wavelengths=wavelengths,
        units=capture.units,
        peak=float(peak) if relative else int(peak),
        noise_sigma=capture.noise.sigma if capture.noise is not None and relative else None,
        saturated=saturated,
        exposure_s=capture.exposure_s,
    )


def _check_tiling(camera: Camera, where: str | Path) -> None:
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


def _check_memory(camera: Camera, settings: Settings, where: str | Path) -> None:
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
    needed = 8 * lenslets * (pixels * (2 * colours + 3) + 2 * points * settings.refine**2)
    budget().require(
        needed,
        "the capture",
        where,
        "take fewer lenslets, pixels or points, a smaller --refine",
    )


def _source(
    camera: Camera, settings: Settings, scene: str | Path | None
) -> tuple[Quadrature, Scene]:
    """The light, and what is in front of the camera, from --target and --scene."""
    from plenocli.base.units import UnitError, parse_wavelength
    from plenocli.forward.scene.light import broadband, broadened, has_colour, narrow_band
    from plenocli.forward.scene.tables import illuminant

    target = settings.target
    if (target is None) == (scene is None):
        raise UsageError(
            "give exactly one of --scene and --target",
            fix="for example --target white or --scene skimage:astronaut",
        )
    if camera.light.band is not None and settings.bandwidth:
        raise UsageError(
            "the camera's light is a band already, given in its [light] section",
            "--bandwidth",
            "leave one of the two out",
        )
    white = broadband(
        camera,
        lambda wavelengths: illuminant(camera.light.illuminant, wavelengths),
        settings.spectral_step,
    )
    if not has_colour(camera) and settings.bandwidth:
        white = broadened(camera.light.wavelengths, settings.bandwidth)
    if scene is not None or target is None:
        return white, read_scene(
            str(scene), sampling=settings.sampling, spectral=has_colour(camera)
        )
    if target.startswith("mono:"):
        try:
            centre = parse_wavelength(target.removeprefix("mono:"))
        except UnitError as error:
            raise UsageError(str(error), "--target", "write for example mono:450nm") from None
        return narrow_band(centre, settings.bandwidth), Uniform(REFERENCE_REFLECTANCE)
    scenes: dict[str, Scene] = {
        "white": Uniform(REFERENCE_REFLECTANCE),
        "dark": Uniform(0.0),
        "colorchecker": Chart(),
    }
    if target not in scenes:
        raise UsageError(
            f"unknown target {target!r}",
            "--target",
            "choose white, dark, mono:450nm or colorchecker",
        )
    return white, scenes[target]


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


_OF_THE_DETECTOR = {
    "lenslet_array": {"count"},
    "sensor": {
        "full_well",
        "read_noise",
        "gain",
        "bits",
        "black_level",
        "quantum_efficiency",
        "cfa",
        "camera",
    },
}
"""What may differ, by section, between a capture's camera and the one that a pif was made for."""


def _read_pif(
    path: str | Path,
    camera: Camera,
    settings: Settings,
    wavelengths: np.ndarray,
    camera_path: str | Path,
) -> tuple[dict[float, StoredMatrix], dict[str, Any]]:
    """(system matrices by wavelength, accuracy record) from a pif artefact; InputError where it
    belongs to another camera or lacks a wavelength.
    """
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.config.camera_file import parse_camera
    from plenocli.files.read.cameras import require_same_files

    artefact = read_pif(path)
    if settings.refine != 1:
        raise UsageError(
            "--refine computes its own finer system matrix and cannot take --pif",
            fix="leave one of them out",
        )
    made_for = parse_camera(artefact.provenance.config, path)
    for section in ("main_lens", "object", "lenslet_array", "sensor", "filter_array"):
        drop = _OF_THE_DETECTOR.get(section, set())
        ours, theirs = getattr(camera, section), getattr(made_for, section)
        if (ours and ours.model_dump(exclude=drop)) != (theirs and theirs.model_dump(exclude=drop)):
            raise InputError(
                f"was made for another camera: [{section}] differs",
                path,
                "run simulate-pif on this camera",
            )
    require_same_files(camera_path, camera, artefact, path)
    known, matrices, offsets = (
        artefact.data[f"pif/{part}"] for part in ("wavelength", "A", "lenslet_offset")
    )
    stored = {}
    for wavelength in wavelengths:
        band = int(np.argmin(np.abs(known - wavelength)))
        if abs(known[band] - wavelength) > 1e-12:
            raise InputError(
                f"has no wavelength {wavelength * 1e9:.4g} nm, which this capture needs",
                path,
                "run simulate-pif with the same --spectral-step, or leave --pif out",
            )
        stored[wavelength] = StoredMatrix(matrices[band], offsets)
    return stored, artefact.provenance.accuracy


def _carry(
    camera: Camera,
    source: Quadrature,
    scene: Scene,
    settings: Settings,
    matrix: Mapping[float, MatrixByPoints] | None,
) -> SensorLight:
    """Light of the scene on every superpixel, band by band through the system matrix."""
    from plenocli.base.budget import budget
    from plenocli.forward.sensor.cfa import sensitivity
    from plenocli.forward.sensor.irradiance import superpixel_light

    letters, efficiency = sensitivity(camera, source.wavelengths)
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    fine = (samples[0] * settings.refine, samples[1] * settings.refine)
    grid = (count[0] * fine[0], count[1] * fine[1])
    finer = (
        camera.replace(**{"object.samples_per_lenslet": fine}) if settings.refine > 1 else camera
    )
    pixels = camera.sensor.pixels_per_lenslet[0] * camera.sensor.pixels_per_lenslet[1]
    light, whites, picture = np.zeros(()), np.zeros(()), None
    for index, wavelength in enumerate(
        bar(source.wavelengths, len(source.wavelengths), "wavelengths")
    ):
        system = matrix[wavelength] if matrix else _build(finer, wavelength, settings)
        if not isinstance(scene, Uniform) and (picture is None or scene.spectral):
            picture = scene.at(wavelength, *grid)
        size = max(8, min(budget().memory, _MOST) // 16 // (8 * len(system.offsets) * pixels))
        carried, white = superpixel_light(system.blocks(size), system.offsets, picture, fine)
        if isinstance(scene, Uniform):
            carried = np.broadcast_to(scene.level * white, (*count, pixels))
        weight = (source.photons[index] * efficiency[:, index]).reshape(-1, 1) / settings.refine**2
        light = light + weight[:, :, None, None] * carried[None]
        whites = whites + weight * white[None]
    return SensorLight(
        colours=letters,
        superpixels=light,
        white=whites,
        scene=_truth(camera, scene, grid, settings.refine),
    )


def _build(camera: Camera, wavelength: float, settings: Settings) -> MatrixByPoints:
    from plenocli.forward.accuracy.dial import pif_builder

    return pif_builder(camera, wavelength, **_request(settings))


def _request(settings: Settings) -> dict[str, Any]:
    """What the dial is asked: with --snr its noise stands in for the sensor's where no
    accuracy is named.
    """
    from plenocli.forward.accuracy.needs import Needs

    needs = (
        None
        if settings.snr_db is None or settings.accuracy is not None
        else Needs(noise=10 ** (-settings.snr_db / 20), source="--snr")
    )
    return dict(
        superpixels=settings.superpixels,
        coherent_ring=settings.coherent_ring,
        accuracy=settings.accuracy,
        model=settings.model,
        needs=needs,
    )


def _accuracy(camera: Camera, settings: Settings, wavelengths: np.ndarray) -> dict[str, Any]:
    """The accuracy record of a capture that computes its own system matrices: that of the middle
    wavelength's plan. Says how long all will take.
    """
    from plenocli.forward.accuracy.dial import plan_pif
    from plenocli.forward.accuracy.explain import expectation

    plan = plan_pif(camera, wavelengths=(wavelengths[len(wavelengths) // 2],), **_request(settings))
    expected = expectation(plan, times=len(wavelengths) * settings.refine**2)
    if expected:
        note(expected)
    return plan.accuracy_record().as_json()


def _truth(camera: Camera, scene: Scene, grid: tuple[int, int], refine: int) -> np.ndarray:
    """The object (band, row, column) on the grid that reconstruction uses: area
    averages of the finer one.
    """
    from plenocli.forward.scene.sample import block_mean

    bands = camera.light.wavelengths if scene.spectral else camera.light.wavelengths[:1]
    return np.stack([block_mean(scene.at(w, *grid), (refine, refine)) for w in bands]).astype(
        np.float32
    )


def _detect(
    camera: Camera, light: SensorLight, settings: Settings, scene: str | Path | None
) -> tuple[Capture, float | None]:
    """What the sensor reports of relative light, and the share of pixels over full well (None in
    relative units).
    """
    mosaic = _through_the_filters(camera, light)
    if not float(light.white.max()) > 0:
        raise ConfigError(
            "no light of this source reaches the sensor",
            "camera",
            "check filters, wavelengths and illuminant",
        )
    rng = stream(settings.seed, "capture-sim")
    if settings.snr_db is not None or settings.noise == "none":
        return _relative(camera, mosaic, settings, rng), None
    return _exposed(camera, mosaic, float(light.white.max()), settings, scene, rng)


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


def _relative(
    camera: Camera, mosaic: np.ndarray, settings: Settings, rng: np.random.Generator
) -> Capture:
    """A capture in relative units, with white noise or none: with one wavelength and no colour
    the mosaic is A x itself.
    """
    from plenocli.forward.sensor.noise import Noise, add_white_noise

    sensor, noise = camera.sensor, Noise()
    mosaic = mosaic / (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0)
    if settings.snr_db is not None:
        mosaic, noise = add_white_noise(mosaic, settings.snr_db, rng)
    return Capture(
        mosaic=mosaic.astype(np.float64),
        units="relative",
        cfa=sensor.cfa,
        noise=noise,
        metadata=CaptureMetadata(snr_db=settings.snr_db, noise_from="--snr and --noise"),
    )


def _exposed(
    camera: Camera,
    mosaic: np.ndarray,
    peak: float,
    settings: Settings,
    scene: str | Path | None,
    rng: np.random.Generator,
) -> tuple[Capture, float]:
    """A capture in digital numbers, and the share of its pixels over full well.

    peak: relative light of the brightest pixel under a uniform white object.
    """
    from plenocli.forward.sensor.noise import SensorModel

    sensor = camera.sensor
    exposure = settings.exposure or camera.light.white_exposure
    scale = WHITE_LEVEL * sensor.full_well / peak * exposure / camera.light.white_exposure
    model = SensorModel.from_camera(camera)
    if not (mosaic.min() >= 0 and np.isfinite(mosaic).all()):
        raise InputError(
            "holds values below 0 or beyond all numbers, which no light has",
            scene,
            "clip it (reconstruct --clip), or use --noise none",
        )
    values = model.expose(mosaic * scale, rng)
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
        exposure_s=exposure,
        noise=model.noise,
        metadata=CaptureMetadata(
            noise_from="camera",
            electrons_per_unit=scale * (sensor.quantum_efficiency if sensor.cfa == "mono" else 1.0),
        ),
    )
    return capture, saturated


def _described(
    capture: Capture,
    camera: Camera,
    settings: Settings,
    truth: np.ndarray,
    scene: str | Path | None,
) -> Capture:
    """The capture with what later stages need to know beside the mosaic."""
    from plenocli.base.units import parse_length

    rows, columns = camera.sensor.pixels_per_lenslet
    count = camera.lenslet_array.count
    first = np.array([(rows - 1) / 2, (columns - 1) / 2])
    index = np.stack(np.meshgrid(np.arange(count[0]), np.arange(count[1]), indexing="ij"), axis=-1)
    target = settings.target or ""
    metadata = replace(
        capture.metadata,
        scene_shape=tuple(truth.shape[1:]),
        target=settings.target or str(Path(str(scene)).name),
        illuminant=camera.light.illuminant,
        band_m=parse_length(target.removeprefix("mono:")) if target.startswith("mono:") else None,
    )
    grid = SuperpixelGrid(
        shape=(rows, columns),
        count=tuple(count),
        centre=first + index * np.array([rows, columns]),
    )
    return replace(capture, grid=grid, metadata=metadata)


def _write_scene(
    path: str | Path,
    truth: np.ndarray,
    wavelengths: np.ndarray,
    provenance: Provenance,
    overwrite: bool,
) -> None:
    """The object as sampled, an `image` artefact or EXR: one picture, or one a band of
    [light] wavelengths.
    """
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    texts, path = provenance_texts(provenance), Path(path)
    if path.suffix == ".exr" and len(truth) == 1:
        write_exr(path, {"Y": truth[0]}, texts, overwrite=overwrite)
    elif path.suffix == ".exr":
        write_spectral_exr(
            path, wavelengths, truth, "reflectance", attrs=texts, overwrite=overwrite
        )
    else:
        data = (
            {"image/value": truth[0]}
            if len(truth) == 1
            else {"image/value": truth, "image/wavelength": wavelengths}
        )
        attrs = {"image": {"method": "object as sampled"}}
        write_artefact(path, Artefact("image", data, attrs, provenance), overwrite=overwrite)
