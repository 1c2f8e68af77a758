"""One point of a sweep: a camera carried through the stages, from its description to
the figures of score.

What goes in and what comes out are plain dicts, so that a point is the same work in any process.
Its files live in a folder of their own while it lasts; only figures are kept. Every figure is
reproducible: what a matrix costs is counted by its plan at nominal rates; the time that was
measured stands apart.
"""

import contextlib
import hashlib
import json
import os
import socket
import tempfile
import time
from pathlib import Path

from plenocli.base.errors import OutputError, PlenoError
from plenocli.base.progress import heard

CHAINS = {
    "spatial": ("simulate-pif", "capture-sim", "reconstruct", "score"),
    "spectral": ("simulate-pif", "capture-sim", "simulate-response", "calibrate", "demux", "score"),
}
"""Stages of each chain, whose options may be set."""

DESIGN = {
    "matrix_seconds": (
        "time to compute the system matrix on one core at nominal speed, as its plan counts it, s"
    ),
    "matrix_bytes": "size of the system matrix, bytes",
    "lenslets": "lenslets of the array",
    "sensor_pixels": "pixels of the sensor",
    "object_points": "object points over the whole array",
    "lenslet_field_m": (
        "width of one lenslet's field on the object: pitch times object distance "
        "over array distance, m"
    ),
}
"""Figures of every point beside those of score."""

_BY_ITSELF = {
    "refine",
    "bandwidth",
    "spectral_step",
    "superpixels",
    "coherent_ring",
    "accuracy",
    "model",
}
"""Options of capture-sim with which it computes a matrix of its own."""
_WHITE, _DARK, _BAND = 1_000_001, 1_000_002, 1_000_003
"""Seeds of the captures beside the one of the scene, over its seed: no two draw the same noise."""


def task_of(chain, camera, options, seed):
    """The task of one point: {"chain", "camera": resolved TOML, "settings": stage -> option ->
    value}, with what the chain supposes.

    options: stage -> option -> value, as the command line reads them; only those given.
    """
    settings = {
        stage: dict(options.get(stage, {}))
        for stage in CHAINS[chain]
        if stage != "calibrate" or stage in options
    }
    capture = settings["capture-sim"]
    if not capture.keys() & {"scene", "target"}:
        capture |= (
            {"scene": "skimage:astronaut"} if chain == "spatial" else {"target": "colorchecker"}
        )
    if chain == "spectral" and "wavelengths" not in settings["simulate-pif"]:
        settings["simulate-pif"].setdefault("spectral_step", "auto")
    if chain == "spatial":
        # auto would try several methods at every point
        settings["reconstruct"].setdefault("method", "lmmse")
    for stage in ("capture-sim", "reconstruct"):
        settings.get(stage, {}).setdefault("seed", seed)
    from plenocli.files.config.camera_file import to_toml

    return {"chain": chain, "camera": to_toml(camera), "settings": settings}


def point_key(task, files):
    """What a point is known by: SHA-256 of everything that its figures depend on.

    files: path -> SHA-256 of the files it names.
    """
    return _digest(task, files)


def matrix_key(task, camera, files):
    """What the matrix of a point is known by: of the camera only what A depends on, so
    that points share it.
    """
    settings = task["settings"]["simulate-pif"]
    kept = camera.model_dump(mode="json")
    # without an accuracy asked for, the sensor's noise decides how exact the matrix is
    noise = {"full_well", "read_noise"} if settings.get("accuracy") is not None else set()
    colour = set() if task["chain"] == "spectral" else {"cfa"}
    for section, names in (
        ("lenslet_array", {"count"}),
        ("light", {"illuminant", "white_exposure"}),
        (
            "sensor",
            {"camera", "bits", "black_level", "gain", "quantum_efficiency"} | colour | noise,
        ),
    ):
        kept[section] = {name: value for name, value in kept[section].items() if name not in names}
    return _digest({"camera": kept, "settings": settings}, files)


def _digest(value, files):
    """SHA-256 of the version and of a JSON-able value, with paths of `files` (path -> digest)
    standing as what they hold.
    """
    from plenocli import __version__

    def content(part):
        """`part` with every path in its strings replaced by what the file holds."""
        if isinstance(part, dict):
            return {key: content(inner) for key, inner in part.items()}
        if isinstance(part, (list, tuple)):
            return [content(inner) for inner in part]
        if isinstance(part, str):
            for path, digest in files.items():
                part = part.replace(path, f"sha256 {digest}")
        return part

    return hashlib.sha256(
        json.dumps([__version__, content(value)], sort_keys=True).encode()
    ).hexdigest()


def _require_files(task):
    """OutputError where this process does not see what the task names: then it is not the
    design that is at fault.
    """
    for path in (*task.get("files", ()), *([task["matrix"]] if task.get("matrix") else ())):
        if not os.path.isfile(path):
            raise OutputError(
                f"{socket.gethostname()} does not see this file",
                path,
                (
                    "workers need the same files under the same names: put them on a file "
                    "system that all share"
                ),
            )


def run_matrix(task):
    """The system matrix of a task: {"content": bytes of the artefact, "info": its cost and what
    simulate-pif said}. PlenoError.
    """
    _require_files(task)
    with _folder(task) as folder, heard() as notes:
        try:
            info = _simulate_pif(task, folder)
        except PlenoError as error:
            raise _elsewhere(error, folder) from None
        return {
            "content": (folder / "pif.h5").read_bytes(),
            "info": info | {"notes": _without(folder, notes)},
        }


def run_point(task):
    """The figures of a task: {"status": exit code, "reason", "metrics": name -> number,
    "notes", "seconds"}.

    task["matrix"]: where the system matrix lies already, with task["info"] about it, or None;
    "files": what else is read; "scratch": folder for files, or None. A camera
    or an option that a stage refuses is a result like any other; what keeps files from being
    written is raised (OutputError).
    """
    start = time.process_time()
    _require_files(task)
    with _folder(task) as folder, heard() as notes:
        try:
            if task.get("matrix") is None:
                info, pif = _simulate_pif(task, folder), folder / "pif.h5"
            else:
                info, pif = task["info"], Path(task["matrix"])
            metrics = {"spatial": _spatial, "spectral": _spectral}[task["chain"]](
                task["settings"], folder, pif
            )
            found = {
                "status": 0,
                "reason": "",
                "metrics": _design(folder / "camera.toml", info) | metrics,
            }
        except OutputError:
            raise
        except PlenoError as error:
            found = refused(_elsewhere(error, folder))
        return found | {
            "notes": _without(folder, [*(task.get("info") or {}).get("notes", ()), *notes]),
            "seconds": time.process_time() - start,
        }


def refused(error):
    """The result of a point that a stage refused: its exit code and the reason."""
    return {
        "status": error.exit_code,
        "reason": str(error),
        "metrics": {},
        "notes": [],
        "seconds": 0.0,
    }


def _elsewhere(error, folder):
    """The error without the folder of this run, so that it reads the same wherever it happened."""
    return type(error)(
        *(
            None if part is None else part.replace(f"{folder}/", "")
            for part in (error.what, error.where, error.fix)
        )
    )


@contextlib.contextmanager
def _folder(task):
    with contextlib.ExitStack() as stack:
        try:
            folder = Path(
                stack.enter_context(
                    tempfile.TemporaryDirectory(
                        prefix="plenocli-", dir=task.get("scratch"), ignore_cleanup_errors=True
                    )
                )
            )
            (folder / "camera.toml").write_text(task["camera"], encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"cannot be written ({error.strerror})",
                task.get("scratch") or tempfile.gettempdir(),
                "free some space there, then run again: what is finished is kept",
            ) from None
        yield folder


def _without(folder, texts):
    return list(dict.fromkeys(text.replace(f"{folder}/", "") for text in texts))


def _simulate_pif(task, folder):
    from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif

    report = run_simulate_pif(
        folder / "camera.toml",
        folder / "pif.h5",
        _settings(Settings, task["settings"]["simulate-pif"]),
    )
    return {"matrix_seconds": report.nominal_seconds, "matrix_bytes": report.bytes}


def _settings(kind, values):
    """A Settings of a stage from what JSON keeps of its options."""
    values = {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if name in kind.__dataclass_fields__
    }
    return kind(**values)


def _capture(settings, folder, name, pif, *, seed=0, **changes):
    """Simulate one capture into the folder; returns its path."""
    from plenocli.stages.forward.capture_sim import Settings, run_capture_sim

    values = settings["capture-sim"] | changes
    scene = None if values.get("target") else values.get("scene")
    own = pif is None or values.keys() & _BY_ITSELF
    made = _settings(Settings, values | {"seed": values["seed"] + seed})
    run_capture_sim(
        folder / "camera.toml", folder / name, made, scene=scene, pif=None if own else pif
    )
    return folder / name


def _spatial(settings, folder, pif):
    from plenocli.stages.inverse.reconstruct import Settings, run_reconstruct

    capture = _capture(settings, folder, "capture.h5", pif)
    options = dict(settings["reconstruct"])
    if options.get("dictionary"):
        options["dictionary"] = Path(options["dictionary"])
    if options.get("overlap"):
        options["overlap"] = int(options["overlap"])
    run_reconstruct([capture], folder / "image.h5", _settings(Settings, options), pif=pif)
    return _score(settings, folder, "image.h5", truth=capture)


def _spectral(settings, folder, pif):
    from plenocli.stages.inverse.demux import Settings, run_demux

    scene = _capture(settings, folder, "scene.h5", pif)
    white = _capture(settings, folder, "white.h5", pif, target="white", seed=_WHITE)
    response = (
        _measured(settings, folder, pif, white)
        if "calibrate" in settings
        else _predicted(settings, folder)
    )
    run_demux(
        [scene],
        folder / "spectra.h5",
        calibration=response,
        settings=_settings(Settings, settings["demux"] | {"reference": white}),
    )
    shown = settings["capture-sim"].get("target") or settings["capture-sim"]["scene"]
    if shown == "colorchecker":
        return _score(
            settings,
            folder,
            "spectra.h5",
            truth=shown,
            patches=shown,
            camera=folder / "camera.toml",
        )
    return _score(settings, folder, "spectra.h5", truth=scene)


def _predicted(settings, folder):
    from plenocli.stages.forward.simulate_response import Settings, run_simulate_response

    run_simulate_response(
        folder / "camera.toml",
        folder / "response.h5",
        _settings(Settings, settings["simulate-response"]),
    )
    return folder / "response.h5"


def _measured(settings, folder, pif, white):
    """The response calibrated from captures of a white target under narrow-band light, as
    a real camera's is.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.stages.inverse.calibrate import run_calibrate

    dark = _capture(settings, folder, "dark.h5", pif, target="dark", seed=_DARK)
    optics = {
        name: value
        for name, value in settings["simulate-pif"].items()
        if name in ("model", "accuracy", "superpixels", "coherent_ring")
    }
    bands = [
        (
            w,
            _capture(
                settings,
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
        folder / "response.h5", whites=[white], darks=[dark], bands=bands, **settings["calibrate"]
    )
    return folder / "response.h5"


def _score(settings, folder, result, **truth):
    from plenocli.stages.evaluation.score import run_score

    document = run_score([folder / result], folder / "score.json", **truth, **settings["score"])
    return {
        name: float(value)
        for name, value in document.figures.items()
        if isinstance(value, (int, float)) and not isinstance(value, bool)
    }


def _design(camera_path, info):
    from plenocli.files.config.camera_file import load_camera

    camera = load_camera(camera_path)
    array = camera.lenslet_array
    lenslets = array.count[0] * array.count[1]
    pixels, samples = camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet
    return {
        "matrix_seconds": info["matrix_seconds"],
        "matrix_bytes": float(info["matrix_bytes"]),
        "lenslets": float(lenslets),
        "sensor_pixels": float(lenslets * pixels[0] * pixels[1]),
        "object_points": float(lenslets * samples[0] * samples[1]),
        "lenslet_field_m": array.pitch * camera.object.distance / array.distance,
    }
