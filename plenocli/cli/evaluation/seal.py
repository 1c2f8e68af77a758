"""`plenocli seal`: vouching for a run folder, or for a file that was edited."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("seal", short_help="Vouch for a run folder, or for a file edited by hand.")
@options.input_path("path", metavar="PATH")
@click.option(
    "--was",
    type=options.FILE,
    metavar="ORIGINAL",
    help="The file before the edit: says value by value what was changed.",
)
@click.option(
    "--sign",
    "key",
    type=options.FILE,
    metavar="KEY",
    help="SSH key that signs the folder's SHA256SUMS into SHA256SUMS.sig.",
)
@options.mem_limit
@options.as_json
def command(path: Path, *, was: Path | None, key: Path | None, as_json: bool) -> None:
    """Write SHA256SUMS into the folder PATH, with the digest of every file in it and its folders
    (hidden ones left out), for `plenocli verify` or `sha256sum -c`; or give the file PATH, which
    was edited by hand or by another program, a digest that fits it again.

    An edited file must be what it was: one that breaks the rules of its kind is refused. An
    artefact keeps among its inputs the digest that it had before.

    \b
    Examples:
      plenocli seal runs/demo
      plenocli seal runs/demo --sign ~/.ssh/id_ed25519
      plenocli seal edited.h5 --was capture.h5
    """
    from plenocli.stages.evaluation.seal import run_seal

    sealed = run_seal(path, was=was, key=key)
    options.summary(sealed.as_json(), as_json, sealed.line())
