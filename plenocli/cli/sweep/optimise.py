"""`plenocli optimise`: a search through a design space."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("optimise", short_help="Search a design space for the best cameras.")
@options.input_path("description", metavar="SWEEP.toml")
@options.table_output
@click.option(
    "--trials",
    type=options.Whole(1, 100_000),
    default=100,
    show_default=True,
    help="Points to try in all, those of earlier runs included.",
)
@click.option(
    "--batch",
    type=options.Whole(1, 1000),
    default=4,
    show_default=True,
    help=(
        "Points proposed at a time, and so the most that run side by side; another "
        "number is another search."
    ),
)
@options.front_plot
@options.seed
@options.workers
@options.scheduler
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    description: Path,
    *,
    output: Path,
    trials: int,
    batch: int,
    plot: Path | None,
    seed: int,
    workers: int,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Search the design space of SWEEP.toml (as for sweep) for what its [front] calls better, with
    the sampler of Optuna: points are proposed where earlier ones were good. Needs
    the extra [optimise].

    OUT is the table that sweep writes, of the points that were tried. A run that was stopped goes
    on where it was; the same seed tries the same points, however many work at the same time. Points
    that sweep computed into the same OUT are not computed again.

    \b
    Examples:
      plenocli optimise sample_configs/sweeps/lenslets.toml --trials 60 -o best.h5
      plenocli optimise sample_configs/sweeps/filters.toml --trials 200 --workers 2 \\
          --plot front.png -o filters.h5
    """
    from plenocli.cli.sections import read_options
    from plenocli.stages.sweep.optimise import run_optimise
    from plenocli.stages.sweep.table import lines

    report = run_optimise(
        description,
        output,
        read_options=read_options,
        command=options.command_line(ctx),
        trials=trials,
        batch=batch,
        plot=plot,
        seed=seed,
        workers=workers,
        scheduler=scheduler,
        overwrite=overwrite,
    )
    options.summary(report.as_json(), as_json, lines(report))
