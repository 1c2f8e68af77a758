"""reconstruct: the picture in front of the camera from a capture, per lenslet or
with the neighbours.
"""

from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import bar, heard, note
from plenocli.base.tiling import to_blocks, to_plane
from plenocli.execution.batch import outcomes, plan_batch, summarise
from plenocli.execution.pool import Here, absolute, open_pool, run_all
from plenocli.files.read.captures import calibrated, read_superpixels
from plenocli.files.read.dictionaries import read_dictionary
from plenocli.files.read.system_matrices import read_lenslet_matrix
from plenocli.files.read.training import files_of, read_training
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.footprint import require_reconstruction
from plenocli.inverse.picture.per_lenslet import SPLIT


@dataclass(frozen=True)
class Settings:
    """Options of the command.

    noise_sigma in units of A x;
    alpha in units of A's squared singular values;
    lam as in learn-dict.
    """

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


@dataclass(frozen=True)
class Recipe:
    """All that the picture of a capture depends on beside it; digests tell files from
    others of the same name.

    threads: as in Estimators.
    """

    settings: Settings
    pif: Path | None
    calibration: Path | None
    digests: tuple
    threads: int | None = None


@dataclass(frozen=True)
class Solved:
    """A picture (row, column) or (band, row, column), its standard deviation and what is seen of a
    block, or None, the report, the share of it below zero, points of a block or None, wavelengths
    of the bands or ().
    """

    picture: np.ndarray
    sigma: np.ndarray | None
    seen: np.ndarray | None
    report: dict
    negative: float
    block: tuple | None
    bands: tuple


def run_reconstruct(
    captures,
    output,
    settings,
    *,
    pif=None,
    calibration=None,
    suffix=".h5",
    scheduler=None,
    overwrite=False,
    command="",
):
    """Reconstruct every capture; returns a summary dict.

    Several go to settings.workers processes, or to the Dask cluster of `scheduler`
    (stages.scheduler); so do batches of the lenslets of a single one, by methods that
    take long over each.

    One capture gives the file `output` (.h5 or .exr), several a folder with one file each; finished
    ones are skipped unless overwrite. One that fails does not stop the others; an error with the
    worst exit code follows at the end.
    """
    from plenocli.files.artefacts.provenance import describe_inputs

    _check_options(settings, pif, calibration)
    inputs = [
        *captures,
        pif,
        calibration,
        settings.dictionary,
        settings.truth,
        *(files_of(settings.training) or ()),
    ]
    batch = plan_batch(captures, output, suffix, "a picture is", overwrite=overwrite, inputs=inputs)
    if not batch.todo:
        return summarise(batch, ())
    split = not batch.several and settings.method in SPLIT
    workers = settings.workers if split else min(settings.workers, len(batch.todo))
    pooled = scheduler is not None or workers > 1
    files = describe_inputs(
        {"pif": pif, "calibration": calibration, "dictionary": settings.dictionary}
    )
    recipe = Recipe(
        settings,
        pif,
        calibration,
        tuple(f["sha256"] for f in files.values()),
        1 if pooled else None,
    )
    if scheduler is not None:
        named = replace(
            settings,
            dictionary=absolute(settings.dictionary),
            truth=absolute(settings.truth),
            training=tuple(map(absolute, settings.training)),
        )
        recipe = replace(
            recipe, settings=named, pif=absolute(pif), calibration=absolute(calibration)
        )

    def write(solved, capture, target):
        return _write(
            target,
            solved,
            settings,
            capture,
            dict(command=command, pif=pif, calibration=calibration),
            overwrite,
        )

    try:
        if pif:  # a broken one ends the run here, before any capture
            _estimators(recipe) if split or not pooled else read_lenslet_matrix(pif, by_band=True)
        with open_pool(workers, scheduler) as pool:
            if split and pooled:
                _estimators(recipe).elsewhere = partial(_spread, recipe, pool)
            return summarise(
                batch,
                outcomes(
                    batch, Here() if split else pool, partial(reconstruct_capture, recipe), write
                ),
            )
    finally:
        _estimators.cache_clear()


@lru_cache(maxsize=1)
def _estimators(recipe):
    settings = recipe.settings
    system = read_lenslet_matrix(recipe.pif, by_band=True)

    def read_pictures(scene):
        return read_training(settings.training, system.object_shape, not_scene=scene)

    def read_learnt():
        return read_dictionary(settings.dictionary, system)

    return Estimators(
        system,
        settings,
        read_pictures,
        None if settings.dictionary is None else read_learnt,
        recipe.threads,
    )


def _spread(recipe, pool, solve, batches, options):
    """What `solve` (see Estimators.in_batches) gives for the batches, through the pool, in their
    order; the first PlenoError is raised.
    """
    found = {}
    with bar(None, len(batches), "batches of lenslets") as progress:
        for number, result in run_all(
            pool,
            (
                (k, partial(_solve_batch, recipe, solve, options), batch)
                for k, batch in enumerate(batches)
            ),
        ):
            if isinstance(result, PlenoError):
                raise result
            found[number] = result
            progress.update()
    return [found[number] for number in range(len(batches))]


def _solve_batch(recipe, solve, options, batch):
    """The task of a batch, in any process; what they share is made once a process.

    What there is to say, the one that sent it has said.
    """
    with heard():
        return solve(_estimators(recipe), batch, *options)


def _check_options(settings, pif, calibration):
    if pif is None and calibration is None:
        raise UsageError(
            "a picture needs --pif, or --calibration for the block mean of a real capture",
            fix="give one of them",
        )
    if pif is None and settings.method not in ("auto", "block-mean"):
        raise UsageError(
            f"--method {settings.method} needs the system matrix",
            "--pif",
            "give it, or use --method block-mean",
        )
    if settings.method == "dictionary" and settings.dictionary is None:
        raise UsageError("--method dictionary needs --dictionary", fix="learn one with learn-dict")
    if settings.truth and settings.method not in ("tikhonov", "tsvd"):
        raise UsageError(
            "--truth serves only to choose the weight of tikhonov or tsvd with hindsight",
            "--truth",
            "leave it out; score compares results with the truth",
        )
    for name, methods in (
        ("alpha", ("tikhonov",)),
        ("rank", ("tsvd",)),
        ("lam", ("dictionary",)),
        ("nnls_iterations", ("nnls",)),
        ("dictionary", ("auto", "dictionary")),
    ):
        if getattr(settings, name) is not None and settings.method not in methods:
            option = {"lam": "lambda"}.get(name, name.replace("_", "-"))
            raise UsageError(
                f"--{option} means nothing to --method {settings.method}",
                fix=f"leave it out, or use --method {methods[-1]}",
            )


def reconstruct_capture(recipe, capture):
    """The Solved of one capture; what many captures need is made once a process."""
    settings, block, sigma, seen, bands = recipe.settings, None, None, None, ()
    if recipe.pif is None:
        picture, report = (
            _white_normalised(capture, recipe.calibration),
            {"method": "block-mean", "reason": "sum over the superpixel, over that of white"},
        )
    else:
        estimators = _estimators(recipe)
        data, block = (
            read_superpixels(capture, estimators.system, recipe.calibration),
            estimators.system.object_shape,
        )
        bands = estimators.system.bands
        require_reconstruction(estimators, data, capture)
        blocks, spread, report = estimators.solve(
            data, _truth(settings.truth, block, data.y.shape[:2], max(1, len(bands)))
        )
        picture, sigma = (
            to_plane(blocks, block),
            None if spread is None else to_plane(spread, block),
        )
        report |= _limits(data, estimators, report)
        noise = report.get("noise_sigma") or data.sigma
        if noise:
            seen, report["seen"] = estimators.seen(noise)
    negative = float(np.mean(picture < 0))
    return Solved(
        np.maximum(picture, 0) if settings.clip else picture,
        sigma,
        seen,
        report,
        negative,
        block,
        bands,
    )


def _limits(data, estimators, report):
    """{"limits": ...} of a picture: whether the capture's noise or the error of the matrix decides,
    and what the latter is expected to cost; {} where that is not known.
    """
    from plenocli.files.artefacts.provenance import file_digest
    from plenocli.forward.accuracy.limits import what_limits
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord

    sigma = report.get("noise_sigma") or data.sigma
    signal = float(np.sqrt(np.mean(np.square(data.y))))
    same = data.matrix is not None and data.matrix == file_digest(estimators.system.path)
    found = what_limits(
        sigma / signal if sigma and signal else None,
        AccuracyRecord.from_json(estimators.system.accuracy),
        AccuracyRecord.from_json(data.accuracy),
        same,
    )
    return (
        {}
        if found is None
        else {
            "limits": found.as_json()
            | {"loss_at_most_db": estimators.loss_db(data, report, found.model_error * signal)}
        }
    )


def _truth(path, shape, count, bands):
    """The true blocks (lenslet_row, lenslet_column, point) from a capture that holds its scene,
    an image .h5 or an EXR; or None.
    """
    if path is None:
        return None
    path = Path(path)
    if path.suffix == ".h5":
        from plenocli.files.artefacts.container import read_artefact

        artefact = read_artefact(path, ("capture", "image"))
        picture = artefact.data.get("capture/scene", artefact.data.get("image/value"))
    else:
        from plenocli.files.images.pictures import read_picture

        picture = np.moveaxis(read_picture(path).values, -1, 0)
    if picture is None:
        raise InputError("holds no scene", path, "give a simulated capture, or an image")
    picture = np.asarray(picture, float)
    picture = (
        picture.mean(axis=0, keepdims=True)
        if picture.ndim == 3 and bands == 1
        else picture.reshape(-1, *picture.shape[-2:])
    )
    expected = (bands, count[0] * shape[0], count[1] * shape[1])
    if picture.shape != expected:
        raise InputError(
            (
                f"has {' x '.join(map(str, picture.shape))} bands, rows and columns of points, the "
                f"picture {' x '.join(map(str, expected))}"
            ),
            path,
            "give the object as sampled (capture-sim --scene-out)",
        )
    return to_blocks(picture, shape)


def _white_normalised(capture, calibration):
    """One value a lenslet (lenslet_row, lenslet_column): the superpixel's sum over that of the
    white reference; 0 where it cannot be had.

    Pixels that the calibration masked (dead, or under dust) are left out of both sums.
    """
    from plenocli.files.images.mosaic import read_mosaic

    signal, white = calibrated(capture, read_mosaic(capture), calibration)
    with np.errstate(divide="ignore", invalid="ignore"):
        usable = np.isfinite(signal) & np.isfinite(white)
        value = np.where(usable, signal, 0).sum(axis=2) / np.where(usable, white, 0).sum(axis=2)
    lost = ~np.isfinite(value)
    if lost.any():
        note(
            f"{Path(capture).name}: {int(lost.sum())} of {lost.size} lenslets lie partly off the "
            "sensor or are dark; they are 0 in the picture"
        )
    return np.where(lost, 0, value)


def _write(target, solved, settings, capture, origin, overwrite):
    """Write one picture; returns its report."""
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs, provenance_texts
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    picture, sigma, report = solved.picture, solved.sigma, solved.report
    inputs = describe_inputs(
        {
            "capture": capture,
            "pif": origin["pif"],
            "calibration": origin["calibration"],
            "dictionary": settings.dictionary,
            "truth": settings.truth,
            "training": files_of(settings.training),
        }
    )
    provenance = Provenance(origin["command"], inputs, settings.seed)
    if target.suffix == ".exr" and picture.ndim == 3:
        write_spectral_exr(
            target,
            solved.bands,
            picture,
            sigma=sigma,
            attrs={"method": report["method"]} | provenance_texts(provenance),
            overwrite=overwrite,
        )
    elif target.suffix == ".exr":
        channels = {"Y": picture.astype(np.float32)} | (
            {} if sigma is None else {"sigma": sigma.astype(np.float32)}
        )
        write_exr(
            target,
            channels,
            {"method": report["method"]} | provenance_texts(provenance),
            overwrite=overwrite,
        )
    else:
        data = {"image/value": picture} | {
            f"image/{name}": values
            for name, values in (("sigma", sigma), ("seen", solved.seen))
            if values is not None
        }
        data |= {"image/wavelength": np.array(solved.bands)} if picture.ndim == 3 else {}
        attrs = {
            "method": report["method"],
            "parameters": {k: v for k, v in report.items() if k != "method"},
            "clipped": solved.negative if settings.clip else 0.0,
        }
        if solved.block is not None:
            attrs["notes"] = {"block": list(solved.block)}
        write_artefact(
            target, Artefact("image", data, {"image": attrs}, provenance), overwrite=overwrite
        )
    return report | {
        "output": str(target),
        "rows": picture.shape[-2],
        "columns": picture.shape[-1],
        "bands_nm": [w * 1e9 for w in solved.bands],
        "negative_share": solved.negative,
        "clipped": settings.clip,
    }
