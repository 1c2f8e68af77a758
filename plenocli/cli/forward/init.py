"""`plenocli init`: sample configurations to start from."""

import shlex
from pathlib import Path

import click

from plenocli.cli import options


@click.command("init", short_help="Write sample cameras and a Makefile that runs the chain.")
@click.argument("folder", type=options.FILE, default=Path("plenocli-start"), metavar="[FOLDER]")
@options.mem_limit
@click.option("--overwrite", is_flag=True, help="Replace files that exist (refused by default).")
@options.as_json
def command(
    folder: Path,
    *,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Write the sample configurations (cameras, a lens, a scene, sweeps) into FOLDER, with a
    Makefile that runs the chain.

    FOLDER is made where it is missing; plenocli-start where none is named.

    \b
    Examples:
      plenocli init
      plenocli init experiment
      make -C experiment report
    """
    from plenocli.stages.forward.init import run_init

    made = run_init(folder, overwrite=overwrite)
    line = f"{folder}: {len(made.files)} files; next: make -C {shlex.quote(str(folder))}"
    options.summary(made.as_json(), as_json, line)
