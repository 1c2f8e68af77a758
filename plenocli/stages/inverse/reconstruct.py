"""reconstruct: the picture in front of the camera from a capture, per lenslet or with the
neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import bar, collected_notes, note
from plenocli.base.tiling import InParts, to_blocks
from plenocli.execution.batch import BatchSummary, outcomes, plan_batch, summarise
from plenocli.execution.pool import InProcess, Pool, absolute, open_pool, run_all
from plenocli.files.artefacts.provenance import file_digest
from plenocli.files.kept import kept
from plenocli.files.read.captures import (
    describe_capture,
    named_captures,
    read_white,
    superpixel_source,
)
from plenocli.files.read.dictionaries import read_dictionary
from plenocli.files.read.system_matrices import (
    FieldMatrix,
    read_field_matrix,
    read_lenslet_matrix,
)
from plenocli.files.read.training import files_of, read_training
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.picture.diagnosis import Seen
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.footprint import cleaned, require_reconstruction
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels, Whole
from plenocli.inverse.picture.methods.method import Method, Sees
from plenocli.inverse.picture.methods.registry import METHODS, takers
from plenocli.inverse.picture.reconstruction import Account, Choice, Reconstruction
from plenocli.inverse.picture.superpixels import windows_of
from plenocli.inverse.picture.tiles import (
    EVERY,
    NUISANCES,
    Source,
    Tile,
    joined,
    side_of,
    spread_over,
    survey,
    tiles_of,
)
from plenocli.stages.inverse.field_classes import estimate_by_class
from plenocli.stages.inverse.fitted_matrix import likely_cause, with_fitted_camera
from plenocli.stages.inverse.tiles import Bench, SolvedTile, picture, solve_all

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.forward.accuracy.limiting_error import Limits
    from plenocli.inverse.prior.natural_images import TrainingPicture


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of the command.

    method: name of one of METHODS.
    overlap, noise_sigma, alpha, rank, lam, nnls_iterations, hold_out: as in Options.
    dictionary: artefact of learn-dict.
    training: photographs for the statistics; () for those of scikit-image.
    truth: what chooses a weight with hindsight.
    fit: fit the camera to each capture first.
    clip: set negative values to zero.
    seed: of every random stream.
    workers: processes.
    """

    method: str = "auto"
    overlap: int | None = None
    dictionary: Path | None = None
    training: tuple[str, ...] = ()
    truth: Path | None = None
    noise_sigma: float | None = None
    alpha: float | None = None
    rank: int | None = None
    lam: float | None = None
    nnls_iterations: int | None = None
    hold_out: float | None = None
    fit: bool = False
    clip: bool = False
    seed: int = 0
    workers: int = 1

    @property
    def options(self) -> Options:
        """What of them the estimate knows."""
        return Options(
            method=self.method,
            overlap=self.overlap,
            noise_sigma=self.noise_sigma,
            alpha=self.alpha,
            rank=self.rank,
            lam=self.lam,
            nnls_iterations=self.nnls_iterations,
            hold_out=self.hold_out,
            seed=self.seed,
        )


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that the picture of a capture depends on beside it.

    settings: of the command.
    pif, calibration: paths, or None.
    digests: of the files, to tell them from others of the same name.
    threads: as in Estimators.
    """

    settings: Settings
    pif: Path | None
    calibration: Path | None
    digests: tuple[str, ...]
    threads: int | None = None


@dataclass(frozen=True, kw_only=True)
class Solved:
    """The picture of a capture.

    found: its value (row, column) or (band, row, column).
    seen: what of an object the sensor tells apart, None where the noise is not known.
    limits: what limits it, None where that is not known.
    negative_share: of the values, before they are clipped.
    bench: of the tiles that it consists of, None where it is in memory.
    block: points (rows, columns) of an object, None without a system matrix.
    bands: wavelengths (m) of the bands, () for one picture.
    rgb: (3, row, column) linear sRGB of a capture whose pixels have colours; None of others.
    """

    found: Reconstruction
    seen: Seen | None = None
    limits: Limits | None = None
    negative_share: float
    block: tuple[int, int] | None = None
    bands: tuple[float, ...] = ()
    rgb: np.ndarray | None = None
    bench: Bench | None = None

    def summary(self, output: Path, *, clipped: bool) -> PictureSummary:
        """What there is to tell of it once it is written to `output`."""
        rows, columns = self.found.value.shape[-2:]
        return PictureSummary(
            output=str(output),
            account=self.found.account,
            limits=self.limits,
            seen=self.seen,
            rows=rows,
            columns=columns,
            bands=self.bands,
            negative_share=self.negative_share,
            clipped=clipped,
        )


@dataclass(frozen=True, kw_only=True)
class PictureSummary:
    """One picture that was written.

    output: its file.
    account: how it came about.
    limits, seen, bands, negative_share: as in Solved.
    rows, columns: of points.
    clipped: whether negative values were set to zero.
    """

    output: str
    account: Account
    limits: Limits | None
    seen: Seen | None
    rows: int
    columns: int
    bands: tuple[float, ...]
    negative_share: float
    clipped: bool

    def told(self) -> dict[str, Any]:
        """How the picture came about, as its artefact holds it."""
        told = self.account.as_json()
        told |= {} if self.limits is None else {"limits": self.limits.as_json()}
        return told | ({} if self.seen is None else {"seen": self.seen.as_json()})

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        return self.told() | {
            "output": self.output,
            "rows": self.rows,
            "columns": self.columns,
            "bands_nm": [w * 1e9 for w in self.bands],
            "negative_share": self.negative_share,
            "clipped": self.clipped,
        }

    def line(self, *, with_reason: bool) -> str:
        """One line for a person; with_reason: why this method was taken, too."""
        rule = f" ({self.account.reason})" if with_reason else ""
        rule += f", {self.account.rule}" if self.account.rule else ""
        seen = bands = ""
        if self.seen is not None:
            seen = (
                f", {self.seen.degrees:.0f} degrees of freedom of {self.seen.points} points above "
                "the noise"
            )
        if len(self.bands) > 1:
            bands = f" in bands of {', '.join(f'{w * 1e9:.4g}' for w in self.bands)} nm"
        return (
            f"{self.output}: {self.rows} x {self.columns} points{bands}, "
            f"{self.account.method}{rule}, {self.negative_share:.1%} negative{seen}"
        )


@dataclass(frozen=True, kw_only=True)
class ReconstructSummary:
    """What a run did.

    output: file or folder.
    skipped: captures that were finished before.
    captures: pictures that were written, in the order of their captures.
    """

    output: str
    skipped: int
    captures: tuple[PictureSummary, ...]

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        return {
            "output": self.output,
            "done": len(self.captures),
            "skipped": self.skipped,
            "captures": [picture.as_json() for picture in self.captures],
        }


def run_reconstruct(
    captures: Sequence[Path],
    output: Path,
    settings: Settings,
    *,
    pif: Path | None = None,
    calibration: Path | None = None,
    suffix: str = ".h5",
    scheduler: str | None = None,
    overwrite: bool = False,
    command: str = "",
) -> ReconstructSummary:
    """Reconstruct every capture.

    Several go to settings.workers processes, or to a Dask cluster; so do batches of the lenslets of
    a single one, by methods that take long over each. Finished ones are skipped unless overwrite.
    One that fails does not stop the others; an error with the worst exit code follows at the end.

    captures: files, folders of them, or patterns (plenocli.files.read.captures.named_captures).
    output: the file (.h5 or .exr) of one capture, or a folder with one file each.
    pif, calibration: what explains the captures; one of them at least.
    suffix: of the files in a folder.
    scheduler: address of the Dask scheduler (plenocli.execution.pool).
    command: for the provenance.
    """
    _check_options(settings, pif, calibration)
    others = [
        pif,
        calibration,
        settings.dictionary,
        settings.truth,
        *(files_of(settings.training) or ()),
    ]
    captures = named_captures(captures, others)
    inputs = [*captures, *others]
    batch = plan_batch(captures, output, suffix, "a picture is", overwrite=overwrite, inputs=inputs)
    if not batch.todo:
        return _summary(summarise(batch, ()))
    method = METHODS[settings.method]
    split = not batch.several and (method.in_batches or method.in_tiles)
    workers = settings.workers if split else min(settings.workers, len(batch.todo))
    pooled = scheduler is not None or workers > 1
    recipe = _recipe(settings, pif, calibration, pooled, elsewhere=scheduler is not None)

    def write(solved: Solved, capture: Path, target: Path) -> PictureSummary:
        inputs = _inputs(settings, capture, pif, calibration)
        return _write(target, solved, settings, command, inputs, overwrite)

    try:
        if pif:  # a broken one ends the run here, before any capture
            _estimators(recipe) if split or not pooled else _system(recipe)
        with open_pool(workers, scheduler) as pool:
            if split and pooled and pif:
                _estimators(recipe).elsewhere = partial(_solve_in_pool, recipe, pool)
            tasks = pool if split else InProcess()
            targets = dict(batch.todo)
            work = partial(reconstruct_capture, recipe, pool=tasks, targets=targets)
            if not split and pooled:  # whose tasks hold no pool
                work = partial(reconstruct_capture, recipe, targets=targets, far=pool.far)
            done = outcomes(batch, InProcess() if split else pool, work, write)
            return _summary(summarise(batch, done))
    finally:
        _estimators.cache_clear()
        _finer.cache_clear()
        _field.cache_clear()


def _summary(done: BatchSummary) -> ReconstructSummary:
    return ReconstructSummary(output=done.output, skipped=done.skipped, captures=done.reports)


def _recipe(
    settings: Settings,
    pif: Path | None,
    calibration: Path | None,
    pooled: bool,
    *,
    elsewhere: bool,
) -> Recipe:
    """The Recipe of a run.

    pooled: whether captures or batches are shared out.
    elsewhere: whether to processes to which relative file names mean nothing.
    """
    from plenocli.files.artefacts.provenance import describe_inputs

    files = describe_inputs(
        {"pif": pif, "calibration": calibration, "dictionary": settings.dictionary}
    )
    recipe = Recipe(
        settings=settings,
        pif=pif,
        calibration=calibration,
        digests=tuple(f["sha256"] for f in files.values()),
        threads=1 if pooled else None,
    )
    if not elsewhere:
        return recipe
    named = replace(
        settings,
        dictionary=absolute(settings.dictionary),
        truth=absolute(settings.truth),
        training=tuple(map(absolute, settings.training)),
    )
    return replace(recipe, settings=named, pif=absolute(pif), calibration=absolute(calibration))


@lru_cache(maxsize=1)
def _estimators(recipe: Recipe) -> Estimators:
    """What all captures of a recipe with a pif share."""
    if recipe.pif is None:
        raise ValueError("without a pif there is nothing to estimate with")
    settings, learnt = recipe.settings, recipe.settings.dictionary
    system = _system(recipe)

    def read_pictures(scene: str | None) -> list[TrainingPicture]:
        return read_training(settings.training, system.object_shape, not_scene=scene)

    return Estimators(
        system,
        settings.options,
        read_pictures,
        None if learnt is None else partial(read_dictionary, learnt, system),
        threads=recipe.threads,
        keep=kept,
    )


def _system(recipe: Recipe) -> LensletMatrix:
    """The matrix of a recipe with a pif; of a whole array that on its axis."""
    assert recipe.pif is not None
    field = _field(recipe)
    return read_lenslet_matrix(recipe.pif, by_band=True) if field is None else field.at((0.0, 0.0))


@lru_cache(maxsize=1)
def _field(recipe: Recipe) -> FieldMatrix | None:
    """The matrices of a whole array, where the pif holds such."""
    return None if recipe.pif is None else read_field_matrix(recipe.pif, by_band=True)


@lru_cache(maxsize=1)
def _finer(recipe: Recipe) -> Estimators | None:
    """The same by a finer matrix of the camera, where it can be had."""
    from plenocli.inverse.picture.trust.finer import finer_matrix

    rough = _estimators(recipe)
    system = finer_matrix(rough.system)
    return None if system is None else rough.with_matrix(system)


def _solve_in_pool(
    recipe: Recipe,
    pool: Any,
    solve: Callable[..., Any],
    batches: list[np.ndarray],
    options: tuple[Any, ...],
) -> list[Any]:
    """What `solve` (see Estimators.in_batches) gives for the batches, through the pool, in their
    order; the first PlenoError is raised.
    """
    found = {}
    task = partial(_solve_batch, recipe, solve, options)
    with bar(None, len(batches), "batches of lenslets") as progress:
        jobs = ((k, task, batch) for k, batch in enumerate(batches))
        for number, result in run_all(pool, jobs):
            if isinstance(result, PlenoError):
                raise result
            found[number] = result
            progress.update()
    return [found[number] for number in range(len(batches))]


def _solve_batch(
    recipe: Recipe, solve: Callable[..., Any], options: tuple[Any, ...], batch: np.ndarray
) -> Any:
    """The task of a batch, in any process; what they share is made once a process.

    What there is to say, the one that sent it has said.
    """
    with collected_notes():
        return solve(_estimators(recipe), batch, *options)


def _check_options(settings: Settings, pif: Path | None, calibration: Path | None) -> None:
    method = METHODS[settings.method]
    if pif is None and calibration is None:
        raise UsageError(
            "a picture needs --pif, or --calibration for the block mean of a real capture",
            fix="give one of them",
        )
    if pif is None and method.needs_pif:
        raise UsageError(
            f"--method {method.name} needs the system matrix",
            "--pif",
            "give it, or use --method block-mean",
        )
    if settings.fit and (pif is None or not method.needs_pif and method.name == "block-mean"):
        raise UsageError("--fit means nothing without a system matrix", "--fit", "leave it out")
    if method.needs_dictionary and settings.dictionary is None:
        raise UsageError(
            f"--method {method.name} needs --dictionary", fix="learn one with learn-dict"
        )
    if settings.truth and not method.hindsight:
        raise UsageError(
            "--truth serves only to choose the weight of tikhonov or tsvd with hindsight",
            "--truth",
            "leave it out; score compares results with the truth",
        )
    for option, spelt, value in (
        ("alpha", "alpha", settings.alpha),
        ("rank", "rank", settings.rank),
        ("lam", "lambda", settings.lam),
        ("nnls_iterations", "nnls-iterations", settings.nnls_iterations),
        ("hold_out", "hold-out", settings.hold_out),
        ("dictionary", "dictionary", settings.dictionary),
    ):
        if value is not None and option not in method.options:
            raise UsageError(
                f"--{spelt} means nothing to --method {method.name}",
                fix=f"leave it out, or use --method {takers(option)[-1]}",
            )


def reconstruct_capture(
    recipe: Recipe,
    capture: Path,
    *,
    targets: Mapping[Path, Path],
    pool: Pool | None = None,
    far: bool = False,
) -> Solved:
    """The picture of one capture; what many captures need is made once a process.

    targets: by the captures, the files beside which tiles may lie.
    pool: for tiles, None for this process.
    far: whether what lies there is not found by who writes the result.
    """
    settings = recipe.settings
    if recipe.pif is None and recipe.calibration is not None:
        choice = Choice(method="block-mean", reason="sum over the superpixel, over that of white")
        value, rgb = _white_normalised(capture, recipe.calibration)
        found = Reconstruction(value=value, method=choice.method, trace=(choice,))
        return _solved(found, settings, rgb=rgb)
    estimators, method = _estimators(recipe), METHODS[settings.method]
    system = estimators.system
    with superpixel_source(
        capture, system, recipe.calibration, each_pixel=method.each_pixel
    ) as source:
        tiles = tiles_of(estimators, method, source.count)
        apart = len(tiles) > 1 and not settings.fit and settings.truth is None
        if apart and _field(recipe) is None and capture in targets and not far:
            target = targets[capture]
            return _in_tiles(recipe, capture, source, tiles, pool or InProcess(), target)
        data = source.cut(*EVERY)
    look = method.sees is not Sees.LENSLET_AS_IS
    require_reconstruction(
        estimators,
        data,
        capture,
        cleaned(method.phases) if look else method.phases,
        joint=method.makes_joint_estimate(estimators),
    )
    count = data.y.shape[:2]
    truth = _truth(settings.truth, system.object_shape, count, max(1, len(system.bands)))
    field, fitted = _field(recipe), False
    if settings.fit and field is not None:
        raise UsageError(
            "a camera is fitted by the matrix of one lenslet, not by those of a whole array",
            "--fit",
            "leave it out, or fit the camera first with fit-camera",
        )
    if settings.fit:
        estimators, fit = with_fitted_camera(estimators, data, capture)
        fitted = fit.accepted
    limits = _limits(estimators, data)
    plain = (look or method.each_pixel) and not fitted and field is None
    if plain and limits is not None and limits.limited_by == "model":
        estimators = _finer(recipe) or estimators
        limits = _limits(estimators, data)
    found, seen = _estimate(field, estimators, method, data, truth, limits)
    return _solved(
        found.as_picture(system.object_shape),
        settings,
        seen=seen,
        limits=limits,
        block=system.object_shape,
        bands=system.bands,
    )


def _in_tiles(
    recipe: Recipe,
    capture: Path,
    source: Source,
    tiles: Sequence[Tile],
    pool: Pool,
    target: Path,
) -> Solved:
    """The picture of a capture that is larger than a tile."""
    settings, estimators = recipe.settings, _estimators(recipe)
    method, system = METHODS[settings.method], estimators.system
    look = method.sees is not Sees.LENSLET_AS_IS
    whole, middle = survey(system, source, side_of(system))
    data = source.cut(*middle.own)
    most = max(tiles, key=lambda t: np.prod([p.stop - p.start for p in t.around]))
    require_reconstruction(
        estimators,
        source.cut(*most.around),
        capture,
        cleaned(method.phases) if look else method.phases,
        joint=method.makes_joint_estimate(estimators),
    )
    limits, finer = _limits(estimators, data), False
    if look and limits is not None and limits.limited_by == "model":
        better = _finer(recipe)
        finer, estimators = better is not None, better or estimators
        limits = _limits(estimators, data)
    task = _TileTask(
        recipe=recipe, capture=capture, finer=finer, model_error=_off(limits), whole=whole
    )
    data, cause = replace(data, whole=whole), partial(likely_cause, estimators)
    sample, seen = estimate(estimators, method, data, model_error=_off(limits), explain=cause)
    all_weigh = METHODS[sample.method].weighs_all  # of the one that auto took
    task = task.sharing(pool, tiles if all_weigh else spread_over(source.count, side_of(system)))
    depends = replace(settings, workers=1), recipe.digests, file_digest(capture), tiles
    bench = Bench.beside(target, depends)
    clip = partial(np.maximum, 0) if settings.clip else np.asarray
    stats = solve_all(pool, task, tiles, bench, clip)
    value, sigma, counted = picture(bench, tiles, system.object_shape, max(1, len(system.bands)))
    size = source.count[0] * source.count[1] * system.own.shape[0]
    declared = data.saturated is not None
    parts: dict[str, Any] = {"value": value, "sigma": sigma, "stats": stats or sample.stats}
    trace = joined(sample, counted[1:], size, declared=declared)
    for entry in trace:
        if isinstance(entry, NUISANCES) and entry.found:
            note(entry.sentence)
    return Solved(
        found=replace(sample, trace=trace, **parts),
        seen=seen,
        limits=limits,
        negative_share=float(counted[0]) / np.prod(value.shape),
        block=system.object_shape,
        bands=system.bands,
        bench=bench,
    )


@dataclass(frozen=True, kw_only=True)
class _TileTask:
    """The task of a tile, in any process; what they share is made once a process.

    finer: whether by a finer matrix of the camera.
    model_error: of the matrix, see estimate.
    whole: what is known of the capture.
    """

    recipe: Recipe
    capture: Path
    finer: bool
    model_error: float
    whole: Whole

    def sharing(self, pool: Pool, pieces: Sequence[Tile]) -> _TileTask:
        """The task that knows the whole, what `pieces` share beside the sample in it."""
        found = {}
        with bar(None, len(pieces), "what tiles share") as progress:
            jobs = ((n, self.shared, piece) for n, piece in enumerate(pieces))
            for number, own in run_all(pool, jobs):
                if isinstance(own, PlenoError):
                    raise own
                found[number] = own
                progress.update()
        return replace(
            self, whole=self.whole.closed_with([own for _, own in sorted(found.items())])
        )

    def shared(self, piece: Tile) -> Whole:
        """What a piece adds to the means over pieces."""
        own = self.whole.for_means()
        self._estimated(piece, own)
        return own.means()

    def __call__(self, job: tuple[int, Tile]) -> SolvedTile:
        """A tile."""
        tile, found = job[1], self._estimated(job[1], self.whole)
        sigma = None if found.sigma is None else found.sigma[tile.within]
        value, trace = found.value[tile.within], found.trace
        return SolvedTile(value=value, sigma=sigma, trace=trace, stats=found.stats)

    def _estimated(self, tile: Tile, whole: Whole) -> Reconstruction:
        """A piece; what there is to say was said of the whole."""
        recipe = self.recipe
        estimators = (_finer(recipe) if self.finer else None) or _estimators(recipe)
        method, system = METHODS[recipe.settings.method], estimators.system
        with collected_notes():
            with superpixel_source(
                self.capture, system, recipe.calibration, verify=False
            ) as source:
                data = replace(source.cut(*tile.around, tile.within), whole=whole)
            return estimate(estimators, method, data, model_error=self.model_error)[0]


def _estimate(
    field: FieldMatrix | None,
    estimators: Estimators,
    method: Method,
    data: Superpixels,
    truth: np.ndarray | None,
    limits: Limits | None,
) -> tuple[Reconstruction, Seen | None]:
    """The picture by one matrix, or by those of a whole array."""
    off = _off(limits)
    if field is None:
        cause = partial(likely_cause, estimators)
        return estimate(estimators, method, data, truth, model_error=off, explain=cause)
    noise = 0.0 if limits is None else limits.noise
    return estimate_by_class(
        field,
        estimators,
        method,
        data,
        truth,
        tolerance=max(noise, field.nodes.error),
        model_error=off,
    )


def _off(limits: Limits | None) -> float:
    """Error of the matrix that counts beside the noise."""
    return 0.0 if limits is None or limits.limited_by == "noise" else limits.model_error


def _solved(found: Reconstruction, settings: Settings, **more: Any) -> Solved:
    picture = found.value
    return Solved(
        found=replace(found, value=np.maximum(picture, 0) if settings.clip else picture),
        negative_share=float(np.mean(picture < 0)),
        **more,
    )


def _limits(estimators: Estimators, data: Superpixels) -> Limits | None:
    """Whether the capture's noise or the error of the matrix decides, by their records; None where
    that is not known.
    """
    from plenocli.forward.accuracy.limiting_error import what_limits

    system, sigma = estimators.system, estimators.options.noise_sigma or data.sigma
    known = data.y[np.isfinite(data.y)]
    signal = float(np.sqrt(np.mean(np.square(known)))) if known.size else 0.0
    return what_limits(
        sigma / signal if sigma and signal else None,
        system.accuracy,
        data.accuracy,
        data.pif_digest is not None and data.pif_digest == file_digest(system.path),
    )


def _truth(
    path: Path | None, shape: tuple[int, int], count: tuple[int, ...], bands: int
) -> np.ndarray | None:
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


def _white_normalised(capture: Path, calibration: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """One value a lenslet (lenslet_row, lenslet_column): the superpixel's sum over that of the
    white reference; 0 where it cannot be had. Of pixels with colours also linear sRGB (3,
    lenslet_row, lenslet_column), each colour's sum over its own of white.

    Pixels that the calibration masked (dead, or under dust) are left out of both sums.
    """
    from plenocli.files.images.mosaic import read_capture
    from plenocli.forward.sensor.cfa import cfa_map
    from plenocli.forward.sensor.superpixel import extract

    shot, known = read_capture(capture), read_white(calibration)
    signal, white = windows_of(shot, known)
    usable = np.isfinite(signal) & np.isfinite(white)

    def share(counted: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(counted, signal, 0).sum(2) / np.where(counted, white, 0).sum(2)

    value, rgb = share(usable), None
    lost = ~np.isfinite(value)
    if shot.cfa != "mono" and not set("RGB") - set(shot.cfa):
        windows = there(known.windows)
        colour = cfa_map((shot.shape[0], shot.shape[1]), shot.cfa)
        places = [extract(colour == letter, windows.origin, windows.shape) == 1 for letter in "RGB"]
        own = np.nan_to_num(np.stack([share(usable & place) for place in places]), posinf=0.0)
        rgb = own if shot.profile is None else np.tensordot(shot.profile.to_rgb, own, axes=1)
    if lost.any():
        note(
            f"{Path(capture).name}: {int(lost.sum())} of {lost.size} lenslets lie partly off the "
            "sensor or are dark; they are 0 in the picture"
        )
    return np.where(lost, 0, value), rgb


def _inputs(
    settings: Settings, capture: Path, pif: Path | None, calibration: Path | None
) -> dict[str, Any]:
    """The files that a picture was made from, for its provenance."""
    from plenocli.files.artefacts.provenance import describe_inputs

    return describe_capture(capture) | describe_inputs(
        {
            "pif": pif,
            "calibration": calibration,
            "dictionary": settings.dictionary,
            "truth": settings.truth,
            "training": files_of(settings.training),
        }
    )


def _write(
    target: Path,
    solved: Solved,
    settings: Settings,
    command: str,
    inputs: dict[str, Any],
    overwrite: bool,
) -> PictureSummary:
    """Write one picture."""
    from plenocli.files.artefacts.provenance import Provenance

    provenance = Provenance(command=command, inputs=inputs, seed=settings.seed)
    summary = solved.summary(target, clipped=settings.clip)
    write = _write_exr if target.suffix == ".exr" else _write_artefact
    write(target, solved, summary, provenance, overwrite)
    if solved.bench is not None:
        solved.bench.remove()
    return summary


def _write_exr(
    target: Path, solved: Solved, summary: PictureSummary, provenance: Provenance, overwrite: bool
) -> None:
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    picture, sigma = _in_memory(solved.found.value), _in_memory(solved.found.sigma)
    attrs = {"method": solved.found.method} | provenance_texts(provenance)
    if picture.ndim == 3:
        write_spectral_exr(
            target, solved.bands, picture, sigma=sigma, attrs=attrs, overwrite=overwrite
        )
    else:
        channels = {"Y": picture} | ({} if sigma is None else {"sigma": sigma})
        channels |= {} if solved.rgb is None else dict(zip("RGB", solved.rgb))
        channels = {name: values.astype(np.float32) for name, values in channels.items()}
        write_exr(target, channels, attrs, overwrite=overwrite)


def _in_memory(values: Any) -> Any:
    return values.whole() if isinstance(values, InParts) else values


def _write_artefact(
    target: Path, solved: Solved, summary: PictureSummary, provenance: Provenance, overwrite: bool
) -> None:
    from plenocli.files.artefacts.container import Artefact, write_artefact

    picture, sigma = solved.found.value, solved.found.sigma
    data = {"image/value": picture}
    data |= {} if sigma is None else {"image/sigma": sigma}
    data |= {} if solved.seen is None else {"image/seen": solved.seen.by_point}
    data |= {"image/wavelength": np.array(solved.bands)} if len(picture.shape) == 3 else {}
    data |= {} if solved.rgb is None else {"image/rgb": solved.rgb}
    attrs: dict[str, Any] = {
        "method": solved.found.method,
        "parameters": {k: v for k, v in summary.told().items() if k != "method"},
        "clipped": solved.negative_share if summary.clipped else 0.0,
    }
    if solved.block is not None:
        attrs["notes"] = {"block": list(solved.block)}
    write_artefact(
        target, Artefact("image", data, {"image": attrs}, provenance), overwrite=overwrite
    )
