"""One point of a sweep: a camera carried through the stages, from its description to the figures of
score.

Its files live in a folder of their own while it lasts; only figures are kept. Every figure is
reproducible: what a matrix costs is counted by its plan at nominal rates; the seconds that were
measured stand apart.
"""

import contextlib
import os
import socket
import tempfile
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from plenocli.base.errors import OutputError, PlenoError
from plenocli.base.progress import collected_notes
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

_WHITE, _DARK, _BAND = 1_000_001, 1_000_002, 1_000_003
"""Seeds of the captures beside the one of the scene, over its seed: no two draw the same noise."""


def _require_files(job: Job) -> None:
    """OutputError where this process does not see what the job names: then it is not the design
    that is at fault.
    """
    shared = [job.matrix.path] if job.matrix else []
    shared += job.capture.paths if job.capture else []
    for path in (*job.files, *shared):
        if not os.path.isfile(path):
            raise OutputError(
                f"{socket.gethostname()} does not see this file",
                path,
                (
                    "workers need the same files under the same names: put them on a file "
                    "system that all share"
                ),
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
            found = PointResult(metrics=_design(folder / "camera.toml", run.cost) | metrics)
        except OutputError:
            raise
        except PlenoError as error:
            found = refused(_elsewhere(error, folder))
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
    seconds: of the processor, by stage.
    """

    job: Job
    folder: Path
    cost: MatrixCost | None = None
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

    def captures(self, pif: Path | None) -> list[Path]:
        """The captures of the chain, that of the scene first, simulated here unless they are
        shared.
        """
        shared = self.job.capture
        if shared is not None:
            self.seconds["capture-sim"] = shared.cpu_seconds
            return [Path(path) for path in shared.paths]
        with self.stage("capture-sim"):
            return _captures(self.task, self.folder, pif)

    def score(self, result: str, **truth: Any) -> dict[str, float]:
        """Figures of a result that are numbers."""
        with self.stage("score"):
            return _score(self.task, self.folder, result, **truth)


def _elsewhere(error: PlenoError, folder: Path) -> PlenoError:
    """The error without the folder of this run, so that it reads the same wherever it happened."""
    return type(error)(
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
    from plenocli.stages.forward.simulate_pif import PifSummary, Settings, run_simulate_pif

    start = time.process_time()
    report = run_simulate_pif(
        folder / "camera.toml",
        folder / "pif.h5",
        _settings(Settings, task.options("simulate-pif")),
    )
    assert isinstance(report, PifSummary)  # nothing was to be explained
    return MatrixCost(
        matrix_seconds=report.nominal_seconds,
        matrix_bytes=report.bytes,
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
    task: Task, folder: Path, name: str, pif: Path | None, *, seed: int = 0, **changes: Any
) -> Path:
    """Simulate one capture into the folder; `seed`: added to that of the task."""
    from plenocli.stages.forward.capture_sim import Settings, run_capture_sim

    values = {**task.options("capture-sim"), **changes}
    scene = None if values.get("target") else values.get("scene")
    own = pif is None or values.keys() & OWN_MATRIX
    made = _settings(Settings, values | {"seed": values.get("seed", 0) + seed})
    run_capture_sim(
        folder / "camera.toml", folder / name, made, scene=scene, pif=None if own else pif
    )
    return folder / name


def _captures(task: Task, folder: Path, pif: Path | None) -> list[Path]:
    """The captures that a chain begins with: of the scene, and for spectra of a white target."""
    found = [_capture(task, folder, "capture.h5", pif)]
    if task.chain == "spectral":
        found.append(_capture(task, folder, "white.h5", pif, target="white", seed=_WHITE))
    return found


def _spatial(run: _Run) -> dict[str, float]:
    from plenocli.stages.inverse.reconstruct import Settings, run_reconstruct

    pif = run.matrix()
    [capture] = run.captures(pif)
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
    from plenocli.stages.inverse.refocus import run_refocus

    camera = run.folder / "camera.toml"
    [capture] = run.captures(None)
    with run.stage("refocus"):
        run_refocus(capture, run.folder / "planes.h5", camera=camera, **run.task.options("refocus"))
    return run.score("planes.h5", truth=format_length(load_camera(camera).object.distance))


def _spectral(run: _Run) -> dict[str, float]:
    from plenocli.stages.inverse.demux import Settings, run_demux

    task, folder = run.task, run.folder
    pif = run.matrix() if task.needs_matrix else None
    scene, white = run.captures(pif)
    by = "calibrate" if "calibrate" in task.settings else "simulate-response"
    with run.stage(by):
        response = (
            _measured(task, folder, pif, white) if by == "calibrate" else _predicted(task, folder)
        )
    with run.stage("demux"):
        run_demux(
            [scene],
            folder / "spectra.h5",
            calibration=response,
            settings=_settings(Settings, {**task.options("demux"), "reference": white}),
        )
    captured = task.options("capture-sim")
    shown = captured.get("target") or captured.get("scene")
    if shown == "colorchecker":
        return run.score(
            "spectra.h5",
            truth=shown,
            patches=shown,
            camera=folder / "camera.toml",
        )
    return run.score("spectra.h5", truth=scene)


_CHAINS = {"spatial": _spatial, "spectral": _spectral, "depth": _depth}


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


def _score(task: Task, folder: Path, result: str, **truth: Any) -> dict[str, float]:
    """Figures of a result that are numbers."""
    from plenocli.stages.evaluation.score import run_score

    document = run_score([folder / result], folder / "score.json", **truth, **task.options("score"))
    return {
        name: float(value)
        for name, value in document.figures.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }


def _design(camera_path: Path, cost: MatrixCost | None) -> dict[str, float]:
    """Figures of the design itself, those of DESIGN."""
    from plenocli.files.config.camera_file import load_camera

    camera = load_camera(camera_path)
    array = camera.lenslet_array
    lenslets = array.count[0] * array.count[1]
    pixels, samples = camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet
    matrix = (
        {}
        if cost is None
        else {
            "matrix_seconds": cost.matrix_seconds,
            "matrix_bytes": float(cost.matrix_bytes),
        }
    )
    return matrix | {
        "lenslets": float(lenslets),
        "sensor_pixels": float(lenslets * pixels[0] * pixels[1]),
        "object_points": float(lenslets * samples[0] * samples[1]),
        "lenslet_field_m": array.pitch * camera.object.distance / array.distance,
    }
