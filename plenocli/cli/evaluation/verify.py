"""`plenocli verify`: whether files are as they were written."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("verify", short_help="Say whether files or a run folder are as they were written.")
@options.input_path("paths", metavar="PATH...", nargs=-1, required=True)
@click.option(
    "--signed-by",
    "signers",
    type=options.FILE,
    metavar="SIGNERS",
    help=(
        "Allowed signers, one of whom must have signed the folder's manifest: lines of a name "
        "and a public SSH key, as ssh-keygen describes them."
    ),
)
@options.mem_limit
@options.as_json
def command(paths: tuple[Path, ...], *, signers: Path | None, as_json: bool) -> None:
    """Compare every PATH with what was written: a file (.h5, .dng, .exr, .ome.tif, score .json)
    with the digest that it carries, a folder with its SHA256SUMS, which the pipelines and
    `plenocli seal` write. What was altered or is missing ends with exit code 3.

    A digest finds damage and edits, not forgery: who can write a file can write its digest. Against
    that a manifest is signed (seal --sign) and checked here with --signed-by.

    \b
    Examples:
      plenocli verify capture.h5 score.json
      plenocli verify runs/demo
      plenocli verify runs/demo --signed-by allowed_signers
    """
    from plenocli.stages.evaluation.verify import run_verify

    found = [run_verify(path, signers=signers) for path in paths]
    options.summary(
        {"verified": [v.as_json() for v in found]}, as_json, "\n".join(v.line() for v in found)
    )
