"""sweep: many cameras through the chain, what each gives as one table, and the front of
those that none beats.
"""

from plenocli.execution.pool import open_pool
from plenocli.stages.sweep.space import open_space
from plenocli.stages.sweep.store import open_store
from plenocli.stages.sweep.table import finish, objectives_of


def run_sweep(
    path,
    output,
    *,
    read_options,
    seed=0,
    workers=1,
    scheduler=None,
    plot=None,
    overwrite=False,
    command="",
):
    """Carry every point of the design through the chain and write the table `output` (.h5), the
    same as .csv, and perhaps the front as a picture; returns a summary dict.

    Finished points lie in the folder OUT.parts and are never computed again, whatever ended the
    run. A point that a stage refuses is a row with the reason.
    workers, scheduler: see execution.pool. Errors: as open_space;
    UsageError for the front, OutputError where nothing can be written or a worker was lost.
    """
    from plenocli.files.config.sweep_file import points

    space = open_space(path, read_options, seed)
    rows = [
        space.row(number, point)
        for number, point in enumerate(points(space.sweep, space.axes, seed))
    ]
    objectives = objectives_of(space, rows)
    with (
        open_store(output, plot, overwrite, [path, space.camera_path]) as store,
        open_pool(workers, scheduler) as pool,
    ):
        computed = store.evaluate(rows, pool, list(space.files))
        return finish(space, rows, objectives, store, computed, command)
