"""`plenocli inspect`: what a file holds."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("inspect", short_help="Verify a file and show what it holds.")
@options.input_path("file", metavar="FILE")
@options.mem_limit
@options.as_json
def command(
    file: Path,
    *,
    as_json: bool,
) -> None:
    """Verify FILE as a stage would and show what it holds: any artefact (.h5), EXR, camera RAW or
    DNG, PNG, TIFF or JPEG.

    Artefacts: command, inputs, seed, accuracy, every dataset with unit and range. RAW: mosaic size,
    colour filter array, black and white level in DN, exposure time in seconds. A file that a stage
    would refuse ends here with the same reason and exit code 3.

    \b
    Examples:
      plenocli inspect pif.h5
      plenocli inspect IMG_0001.NEF --json
    """
    from plenocli.stages.evaluation.inspect import run_inspect

    report = run_inspect(file)
    options.summary(report.as_json(), as_json, report.text())
