"""capture-sim of a volume before a microscope's lenslets."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.progress import bar, note
from plenocli.stages.forward.capture_settings import CaptureSummary, Settings

if TYPE_CHECKING:
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.volume.optics import VolumeOptics
    from plenocli.forward.volume.phantoms import Sampler

TAKEN = ("snr_db", "noise", "exposure", "refine", "accuracy", "model", "seed")
"""Settings that a volume's capture has."""


def run_volume_capture(
    path: str | Path,
    output: str | Path,
    settings: Settings,
    volume: str,
    *,
    scene_out: str | Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CaptureSummary:
    """Simulate the capture of a volume and write it.

    path: description of a microscope, .toml.
    output: .h5, .exr or .dng.
    volume: "phantom:NAME", a file of kind volume, or a TIFF stack.
    scene_out: also write the volume on the voxels of the description, .h5 or .ome.tif.

    Raises ConfigError for the description, UsageError for options, InputError for files,
    NumericsError where memory does not suffice, OutputError where a file cannot be written.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output, together
    from plenocli.files.config.microscope_file import load_microscope, microscope_toml
    from plenocli.files.images.mosaic import write_capture
    from plenocli.forward.volume.cameras import optics_of
    from plenocli.forward.volume.recording import finer, record
    from plenocli.stages.forward.simulate_stack import DEFAULT_ACCURACY

    _require_taken(settings)
    file = None if volume.startswith("phantom:") else volume
    check_output(output, overwrite=overwrite, inputs=[path, file], suffixes=(".h5", ".exr", ".dng"))
    if scene_out:
        check_output(scene_out, overwrite=overwrite, inputs=[path, file, output])
    microscope = load_microscope(path)
    coarse = optics_of(microscope)
    specimen = _specimen(volume, microscope, coarse, settings.seed)
    samples = microscope.object.samples_per_lenslet
    optics, plan = finer(
        coarse, samples, settings.refine, settings.accuracy or DEFAULT_ACCURACY, settings.model
    )
    note(f"about {plan.seconds:.2g} s on one core for {len(plan.reach)} planes ({plan.rung})")
    with bar(None, len(plan.reach), "planes") as shown:
        found = record(
            optics, plan, microscope.lenslet_array.count, specimen, settings.refine, shown.update
        )
    capture, saturated = _detected(microscope, found.light, settings, volume)
    provenance = Provenance(
        command=command,
        inputs=describe_inputs({"camera": path, "volume": file}),
        seed=settings.seed,
        config=microscope_toml(microscope),
        accuracy={"asked": plan.asked, "estimated": plan.error, "rung": plan.rung},
    )
    with together():
        write_capture(output, capture, provenance, overwrite=overwrite)
        if scene_out:
            spacing = [coarse.object_pitch / n for n in samples]
            write_volume(
                scene_out, found.volume, np.array(coarse.depths), spacing, provenance, overwrite
            )
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


def write_volume(
    path: str | Path,
    value: np.ndarray,
    depth: np.ndarray,
    spacing: list[float],
    provenance: object,
    overwrite: bool,
) -> None:
    """A volume that is known, as its artefact (.h5) or OME-TIFF."""
    from plenocli.files.artefacts.container import write_artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.images.tiff_stack import write_ome_tiff
    from plenocli.files.results.volumes import truth_artefact

    assert isinstance(provenance, Provenance)
    if Path(path).suffix.lower() in (".tif", ".tiff"):
        rows, columns = spacing
        write_ome_tiff(path, value, None, depth, (rows, columns), overwrite=overwrite)
        return
    artefact = truth_artefact(value, depth, np.tile(spacing, (len(depth), 1)), provenance)
    write_artefact(path, artefact, overwrite=overwrite)


def _require_taken(settings: Settings) -> None:
    """UsageError where settings ask for what a volume's capture does not have."""
    plain = Settings(**{name: getattr(settings, name) for name in TAKEN})
    for name in (field.name for field in fields(settings)):
        if getattr(settings, name) != getattr(plain, name):
            raise UsageError(
                "does not go with --volume", f"--{name.replace('_', '-')}", "leave one of them out"
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
    half = (deep, rows * pitch / 2, columns * pitch / 2)
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
    microscope: Microscope, light: np.ndarray, settings: Settings, name: str
) -> tuple[Capture, float | None]:
    """What the sensor reports, and the share of its pixels over full well."""
    from plenocli.base.random_streams import stream
    from plenocli.base.tiling import to_plane
    from plenocli.forward.sensor.capture import SuperpixelGrid
    from plenocli.forward.sensor.exposure import (
        WHITE_LEVEL,
        ExposureScale,
        exposed_capture,
        relative_capture,
    )

    sensor = microscope.sensor
    if not light.any():
        raise InputError(
            "puts no light on the sensor", name, "give a volume within the planes and the field"
        )
    # rounding of transforms leaves dark pixels below zero
    mosaic = to_plane(np.maximum(light, 0), sensor.pixels_per_lenslet) * sensor.quantum_efficiency
    rng = stream(settings.seed, "capture-sim of a volume")
    saturated = None
    if settings.snr_db is not None or settings.noise == "none":
        capture = relative_capture(sensor, mosaic, settings.options, rng)
    else:
        usual = microscope.light.white_exposure
        seconds = settings.exposure or sensor.exposure or usual
        full = WHITE_LEVEL * sensor.full_well / float(mosaic.max())
        scale = ExposureScale(full * seconds / usual, seconds)
        capture, saturated = exposed_capture(sensor, mosaic, scale, name, rng)
    grid = SuperpixelGrid.tiled(microscope.lenslet_array.count, sensor.pixels_per_lenslet)
    about = replace(capture.metadata, target=Path(name).name)
    return replace(capture, grid=grid, metadata=about), saturated
