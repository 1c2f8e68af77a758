"""`plenocli report`: one page about a run folder."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "report", short_help="One page with pictures and tables about everything in a run folder."
)
@options.input_path("run_folder")
@options.output
@click.option("--title", help="Title of the page; default the name of the folder.")
@click.option(
    "--view",
    type=options.FILE,
    metavar="VIEW",
    help="Also write this page of views of the files (.html), as view does, and link to it.",
)
@options.mem_limit
@options.overwrite
@options.as_json
def command(
    run_folder: Path,
    *,
    output: Path,
    title: str | None,
    view: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw what lies in RUN_FOLDER and below (.h5, .exr, .dng, score*.json) on one
    self-contained HTML page.

    Sections: spatial (system matrix, captures, reconstructions beside their truth, dictionary),
    spectral (calibration, response, bands, spectra of patches, error and SNR), files with their
    provenance. Needs matplotlib: the extra [plot].

    \b
    Example:
      plenocli report runs/demo -o runs/demo/report.html --view runs/demo/view.html --overwrite
    """
    from plenocli.base.text import counted
    from plenocli.stages.evaluation.report import run_report

    made = run_report(run_folder, output, title=title, view=view, overwrite=overwrite)
    missing = f", {len(made.unreadable)} unreadable" if made.unreadable else ""
    options.summary(
        made.as_json(),
        as_json,
        f"{output}: {', '.join(made.sections) or 'no pictures'}; "
        f"{counted(made.files, 'file')}{missing}",
    )
