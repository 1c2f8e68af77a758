"""`plenocli colorchecker`: a real chart, measured band by band against a
spectrometer, and as a scene.
"""

from pathlib import Path

import click

from plenocli.cli import options


@click.command(
    "colorchecker",
    short_help="Measure a ColorChecker in captures under narrow-band light; write it as a scene.",
)
@options.input_path("folder", metavar="FOLDER")
@options.output
@click.option("--measures", type=options.FILE, help="Also write the numbers as JSON.")
@click.option(
    "--cfa",
    type=click.Choice(["mono", "RGGB", "BGGR", "GRBG", "GBRG"]),
    default="mono",
    show_default=True,
    help="Colour filter array of the captures, which PNG and TIFF cannot say.",
)
@click.option(
    "--flatten",
    type=click.Choice(["paper", "none"]),
    default="paper",
    show_default=True,
    help="Even out the light by the white paper around the chart (a field of degree 2), or not.",
)
@click.option(
    "--grid",
    type=options.Grid(),
    default="96x144",
    show_default=True,
    help="Samples of the scene over the chart, rows by columns.",
)
@click.option(
    "--labels",
    type=options.FILE,
    help="Label map of the patches (0 nothing, 1 to 24 row by row); default the one in FOLDER.",
)
@click.option(
    "--spectra",
    type=options.FILE,
    help="Spectrometer's table (.csv) of patches and filters; default the one in FOLDER.",
)
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    folder: Path,
    *,
    output: Path,
    measures: Path | None,
    cfa: str,
    flatten: str,
    grid: tuple[int, int],
    labels: Path | None,
    spectra: Path | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Merge the exposures in FOLDER, measure the reflectances of the 24 patches against the white
    one and compare them with the spectrometer's; write the chart, upright, as a spectral
    scene for capture-sim.

    File names say band and exposure time: chart_550nm_25ms.tif, dark_25ms.tif. A band is measured
    with the one colour of the mosaic that passes it. Values below 4 DN and saturated ones are left
    out, dark frames of the same time taken off.

    \b
    Examples:
      plenocli colorchecker captures --cfa GBRG -o chart.h5 --measures chart.json
      plenocli capture-sim camera.toml --scene chart.h5 -o capture.h5
    """
    from plenocli.stages.evaluation.colorchecker import Settings, run_colorchecker, table

    document = run_colorchecker(
        folder,
        output,
        Settings(cfa=cfa, flatten=flatten, grid=grid, labels=labels, spectra=spectra),
        measures=measures,
        overwrite=overwrite,
        command=options.command_line(ctx),
    )
    bands = ", ".join(f"{band:.0f}" for band in document.measures.bands_nm)
    options.summary(
        document.as_json(), as_json, f"{table(document)}\n{output}: the chart at {bands} nm"
    )
