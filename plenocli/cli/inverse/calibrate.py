"""`plenocli calibrate`: the lenslet grid and the response of a camera from its captures."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "calibrate",
    short_help=(
        "Find the lenslet grid and measure the response F from white, dark and "
        "narrow-band captures."
    ),
)
@click.option(
    "--white",
    "whites",
    multiple=True,
    type=options.FILE,
    help="White image: even light through the main lens. Repeatable, or a folder: averaged.",
)
@click.option(
    "--scene",
    "scenes",
    multiple=True,
    type=options.FILE,
    help=(
        "Capture of any scene, where there is no white image: the grid with the error to expect. "
        "Repeatable, which makes it surer; beside a --white of another day: how lenslets moved "
        "since."
    ),
)
@click.option(
    "--grid-error",
    type=options.POSITIVE,
    default=0.1,
    show_default=True,
    metavar="PX",
    help="Largest expected error (rms) of a grid from --scene that is accepted.",
)
@click.option(
    "--dark",
    "darks",
    multiple=True,
    type=options.FILE,
    help="Dark frame. Repeatable; without one the file's black level is used.",
)
@click.option(
    "--band",
    "bands",
    multiple=True,
    type=options.Pair("FILE", Path),
    help=(
        "White target under narrow-band light, such as 450nm=band450.dng. "
        "Repeatable, also within a band."
    ),
)
@click.option(
    "--band-across",
    "across",
    type=options.Pair("FILE", Path),
    multiple=True,
    help=(
        "For cameras with polarisers: the same under light along 90 degrees, where that of --band "
        "is along 0. Repeatable."
    ),
)
@click.option(
    "--band-radiance",
    "radiances",
    multiple=True,
    type=options.Pair("NUMBER", options.positive),
    help="Relative radiance of a narrow-band source, such as 450nm=0.8; default 1.",
)
@click.option(
    "--camera",
    type=options.FILE,
    help="Camera description (.toml) for gain, read noise and the number of lenslets.",
)
@click.option(
    "--response",
    type=click.Choice(["auto", "shared", "own", "low-rank"]),
    default="auto",
    show_default=True,
    help=(
        "One F shared by all lenslets, an F of its own for each, or own ones without the noise "
        "that stands out of what they have in common (with a hundred lenslets one capture a band "
        "then does what four do). auto: shared where the data cannot tell lenslets apart, else own."
    ),
)
@click.option(
    "--lattice",
    type=click.Choice(["auto", "square", "hexagonal"]),
    default="auto",
    show_default=True,
    help="Lattice of the lenslet array; auto lets the image decide.",
)
@click.option(
    "--centre",
    "near",
    type=(options.NON_NEGATIVE, options.NON_NEGATIVE),
    default=None,
    metavar="ROW COLUMN",
    help=(
        "A pixel near the centre of any superpixel: a grid without a centre within a quarter of "
        "the pitch of it is refused. Needed only where filters in the pupil draw lines as dark as "
        "the superpixels' borders."
    ),
)
@click.option(
    "--cfa",
    type=click.Choice(["mono", "RGGB", "BGGR", "GRBG", "GBRG"]),
    help=(
        "Colour filter array of PNG and TIFF mosaics, which cannot say it; default the "
        "camera's, else mono."
    ),
)
@options.output
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    *,
    whites: tuple[Path, ...],
    scenes: tuple[Path, ...],
    grid_error: float,
    darks: tuple[Path, ...],
    bands: tuple[tuple[float, Path], ...],
    across: tuple[tuple[float, Path], ...],
    radiances: tuple[tuple[float, float], ...],
    camera: Path | None,
    response: str,
    lattice: str,
    near: tuple[float, float] | None,
    cfa: str | None,
    output: Path,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Calibrate a plenoptic camera: lenslet grid, white and dark levels, and the response F
    of every superpixel.

    Files are camera RAW, DNG, PNG or TIFF mosaics (never demosaiced) or captures of capture-sim.
    The grid may be square or hexagonal, turned, of any pitch from 5 to 300 pixels. F needs --band
    captures; without them the calibration holds grid, white and dark.

    \b
    Examples:
      plenocli calibrate --white white.png --dark dark.png -o grid.h5
      plenocli calibrate --scene scene.png --dark dark.png -o grid.h5
      plenocli calibrate --white w1.NEF --white w2.NEF --dark d.NEF --band 450nm=b450.NEF \\
          --band 540nm=b540.NEF -o cal.h5
      plenocli calibrate --white white.dng --band 450nm=450.dng --band-radiance 450nm=0.8 \\
          --camera camera.toml -o cal.h5
      plenocli calibrate --white w.NEF --dark d.NEF --band 450nm=b450.NEF --band 540nm=b540.NEF \\
          --response low-rank -o cal.h5
    """
    from plenocli.stages.inverse.calibrate import run_calibrate

    summary = run_calibrate(
        output,
        radiances=radiances,
        command=options.command_line(ctx),
        whites=whites,
        scenes=scenes,
        grid_error=grid_error,
        darks=darks,
        bands=bands,
        across=across,
        camera=camera,
        response=response,
        lattice=lattice,
        near=near,
        cfa=cfa,
        overwrite=overwrite,
    )
    down, right = summary.pitch_px
    line = (
        f"{output}: {summary.lattice} grid, pitch {down:.4f} x {right:.4f} px, angle "
        f"{summary.angle_deg:.3f} deg, {summary.lenslets} lenslets, residual "
        f"{summary.rms_px:.3f} px rms ({summary.model})"
    )
    if summary.expected_error_px is not None:
        line += f", expected error {summary.expected_error_px:.3f} px rms"
    if measured := summary.response:
        line += (
            f"; F: {len(measured.bands_nm)} bands, condition {measured.condition:.3g}, "
            f"{measured.columns}"
        )
        if measured.bias:
            line += f", bias by its noise up to {max(map(abs, measured.bias)):.1g}"
    options.summary(summary.as_json(), as_json, line)
