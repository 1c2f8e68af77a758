"""sweep: many cameras through the chain, what each gives as one table, and the front of
those that none beats.
"""

from pathlib import Path

from plenocli.execution.pool import open_pool
from plenocli.stages.sweep.space import ReadOptions, open_space
from plenocli.stages.sweep.store import open_store
from plenocli.stages.sweep.table import SweepSummary, finish, objectives_of


def run_sweep(
    path: Path | str,
    output: Path | str,
    *,
    read_options: ReadOptions,
    seed: int = 0,
    workers: int = 1,
    scheduler: str | None = None,
    plot: Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> SweepSummary:
    """Carry every point of the design through the chain and write the table.

    path: of the sweep file.
    output: .h5; the same as .csv beside it.
    read_options: (stage, values) -> option -> value, as the command line reads them.
    workers, scheduler: as plenocli.execution.pool.open_pool.
    plot: picture of the front, where it is wanted.

    Finished points lie in the folder OUT.parts and are never computed again, whatever ended the
    run. A point that a stage refuses is a row with the reason.

    Raises ConfigError, InputError and UsageError as open_space, ConfigError for the front,
    OutputError where nothing can be written or a worker was lost.
    """
    from plenocli.files.config.sweep_file import points as points_of

    space = open_space(path, read_options, seed)
    points = [
        space.point(number, values)
        for number, values in enumerate(points_of(space.sweep, space.axes, seed))
    ]
    objectives = objectives_of(space, points)
    with (
        open_store(output, plot, overwrite, [path, space.camera_path]) as store,
        open_pool(workers, scheduler) as pool,
    ):
        computed = store.evaluate(points, pool, list(space.files))
        return finish(space, points, objectives, store, computed, command)
