"""`plenocli simulate-pif`: the system matrix of a camera."""

from pathlib import Path
from typing import Any, Literal

import click

from plenocli.cli import options


class _Step(click.ParamType):
    name = "auto|LENGTH"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float | str:
        return value if value == "auto" else options.LENGTH.convert(value, param, ctx)


@click.command("simulate-pif", short_help="Compute the system matrix A of a camera by wave optics.")
@options.input_path("camera")
@click.option(
    "-o",
    "--output",
    type=options.FILE,
    metavar="OUT",
    help="File to write, .h5; not needed with --explain.",
)
@click.option(
    "--wavelength",
    "wavelengths",
    type=options.WAVELENGTH,
    multiple=True,
    help="Wavelength such as 550nm; repeatable; default [light] wavelengths.",
)
@click.option(
    "--spectral-step",
    type=_Step(),
    default=None,
    help=(
        "Instead: the wavelengths at which capture-sim samples white light, at "
        "this spacing, or auto."
    ),
)
@options.superpixels("Superpixels whose pixels are kept, odd")
@options.coherent_ring
@click.option(
    "--lenslet",
    type=options.PLACE,
    default=None,
    help=(
        "Lenslet of the array, counted from 0, with its pixels where the sensor's raster has them; "
        "default the one on the axis."
    ),
)
@click.option(
    "--field-nodes",
    type=options.Nodes(auto=True),
    default=None,
    help=(
        "Compute the matrices of a whole array: places of the field along an axis (3, 5, 7 ...), "
        "between which those of all lenslets are interpolated, or auto for the fewest that meet "
        "the accuracy; in numbered files beside OUT. Default: one matrix, that of the axis."
    ),
)
@options.model(
    "Propagation model; auto takes the cheapest that meets the accuracy, a named one is "
    "accurate within itself."
)
@click.option(
    "--accuracy",
    type=options.POSITIVE,
    default=None,
    help=(
        "Relative error of the worst column, against the finest model; default: what the "
        "sensor's noise lets be seen."
    ),
)
@click.option(
    "--scene",
    type=options.FILE,
    metavar="SCENE",
    help=(
        "Model only what this scene requires: a scene .toml (depth, spectrum, lenslets, snr), a "
        "photograph or a spectral EXR. Depth makes a matrix for each of the fewest planes that "
        "serve, in numbered files beside OUT."
    ),
)
@click.option(
    "--calibration",
    type=options.FILE,
    help=(
        "White image and lenslet grid (from calibrate) of a microscope: its objective's pupil is "
        "measured there, in place of an ideal one."
    ),
)
@click.option(
    "--dtype",
    type=click.Choice(["auto", "float32", "float64"]),
    default="auto",
    show_default=True,
    help="Type of the stored matrix.",
)
@options.device("Where the products of --model exact, square lenslets, are compressed")
@click.option(
    "--explain", is_flag=True, help="Print the plan, its cost and its reasons; compute nothing."
)
@options.mem_limit
@options.workers
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    camera: Path,
    *,
    output: Path | None,
    wavelengths: tuple[float, ...],
    spectral_step: float | Literal["auto"] | None,
    superpixels: tuple[int, int] | str,
    coherent_ring: int | str,
    lenslet: tuple[int, int] | None,
    field_nodes: int | Literal["auto"] | None,
    model: str,
    accuracy: float | None,
    scene: Path | None,
    calibration: Path | None,
    dtype: str,
    device: str,
    explain: bool,
    workers: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compute the system matrix A of CAMERA (a .toml file): for every object point over one
    lenslet's field the share of its light that lands on each pixel, by the cheapest model that
    meets --accuracy. Reports rank, condition, energy and symmetry.

    \b
    Examples:
      plenocli simulate-pif camera.toml -o pif.h5
      plenocli simulate-pif camera.toml --wavelength 450nm --wavelength 650nm \\
          --accuracy 1e-3 --explain
      plenocli simulate-pif camera.toml --scene scene.toml -o pif.h5
      plenocli simulate-pif camera.toml --field-nodes auto --accuracy 1e-2 -o field.h5
      plenocli simulate-pif camera.toml --model fresnel --superpixels 1x1 \\
          --coherent-ring 0 -o isolated.h5
      plenocli simulate-pif microscope.toml --calibration white.h5 -o kernels.h5
    """
    from plenocli.stages.forward.simulate_pif import Settings, run_simulate_pif

    report = run_simulate_pif(
        camera,
        output,
        Settings(
            wavelengths=wavelengths,
            spectral_step=spectral_step,
            superpixels=superpixels,
            coherent_ring=coherent_ring,
            lenslet=lenslet,
            field_nodes=field_nodes,
            model=model,
            accuracy=accuracy,
            scene=scene,
            calibration=calibration,
            dtype=dtype,
            device=device,
        ),
        explain=explain,
        overwrite=overwrite,
        workers=workers,
        command=options.command_line(ctx),
    )
    options.summary(report.as_json(), as_json, report.line())
