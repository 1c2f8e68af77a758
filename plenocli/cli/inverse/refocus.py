"""`plenocli refocus`: pictures focused elsewhere, and depth, from one capture."""

from pathlib import Path
from typing import Any

import click

from plenocli.cli import options


class _Slope(click.ParamType):
    """A number between -100 and 100."""

    name = "number"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number."""
        try:
            number = float(value)
        except ValueError:
            number = float("nan")
        if not -100 <= number <= 100:
            self.fail(f"{value!r} is no slope from -100 to 100; write for example 0.5", param, ctx)
        return number


@click.command(
    "refocus",
    short_help=(
        "Focus a capture at other distances, map its depth, look through parts of the pupil."
    ),
)
@options.input_path("capture")
@click.option(
    "--calibration",
    type=options.FILE,
    help="Lenslet grid and white image (from calibrate); captures of capture-sim need none.",
)
@click.option(
    "--camera", type=options.FILE, help="Camera description (.toml): turns slopes into distances."
)
@click.option(
    "--distance",
    "distances",
    multiple=True,
    type=options.DISTANCE,
    help="Plane to focus on, in front of the main lens, such as 500mm. Repeatable; needs --camera.",
)
@click.option(
    "--slope",
    "slopes",
    multiple=True,
    type=_Slope(),
    help=(
        "Plane by its parallax: 0 is the plane focused on the lenslets, 1 has one lenslet of "
        "parallax across the pupil, nearer ones are above 0. Repeatable."
    ),
)
@click.option(
    "--planes",
    type=options.Whole(1, 1000),
    default=13,
    show_default=True,
    help=(
        "Planes from slope -3 to 3 where neither --distance nor --slope is given; more of them, as "
        "far apart, while what has texture lies beyond."
    ),
)
@click.option(
    "--views",
    type=options.Whole(0, 15),
    default=3,
    show_default=True,
    help="Parts of the pupil along each side whose views are kept.",
)
@options.output
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    capture: Path,
    *,
    calibration: Path | None,
    camera: Path | None,
    distances: tuple[float, ...],
    slopes: tuple[float, ...],
    planes: int,
    views: int,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Refocus CAPTURE: every pixel's ray is followed to the planes asked for. With three planes or
    more OUT (.h5) holds a map of depth with its confidence; where nothing tells the depth it is
    unknown (NaN).

    Of a colour filter array each colour is refocused from its own pixels. Spectra from demux are
    refocused too, with the calibration of demux: each band is a view through its filter.

    \b
    Examples:
      plenocli refocus capture.png --calibration grid.h5 -o planes.h5
      plenocli refocus capture.h5 --camera camera.toml --distance 400mm --distance 550mm \\
          --distance 900mm -o planes.h5
      plenocli refocus chart.exr --calibration cal.h5 -o bands.h5
      plenocli show planes.h5
    """
    from plenocli.stages.inverse.refocus import run_refocus

    report = run_refocus(
        capture,
        output,
        overwrite=overwrite,
        command=options.command_line(ctx),
        calibration=calibration,
        camera=camera,
        distances=distances,
        slopes=slopes,
        planes=planes,
        views=views,
    )
    away = report.sharpest_distance_m
    known = report.depth_known_share
    rows, columns = report.lenslets
    options.summary(
        report.as_json(),
        as_json,
        (
            f"{report.output}: {report.planes} planes of {rows} x {columns} lenslets; sharpest at "
            f"slope {report.sharpest_slope:.3g}"
            f"{'' if away is None else f', {away:.4g} m away'}"
            f"{'' if known is None else f'; depth known in {100 * known:.3g} %'}"
        ),
    )
