"""capture-sim: source -> optics -> detector, one exposure of a plenoptic camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.progress import note
from plenocli.base.tiling import InParts
from plenocli.files.read.cameras import camera_files
from plenocli.files.read.scenes import read_polarised, read_scene
from plenocli.forward.camera.sections.sensor import Sensor
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.scene.scenes import Chart, Scene, Uniform
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.exposure.matrices import (
    StoredField,
    StoredMatrix,
    planned_accuracy,
    stored_field,
)
from plenocli.forward.sensor.exposure.simulate import (
    SimulatedCapture,
    dark_capture,
    require_memory_for,
    require_tiling,
    simulate_capture,
)
from plenocli.stages.forward.capture_settings import CaptureSummary, Settings
from plenocli.stages.forward.kept_matrices import KeptMatrices

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature


def run_capture_sim(
    camera_path: str | Path,
    output: str | Path,
    settings: Settings,
    *,
    scene: str | Path | None = None,
    volume: str | None = None,
    layers: Sequence[str] = (),
    pif: str | Path | None = None,
    scene_out: str | Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CaptureSummary:
    """Simulate one capture and write it.

    camera_path: description of the camera, .toml.
    output: .h5, .exr or .dng.
    scene: what read_scene takes; None where the settings have a target.
    volume: what run_volume_capture takes, before a camera with an [objective].
    layers: opaque pictures before a photographic camera, PICTURE@DISTANCE each.
    pif: artefact whose system matrix is used instead of a computed one.
    scene_out: also write the object as sampled, .h5 or .exr.
    overwrite: replace files that are there.
    command: for the provenance.

    Returns what was written.
    Raises ConfigError where the camera does not tile the sensor, UsageError for contradicting
    options, InputError for files, OutputError where one cannot be written.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import together
    from plenocli.files.config.camera_file import describes_microscope, to_toml
    from plenocli.files.images.mosaic import write_capture
    from plenocli.files.read.cameras import read_camera

    if volume is not None or layers or describes_microscope(camera_path):
        return _of_volume(
            camera_path,
            output,
            settings,
            volume,
            layers,
            {"--scene": scene, "--pif": pif, "--polarisation": settings.polarisation},
            scene_out=scene_out,
            overwrite=overwrite,
            command=command,
        )
    output = Path(output)
    others = {"pif": pif, "scene": _file(scene), "polarisation": _file(settings.polarisation)}
    _check_outputs(output, scene_out, settings, [camera_path, *others.values()], overwrite)
    camera = read_camera(camera_path)
    options = settings.options
    require_tiling(camera, camera_path)
    in_parts = output.suffix == ".h5" and Path(scene_out or "").suffix != ".exr"
    polarised = settings.polarisation is not None
    require_memory_for(camera, options, camera_path, in_parts=in_parts, polarised=polarised)
    source, what = _source(camera, settings, scene)
    name = settings.target or str(scene)
    found, accuracy = _exposed(camera, camera_path, settings, source, what, pif, name, in_parts)
    provenance = Provenance(
        command=command,
        inputs=describe_inputs(camera_files(camera_path, camera) | others),
        seed=settings.seed,
        config=to_toml(camera),
        accuracy=accuracy,
    )
    truth, bands = found.scene, found.wavelengths
    with together():
        write_capture(
            output,
            found.capture,
            provenance,
            scene=truth,
            wavelengths=bands,
            degree=found.degree,
            overwrite=overwrite,
        )
        if scene_out:
            _write_scene(scene_out, truth, bands, provenance, overwrite)
    return _summary(output, found, len(source.wavelengths))


def _exposed(
    camera: Camera,
    camera_path: str | Path,
    settings: Settings,
    source: Quadrature,
    scene: Scene,
    pif: str | Path | None,
    name: str,
    in_parts: bool,
) -> tuple[SimulatedCapture, dict[str, Any]]:
    """(the exposure, the accuracy record of its matrices)."""
    options = settings.options
    if settings.target == "dark" and not pif:
        found = dark_capture(camera, options, in_parts=in_parts)
        if found is not None:
            return found, {}
    store = _kept_matrices(camera, camera_path)
    if pif:
        matrices, accuracy = _read_pif(pif, camera, settings, source.wavelengths, camera_path)
    else:
        missing = store.missing(camera, source.wavelengths, options)
        planned = planned_accuracy(camera, options, source.wavelengths, missing)
        matrices, accuracy = None, planned.as_json()
    record = AccuracyRecord.from_json(accuracy)
    _tell_of_the_field(record)
    if record is None or record.model != "ray":
        _tell_of_the_points(camera, options.refine)
    found = simulate_capture(
        camera,
        source,
        scene,
        options,
        matrices=matrices,
        build=store.build,
        name=name,
        band_m=_band(settings.target),
        in_parts=in_parts,
    )
    return found, accuracy


def _file(name: str | Path | None) -> str | Path | None:
    """The name, where it is that of a file or folder."""
    return name if name and Path(name).exists() else None


def _of_volume(
    camera_path: str | Path,
    output: str | Path,
    settings: Settings,
    volume: str | None,
    layers: Sequence[str],
    others: dict[str, str | Path | None],
    *,
    scene_out: str | Path | None,
    overwrite: bool,
    command: str,
) -> CaptureSummary:
    """The capture of a volume or of layers; UsageError where one is not what the other needs."""
    from plenocli.files.config.camera_file import describes_microscope
    from plenocli.stages.forward.volume_capture import run_volume_capture

    microscope = describes_microscope(camera_path)
    if microscope and (volume is None or layers):
        raise UsageError(
            "has an [objective], before which a volume lies",
            camera_path,
            "give --volume, for example --volume phantom:beads",
        )
    if not microscope and volume is not None:
        raise UsageError(
            "has no [objective], before which a volume would lie",
            camera_path,
            "give --scene, --target or --layer instead of --volume",
        )
    for option, value in others.items():
        if value is not None:
            given = "--layer" if layers else "--volume"
            raise UsageError(f"does not go with {given}", option, "leave one of them out")
    return run_volume_capture(
        camera_path,
        output,
        settings,
        volume,
        layers,
        scene_out=scene_out,
        overwrite=overwrite,
        command=command,
    )


def _check_outputs(
    output: Path,
    scene_out: str | Path | None,
    settings: Settings,
    inputs: list[str | Path | None],
    overwrite: bool,
) -> None:
    """UsageError or OutputError, before any work, where the files cannot be written."""
    from plenocli.files.atomic import check_output

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
    check_output(output, overwrite=overwrite, inputs=inputs)
    if scene_out:
        check_output(
            scene_out,
            overwrite=overwrite,
            inputs=inputs,
            others=[output],
            suffixes=(".h5", ".exr"),
        )


def _summary(output: Path, found: SimulatedCapture, wavelengths: int) -> CaptureSummary:
    capture, relative = found.capture, found.saturated is None
    peak = found.tally.peak
    return CaptureSummary(
        output=output,
        rows=capture.shape[0],
        columns=capture.shape[1],
        wavelengths=wavelengths,
        units=capture.units,
        peak=float(peak) if relative else int(peak),
        noise_sigma=capture.noise.sigma if capture.noise and relative else None,
        saturated=found.saturated,
        exposure_s=capture.exposure_s,
    )


def _band(target: str | None) -> float | None:
    """Centre of the band that --target mono names, m."""
    from plenocli.base.units import parse_length

    if target is None or not target.startswith("mono:"):
        return None
    return parse_length(target.removeprefix("mono:"))


def _source(
    camera: Camera, settings: Settings, scene: str | Path | None
) -> tuple[Quadrature, Scene]:
    """The light, and what is in front of the camera, from --target, --scene and --polarisation."""
    source, what = _light_and_scene(camera, settings, scene)
    if settings.polarisation is None:
        return source, what
    return source, read_polarised(what, settings.polarisation, camera, settings.sampling)


def _light_and_scene(
    camera: Camera, settings: Settings, scene: str | Path | None
) -> tuple[Quadrature, Scene]:
    """The same of light that is not polarised."""
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


_OF_THE_DETECTOR = {"lenslet_array": {"count"}, "sensor": Sensor.DETECTION}
"""What may differ, by section, between a capture's camera and the one that a pif was made for."""


def _tell_of_the_field(record: AccuracyRecord | None) -> None:
    """Say where one matrix for all lenslets is further off at the array's corner than it is said to
    be.
    """
    if record is not None and (record.field_error or 0) > (record.asked or 1):
        note(
            "all lenslets are simulated as the one on the axis: at the array's corner that is off "
            f"by about {record.field_error:.1g} of a column"
        )


def _tell_of_the_points(camera: Camera, refine: int) -> None:
    """Say where points are so far apart that light from between them is missed: even fields of six
    cameras were off by 0.02 to 0.2 of a superpixel with less than half a point a diffraction cell,
    by at most 0.004 with 0.6.
    """
    from plenocli.forward.camera.geometry import geometry

    cells = geometry(camera, camera.light.design_wavelength).diffraction_cells
    points = min(camera.object.samples_per_lenslet)
    if points * refine >= cells / 2:
        return
    enough = math.ceil(0.6 * cells / points)
    note(
        f"{points * refine} points a side stand for a lenslet's field of {cells:.0f} diffraction "
        "cells: of light between the lenslets up to a fifth of a superpixel's is missed, which "
        "simulate-response and real captures have; "
        + (f"--refine {enough} has it" if enough <= 8 else "more samples_per_lenslet have it")
    )


def _kept_matrices(camera: Camera, path: str | Path) -> KeptMatrices:
    """Where matrices of a camera are kept, by the files that its description at `path` names."""
    from plenocli.files.artefacts.provenance import describe_inputs

    files = {k: v for k, v in camera_files(path, camera).items() if k != "camera"}
    told = describe_inputs(files)
    return KeptMatrices({role: about["sha256"] for role, about in told.items()})


def _read_pif(
    path: str | Path,
    camera: Camera,
    settings: Settings,
    wavelengths: np.ndarray,
    camera_path: str | Path,
) -> tuple[dict[float, StoredMatrix | StoredField], dict[str, Any]]:
    """(system matrices by wavelength, accuracy record) from a pif artefact; InputError where it
    belongs to another camera or lacks a wavelength.
    """
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.artefacts.shards import PIF_KINDS, read_field, read_pif, shapes_of
    from plenocli.files.config.camera_file import parse_camera
    from plenocli.files.read.cameras import require_same_files

    for option, given in (
        ("--refine", settings.refine != 1),
        ("--field-nodes", settings.field_nodes is not None),
    ):
        if given:
            raise UsageError(
                f"{option} computes its own finer system matrix and cannot take --pif",
                fix="leave one of them out",
            )
    field = read_artefact(path, PIF_KINDS).kind == "pif-field"
    nodes, parts = read_field(path) if field else (None, [read_pif(path, camera.object.distance)])
    artefact = parts[0]
    made_for = parse_camera(artefact.provenance.config, path)
    for section in ("main_lens", "object", "lenslet_array", "sensor", "filter_array", "fitted"):
        drop = set(_OF_THE_DETECTOR.get(section, ()))
        ours, theirs = getattr(camera, section), getattr(made_for, section)
        if (ours and ours.model_dump(exclude=drop)) != (theirs and theirs.model_dump(exclude=drop)):
            raise InputError(
                f"was made for another camera: [{section}] differs",
                path,
                "run simulate-pif on this camera",
            )
    require_same_files(camera_path, camera, artefact, path)
    if camera.light.polarisation != made_for.light.polarisation:
        raise InputError(
            "was made for light of another polarisation", path, "run simulate-pif on this camera"
        )
    known, offsets = (artefact.data[f"pif/{part}"] for part in ("wavelength", "lenslet_offset"))
    shapes = shapes_of(artefact, path)
    stored: dict[float, StoredMatrix | StoredField] = {}
    for wavelength in wavelengths:
        band = int(np.argmin(np.abs(known - wavelength)))
        if abs(known[band] - wavelength) > 1e-12:
            raise InputError(
                f"has no wavelength {wavelength * 1e9:.4g} nm, which this capture needs",
                path,
                "run simulate-pif with the same --spectral-step, or leave --pif out",
            )
        matrices = [part.data["pif/A"][band] for part in parts]
        stored[wavelength] = (
            StoredMatrix(matrices[0], offsets)
            if nodes is None
            else stored_field(nodes, matrices, offsets, shapes)
        )
    return stored, artefact.provenance.accuracy


def _write_scene(
    path: str | Path,
    truth: np.ndarray | InParts,
    wavelengths: np.ndarray,
    provenance: Provenance,
    overwrite: bool,
) -> None:
    """The object as sampled, an `image` artefact or EXR: one picture, or one a band of
    [light] wavelengths.
    """
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    texts, path = provenance_texts(provenance), Path(path)
    count = truth.shape[0]
    if path.suffix == ".exr" and not isinstance(truth, InParts) and count == 1:
        write_exr(path, {"Y": truth[0]}, texts, overwrite=overwrite)
    elif path.suffix == ".exr" and not isinstance(truth, InParts):
        write_spectral_exr(
            path, wavelengths, truth, "reflectance", attrs=texts, overwrite=overwrite
        )
    else:
        if isinstance(truth, InParts):
            one: Any = replace(truth, shape=truth.shape[-2:])
        else:
            one = truth[0]
        data = (
            {"image/value": one}
            if count == 1
            else {"image/value": truth, "image/wavelength": wavelengths}
        )
        attrs = {"image": {"method": "object as sampled"}}
        write_artefact(path, Artefact("image", data, attrs, provenance), overwrite=overwrite)
