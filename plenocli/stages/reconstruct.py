"""reconstruct: the picture in front of the camera from a capture, per lenslet or with the neighbours."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.errors import InputError, UsageError
from plenocli.operators import to_blocks, to_plane
from plenocli.stages.batch import one_by_one, plan_batch, summarise
from plenocli.stages.estimators import Estimators
from plenocli.stages.progress import note
from plenocli.stages.superpixels import calibrated, read_superpixels
from plenocli.stages.systems import read_system
from plenocli.stages.training import files_of


@dataclass(frozen=True)
class Settings:
    """Options of the command. noise_sigma in units of A x; alpha in units of A's squared singular values; lam as in learn-dict."""

    method: str = "auto"
    overlap: int | None = None
    dictionary: Path | None = None
    training: tuple = ()
    truth: Path | None = None
    noise_sigma: float | None = None
    alpha: float | None = None
    rank: int | None = None
    lam: float | None = None
    nnls_iterations: int | None = None
    clip: bool = False
    seed: int = 0
    workers: int = 1
    mem_limit: int | None = None


def run_reconstruct(captures, output, settings, *, pif=None, calibration=None, suffix=".h5", overwrite=False, command=""):
    """Reconstruct every capture; returns a summary dict.

    One capture gives the file `output` (.h5 or .exr), several a folder with one file each; finished ones are skipped unless
    overwrite. One that fails does not stop the others; an error with the worst exit code follows at the end.
    """
    _check_options(settings, pif, calibration)
    inputs = [*captures, pif, calibration, settings.dictionary, settings.truth, *(files_of(settings.training) or ())]
    batch = plan_batch(captures, output, suffix, "a picture is", overwrite=overwrite, inputs=inputs)
    estimators = Estimators(read_system(pif, settings.mem_limit), settings) if pif and batch.todo else None
    origin = dict(command=command, pif=pif, calibration=calibration)

    def work(capture, target):
        return _one(capture, target, settings, estimators, calibration, overwrite, origin)

    return summarise(batch, one_by_one(batch, work))


def _check_options(settings, pif, calibration):
    if pif is None and calibration is None:
        raise UsageError("a picture needs --pif, or --calibration for the block mean of a real capture", fix="give one of them")
    if pif is None and settings.method not in ("auto", "block-mean"):
        raise UsageError(f"--method {settings.method} needs the system matrix", "--pif", "give it, or use --method block-mean")
    if settings.method == "dictionary" and settings.dictionary is None:
        raise UsageError("--method dictionary needs --dictionary", fix="learn one with learn-dict")
    if settings.truth and settings.method not in ("tikhonov", "tsvd"):
        raise UsageError("--truth serves only to choose the weight of tikhonov or tsvd with hindsight", "--truth", "leave it out; score compares results with the truth")
    for name, methods in (("alpha", ("tikhonov",)), ("rank", ("tsvd",)), ("lam", ("dictionary",)), ("nnls_iterations", ("nnls",)), ("dictionary", ("auto", "dictionary"))):
        if getattr(settings, name) is not None and settings.method not in methods:
            option = {"lam": "lambda"}.get(name, name.replace("_", "-"))
            raise UsageError(f"--{option} means nothing to --method {settings.method}", fix=f"leave it out, or use --method {methods[-1]}")


def _one(capture, target, settings, estimators, calibration, overwrite, origin):
    """Reconstruct and write one capture; returns its report."""
    if estimators is None:
        picture, sigma, seen, report = _white_normalised(capture, calibration), None, None, {"method": "block-mean", "reason": "sum over the superpixel, over that of white"}
    else:
        data = read_superpixels(capture, estimators.system, calibration, settings.mem_limit)
        blocks, spread, report = estimators.solve(data, _truth(settings.truth, estimators.system.object_shape, data.y.shape[:2]))
        picture = to_plane(blocks, estimators.system.object_shape)
        sigma = None if spread is None else to_plane(spread, estimators.system.object_shape)
        report |= _limits(data, estimators.system, report)
        noise = report.get("noise_sigma") or data.sigma
        seen = None
        if noise:
            seen, report["seen"] = estimators.seen(noise)
    negative = float(np.mean(picture < 0))
    if settings.clip:
        picture = np.maximum(picture, 0)
    _write(target, picture, sigma, seen, report, negative if settings.clip else 0.0, settings, estimators, capture, origin, overwrite)
    return report | {"output": str(target), "rows": picture.shape[0], "columns": picture.shape[1], "negative_share": negative, "clipped": settings.clip}


def _limits(data, system, report):
    """{"limits": ...} of a picture: whether the capture's noise or the error of the matrix decides; {} where that is not known."""
    from plenocli.accuracy.limits import what_limits
    from plenocli.artefacts.provenance import file_digest

    sigma = report.get("noise_sigma") or data.sigma
    signal = float(np.sqrt(np.mean(np.square(data.y))))
    same = data.matrix is not None and data.matrix == file_digest(system.path)
    found = what_limits(sigma / signal if sigma and signal else None, system.accuracy, data.accuracy, same)
    return {} if found is None else {"limits": found}


def _truth(path, shape, count):
    """The true blocks (lenslet_row, lenslet_column, point) from a capture that holds its scene, an image .h5 or an EXR; or None."""
    if path is None:
        return None
    path = Path(path)
    if path.suffix == ".h5":
        from plenocli.artefacts import read_artefact

        artefact = read_artefact(path, ("capture", "image"))
        picture = artefact.data.get("capture/scene", artefact.data.get("image/value"))
    else:
        from plenocli.artefacts import read_picture

        picture = np.moveaxis(read_picture(path).values, -1, 0)
    if picture is None:
        raise InputError("holds no scene", path, "give a simulated capture, or an image")
    picture = np.asarray(picture, float)
    picture = picture.mean(axis=0) if picture.ndim == 3 else picture
    expected = (count[0] * shape[0], count[1] * shape[1])
    if picture.shape != expected:
        raise InputError(f"is {picture.shape[0]} x {picture.shape[1]} points, the picture {expected[0]} x {expected[1]}", path, "give the object as sampled (capture-sim --scene-out)")
    return to_blocks(picture, shape)


def _white_normalised(capture, calibration):
    """One value a lenslet (lenslet_row, lenslet_column): the superpixel's sum over that of the white reference; 0 where it cannot be had.

    Pixels that the calibration masked (dead, or under dust) are left out of both sums.
    """
    from plenocli.artefacts import read_mosaic

    signal, white = calibrated(capture, read_mosaic(capture), calibration)
    with np.errstate(divide="ignore", invalid="ignore"):
        usable = np.isfinite(signal) & np.isfinite(white)
        value = np.where(usable, signal, 0).sum(axis=2) / np.where(usable, white, 0).sum(axis=2)
    lost = ~np.isfinite(value)
    if lost.any():
        note(f"{Path(capture).name}: {int(lost.sum())} of {lost.size} lenslets lie partly off the sensor or are dark; they are 0 in the picture")
    return np.where(lost, 0, value)


def _write(target, picture, sigma, seen, report, clipped, settings, estimators, capture, origin, overwrite):
    from plenocli.artefacts import Artefact, Provenance, describe_inputs, provenance_texts, write_artefact, write_exr

    inputs = describe_inputs({"capture": capture, "pif": origin["pif"], "calibration": origin["calibration"], "dictionary": settings.dictionary,
                              "truth": settings.truth, "training": files_of(settings.training)})
    provenance = Provenance(origin["command"], inputs, settings.seed)
    if target.suffix == ".exr":
        channels = {"Y": picture.astype(np.float32)} | ({} if sigma is None else {"sigma": sigma.astype(np.float32)})
        write_exr(target, channels, {"method": report["method"]} | provenance_texts(provenance), overwrite=overwrite)
        return
    data = {"image/value": picture} | {f"image/{name}": values for name, values in (("sigma", sigma), ("seen", seen)) if values is not None}
    attrs = {"method": report["method"], "parameters": {k: v for k, v in report.items() if k != "method"}, "clipped": clipped}
    if estimators is not None:
        attrs["notes"] = {"block": list(estimators.system.object_shape)}
    write_artefact(target, Artefact("image", data, {"image": attrs}, provenance), overwrite=overwrite)
