"""`plenocli refocus`: pictures focused elsewhere, and depth, from captures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from plenocli.cli import options

if TYPE_CHECKING:
    from plenocli.stages.inverse.refocus import RefocusSummary


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


class _Distance(click.ParamType):
    """A length, which before an objective may be below zero."""

    name = "length"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Metres."""
        if str(value).startswith("-"):
            return -float(options.PLANE.convert(str(value)[1:], param, ctx))
        return float(options.PLANE.convert(value, param, ctx))


@click.command(
    "refocus",
    short_help=(
        "Focus a capture at other distances, map its depth, look through parts of the pupil."
    ),
)
@options.input_path("captures", nargs=-1, required=True)
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
    type=_Distance(),
    help=(
        "Plane to focus on, in front of the main lens, such as 500mm; of a microscope its depth, "
        "away from the objective, such as -10um. Repeatable; needs --camera."
    ),
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
@click.option(
    "--format",
    "suffix",
    type=click.Choice(["h5", "tif", "exr"]),
    default="h5",
    show_default=True,
    help="File type when OUT is a folder.",
)
@options.output
@options.workers
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    captures: tuple[Path, ...],
    *,
    calibration: Path | None,
    camera: Path | None,
    distances: tuple[float, ...],
    slopes: tuple[float, ...],
    planes: int,
    views: int,
    suffix: str,
    output: Path,
    workers: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Refocus CAPTURE...: every pixel's ray is followed to the planes asked for. With three planes
    or more OUT holds a map of depth with its confidence and standard deviation; where nothing tells
    the depth it is unknown (NaN).

    OUT is an .h5 file, an OME-TIFF (.tif) that ImageJ and Fiji open as stacks with their sizes, or
    an .exr with the picture in focus, depth as Z and every plane as a layer; with several captures,
    or folders of them, a folder with one file each, in which finished ones are skipped. Of a large
    capture a run that was killed goes on from the planes that it finished.

    Of a colour filter array each colour is refocused from its own pixels. Spectra from demux are
    refocused too, with the calibration of demux: each band is a view through its filter.

    \b
    Examples:
      plenocli refocus capture.png --calibration grid.h5 -o planes.h5
      plenocli refocus capture.h5 --camera camera.toml --distance 400mm --distance 550mm \\
          --distance 900mm -o planes.h5
      plenocli refocus chart.exr --calibration cal.h5 -o bands.h5
      plenocli refocus captures/ --calibration grid.h5 --format tif --workers 2 -o stacks/
      plenocli show planes.h5
    """
    from plenocli.stages.inverse.refocus import Settings, run_refocus

    with options.partly_told(as_json):
        done = run_refocus(
            captures,
            output,
            Settings(
                calibration=calibration,
                camera=camera,
                distances=distances,
                slopes=slopes,
                planes=planes,
                views=views,
            ),
            suffix=f".{suffix}",
            workers=workers,
            overwrite=overwrite,
            command=options.command_line(ctx),
        )
    if len(done.reports) == 1 and not done.skipped:
        options.summary(done.reports[0].as_json(), as_json, _line(done.reports[0]))
        return
    report = {
        "output": done.output,
        "done": len(done.reports),
        "skipped": done.skipped,
        "captures": [one.as_json() for one in done.reports],
    }
    line = f"{output}: {len(done.reports)} refocused, {done.skipped} were finished before"
    options.summary(report, as_json, line)


def _line(report: RefocusSummary) -> str:
    """What is told of one capture."""
    away, known = report.sharpest_distance_m, report.depth_known_share
    rows, columns = report.lenslets
    return (
        f"{report.output}: {report.planes} planes of {rows} x {columns} lenslets"
        f"{' in ' + ', '.join(report.channels) if report.channels else ''}; sharpest at "
        f"slope {report.sharpest_slope:.3g}"
        f"{'' if away is None else ', ' + _away(away)}"
        f"{'' if known is None else f'; depth known in {100 * known:.3g} %'}"
    )


def _away(distance: float) -> str:
    return f"{distance:.4g} m away" if abs(distance) >= 1e-3 else f"{1e6 * distance:.4g} um deep"
