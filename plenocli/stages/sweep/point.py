"""One point of a sweep: a camera carried through the stages, from its description to the figures of
score.

Its files live in a folder of their own while it lasts; only figures are kept. Every figure is
reproducible: what a matrix costs is counted by its plan at nominal rates; the seconds that were
measured stand apart.
"""

import contextlib
import errno
import os
import socket
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import OutputError, PlenoError
from plenocli.base.progress import collected_notes
from plenocli.evaluation.metrics.classes import DEFINITIONS as CLASSES
from plenocli.stages.sweep.task import (
    OWN_MATRIX,
    Job,
    MadeCapture,
    MadeMatrix,
    MatrixCost,
    Options,
    PointResult,
    Task,
    refused,
)

if TYPE_CHECKING:
    from plenocli.stages.sweep.task import Description

_SEEDS = {"white": 1_000_001, "classes": 2_000_001, "picture": 2_000_002}
_DARK, _BAND = 1_000_002, 1_000_003
"""Seeds of the captures beside the first, over its seed: no two draw the same noise."""

_MACHINE = (errno.EIO, errno.EAGAIN, errno.ENOMEM, errno.EMFILE, errno.ENFILE)


def _require_files(job: Job) -> None:
    """OutputError where this process does not see what the job names: then it is not the design
    that is at fault.
    """
    shared = [job.matrix.path] if job.matrix else []
    shared += job.capture.paths if job.capture else []
    for path in (*job.files, *shared):
        if not os.path.exists(path):
            raise OutputError(
                f"{socket.gethostname()} does not see this file",
                path,
                "workers need the same files under the same names: put them on a file "
                "system that all share",
            )


def run_matrix(job: Job) -> MadeMatrix:
    """The system matrix of a job.

    Raises PlenoError.
    """
    _require_files(job)
    with _folder(job) as folder, collected_notes() as notes:
        try:
            cost = _simulate_pif(job.task, folder)
        except PlenoError as error:
            raise _elsewhere(error, folder) from None
        return MadeMatrix(
            (folder / "pif.h5").read_bytes(), replace(cost, notes=_without(folder, notes))
        )


def run_capture(job: Job) -> MadeCapture:
    """The captures of a job, by the matrix that its options of capture-sim ask for.

    Raises PlenoError.
    """
    _require_files(job)
    start = time.process_time()
    with _folder(job) as folder, collected_notes() as notes:
        try:
            paths = _captures(job.task, folder, None)
        except PlenoError as error:
            raise _elsewhere(error, folder) from None
        return MadeCapture(
            tuple(p.read_bytes() for p in paths),
            _without(folder, notes),
            time.process_time() - start,
        )


def run_point(job: Job) -> PointResult:
    """The figures of a job.

    A camera or an option that a stage refuses is a result like any other.

    Raises OutputError, which keeps files from being written.
    """
    start = time.process_time()
    _require_files(job)
    with _folder(job) as folder, collected_notes() as notes:
        run = _Run(job=job, folder=folder)
        try:
            metrics = _CHAINS[job.task.chain](run)
            design = _design(folder / "camera.toml", run.cost)
            found = PointResult(metrics=design | run.light | metrics)
        except PlenoError as caught:
            error = _elsewhere(caught, folder)
            if isinstance(error, OutputError):
                raise error from None
            found = refused(error)
        before = [
            *(job.matrix.cost.notes if job.matrix else ()),
            *(job.capture.notes if job.capture else ()),
        ]
        return replace(
            found,
            notes=_without(folder, [*before, *notes]),
            seconds=time.process_time() - start,
            stages=run.seconds,
        )


@dataclass(kw_only=True)
class _Run:
    """A job under way in its folder.

    cost: of its matrix, None before there is one.
    light: figures of the first capture.
    seconds: of the processor, by stage.
    """

    job: Job
    folder: Path
    cost: MatrixCost | None = None
    light: dict[str, float] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def task(self) -> Task:
        """What is to be done."""
        return self.job.task

    @contextlib.contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Seconds of the processor while the block lasts are those of the stage."""
        start = time.process_time()
        try:
            yield
        finally:
            spent = time.process_time() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + spent

    def matrix(self) -> Path:
        """The system matrix, computed here unless it is shared."""
        shared = self.job.matrix
        if shared is not None:
            self.cost, self.seconds["simulate-pif"] = shared.cost, shared.cost.cpu_seconds
            return Path(shared.path)
        self.cost = _simulate_pif(self.task, self.folder)
        self.seconds["simulate-pif"] = self.cost.cpu_seconds
        return self.folder / "pif.h5"

    def captures(self, pif: Path | None) -> dict[str, Path]:
        """The captures of the chain by their names in Task.shown, simulated here unless they are
        shared.
        """
        shared = self.job.capture
        if shared is not None:
            self.seconds["capture-sim"] = shared.cpu_seconds
            paths = [Path(path) for path in shared.paths]
        else:
            with self.stage("capture-sim"):
                paths = _captures(self.task, self.folder, pif)
        self.light = _light(paths[0])
        return dict(zip(self.task.shown, paths, strict=True))

    def score(self, result: str, **truth: Any) -> dict[str, float]:
        """Figures of a result that are numbers."""
        from plenocli.stages.evaluation.score.run import run_score

        options = dict(self.task.options("score"))
        names = [name for name in options if name in ("classes", "detect", "learnt")]
        classes: dict[str, Any] = {name: options.pop(name) for name in names}
        if truth.get("truth") in (None, classes.get("classes")):
            options |= classes  # a chart of them, or what a response lets expect of them
        output = (self.folder / result).with_suffix(".json")
        with self.stage("score"):
            document = run_score([self.folder / result], output, **truth, **options)
        return {
            name: float(value)
            for name, value in document.figures.items()
            if isinstance(value, (int, float)) and not isinstance(value, bool)
        }


def _elsewhere(error: PlenoError, folder: Path) -> PlenoError:
    """The error without the folder of this run, so that it reads the same wherever it happened; an
    OutputError where the machine failed, which is no design's fault.
    """
    kind: type[PlenoError] = type(error)
    cause: BaseException | None = error
    while cause is not None:
        if isinstance(cause, OSError) and cause.errno in _MACHINE:
            kind = OutputError
        cause = cause.__cause__ or cause.__context__
    return kind(
        *(
            None if part is None else part.replace(f"{folder}/", "")
            for part in (error.what, error.where, error.fix)
        )
    )


@contextlib.contextmanager
def _folder(job: Job) -> Iterator[Path]:
    """A folder for the files of a job, with its camera, while the block lasts."""
    with contextlib.ExitStack() as stack:
        try:
            folder = Path(
                stack.enter_context(
                    tempfile.TemporaryDirectory(
                        prefix="plenocli-", dir=job.scratch, ignore_cleanup_errors=True
                    )
                )
            )
            (folder / "camera.toml").write_text(job.task.camera, encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"cannot be written ({error.strerror})",
                job.scratch or tempfile.gettempdir(),
                "free some space there, then run again: what is finished is kept",
            ) from None
        yield folder


def _without(folder: Path, texts: Iterable[str]) -> tuple[str, ...]:
    """Texts without the folder of this run, each once."""
    return tuple(dict.fromkeys(text.replace(f"{folder}/", "") for text in texts))


def _simulate_pif(task: Task, folder: Path) -> MatrixCost:
    from plenocli.stages.forward.pif_summary import PifSummary
    from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif
    from plenocli.stages.forward.simulate_stack import StackSummary

    start = time.process_time()
    report = run_simulate_pif(
        folder / "camera.toml", folder / "pif.h5", _settings(Settings, task.options("simulate-pif"))
    )
    assert isinstance(report, PifSummary | StackSummary)  # nothing was to be explained
    cost = report.plan if isinstance(report, StackSummary) else report
    return MatrixCost(
        matrix_seconds=cost.nominal_seconds,
        matrix_bytes=cost.bytes,
        cpu_seconds=time.process_time() - start,
    )


def _settings(kind: Any, values: Options) -> Any:
    """A Settings of a stage from what JSON keeps of its options."""
    values = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if name in kind.__dataclass_fields__
    }
    return kind(**values)


def _capture(
    task: Task,
    folder: Path,
    name: str,
    pif: Path | None,
    *,
    seed: int = 0,
    scene_out: Path | None = None,
    **changes: Any,
) -> Path:
    """Simulate one capture into the folder; `seed`: added to that of the task."""
    from plenocli.stages.forward.capture_sim import Settings, run_capture_sim

    values = {**task.options("capture-sim"), **changes}
    scene = None if values.get("target") else values.get("scene")
    own = pif is None or values.keys() & OWN_MATRIX
    made = _settings(Settings, values | {"seed": values.get("seed", 0) + seed})
    run_capture_sim(
        folder / "camera.toml",
        folder / name,
        made,
        scene=scene,
        volume=values.get("volume"),
        pif=None if own else pif,
        scene_out=scene_out,
    )
    return folder / name


def _captures(task: Task, folder: Path, pif: Path | None) -> list[Path]:
    """The captures that a chain begins with."""
    if task.chain == "volume":
        truth = folder / "truth.h5"
        return [_capture(task, folder, "capture.h5", None, scene_out=truth), truth]
    return [
        _capture(task, folder, f"{name}.h5", pif, seed=_SEEDS.get(name, 0), **changes)
        for name, changes in task.shown.items()
    ]


def _light(capture: Path) -> dict[str, float]:
    """Figures of a capture that was simulated with the sensor's own noise."""
    from plenocli.files.images.mosaic import read_capture

    found = read_capture(capture)
    if found.units != "DN" or not found.levels.gain:
        return {}
    light = {"electrons_per_pixel": float(np.nanmean(found.signal())) / found.levels.gain}
    return light | ({} if found.exposure_s is None else {"exposure_s": found.exposure_s})


def _expected_light(response: Path) -> dict[str, float]:
    """The same figures of the white reference, as a predicted response has it."""
    from plenocli.files.read.calibrations import read_described
    from plenocli.inverse.calibration.calibration import there

    found = read_described(response, needs=("response", "white"))[0]
    gain, seconds = found.sensor.gain_e_per_dn, found.sensor.exposure
    mean = float(np.nanmean(there(there(found.white).superpixels)))
    light = {} if gain is None else {"electrons_per_pixel": mean * gain}
    return light | ({} if seconds is None else {"exposure_s": seconds})


def _spatial(run: _Run) -> dict[str, float]:
    pif = run.matrix()
    [capture] = run.captures(pif).values()
    return _picture(run, capture, pif)


def _joint(run: _Run) -> dict[str, float]:
    """Figures of spectra count by their names where a picture in bands has the same."""
    pif = run.matrix()
    captures = run.captures(pif)
    return _picture(run, captures["picture"], pif) | _spectra(run, captures, pif)


def _picture(run: _Run, capture: Path, pif: Path) -> dict[str, float]:
    from plenocli.stages.inverse.reconstruct.recipe import Settings
    from plenocli.stages.inverse.reconstruct.run import run_reconstruct

    options = dict(run.task.options("reconstruct"))
    if dictionary := options.get("dictionary"):
        options |= {"dictionary": Path(dictionary)}
    if overlap := options.get("overlap"):
        options |= {"overlap": int(overlap)}
    with run.stage("reconstruct"):
        run_reconstruct([capture], run.folder / "image.h5", _settings(Settings, options), pif=pif)
    return run.score("image.h5", truth=capture)


def _depth(run: _Run) -> dict[str, float]:
    from plenocli.base.units import format_length
    from plenocli.files.config.camera_file import load_camera
    from plenocli.stages.inverse.refocus import Settings, run_refocus

    camera = run.folder / "camera.toml"
    [capture] = run.captures(None).values()
    with run.stage("refocus"):
        run_refocus(
            [capture],
            run.folder / "planes.h5",
            _settings(Settings, dict(run.task.options("refocus")) | {"camera": camera}),
        )
    return run.score("planes.h5", truth=format_length(load_camera(camera).object.distance))


def _volume(run: _Run) -> dict[str, float]:
    from plenocli.stages.inverse.volume import run_volume

    pif = run.matrix()
    captures = run.captures(None)
    options = run.task.options("volume")
    with run.stage("volume"):
        run_volume(captures["capture"], run.folder / "volume.h5", pif, **options)
    return run.score("volume.h5", truth=captures["truth"])


def _spectral(run: _Run) -> dict[str, float]:
    pif = run.matrix() if run.task.needs_matrix else None
    return _spectra(run, run.captures(pif), pif)


def _spectra(run: _Run, captures: dict[str, Path], pif: Path | None) -> dict[str, float]:
    """Figures of the chart, and of the chart of classes where there is one."""
    from plenocli.stages.inverse.demux import Settings, run_demux

    task, folder, white = run.task, run.folder, captures["white"]
    by = "calibrate" if "calibrate" in task.settings else "simulate-response"
    with run.stage(by):
        response = (
            _measured(task, folder, pif, white) if by == "calibrate" else _predicted(task, folder)
        )
    options = dict(task.options("demux"))
    if prior := options.get("prior"):
        options |= {"prior": Path(prior)}
    (folder / "spectra").mkdir()
    with run.stage("demux"):
        wanted = [captures[name] for name in ("chart", "classes") if name in captures]
        single = folder / f"spectra/{wanted[0].stem}.h5"
        run_demux(
            wanted,
            single if len(wanted) == 1 else folder / "spectra",
            suffix=".h5",
            calibration=response,
            settings=_settings(Settings, {**options, "reference": white}),
        )
    camera = folder / "camera.toml"
    captured = {**task.options("capture-sim"), **task.shown["chart"]}
    shown = captured.get("target") or captured.get("scene")
    chart = f"spectra/{captures['chart'].stem}.h5"
    if shown == "colorchecker":
        found = run.score(chart, truth=shown, patches=shown, camera=camera)
    else:
        found = run.score(chart, truth=captures["chart"])
    if "classes" in captures:
        told = f"spectra/{captures['classes'].stem}.h5"
        known = task.options("score")["classes"]
        figures = run.score(told, truth=known, camera=camera)
        found |= {name: figures[name] for name in CLASSES if name in figures}
        own = ("rmse", "spectral_angle_deg", "delta_e_2000")
        found |= {f"class_{name}": figures[name] for name in own}
    return found


def _expected(run: _Run) -> dict[str, float]:
    """What the predicted response lets expect; nothing is captured."""
    with run.stage("simulate-response"):
        response = _predicted(run.task, run.folder)
    run.light = _expected_light(response)
    options = run.task.options("demux")
    given = {name: options[name] for name in ("method", "prior") if name in options}
    return run.score(response.name, **given)


_CHAINS = {
    "spatial": _spatial,
    "spectral": _spectral,
    "joint": _joint,
    "expected": _expected,
    "depth": _depth,
    "volume": _volume,
}


def _predicted(task: Task, folder: Path) -> Path:
    """The response predicted from the camera's description."""
    from plenocli.stages.forward.simulate_response import Settings, run_simulate_response

    run_simulate_response(
        folder / "camera.toml",
        folder / "response.h5",
        _settings(Settings, task.options("simulate-response")),
    )
    return folder / "response.h5"


def _measured(task: Task, folder: Path, pif: Path | None, white: Path) -> Path:
    """The response calibrated from captures of a white target under narrow-band light, as a real
    camera's is.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.stages.inverse.calibrate import run_calibrate

    dark = _capture(task, folder, "dark.h5", pif, target="dark", seed=_DARK)
    optics = {
        name: value
        for name, value in task.options("simulate-pif").items()
        if name in ("model", "accuracy", "superpixels", "coherent_ring")
    }
    bands = [
        (
            w,
            _capture(
                task,
                folder,
                f"band{i}.h5",
                None,
                target=f"mono:{w * 1e9:.9g}nm",
                seed=_BAND + i,
                **optics,
            ),
        )
        for i, w in enumerate(load_camera(folder / "camera.toml").light.wavelengths)
    ]
    run_calibrate(
        folder / "response.h5",
        whites=[white],
        darks=[dark],
        bands=bands,
        **task.options("calibrate"),
    )
    return folder / "response.h5"


def _design(camera_path: Path, cost: MatrixCost | None) -> dict[str, float]:
    """Figures of the design itself, those of DESIGN."""
    from plenocli.files.config.camera_file import describes_microscope, load_camera
    from plenocli.files.config.microscope_file import load_microscope

    camera: Description
    if describes_microscope(camera_path):
        microscope = camera = load_microscope(camera_path)
        planes = len(microscope.object.planes)
        field = microscope.lenslet_array.pitch / microscope.objective.magnification
    else:
        photographic = camera = load_camera(camera_path)
        array, planes = photographic.lenslet_array, 1
        field = array.pitch * photographic.object.distance / array.distance
    lenslets = camera.lenslet_array.count[0] * camera.lenslet_array.count[1]
    pixels, samples = camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet
    matrix = (
        {}
        if cost is None
        else {"matrix_seconds": cost.matrix_seconds, "matrix_bytes": float(cost.matrix_bytes)}
    )
    return matrix | {
        "lenslets": float(lenslets),
        "sensor_pixels": float(lenslets * pixels[0] * pixels[1]),
        "object_points": float(lenslets * samples[0] * samples[1] * planes),
        "lenslet_field_m": field,
    }
