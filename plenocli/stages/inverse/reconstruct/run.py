"""reconstruct: the picture in front of the camera from a capture, per lenslet or with the
neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from plenocli.base.budget import on_threads
from plenocli.base.errors import UsageError
from plenocli.execution.batch import BatchSummary, outcomes, plan_batch, summarise
from plenocli.execution.pool import InProcess, open_pool
from plenocli.files.read.captures import forget_captures, named_captures
from plenocli.files.read.training import files_of
from plenocli.inverse.picture.methods.registry import METHODS, takers
from plenocli.stages.inverse.reconstruct.in_tiles import tiles_at_once
from plenocli.stages.inverse.reconstruct.one_capture import reconstruct_capture
from plenocli.stages.inverse.reconstruct.recipe import (
    Settings,
    estimators_of,
    forget,
    recipe_of,
    solve_in_pool,
    system_of,
)
from plenocli.stages.inverse.reconstruct.solved import PictureSummary, ReconstructSummary, Solved
from plenocli.stages.inverse.reconstruct.truth import truth_of
from plenocli.stages.inverse.reconstruct.write import write_picture


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

    Several go to settings.workers processes, or to a Dask cluster; so do tiles of a single one, or
    batches of its lenslets by methods that take long over each, or to as many threads where these
    serve as well. Finished ones are skipped unless overwrite.
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
    split = not batch.several
    workers = settings.workers if split else min(settings.workers, len(batch.todo))
    pooled = scheduler is not None or workers > 1
    # of several captures each is one worker's
    own = settings if split else replace(settings, workers=1)
    recipe = recipe_of(own, pif, calibration, pooled, elsewhere=scheduler is not None)

    def write(solved: Solved, capture: Path, target: Path) -> PictureSummary:
        inputs = solved.capture | _inputs(settings, pif, calibration)
        # of a single one nothing is estimated any more
        with on_threads(own.workers):
            return write_picture(target, solved, settings, command, inputs, overwrite)

    try:
        if pif:  # a broken one ends the run here, before any capture
            estimators_of(recipe) if split or not pooled else system_of(recipe)
        threads = split and method.in_threads
        if threads and pif:
            workers = min(workers, tiles_at_once(recipe))
        with open_pool(workers, scheduler, threads=threads) as pool:
            if split and pooled and pif:
                estimators_of(recipe).elsewhere = partial(solve_in_pool, recipe, pool)
            tasks = pool if split else InProcess()
            targets = dict(batch.todo)
            work = partial(reconstruct_capture, recipe, pool=tasks, targets=targets)
            if not split and pooled:  # whose tasks hold no pool
                work = partial(reconstruct_capture, recipe, targets=targets, far=pool.far)
            done = outcomes(batch, InProcess() if split else pool, work, write)
            return _summary(summarise(batch, done))
    finally:
        forget()
        truth_of.cache_clear()
        forget_captures()


def _summary(done: BatchSummary) -> ReconstructSummary:
    return ReconstructSummary(output=done.output, skipped=done.skipped, captures=done.reports)


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
        ("device", "device", None if settings.device == "cpu" else settings.device),
    ):
        if value is not None and option not in method.options:
            raise UsageError(
                f"--{spelt} means nothing to --method {method.name}",
                fix=f"leave it out, or use --method {takers(option)[-1]}",
            )


def _inputs(settings: Settings, pif: Path | None, calibration: Path | None) -> dict[str, Any]:
    """The files that a picture was made from beside its capture, for its provenance."""
    from plenocli.files.artefacts.provenance import describe_inputs

    return describe_inputs(
        {
            "pif": pif,
            "calibration": calibration,
            "dictionary": settings.dictionary,
            "truth": settings.truth,
            "training": files_of(settings.training),
        }
    )
