"""`plenocli plan`: the cheapest chain that loses little."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "plan",
    short_help="The cheapest way from a camera's capture to a picture that loses little.",
)
@options.input_path("camera")
@click.option(
    "--scene",
    required=True,
    metavar="SCENE",
    help=(
        "Photograph that stands for what will be captured, or skimage:astronaut: a part of it is "
        "captured and reconstructed in rehearsal."
    ),
)
@click.option(
    "--quality-loss",
    type=options.LOSS,
    required=True,
    help="PSNR that may be lost against the best chain, such as 0.1dB.",
)
@click.option(
    "--snr",
    "snr_db",
    type=options.DECIBEL,
    help="Signal-to-noise ratio of the captures, such as 60dB, instead of the sensor's own noise.",
)
@click.option(
    "--capture",
    type=options.FILE,
    default=Path("capture.h5"),
    show_default=True,
    help="Capture that the printed commands name; it is not read.",
)
@options.seed
@options.mem_limit
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    camera: Path,
    *,
    scene: str,
    quality_loss: float,
    snr_db: float | None,
    capture: Path,
    seed: int,
    as_json: bool,
) -> None:
    """Plan the chain from CAMERA (a .toml file) and its captures to a picture: which model, which
    accuracy, whether with the neighbours' light, which method. Every chain is listed with the time
    of one core and the memory that it takes and the PSNR that it is predicted to lose, those that
    were not rehearsed themselves as "about". The last lines are the commands of the cheapest one
    that loses no more than asked; all others are comments, so that sh can run
    what is printed.

    \b
    Examples:
      plenocli plan camera.toml --scene photo.png --quality-loss 0.1dB
      plenocli plan sample_configs/tiny.toml --scene skimage:astronaut --snr 50dB \\
          --quality-loss 0.5dB
    """
    from plenocli.stages.inverse.plan import Settings, run_plan

    settings = Settings(quality_loss=quality_loss, snr_db=snr_db, capture=str(capture), seed=seed)
    report = run_plan(camera, scene, settings)
    options.summary(report.as_json(), as_json, report.lines())
