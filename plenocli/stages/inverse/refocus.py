"""refocus: views, pictures focused at other distances and depth maps of captures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import one_thread
from plenocli.base.errors import UsageError
from plenocli.base.text import Record
from plenocli.base.tiling import EVERYTHING, Plane
from plenocli.execution.batch import outcomes, plan_batch, summarise
from plenocli.execution.pool import open_pool

if TYPE_CHECKING:
    from plenocli.execution.batch import BatchSummary
    from plenocli.files.bench import Bench
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.sensor.light_meter import Light
    from plenocli.inverse.lightfield.optics import MicroscopeOptics, Optics
    from plenocli.inverse.lightfield.planes import DepthMap, LightField
    from plenocli.inverse.lightfield.samples import SampleBands

LARGE = 64
"""Bands of samples, times planes, from which on what is finished is kept: some seconds of work."""


@dataclass(frozen=True, kw_only=True)
class RefocusSummary(Record):
    """What refocus made.

    capture, output: files.
    lenslets: rows and columns of a picture, in lenslet pitches.
    channels: colours or bands; none of a grey capture.
    sharpest_slope: of the plane whose picture is the sharpest, px per px.
    slopes, sharpness: of every plane.
    sharpest_distance_m: None without a camera or beyond infinity.
    depth_known_share: of the depth map; None without one.
    depth_beyond_share: of the depth map, with texture but beyond the slopes tried.
    """

    capture: str
    output: str
    planes: int
    lenslets: list[int]
    channels: list[str]
    sharpest_slope: float
    slopes: list[float]
    sharpness: list[float]
    sharpest_distance_m: float | None
    depth_known_share: float | None
    depth_beyond_share: float | None


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How captures are refocused.

    calibration: their lenslet grid and white image; a simulated capture needs none.
    camera: description (.toml), of a photographic camera or a microscope, that turns slopes into
        distances.
    distances: of planes in front of the main lens, or depths before an objective, m (needs
        `camera`).
    slopes: of planes; without either, `planes` slopes around the lenslets' own plane, and more
        of them, as far apart, while what has texture lies beyond. A depth map needs at least three
        planes.
    views: along each side, 0 for none.
    """

    calibration: Path | None = None
    camera: Path | None = None
    distances: tuple[float, ...] = ()
    slopes: tuple[float, ...] = ()
    planes: int = 13
    views: int = 3


def run_refocus(
    captures: Sequence[Path | str],
    output: Path | str,
    settings: Settings = Settings(),
    *,
    suffix: str = ".h5",
    workers: int = 1,
    overwrite: bool = False,
    command: str = "",
) -> BatchSummary:
    """Refocus captures: one gives the file `output` (.h5, OME-TIFF or .exr), several a folder with
    one file each, in which finished ones are skipped unless overwrite. One that fails does not stop
    the others.

    captures: mosaics, raw files, capture artefacts or spectra of demux; folders and patterns of
        them.
    suffix: of the files in a folder.
    workers: captures at the same time, in threads; the results do not depend on it.

    Raises UsageError, InputError, OutputError; at the end, with the exit code of the worst, where
    some of several failed.
    """
    from plenocli.files.read.captures import named_captures
    from plenocli.files.results.lightfields import SUFFIXES

    others = [settings.calibration, settings.camera]
    captures = named_captures(captures, others)
    batch = plan_batch(
        captures,
        output,
        suffix,
        "planes are",
        overwrite=overwrite,
        inputs=[*captures, *others],
        suffixes=SUFFIXES,
    )
    if not batch.todo:
        return summarise(batch, ())
    optics = None if settings.camera is None else _optics(settings.camera)
    tried = _slopes(settings, optics)
    targets = dict(batch.todo)
    work = partial(_refocused, targets=targets, settings=settings, optics=optics, tried=tried)
    write = partial(_write, overwrite=overwrite, command=command)
    with (
        one_thread(),
        open_pool(min(workers, len(batch.todo)), None, threads=True) as pool,
    ):
        return summarise(batch, outcomes(batch, pool, work, write))


def _optics(camera: Path) -> Optics | MicroscopeOptics:
    from plenocli.files.config.camera_file import describes_microscope
    from plenocli.files.config.microscope_file import load_microscope
    from plenocli.files.read.cameras import read_camera
    from plenocli.inverse.lightfield.optics import MicroscopeOptics, Optics

    if describes_microscope(camera):
        return MicroscopeOptics.of(load_microscope(camera))
    return Optics.of(read_camera(camera))


def _refocused(
    capture: Path,
    *,
    targets: Mapping[Path, Path],
    settings: Settings,
    optics: Optics | MicroscopeOptics | None,
    tried: np.ndarray,
) -> _Refocused:
    """The light field of one capture, kept beside its file meanwhile, and of a large one all that
    is finished, for a run after one that was killed.
    """
    from plenocli.base.tiling import FORGETFUL
    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.scratch import Scratch
    from plenocli.inverse.lightfield.light_field import refocused

    target = targets[capture]
    source, light = _source(capture, settings.calibration, target)
    inputs = describe_inputs(
        {"capture": capture, "calibration": settings.calibration, "camera": settings.camera}
    )
    bench = _bench(
        target, source, tried, (replace(settings, calibration=None, camera=None), inputs)
    )
    field = refocused(
        source,
        tried,
        views=settings.views,
        optics=optics,
        grow=not (settings.slopes or settings.distances),
        room=Scratch(target, bench),
        keeper=bench or FORGETFUL,
    )
    if light is not None:
        light.tell(capture.name)
    return _Refocused(field=field, source=source, inputs=inputs)


@dataclass(frozen=True, kw_only=True)
class _Refocused:
    """A light field, and what it was made from."""

    field: LightField
    source: SampleBands
    inputs: dict[str, dict[str, str]]


def _bench(target: Path, source: SampleBands, tried: np.ndarray, depends: Any) -> Bench | None:
    """Where what is finished is kept until the result is written; None of a small capture.

    depends: all that it depends on, beside the code and how the capture is cut into bands.
    """
    from plenocli.files.bench import Bench

    if len(source.rows) * len(tried) < LARGE:
        return None
    return Bench.beside(target, (depends, source.rows))


def _write(
    done: _Refocused,
    capture: Path,
    target: Path,
    *,
    overwrite: bool,
    command: str,
) -> RefocusSummary:
    """Write one light field."""
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.bench import clear
    from plenocli.files.results.lightfields import write_lightfield

    field, source = done.field, done.source
    provenance = Provenance(command=command, inputs=done.inputs, seed=0)
    write_lightfield(target, field, source, provenance, overwrite=overwrite)
    clear(target)
    known, beyond = _told(field.depth, field.slopes)
    best = int(np.argmax(field.sharpness))
    distance = np.nan if field.distances is None else float(field.distances[best])
    return RefocusSummary(
        capture=str(capture),
        output=str(target),
        planes=len(field.slopes),
        lenslets=list(source.shape),
        channels=[] if field.colours is None else list(field.colours.channels.names),
        sharpest_slope=float(field.slopes[best]),
        slopes=field.slopes.tolist(),
        sharpness=field.sharpness.tolist(),
        sharpest_distance_m=None if np.isnan(distance) else distance,
        depth_known_share=known,
        depth_beyond_share=beyond,
    )


def _source(
    capture: Path, calibration: Path | None, target: Path
) -> tuple[SampleBands, Light | None]:
    """Samples of a capture and the light on its pixels, or those of spectra that demux made of one,
    on the way to `target`.
    """
    from plenocli.files.images.mosaic import capture_in_file
    from plenocli.files.opened_file import open_file
    from plenocli.files.read.calibrations import read_calibration, read_images
    from plenocli.files.results.results import read_result
    from plenocli.files.scratch import Scratch
    from plenocli.forward.sensor.light_meter import Light
    from plenocli.inverse.lightfield.gather import bands_of, samples_of_spectra
    from plenocli.inverse.lightfield.samples import SampleBands

    if open_file(capture).kind == "spectra":
        if calibration is None:
            raise UsageError(
                "holds spectra, and the calibration knows through which part of the pupil each "
                "band came",
                capture,
                "give --calibration, the one of demux",
            )
        spectra = read_result(capture, ("spectra",))
        assert spectra.wavelengths is not None
        known = read_calibration(calibration)
        found = samples_of_spectra(spectra.values, spectra.wavelengths, known, where=calibration)
        return SampleBands.of(*found), None
    images = None if calibration is None else read_images(calibration)
    shot = capture_in_file(capture, small=False, room=Scratch(target))
    samples = bands_of(shot, images, where=calibration)
    dark = None if images is None else images.dark
    white = min(shot.levels.white, np.inf if images is None else images.sensor.white_level)
    return samples, Light.of(_seen(shot, None if dark is None else Plane.of(dark.mean), white))


def _seen(
    shot: Capture, dark: Plane | None, white: float
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Light of some rows of a capture after the other, and which of their pixels are saturated.

    dark: what the sensor reports without light, None: its black level.
    white: where the sensor saturates.
    """
    from plenocli.forward.sensor.frames import saturated

    for rows in Plane.of(shot.mosaic).in_bands(2):  # levels go by the parity of rows
        part = shot.window(rows, EVERYTHING)
        light = part.signal() if dark is None else part.mosaic - dark.read(rows, EVERYTHING)
        yield light, saturated(part.mosaic, part.levels.black, white)


def _told(depth: DepthMap | None, slopes: np.ndarray) -> tuple[float | None, float | None]:
    """Shares of a depth map that are known and that lie beyond the slopes, which a note tells."""
    from plenocli.base.progress import note

    if depth is None:
        return None, None
    beyond = depth.beyond or 0.0
    if beyond > 0:
        note(
            f"{100 * beyond:.3g} % of the depth map has texture but lies beyond slopes "
            f"{slopes[0]:.3g} to {slopes[-1]:.3g}: unknown there"
        )
    return float(np.isfinite(depth.slope).mean()), beyond


def _slopes(settings: Settings, optics: Optics | MicroscopeOptics | None) -> np.ndarray:
    """Slopes of the planes asked for, rising, each once."""
    from plenocli.inverse.lightfield.light_field import usual_slopes
    from plenocli.inverse.lightfield.optics import Optics

    slopes: Sequence[float] = settings.slopes
    if slopes and settings.distances:
        raise UsageError(
            "give planes as --distance or as --slope, not both", "--slope", "leave one of them out"
        )
    if settings.distances:
        if optics is None:
            raise UsageError(
                "distances need the camera's description",
                "--distance",
                "give --camera, or name planes by --slope",
            )
        if min(settings.distances) <= 0 and isinstance(optics, Optics):
            raise UsageError(
                "planes before a main lens are farther than 0",
                "--distance",
                "give for example 500mm",
            )
        slopes = [optics.slope(d) for d in settings.distances]
    elif not slopes:
        slopes = usual_slopes(settings.planes).tolist()
    return np.array(sorted(set(float(s) for s in slopes)))
