"""`plenocli show`: pictures of files."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("show", short_help="Draw what is in a file, or results beside their truth.")
@options.input_path("files", metavar="FILE...", nargs=-1, required=True)
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    metavar="OUT",
    help="PNG to write; default the name of the first FILE, .png, in this folder.",
)
@click.option(
    "--truth",
    metavar="TRUTH",
    help=(
        "What pictures are compared with, as in score: the capture, a "
        "photograph, skimage:astronaut."
    ),
)
@click.option(
    "--calibration",
    type=options.FILE,
    help="Calibration whose lenslet grid is drawn over captures.",
)
@click.option(
    "--point",
    "points",
    type=options.PLACE,
    multiple=True,
    help="Object point whose column of A is shown, counted from 0; repeatable; default nine.",
)
@click.option(
    "--lenslet",
    "lenslets",
    type=options.PLACE,
    multiple=True,
    help="Lenslet whose spectrum is shown, counted from 0; repeatable; default five.",
)
@options.mem_limit
@options.overwrite
@options.as_json
def command(
    files: tuple[Path, ...],
    *,
    output: Path | None,
    truth: str | None,
    calibration: Path | None,
    points: tuple[tuple[int, int], ...],
    lenslets: tuple[tuple[int, int], ...],
    overwrite: bool,
    as_json: bool,
) -> None:
    """Draw FILEs, or folders of them, into one picture: system matrix, capture (with its lenslet
    grid), calibration, spectra, dictionary, image, as artefact, EXR or RAW.

    A dictionary is drawn on the sensor too when its pif is among the FILEs. Needs
    matplotlib: the extra [plot].

    \b
    Examples:
      plenocli show pif.h5 -o pif.png
      plenocli show pif.h5 --point 0,0 --point 20,20 -o columns.png
      plenocli show tikhonov.h5 lmmse.h5 --truth capture.h5 -o compared.png
      plenocli show IMG_0001.NEF --calibration calibration.h5
    """
    from plenocli.stages.evaluation.show import run_show

    made = run_show(
        files,
        output=output,
        truth=truth,
        calibration=calibration,
        points=points,
        lenslets=lenslets,
        overwrite=overwrite,
    )
    kinds = ", ".join(dict.fromkeys(made.kinds))
    options.summary(made.as_json(), as_json, f"{made.output}: {kinds}")
