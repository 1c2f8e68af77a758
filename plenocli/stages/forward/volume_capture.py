"""capture-sim of a volume before a microscope, and of opaque layers before a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError, InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.stages.forward.capture_settings import CaptureSummary, Settings
from plenocli.stages.forward.simulate_stack import DEFAULT_ACCURACY, LONG

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.volume.layers import Layer
    from plenocli.forward.volume.optics import VolumeOptics
    from plenocli.forward.volume.phantoms import Sampler
    from plenocli.forward.volume.plan import VolumePlan

TAKEN = ("snr_db", "noise", "exposure", "refine", "accuracy", "model", "seed")
"""Settings that a volume's capture has."""


@dataclass(frozen=True, kw_only=True)
class _Recorded:
    """What was recorded before a camera.

    camera: its description, resolved; config: the same as TOML.
    depth: (plane,) m; spacing: (plane, 2) m between voxels; opacity: like the volume, of layers.
    files: that were read, by their roles.
    """

    camera: Microscope | Camera
    config: str
    light: np.ndarray
    volume: np.ndarray
    depth: np.ndarray
    spacing: np.ndarray
    plan: VolumePlan
    files: dict[str, str | None]
    opacity: np.ndarray | None = None


def run_volume_capture(
    path: str | Path,
    output: str | Path,
    settings: Settings,
    volume: str | None,
    layers: Sequence[str] = (),
    *,
    scene_out: str | Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CaptureSummary:
    """Simulate the capture of a volume, or of opaque layers, and write it.

    path: description, .toml: of a microscope for a volume, of a photographic camera for layers.
    output: .h5, .exr or .dng.
    volume: "phantom:NAME", a file of kind volume, or a TIFF stack.
    layers: instead, "PICTURE@DISTANCE" each.
    scene_out: also write the volume on the voxels of the description, .h5 or .ome.tif.

    Raises ConfigError for the description, UsageError for options, InputError for files,
    NumericsError where memory does not suffice, OutputError where a file cannot be written.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output, together
    from plenocli.files.images.mosaic import write_capture

    _require_taken(settings, "--layer" if layers else "--volume")
    pictures = [_named(layer) for layer in layers]
    files = [name for name, _ in pictures if not name.startswith("skimage:")]
    if volume is not None and not volume.startswith("phantom:"):
        files = [volume]
    check_output(
        output, overwrite=overwrite, inputs=[path, *files], suffixes=(".h5", ".exr", ".dng")
    )
    if scene_out:
        check_output(
            scene_out,
            overwrite=overwrite,
            inputs=[path, *files, output],
            suffixes=(".h5", ".tif", ".tiff"),
        )
    if volume is not None:
        found, name = _of_specimen(path, settings, volume), volume
    else:
        found, name = _of_layers(path, settings, pictures), " before ".join(layers)
    capture, saturated = _detected(found.camera, found.light, settings, name)
    plan = found.plan
    provenance = Provenance(
        command=command,
        inputs=describe_inputs({"camera": path} | found.files),
        seed=settings.seed,
        config=found.config,
        accuracy={"asked": plan.asked, "estimated": plan.error, "rung": plan.rung},
    )
    with together():
        write_capture(output, capture, provenance, overwrite=overwrite)
        if scene_out:
            _write_truth(scene_out, found, provenance, overwrite)
    relative = saturated is None
    peak = capture.mosaic.max()
    return CaptureSummary(
        output=Path(output),
        rows=capture.shape[0],
        columns=capture.shape[1],
        wavelengths=1,
        units=capture.units,
        peak=float(peak) if relative else int(peak),
        noise_sigma=capture.noise.sigma if capture.noise and relative else None,
        saturated=saturated,
        exposure_s=capture.exposure_s,
    )


def _of_specimen(path: str | Path, settings: Settings, volume: str) -> _Recorded:
    """A specimen before an objective."""
    from plenocli.base.tiling import in_lenslets
    from plenocli.files.config.microscope_file import load_microscope, microscope_toml
    from plenocli.forward.volume.cameras import optics_of
    from plenocli.forward.volume.recording import finer, record

    microscope = load_microscope(path)
    _require_raster(microscope, path)
    coarse = optics_of(microscope)
    specimen = _specimen(volume, microscope, coarse, settings.seed)
    samples = microscope.object.samples_per_lenslet
    optics, plan = finer(
        coarse, samples, settings.refine, settings.accuracy or DEFAULT_ACCURACY, settings.model
    )
    rows, columns = microscope.lenslet_array.count
    many = len(coarse.sites)
    with _shown(plan) as progress:
        cells = -(-rows // many), columns
        found = record(optics, plan, cells, specimen, settings.refine, progress)
    spacing = [
        coarse.row_spacing * coarse.object_pitch / samples[0],
        coarse.object_pitch / samples[1],
    ]
    return _Recorded(
        camera=microscope,
        config=microscope_toml(microscope),
        light=in_lenslets(found.light, many)[:rows],
        volume=found.volume,
        depth=np.array(coarse.depths),
        spacing=np.tile(spacing, (len(coarse.depths), 1)),
        plan=plan,
        files={"volume": None if volume.startswith("phantom:") else volume},
    )


def _require_raster(microscope: Microscope, where: str | Path) -> None:
    """ConfigError unless superpixels of whole pixels tile the sensor."""
    columns = microscope.sensor.pixels_per_lenslet[1]
    if microscope.lenslet_array.lattice == "hexagonal" and columns % 2:
        raise ConfigError(
            f"every other row of a hexagonal lattice stands half of {columns} pixels aside",
            where,
            "simulate with an even number of pixels_per_lenslet in columns",
        )


def _aside(mosaic: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A mosaic of superpixels (rows, columns) with every other row of them half of one to the
    right; what is beside the rows is dark.
    """
    half = shape[1] // 2
    rows = mosaic.reshape(-1, shape[0], mosaic.shape[1])
    out = np.zeros((*rows.shape[:2], mosaic.shape[1] + half))
    out[::2, :, :-half], out[1::2, :, half:] = rows[::2], rows[1::2]
    return out.reshape(mosaic.shape[0], -1)


def _of_layers(
    path: str | Path, settings: Settings, pictures: Sequence[tuple[str, float]]
) -> _Recorded:
    """Opaque layers before a photographic camera, the nearest hiding those behind."""
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.cameras import read_camera
    from plenocli.forward.sensor.exposure.simulate import require_tiling
    from plenocli.forward.volume.cameras import optics_of_camera
    from plenocli.forward.volume.layers import record_layers
    from plenocli.forward.volume.plan import plan_volume

    camera = read_camera(path)
    require_tiling(camera, path)
    pictures = sorted(pictures, key=lambda one: one[1])
    distances = tuple(distance for _, distance in pictures)
    if len(set(distances)) < len(distances):
        raise UsageError("two layers stand at one distance", "--layer", "draw them as one picture")
    if (camera.lenslet_array.lattice, camera.lenslet_array.aperture_shape) != ("square", "square"):
        raise ConfigError(
            "layers are recorded behind square lenslets on a square lattice",
            path,
            "leave layers out, or take such lenslets",
        )
    planes = camera.object.model_copy(update={"planes": distances})
    optics = optics_of_camera(camera.model_copy(update={"object": planes}))
    refine, samples, count = (
        settings.refine,
        camera.object.samples_per_lenslet,
        camera.lenslet_array.count,
    )
    fine = samples[0] * refine, samples[1] * refine
    plan = plan_volume(
        optics,
        fine,
        accuracy=settings.accuracy or DEFAULT_ACCURACY,
        model=settings.model,
        box=max(1, round(2 / refine)),
    )
    shape = count[0] * fine[0], count[1] * fine[1]
    layers = [_layer(name, shape, settings.sampling) for name, _ in pictures]
    with _shown(plan) as progress:
        found = record_layers(optics, plan, count, layers, refine, progress)
    blocks = [
        one.opacity.reshape(shape[0] // refine, refine, shape[1] // refine, refine).mean((1, 3))
        for one in layers
    ]
    pitches = [optics.object_pitch / n for n in samples]
    return _Recorded(
        camera=camera,
        config=to_toml(camera),
        light=found.light,
        volume=found.volume,
        depth=np.array(distances),
        spacing=np.outer(optics.scales, pitches),
        plan=plan,
        files={
            f"layer {number}": None if name.startswith("skimage:") else name
            for number, (name, _) in enumerate(pictures, 1)
        },
        opacity=np.array(blocks),
    )


def _named(layer: str) -> tuple[str, float]:
    """Picture and distance (m) of PICTURE@DISTANCE."""
    from plenocli.base.units import UnitError, parse_length

    name, _, distance = layer.rpartition("@")
    try:
        found = parse_length(distance)
    except UnitError as error:
        raise UsageError(
            f"{layer!r} does not say where the layer stands ({error})",
            "--layer",
            "write PICTURE@DISTANCE, such as near.png@380mm",
        ) from None
    if not name or found <= 0:
        raise UsageError(
            f"{layer!r} names no picture before the camera",
            "--layer",
            "write PICTURE@DISTANCE, such as near.png@380mm",
        )
    return name, found


def _layer(name: str, shape: tuple[int, int], sampling: str) -> Layer:
    """A picture on (rows, columns) points; what it has of alpha is its opacity."""
    from plenocli.files.images.pictures import read_opacity
    from plenocli.files.read.scenes import read_scene
    from plenocli.forward.scene.sample import sample_picture
    from plenocli.forward.volume.layers import Layer

    light = read_scene(name, sampling=sampling).at(550e-9, *shape).astype(float)
    alpha = None if name.startswith("skimage:") else read_opacity(name)
    if alpha is None:
        return Layer(light, np.ones(shape))
    return Layer(light, np.clip(sample_picture(alpha, *shape, sampling), 0, 1))


@contextmanager
def _shown(plan: VolumePlan) -> Iterator[Callable[[int], None]]:
    """Says how long it takes, where it is long, and shows the planes that are done."""
    if plan.seconds > LONG:
        note(f"about {plan.seconds:.2g} s on one core: a larger --accuracy takes less")
    with bar(None, len(plan.reach), "planes") as shown:
        yield shown.update


def _write_truth(
    path: str | Path, found: _Recorded, provenance: Provenance, overwrite: bool
) -> None:
    """What was recorded, as its artefact (.h5) or OME-TIFF."""
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.images.tiff_stack import write_volume_tiff
    from plenocli.files.results.volumes import truth_artefact

    if Path(path).suffix.lower() in (".tif", ".tiff"):
        rows, columns = found.spacing.mean(axis=0).tolist()
        write_volume_tiff(
            path, found.volume, None, found.depth, (rows, columns), overwrite=overwrite
        )
        return
    artefact = truth_artefact(found.volume, found.depth, found.spacing, provenance, found.opacity)
    write_artefact(path, artefact, overwrite=overwrite)


def _require_taken(settings: Settings, option: str) -> None:
    """UsageError where settings ask for what the capture of a volume, or of layers, has not."""
    taken = (*TAKEN, "sampling") if option == "--layer" else TAKEN
    plain = Settings(**{name: getattr(settings, name) for name in taken})
    for name in (field.name for field in fields(settings)):
        if getattr(settings, name) != getattr(plain, name):
            raise UsageError(
                f"does not go with {option}", f"--{name.replace('_', '-')}", "leave one of them out"
            )


def _specimen(volume: str, microscope: Microscope, optics: VolumeOptics, seed: int) -> Sampler:
    """What is before the objective."""
    from plenocli.forward.volume.phantoms import PHANTOMS, Region, phantom

    if not volume.startswith("phantom:"):
        return _stored(volume, optics)
    name = volume.removeprefix("phantom:")
    if name not in PHANTOMS:
        raise UsageError(
            f"there is no phantom {name!r}",
            "--volume",
            f"take one of {', '.join('phantom:' + known for known in PHANTOMS)}, or a file",
        )
    depths, pitch = optics.depths, optics.object_pitch
    rows, columns = microscope.lenslet_array.count
    deep = (depths[-1] - depths[0]) / 2 if len(depths) > 1 else pitch
    half = (deep, rows * optics.row_spacing * pitch / 2, columns * pitch / 2)
    region = Region(half=half, middle=(depths[0] + depths[-1]) / 2, unit=pitch)
    return phantom(name, region, seed)


def _stored(path: str, optics: VolumeOptics) -> Sampler:
    """A volume in a file, about the axis; linear between its voxels, dark beyond them."""
    from scipy.interpolate import RegularGridInterpolator

    from plenocli.files.images.tiff_stack import read_tiff_volume
    from plenocli.files.results.volumes import read_volume

    if Path(path).suffix.lower() in (".tif", ".tiff"):
        stack = read_tiff_volume(path)
        value = stack.value
        if stack.step is None or stack.spacing is None:
            raise InputError(
                "does not say how large its voxels are",
                path,
                "save it as OME-TIFF with physical sizes, or from Fiji with Image > Properties set",
            )
        depth = (np.arange(len(value)) - (len(value) - 1) / 2) * stack.step
        depth += (optics.depths[0] + optics.depths[-1]) / 2
        spacing = stack.spacing
    else:
        known = read_volume(path)
        value, depth, spacing = known.value, known.depth, known.spacing
    if value.min() < 0:
        raise InputError("holds values below 0, which no light has", path, "clip it")
    places = [(np.arange(n) - (n - 1) / 2) * s for n, s in zip(value.shape[1:], spacing)]
    if len(depth) == 1:
        # one plane: a layer as thick as those that are recorded
        depth, value = np.array([depth[0], depth[0] + 1e-12]), np.concatenate([value, value])
    linear = RegularGridInterpolator((depth, *places), value, bounds_error=False, fill_value=0.0)

    def at(z: float, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        grid = np.stack(np.broadcast_arrays(z, rows[:, None], columns), axis=-1)
        return linear(grid)

    return at


def _detected(
    camera: Microscope | Camera, light: np.ndarray, settings: Settings, name: str
) -> tuple[Capture, float | None]:
    """What the sensor reports, and the share of its pixels over full well."""
    from plenocli.base.tiling import to_plane
    from plenocli.forward.scene.white_reference import WHITE_LEVEL
    from plenocli.forward.sensor.capture import SuperpixelGrid
    from plenocli.forward.sensor.exposure.recorder import ExposureScale, recorded

    sensor = camera.sensor
    if not light.any():
        raise InputError(
            "puts no light on the sensor", name, "give a volume within the planes and the field"
        )
    # rounding of transforms leaves dark pixels below zero
    lattice = camera.lenslet_array.lattice
    mosaic = to_plane(np.maximum(light, 0), sensor.pixels_per_lenslet) * sensor.quantum_efficiency
    if lattice == "hexagonal":
        mosaic = _aside(mosaic, sensor.pixels_per_lenslet)
    scale = None
    if settings.snr_db is None and settings.noise != "none":
        usual = camera.light.white_exposure
        seconds = settings.exposure or sensor.exposure or usual
        full = WHITE_LEVEL * sensor.full_well / float(mosaic.max())
        scale = ExposureScale(full * seconds / usual, seconds)
    stage = "capture-sim of a volume"
    capture, saturated = recorded(sensor, mosaic, settings.options, name, scale, stage)
    grid = SuperpixelGrid.tiled(camera.lenslet_array.count, sensor.pixels_per_lenslet, lattice)
    about = replace(capture.metadata, target=Path(name).name)
    return replace(capture, grid=grid, metadata=about), saturated
