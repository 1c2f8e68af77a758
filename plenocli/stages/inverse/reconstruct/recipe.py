"""What all captures of a run share: settings, matrices, estimators, batches of lenslets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from plenocli.base.device import device as device_of
from plenocli.base.errors import PlenoError
from plenocli.base.progress import bar, collected_notes
from plenocli.execution.pool import absolute, run_all
from plenocli.files.kept import kept
from plenocli.files.read.captures import superpixel_source
from plenocli.files.read.dictionaries import read_dictionary
from plenocli.files.read.system_matrices import (
    FieldMatrix,
    read_field_matrix,
    read_lenslet_matrix,
)
from plenocli.files.read.training import read_training
from plenocli.forward.camera.model import Camera
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.tiles import Source

if TYPE_CHECKING:
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
    device: "cpu" or "cuda", where plug and play works.
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
    device: str = "cpu"
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


def recipe_of(
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
        {
            "pif": pif,
            "calibration": calibration,
            "dictionary": settings.dictionary,
            "truth": settings.truth,
        }
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
def estimators_of(recipe: Recipe) -> Estimators:
    """What all captures of a recipe with a pif share."""
    if recipe.pif is None:
        raise ValueError("without a pif there is nothing to estimate with")
    settings, learnt = recipe.settings, recipe.settings.dictionary
    system = system_of(recipe)

    def read_pictures(scene: str | None) -> list[TrainingPicture]:
        return read_training(settings.training, system.object_shape, not_scene=scene)

    return Estimators(
        system,
        settings.options,
        read_pictures,
        None if learnt is None else partial(read_dictionary, learnt, system),
        threads=recipe.threads,
        keep=kept,
        device=device_of(settings.device),
    )


def source_of(
    recipe: Recipe, capture: Path, each_pixel: bool, beside: Path | None, *, verify: bool = True
) -> Source:
    """The superpixels of a capture, in the units of the recipe's matrix; arguments and errors as of
    superpixel_source.
    """
    return superpixel_source(
        capture,
        estimators_of(recipe).system,
        recipe.calibration,
        each_pixel=each_pixel,
        beside=beside,
        verify=verify,
    )


def system_of(recipe: Recipe) -> LensletMatrix:
    """The matrix of a recipe with a pif; of a whole array that on its axis."""
    assert recipe.pif is not None
    field = field_of(recipe)
    return read_lenslet_matrix(recipe.pif, by_band=True) if field is None else field.at((0.0, 0.0))


@lru_cache(maxsize=1)
def field_of(recipe: Recipe) -> FieldMatrix | None:
    """The matrices of a whole array, where the pif holds such."""
    return None if recipe.pif is None else read_field_matrix(recipe.pif, by_band=True)


@dataclass(frozen=True, kw_only=True)
class FittedCamera:
    """A camera that was fitted to a capture.

    model: of propagation behind which the capture is believed to have come about.
    """

    camera: Camera
    model: str


Matrix = FittedCamera | Literal["told", "finer"]
"""Which matrix pictures are estimated with: the pif's, a finer one of its camera, that of another
camera.
"""


def estimators_by(recipe: Recipe, matrix: Matrix) -> Estimators:
    """What all captures of a recipe share, by a matrix. That of a camera that was fitted takes some
    seconds once a process, and raises as plenocli.inverse.picture.trust.finer.matrix_of.
    """
    if isinstance(matrix, FittedCamera):
        return _fitted(recipe, matrix)
    return (finer_of(recipe) if matrix == "finer" else None) or estimators_of(recipe)


@lru_cache(maxsize=1)
def _fitted(recipe: Recipe, to: FittedCamera) -> Estimators:
    from plenocli.inverse.picture.trust.finer import matrix_of

    described = estimators_of(recipe)
    return described.with_matrix(matrix_of(described.system, to.camera, to.model))


@lru_cache(maxsize=1)
def finer_of(recipe: Recipe) -> Estimators | None:
    """The same by a finer matrix of the camera, where it can be had."""
    from plenocli.inverse.picture.trust.finer import finer_matrix

    rough = estimators_of(recipe)
    system = finer_matrix(rough.system)
    return None if system is None else rough.with_matrix(system)


def forget() -> None:
    """Let go of what captures shared."""
    for shared in (estimators_of, finer_of, field_of, _fitted):
        shared.cache_clear()


def solve_in_pool(
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
        return solve(estimators_of(recipe), batch, *options)
