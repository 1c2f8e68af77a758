"""optimise: a design space searched where earlier points were good, by the tree-structured Parzen
estimator of Optuna.

Points are proposed in batches of a fixed size from a seeded sampler that hears results in the order
in which it proposed, so that the search does not depend on how many work at the same time; and
since results are kept, a run that was stopped is repeated from its journal up to where it was.
"""

import numpy as np

from plenocli.base.errors import ConfigError, UsageError
from plenocli.base.extras import how_to_install
from plenocli.execution.pool import open_pool
from plenocli.stages.sweep.space import open_space
from plenocli.stages.sweep.store import open_store
from plenocli.stages.sweep.table import finish, objectives_of


def run_optimise(
    path,
    output,
    *,
    read_options,
    trials=100,
    batch=4,
    seed=0,
    workers=1,
    scheduler=None,
    plot=None,
    overwrite=False,
    command="",
):
    """Try `trials` points of the space in the sweep file at `path`, `batch` at a time, and write
    the table as run_sweep does; returns its summary.

    ConfigError where nothing varies freely (design = "list"), UsageError where Optuna is missing;
    else as run_sweep.
    """
    space = open_space(path, read_options, seed)
    if not space.axes:
        raise ConfigError(
            'design = "list" leaves nothing to search', path, "give [vary], or use sweep"
        )
    objectives = objectives_of(
        space, [space.row(0, {key: axis.at(0.0) for key, axis in space.axes.items()})]
    )
    with (
        open_store(output, plot, overwrite, [path, space.camera_path]) as store,
        open_pool(workers, scheduler) as pool,
    ):
        study, rows, computed = _study(objectives, seed), {}, 0
        for start in range(0, trials, batch):
            asked = [_ask(study, space) for _ in range(min(batch, trials - start))]
            found = [space.row(start + i, point) for i, (_, point) in enumerate(asked)]
            computed += store.evaluate(
                found,
                pool,
                list(space.files),
                label=f"points {start + 1} to {start + len(asked)} of {trials}",
            )
            for (trial, _), row in zip(asked, found):
                _tell(study, trial, row, objectives)
                rows.setdefault(row.key, row)
        for number, row in enumerate(rows.values()):
            row.number = number
        return finish(space, list(rows.values()), objectives, store, computed, command)


def _study(objectives, seed):
    try:
        import optuna
    except ImportError as error:
        raise UsageError(
            "optimise needs Optuna, which is not installed", fix=how_to_install("optimise")
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    directions = ["maximize" if way == "max" else "minimize" for way in objectives.values()]
    return optuna.create_study(
        directions=directions,
        sampler=optuna.samplers.TPESampler(seed=seed % 2**32, multivariate=False),
    )


def _ask(study, space):
    """(trial, point) that the sampler proposes.

    Values in an order are places in it, so that neighbours are seen as such.
    """
    from plenocli.files.config.sweep_file import Choice, number

    trial = study.ask()
    point = {}
    for key, axis in space.axes.items():
        if isinstance(axis, Choice):
            numbers = [number(value) for value in axis.values]
            ordered = all(n is not None for n in numbers) and bool(np.all(np.diff(numbers) > 0))
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


def _tell(study, trial, row, objectives):
    from optuna.trial import TrialState

    from plenocli.files.config.sweep_file import number

    figures = [row.result["metrics"].get(name, number(row.point.get(name))) for name in objectives]
    if row.result["status"] or any(value is None for value in figures):
        study.tell(trial, state=TrialState.FAIL)
    else:
        study.tell(trial, figures)
