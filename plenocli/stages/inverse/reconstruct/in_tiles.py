"""The picture of a capture that is larger than a tile."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import both, on_threads
from plenocli.base.errors import PlenoError
from plenocli.base.progress import bar, collected_notes
from plenocli.execution.pool import Pool, run_all
from plenocli.files.artefacts.provenance import file_digest
from plenocli.files.read.captures import describe_capture, superpixel_source
from plenocli.forward.sensor.light_meter import Light
from plenocli.inverse.picture.diagnosis import Seen
from plenocli.inverse.picture.estimate import estimate
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.footprint import pieces_at_once, require_reconstruction
from plenocli.inverse.picture.lenslet_model import Superpixels, Whole
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.tiles import (
    Area,
    Source,
    Tile,
    largest_tile,
    side_of,
    spread_over,
    survey,
)
from plenocli.stages.inverse.reconstruct.fitted_matrix import fitted_to, likely_cause
from plenocli.stages.inverse.reconstruct.recipe import (
    Matrix,
    Recipe,
    estimators_by,
    estimators_of,
    field_of,
    finer_of,
)
from plenocli.stages.inverse.reconstruct.solved import Solved
from plenocli.stages.inverse.reconstruct.tiles import (
    SolvedTile,
    bench_of,
    put_together,
    solve_all,
)
from plenocli.stages.inverse.reconstruct.truth import truth_of

if TYPE_CHECKING:
    from plenocli.forward.accuracy.limiting_error import Limits


def picture_in_tiles(
    recipe: Recipe,
    capture: Path,
    source: Source,
    tiles: Sequence[Tile],
    pool: Pool,
    target: Path | None,
) -> Solved:
    """The picture of a capture that is larger than a tile; target: as of bench_of."""
    settings, system = recipe.settings, estimators_of(recipe).system
    # what comes before there are tiles is worked out by as many threads
    with on_threads(settings.workers):
        typical = _Typical.of(recipe, capture, source, tiles, target)
    sample, task = typical.found, typical.task
    all_weigh = METHODS[sample.method].weighs_all  # of the one that auto took
    task = task.sharing(pool, tiles if all_weigh else spread_over(source.count, side_of(system)))
    bench = bench_of(target, recipe, typical.capture, tiles)
    stats = solve_all(pool, task, tiles, bench, clip=settings.clip)
    return put_together(
        replace(sample, stats=stats or sample.stats),
        bench,
        tiles,
        system,
        declared=typical.declared,
        capture=typical.capture,
        seen=typical.seen,
        limits=typical.limits,
    )


def tiles_at_once(recipe: Recipe) -> int:
    """How many of its workers, threads of this process, the memory holds with a tile each."""
    estimators, method = estimators_of(recipe), METHODS[recipe.settings.method]
    return pieces_at_once(
        estimators,
        largest_tile(estimators, method),
        method.all_phases,
        joint=method.makes_joint_estimate(estimators),
        most=recipe.settings.workers,
    )


@dataclass(frozen=True, kw_only=True)
class _Typical:
    """What the square that is most like a capture tells of it.

    found: of the square.
    capture: as in Solved.
    seen: of its objects.
    limits: whether noise or the matrix decides.
    declared: whether the capture says where its sensor saturates.
    task: for tiles, which knows all this.
    """

    found: Reconstruction
    capture: dict[str, Any]
    seen: Seen | None
    limits: Limits | None
    declared: bool
    task: _TileTask

    @classmethod
    def of(
        cls,
        recipe: Recipe,
        capture: Path,
        source: Source,
        tiles: Sequence[Tile],
        target: Path | None,
    ) -> _Typical:
        """Of a capture whose tiles fit the memory. Raises NumericsError."""
        method, described = METHODS[recipe.settings.method], estimators_of(recipe)
        require_reconstruction(
            described,
            max(math.prod(part.stop - part.start for part in tile.around) for tile in tiles),
            source.cut(slice(1), slice(1)).sigma,
            capture,
            method.all_phases,
            joint=method.makes_joint_estimate(described),
        )
        matrix = matrix_of_capture(recipe, source, capture)
        asked = estimators_by(recipe, matrix)
        system = asked.system

        def about_capture() -> dict[str, Any]:
            if method.by_noise:  # what all that follows needs is made while the survey waits
                asked.prior.pictures(source.cut(slice(1), slice(1)).scene)
                asked.svd  # noqa: B018
            return describe_capture(capture)

        (whole, middle), about = both(
            lambda: survey(system, source, side_of(system)), about_capture
        )
        data = source.cut(*middle.own)
        Light.of([(data.y, None)]).tell(capture.name)
        matrix, limits = matrix_that_serves(recipe, matrix, data)
        estimators, off = estimators_by(recipe, matrix), error_that_counts(limits)
        declared = data.saturated is not None
        data, cause = replace(data, whole=whole), partial(likely_cause, estimators)
        truth = true_objects(recipe, source, middle.own)
        found, seen = estimate(estimators, method, data, truth, model_error=off, explain=cause)
        task = _TileTask(
            recipe=recipe,
            capture=capture,
            target=target,
            matrix=matrix,
            model_error=off,
            whole=whole,
        )
        return cls(
            found=found, capture=about, seen=seen, limits=limits, declared=declared, task=task
        )


@dataclass(frozen=True, kw_only=True)
class _TileTask:
    """The task of a tile, in any process; what they share is made once a process.

    target: beside which a capture that cannot be read in parts is decoded.
    matrix: by which.
    model_error: of the matrix, see estimate.
    whole: what is known of the capture.
    """

    recipe: Recipe
    capture: Path
    target: Path | None
    matrix: Matrix
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
        return SolvedTile.of(self._estimated(job[1], self.whole), job[1])

    def _estimated(self, tile: Tile, whole: Whole) -> Reconstruction:
        """A piece; what there is to say was said of the whole."""
        recipe = self.recipe
        estimators = estimators_by(recipe, self.matrix)
        method, system = METHODS[recipe.settings.method], estimators.system
        with collected_notes():
            source = superpixel_source(
                self.capture,
                system,
                recipe.calibration,
                each_pixel=method.each_pixel,
                beside=self.target,
                verify=False,
            )
            data = replace(source.cut(*tile.around, tile.within), whole=whole)
            truth = true_objects(recipe, source, tile.around)
            return estimate(estimators, method, data, truth, model_error=self.model_error)[0]


def true_objects(recipe: Recipe, source: Source, area: Area) -> np.ndarray | None:
    """Those of some lenslets, where a person gave them."""
    known = truth_of(recipe, source.count)
    return None if known is None else known.cut(*area)


def matrix_of_capture(recipe: Recipe, source: Source, capture: Path) -> Matrix:
    """The matrix that a person asked for: the pif's, or that of the camera that fits the capture.

    Raises as fitted_to.
    """
    if not recipe.settings.fit:
        return "told"
    return fitted_to(estimators_of(recipe), source, capture) or "told"


def matrix_that_serves(
    recipe: Recipe, matrix: Matrix, data: Superpixels
) -> tuple[Matrix, Limits | None]:
    """(the same, or a finer one where the pif's is off by more than the noise and it can be had;
    what limits the capture by it).
    """
    limits = limits_of(estimators_by(recipe, matrix), data)
    by_noise = METHODS[recipe.settings.method].by_noise
    off = by_noise and limits is not None and limits.limited_by == "model"
    if matrix != "told" or not off or field_of(recipe) is not None or finer_of(recipe) is None:
        return matrix, limits
    return "finer", limits_of(estimators_by(recipe, "finer"), data)


def error_that_counts(limits: Limits | None) -> float:
    """Error of the matrix that counts beside the noise."""
    return 0.0 if limits is None or limits.limited_by == "noise" else limits.model_error


def limits_of(estimators: Estimators, data: Superpixels) -> Limits | None:
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
