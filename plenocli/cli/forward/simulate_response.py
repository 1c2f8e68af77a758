"""`plenocli simulate-response`: the response matrix F that a camera will have."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "simulate-response",
    short_help="Predict the response F of a camera, as a calibration that demux takes.",
)
@options.input_path("camera")
@click.option(
    "-o",
    "--output",
    required=True,
    type=options.FILE,
    metavar="OUT",
    help="Calibration to write, .h5.",
)
@click.option(
    "--wavelength",
    "wavelengths",
    type=options.WAVELENGTH,
    multiple=True,
    help="Band centre such as 450nm; repeatable; default [light] wavelengths.",
)
@click.option(
    "--bandwidth",
    type=options.LENGTH,
    default=None,
    help="Full width at half maximum of each band, such as 10nm; default one exact wavelength.",
)
@options.model("Rays (exact areas of the pupil), paraxial waves, or exact waves; auto is waves.")
@click.option(
    "--own-field",
    is_flag=True,
    help=(
        "Only light of the lenslet's own object points; default an even object, whose light "
        "neighbours exchange where the lens is out of focus."
    ),
)
@click.option(
    "--grid",
    type=options.FILE,
    metavar="CALIBRATION",
    help=(
        "Put F where the lenslets of a real camera are: a calibration made from white "
        "and dark images alone."
    ),
)
@click.option(
    "--exposure",
    type=options.DURATION,
    help="Exposure to which F refers, such as 2.5ms; default the camera's own.",
)
@click.option(
    "--spectral-step",
    type=options.LENGTH,
    default=None,
    help="Spacing of wavelengths for the white reference; default half of the narrowest filter.",
)
@options.superpixels("Superpixels summed over, where F is the sum of a system matrix")
@options.coherent_ring
@click.option(
    "--accuracy",
    type=options.POSITIVE,
    default=None,
    help="Relative error of that system matrix; default: what the sensor's noise lets be seen.",
)
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    camera: Path,
    *,
    output: Path,
    wavelengths: tuple[float, ...],
    bandwidth: float | None,
    model: str,
    own_field: bool,
    grid: Path | None,
    exposure: float | None,
    spectral_step: float | None,
    superpixels: tuple[int, int] | str,
    coherent_ring: int | str,
    accuracy: float | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Predict the response matrix F of CAMERA (a .toml file): pixel by band behind every lenslet,
    from filters, glasses, diffraction, colour filters and quantum efficiency. OUT is a calibration
    as calibrate measures it.

    \b
    Examples:
      plenocli simulate-response camera.toml -o predicted.h5
      plenocli simulate-response camera.toml --model ray --bandwidth 10nm -o rays.h5
      plenocli simulate-response camera.toml --grid white-only.h5 -o predicted.h5
      plenocli score predicted.h5 --truth calibration.h5 -o agreement.json
    """
    from plenocli.stages.forward.simulate_response import Settings, run_simulate_response

    summary = run_simulate_response(
        camera,
        output,
        Settings(
            wavelengths=wavelengths,
            bandwidth=bandwidth or 0.0,
            model=model,
            own_field=own_field,
            exposure=exposure,
            spectral_step=spectral_step,
            superpixels=superpixels,
            coherent_ring=coherent_ring,
            accuracy=accuracy,
        ),
        grid=grid,
        overwrite=overwrite,
        command=options.command_line(ctx),
    )
    notes = summary.notes
    line = (
        f"{output}: F of {len(summary.bands_nm)} bands, {summary.lenslets} lenslets, "
        f"{notes.model}, condition {summary.condition:.3g}"
    )
    if summary.smallest_angle_deg is not None:
        line += f", smallest angle between two columns {summary.smallest_angle_deg:.2f} deg"
    line += "; light from a lenslet's own field " + ", ".join(
        f"{share:.0%}" for share in notes.own_light
    )
    line += f"; taken to be known to {max(notes.error):.0%}"
    if notes.rays_against_waves is not None:
        line += "; rays differ from waves by " + ", ".join(
            f"{share:.1%}" for share in notes.rays_against_waves
        )
    options.summary(summary.as_json(), as_json, line)
