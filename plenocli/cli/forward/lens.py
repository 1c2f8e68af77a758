"""`plenocli lens`: real lenses, imported and described."""

import math
from pathlib import Path
from typing import Any

import click

from plenocli.cli import options


class _Angle(click.ParamType):
    name = "angle"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Radians from text such as 5deg or 0.1rad, from 0 to below 90 degrees."""
        if not isinstance(value, str):
            return value
        for unit, scale in (("deg", math.pi / 180), ("mrad", 1e-3), ("rad", 1.0)):
            if value.strip().endswith(unit):
                try:
                    angle = float(value.strip().removesuffix(unit)) * scale
                except ValueError:
                    break
                if 0 <= angle < math.radians(89):
                    return angle
                self.fail(f"{value!r} is outside 0deg ... 89deg", param, ctx)
        self.fail(
            f"{value!r} is no angle; write a number and deg, rad or mrad, such as 5deg", param, ctx
        )


@click.group("lens", short_help="Import a lens prescription; show what a lens does.")
def command() -> None:
    """Real lenses for main_lens.prescription: surfaces, glasses and stop in a TOML
    file, traced exactly.

    \b
    Examples:
      plenocli lens import triplet.zmx -o lens.toml
      plenocli lens show lens.toml --wavelength 450nm --wavelength 650nm --field 0deg --field 12deg
    """


@command.command(
    "import", short_help="Convert a .zmx, .seq or optiland .json prescription into a lens file."
)
@options.input_path("prescription", metavar="FILE")
@options.output
@click.option(
    "--focal-length",
    type=options.DISTANCE,
    help="Scale the lens to this focal length, such as 50mm.",
)
@options.mem_limit
@options.overwrite
@options.as_json
def import_command(
    prescription: Path,
    *,
    output: Path,
    focal_length: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Convert FILE, a Zemax .zmx, CODE V .seq or optiland .json prescription, into a lens file OUT
    (.toml) with the dispersion of every glass written out. Needs optiland: the extra [lens].

    \b
    Examples:
      plenocli lens import triplet.zmx -o lens.toml
      plenocli lens import doublegauss.seq --focal-length 50mm -o lens50.toml
    """
    from plenocli.stages.forward.lens import line, run_lens_import

    report = run_lens_import(prescription, output, focal_length=focal_length, overwrite=overwrite)
    options.summary(report.as_json(), as_json, line(report))


@command.command(
    "show",
    short_help="First-order data, focal shift, wavefront error and lateral colour of a lens file.",
)
@options.input_path("lens", metavar="LENS")
@click.option(
    "--wavelength",
    "wavelengths",
    type=options.WAVELENGTH,
    multiple=True,
    help="Wavelength such as 550nm; repeatable; default F, C and the lens's own.",
)
@click.option(
    "--field",
    "fields",
    type=_Angle(),
    multiple=True,
    default=("0deg",),
    help="Field angle such as 5deg; repeatable; default 0deg.",
)
@click.option(
    "--object-distance",
    type=options.DISTANCE,
    help=(
        "From the first surface, such as 550mm; default the lens's own, infinity "
        "where it names none."
    ),
)
@options.mem_limit
@options.as_json
def show_command(
    lens: Path,
    *,
    wavelengths: tuple[float, ...],
    fields: tuple[float, ...],
    object_distance: float | None,
    as_json: bool,
) -> None:
    """Trace the lens of LENS (a .toml file) and print focal length, back focus, pupils and focal
    shift per wavelength, and per field the wavefront error, lateral colour, distortion and the
    share of the stop that is lit. --json adds Zernike terms.

    \b
    Examples:
      plenocli lens show lens.toml
      plenocli lens show lens.toml --wavelength 450nm --wavelength 650nm --field 0deg \\
          --field 12deg --object-distance 550mm --json
    """
    from plenocli.stages.forward.lens import describe, run_lens_show

    report = run_lens_show(
        lens, wavelengths=wavelengths, fields=fields, object_distance=object_distance
    )
    options.summary(report.as_json(), as_json, describe(report))
