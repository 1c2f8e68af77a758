"""`plenocli sweep`: many cameras through the stages."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "sweep",
    short_help=(
        "Carry a design space through the stages: a table, and the designs that no other beats."
    ),
)
@options.input_path("description", metavar="SWEEP.toml")
@options.table_output
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
    plot: Path | None,
    seed: int,
    workers: int,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Carry every point of a design space through simulate-pif, capture-sim, reconstruct (or
    simulate-response or calibrate, and demux; or refocus) and score. SWEEP.toml names a camera, the
    keys of it and of the stages' options that vary (a grid, a Latin hypercube or a list), and what
    counts as better.

    OUT is a table (.h5), with the same as .csv beside it and the points that no other beats marked.
    Finished points are kept in OUT's folder .parts: a run that was stopped goes on where it was,
    and one with more values computes only those; measured.csv there has the processor seconds of
    each stage, which differ from run to run. A camera that a stage refuses is a
    row with the reason.

    \b
    Examples:
      plenocli sweep sample_configs/sweeps/lenslets.toml -o sweep.h5 --plot front.png
      plenocli sweep sample_configs/sweeps/filters.toml --workers 2 -o filters.h5
      plenocli sweep sweep.toml --scheduler tcp://10.0.0.1:8786 -o sweep.h5
    """
    from plenocli.cli.sections import read_options
    from plenocli.stages.sweep.sweep import run_sweep
    from plenocli.stages.sweep.table import lines

    report = run_sweep(
        description,
        output,
        read_options=read_options,
        command=options.command_line(ctx),
        plot=plot,
        seed=seed,
        workers=workers,
        scheduler=scheduler,
        overwrite=overwrite,
    )
    options.summary(report.as_json(), as_json, lines(report))
