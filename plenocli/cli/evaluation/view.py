"""`plenocli view`: a page in which files are looked at."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("view", short_help="One page to refocus, compare and read spectra in, offline.")
@options.input_path("files", metavar="FILE...", nargs=-1, required=True)
@options.output
@click.option(
    "--truth",
    metavar="TRUTH",
    help=(
        "What pictures and spectra are compared with, as in score: the capture, a "
        "photograph, skimage:astronaut."
    ),
)
@click.option(
    "--calibration",
    type=options.FILE,
    help="Calibration with the lenslets and the white image of captures, for their views.",
)
@click.option("--title", help="Title of the page; default the names of the files.")
@options.mem_limit
@options.overwrite
@options.as_json
def command(
    files: tuple[Path, ...],
    *,
    output: Path,
    truth: str | None,
    calibration: Path | None,
    title: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write one self-contained HTML page in which FILEs, or folders of them, are looked at: it
    asks no network for anything and opens from the file system.

    Captures and light fields are refocused by a slider and turned by dragging; spectra are drawn
    with error bars where one clicks; pictures beside --truth share a wipe of truth, result and
    error; volumes are cut three ways, sigma beside; calibrations, system matrices and dictionaries
    are leafed through. Values at the pointer are told, and ? lists the keys.

    Large pictures are averaged over whole blocks, which the page says.

    \b
    Examples:
      plenocli view capture.h5 -o view.html
      plenocli view lmmse.h5 tikhonov.h5 --truth capture.h5 -o compared.html
      plenocli view spectra.h5 calibration.h5 -o view.html
    """
    from plenocli.stages.evaluation.view import run_view

    made = run_view(
        files,
        output,
        truth=truth,
        calibration=calibration,
        title=title,
        overwrite=overwrite,
    )
    said = f"{output}: {', '.join(made.panels)}; {made.size_bytes / 1e6:.1f} MB"
    options.summary(made.as_json(), as_json, said)
