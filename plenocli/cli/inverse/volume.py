"""`plenocli volume`: a specimen in three dimensions from one capture."""

from pathlib import Path
from typing import Any, Literal

import click

from plenocli.cli import options


class _Background(click.ParamType):
    name = "auto|NUMBER"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        """The word auto, or a number."""
        return value if value == "auto" else options.NON_NEGATIVE.convert(value, param, ctx)


@click.command("volume", short_help="Reconstruct a volume, with error bars, from one capture.")
@options.input_path("capture")
@click.option(
    "--pif",
    type=options.FILE,
    required=True,
    help="Kernels of the volume: simulate-pif of a description with an [objective].",
)
@click.option(
    "--calibration",
    type=options.FILE,
    help="Lenslet grid and white image (from calibrate); captures of capture-sim need none.",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "rl", "lmmse", "tv", "tikhonov"]),
    default="auto",
    show_default=True,
    help=(
        "Richardson-Lucy, Gaussian prior with error bars (lmmse), total variation, independent "
        "voxels (tikhonov); auto takes what predicts held-out pixels best."
    ),
)
@click.option(
    "--hold-out",
    type=options.SHARE,
    default=0.05,
    show_default=True,
    help="Share of the pixels that no method sees and by which they are judged, such as 0.05.",
)
@click.option(
    "--background",
    type=_Background(),
    default="auto",
    show_default=True,
    help=(
        "Light without any specimen, in units of the white image (or of the simulation); auto "
        "takes the haze that the darkest lenslets show, where held-out pixels agree."
    ),
)
@click.option(
    "--most-planes",
    type=options.Whole(1, 1000),
    default=None,
    help=(
        "Keep the planes of the kernels that predict held-out pixels best, no more than this: "
        "photographic cameras support two or three. Default: all."
    ),
)
@click.option(
    "--channel",
    type=click.Choice(["R", "G", "B"]),
    default=None,
    help="Pixels of a colour sensor that are taken; each colour makes a volume of its own.",
)
@click.option(
    "--like",
    type=options.FILE,
    help=(
        "Volume (.h5) of another colour of the specimen, on the same voxels and clearer than this "
        "one, whose structure it may share; by total variation of what is not in the other."
    ),
)
@options.device("Where kernels are multiplied and transformed")
@options.output
@options.seed
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    capture: Path,
    *,
    pif: Path,
    calibration: Path | None,
    method: str,
    hold_out: float,
    background: float | Literal["auto"],
    most_planes: int | None,
    channel: str | None,
    like: Path | None,
    device: str,
    output: Path,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Make a volume of CAPTURE, seen through a microscope's lenslets. OUT is .h5, or .ome.tif
    (voxels in micrometres, errors as a second channel), which Fiji opens.

    \b
    Examples:
      plenocli simulate-pif microscope.toml -o kernels.h5
      plenocli volume capture.h5 --pif kernels.h5 -o volume.h5
      plenocli volume light_field.tif --pif kernels.h5 --calibration grid.h5 \\
          --method lmmse -o volume.ome.tif
      plenocli volume red.h5 --pif kernels-red.h5 --like green-volume.h5 -o red-volume.h5
    """
    from plenocli.stages.inverse.volume import run_volume

    report = run_volume(
        capture,
        output,
        pif,
        calibration=calibration,
        method=method,
        hold_out=hold_out,
        background=background,
        most_planes=most_planes,
        channel=channel,
        like=like,
        device=device,
        overwrite=overwrite,
        seed=seed,
        command=options.command_line(ctx),
    )
    options.summary(report.as_json(), as_json, report.line())
