"""`plenocli fit-camera`: a camera's description made true by its own captures."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("fit-camera", short_help="Make a camera's description true by its own captures.")
@options.input_path("captures", nargs=-1, required=True)
@click.option(
    "--camera", required=True, type=options.FILE, help="Description (.toml) to start from."
)
@click.option(
    "--calibration",
    type=options.FILE,
    help="Lenslet grid and white reference of a real camera (from calibrate).",
)
@click.option(
    "--details",
    type=options.FILE,
    metavar="FIT",
    help="Also write values, standard deviations and correlations, an artefact .h5.",
)
@click.option(
    "--training",
    multiple=True,
    metavar="IMAGE",
    help=(
        "Photograph or skimage:NAME for the statistics of pictures. Repeatable; default those of "
        "scikit-image, without the astronaut."
    ),
)
@click.option(
    "--noise-sigma",
    type=options.POSITIVE,
    help="Standard deviation of the noise, relative like A x; default what the captures say.",
)
@click.option(
    "--fix",
    "fixed",
    multiple=True,
    metavar="NAME",
    help='Keep a parameter as described, such as "wavelength". Repeatable.',
)
@click.option(
    "--model",
    type=click.Choice(["auto", "fresnel", "exact"]),
    default="auto",
    show_default=True,
    help="Of propagation; auto: the one of simulated captures, else the finest that serves.",
)
@options.output
@options.seed
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    captures: tuple[Path, ...],
    *,
    camera: Path,
    calibration: Path | None,
    details: Path | None,
    training: tuple[str, ...],
    noise_sigma: float | None,
    fixed: tuple[str, ...],
    model: str,
    output: Path,
    seed: int,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Fit the description of a camera to CAPTURE..., of any scenes: no target is needed. Focus,
    lenslet pitch, sensor distance, lenslet focal length, wavelength, shift of the pixels and the
    main lens's astigmatism, coma and spherical aberration become what makes the captures most
    likely, with standard deviations; what they cannot tell apart is said.

    OUT is a camera description (.toml) like any other; a matrix that simulate-pif makes from it
    carries the remaining uncertainty as its model error. Captures must be of one camera, in light
    of one wavelength, with square lenslets that light only their own superpixels. Defective
    and saturated pixels count for nothing. Where no camera near the described one explains the
    captures, nothing is written and the exit code is 5.

    \b
    Examples:
      plenocli fit-camera capture.h5 --camera camera.toml -o fitted.toml
      plenocli fit-camera a.h5 b.h5 --camera camera.toml --details fit.h5 -o fitted.toml
      plenocli simulate-pif fitted.toml --superpixels 1x1 --coherent-ring 0 -o pif.h5
    """
    from plenocli.stages.inverse.fit_camera import run_fit_camera

    report = run_fit_camera(
        captures,
        output,
        camera=camera,
        calibration=calibration,
        details=details,
        training=training,
        noise_sigma=noise_sigma,
        fixed=fixed,
        model=model,
        seed=seed,
        overwrite=overwrite,
        command=options.command_line(ctx),
    )
    options.summary(report.as_json(), as_json, report.line())
