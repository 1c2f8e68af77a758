"""optimise: a design space searched where earlier points were good, by the tree-structured Parzen
estimator of Optuna.

Points are proposed in batches of a fixed size from a seeded sampler that hears results in the order
in which it proposed, so that the search does not depend on how many work at the same time; and
since results are kept, a run that was stopped is repeated from its journal up to where it was.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import ConfigError, UsageError
from plenocli.base.text import how_to_install
from plenocli.execution.pool import open_pool
from plenocli.stages.sweep.space import DesignPoint, ReadOptions, Space, open_space
from plenocli.stages.sweep.store import open_store
from plenocli.stages.sweep.table import SweepSummary, finish, objectives_of, result_of

if TYPE_CHECKING:
    from optuna import Study, Trial


def run_optimise(
    path: Path | str,
    output: Path | str,
    *,
    read_options: ReadOptions,
    trials: int = 100,
    batch: int = 4,
    seed: int = 0,
    workers: int = 1,
    scheduler: str | None = None,
    plot: Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> SweepSummary:
    """Try points of a design space where earlier ones were good, and write the table as run_sweep
    does.

    trials: points to try.
    batch: of them proposed at a time.
    The others as run_sweep's.

    Raises ConfigError where nothing varies freely (design = "list"), UsageError where Optuna is
    missing; else as run_sweep.
    """
    space = open_space(path, read_options, seed)
    if not space.axes:
        raise ConfigError(
            'design = "list" leaves nothing to search', path, "give [vary], or use sweep"
        )
    objectives = objectives_of(
        space, [space.point(0, {key: axis.at(0.0) for key, axis in space.axes.items()})]
    )
    with (
        open_store(output, plot, overwrite, [path, space.camera_path]) as store,
        open_pool(workers, scheduler) as pool,
    ):
        study, computed = _study(objectives, seed), 0
        tried: dict[str, DesignPoint] = {}
        for start in range(0, trials, batch):
            asked = [_ask(study, space) for _ in range(min(batch, trials - start))]
            found = [space.point(start + i, values) for i, (_, values) in enumerate(asked)]
            computed += store.evaluate(
                found,
                pool,
                list(space.files),
                label=f"points {start + 1} to {start + len(asked)} of {trials}",
            )
            for (trial, _), point in zip(asked, found):
                _tell(study, trial, point, objectives)
                tried.setdefault(point.key, point)
        for number, point in enumerate(tried.values()):
            point.number = number
        return finish(space, list(tried.values()), objectives, store, computed, command)


def _study(objectives: Mapping[str, str], seed: int) -> Study:
    try:
        import optuna
    except ImportError as error:
        raise UsageError(
            "optimise needs Optuna, which is not installed", fix=how_to_install("optimise")
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna.create_study(
        directions=["maximize" if aim == "max" else "minimize" for aim in objectives.values()],
        sampler=optuna.samplers.TPESampler(seed=seed % 2**32, multivariate=False),
    )


def _ask(study: Study, space: Space) -> tuple[Trial, dict[str, Any]]:
    """(trial, point) that the sampler proposes.

    Values in an order are places in it, so that neighbours are seen as such.
    """
    from plenocli.files.config.sweep_file import Choice, number

    trial = study.ask()
    point = {}
    for key, axis in space.axes.items():
        if isinstance(axis, Choice):
            numbers = [number(value) for value in axis.values]
            known = [n for n in numbers if n is not None]
            ordered = len(known) == len(numbers) and bool(np.all(np.diff(known) > 0))
            count = len(axis.values)
            place = (
                trial.suggest_int(key, 0, count - 1)
                if ordered
                else trial.suggest_categorical(key, list(range(count)))
            )
            point[key] = axis.values[place]
        elif axis.steps is not None:
            point[key] = axis.at((trial.suggest_int(key, 0, axis.steps - 1) + 0.5) / axis.steps)
        else:
            point[key] = axis.at(trial.suggest_float(key, 0.0, 1.0))
    return trial, point


def _tell(study: Study, trial: Trial, point: DesignPoint, objectives: Mapping[str, str]) -> None:
    """Tell the sampler the figures of a point; one without figures counts as the worst of all that
    were heard so far, so that the sampler keeps away from its like.
    """
    from optuna.trial import TrialState

    from plenocli.files.config.sweep_file import number

    result = result_of(point)
    figures = [result.metrics.get(name, number(point.values.get(name))) for name in objectives]
    known = [value for value in figures if value is not None]
    if not result.status and len(known) == len(figures):
        study.tell(trial, known)
        return
    heard = [t.values for t in study.trials if t.state == TrialState.COMPLETE]
    if not heard:
        study.tell(trial, state=TrialState.FAIL)
        return
    worst = [min if aim == "max" else max for aim in objectives.values()]
    study.tell(trial, [of(values) for of, values in zip(worst, zip(*heard), strict=True)])
