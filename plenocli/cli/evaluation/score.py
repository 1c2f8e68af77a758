"""`plenocli score`: results against the truth."""

from pathlib import Path

import click

from plenocli.cli import options

METRICS = (
    "psnr",
    "ssim",
    "block-mean",
    "rmse",
    "intervals",
    "patches",
    "spectral-angle",
    "delta-e",
    "snr",
    "classification",
    "classes",
    "detection",
    "expected",
    "single-pixel",
    "coherence",
    "response",
    "depth",
)


@click.command("score", short_help="Compare results with the truth: JSON, a table, a report.")
@options.input_path("results", nargs=-1, required=True, metavar="RESULT...")
@click.option(
    "--truth",
    metavar="TRUTH",
    help=(
        "Capture that holds its scene, photograph, spectral EXR, image or spectra .h5, "
        "skimage:astronaut, colorchecker, or for refocused planes a distance such as 620mm."
    ),
)
@click.option(
    "-o",
    "--output",
    required=True,
    type=options.File(path_type=Path, allow_dash=True),
    metavar="OUT",
    help="JSON to write; - prints it instead.",
)
@click.option(
    "--report", type=options.FILE, help="Also write a page with pictures, such as report.html."
)
@click.option(
    "--metric",
    "metrics",
    multiple=True,
    type=click.Choice(METRICS),
    help="Only these numbers. Repeatable; default all that apply.",
)
@click.option(
    "--white",
    "whites",
    multiple=True,
    type=options.FILE,
    help=(
        "Spectra of a white target, for the SNR and for radiance. Repeatable: frames over time, "
        "and for each method of the results."
    ),
)
@click.option(
    "--patches",
    metavar="MAP",
    help="Label map on the lenslet grid (0 nothing, 1 to 24 the patches), or colorchecker.",
)
@click.option("--pif", type=options.FILE, help="System matrix; a dictionary is scored with it.")
@click.option("--capture", type=options.FILE, help="Simulated capture, for its sensor-model SNR.")
@click.option(
    "--block",
    type=options.Grid(),
    help="Object samples under one lenslet, such as 40x40; default what the files say.",
)
@click.option(
    "--sampling",
    type=click.Choice(["fit", "crop"]),
    default="fit",
    show_default=True,
    help="How a photograph became the object, as in capture-sim.",
)
@click.option(
    "--illuminant",
    "light",
    default="D65",
    show_default=True,
    help='Light for colour differences: A, D50, D65, E or a temperature such as "3200 K".',
)
@click.option(
    "--camera",
    type=options.FILE,
    help=(
        "See the truth of spectra through this camera's filters (width, leak, light) instead "
        "of at their centres."
    ),
)
@click.option(
    "--classes",
    type=options.FILE,
    help=(
        "Spectra to be told apart: how often lenslets tell their class. A table (.csv: wavelengths "
        "in nm, then a column of reflectances a spectrum below the name of its class), or a folder "
        "with a folder, a .csv or a spectral image named after each class. As --truth they stand "
        "for the chart of them that capture-sim --scene shows."
    ),
)
@click.option(
    "--detect",
    metavar="CLASS",
    help="The class of --classes to look for: how well it stands out from the others.",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "pinv", "wls", "lmmse", "single-pixel"]),
    default="auto",
    show_default=True,
    help=(
        "How spectra of a calibration would be made, for what it lets expect of --classes; auto: "
        "by the least expected error."
    ),
)
@options.prior
@click.option(
    "--learnt",
    is_flag=True,
    help=(
        "Judge lenslets by how others of their class came out (four fifths teach, one fifth is "
        "judged, in turn), not by what the --classes are."
    ),
)
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    results: tuple[Path, ...],
    *,
    truth: str | None,
    output: Path,
    report: Path | None,
    metrics: tuple[str, ...],
    whites: tuple[Path, ...],
    patches: str | None,
    pif: Path | None,
    capture: Path | None,
    block: tuple[int, int] | None,
    sampling: str,
    light: str,
    camera: Path | None,
    classes: Path | None,
    detect: str | None,
    method: str,
    prior: Path | None,
    learnt: bool,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Compare RESULTs (image, spectra, dictionary, calibration or refocused planes; .h5 or .exr,
    or folders of them) with the truth, side by side in one table.

    Pictures: PSNR with peak 1.0, SSIM, the block-mean baseline, the share of points whose 95 %
    interval holds the truth. Spectra: error per band and over the six patches of the paper,
    spectral angle, colour difference, SNR under three names, how often a lenslet tells its patch
    (with scikit-learn installed also by a trained classifier), and all against single pixel where
    one of the RESULTs is that. Dictionaries: coherence. Calibrations: response against response.
    Of a calibration that simulate-response made, --classes says what it lets expect before
    anything is captured. Refocused planes (made with --camera): depth over the geometric limit. OUT
    is JSON with the definition of every number; null stands for "infinite" (no error at all) or
    "does not apply".

    \b
    Examples:
      plenocli score tikhonov.h5 lmmse.h5 --truth capture.h5 -o score.json --report report.html
      plenocli score chart.exr --truth colorchecker --white white1.h5 \\
          --white white2.h5 -o score.json
      plenocli score spectra.h5 --truth capture.h5 --classes paints.csv -o told.json
      plenocli score shown.h5 --truth paints.csv --camera camera.toml --classes paints.csv \\
          --detect rust -o found.json
      plenocli score response.h5 --classes paints.csv --method lmmse -o expected.json
      plenocli score dictionary.h5 --pif pif.h5 -o coherence.json
      plenocli score predicted.h5 --truth calibration.h5 -o agreement.json
      plenocli score planes.h5 --truth 620mm -o depth.json
      plenocli score image.h5 --truth capture.h5 -o -
    """
    from plenocli.stages.evaluation.score.run import run_score, table

    printed = str(output) == "-"
    document = run_score(
        results,
        None if printed else output,
        command=options.command_line(ctx),
        truth=truth,
        report=report,
        metrics=metrics,
        whites=whites,
        patches=patches,
        pif=pif,
        capture=capture,
        block=block,
        sampling=sampling,
        light=light,
        camera=camera,
        classes=classes,
        detect=detect,
        method=method,
        prior=prior,
        learnt=learnt,
        overwrite=overwrite,
    )
    options.summary(document.as_json(), as_json or printed, table(document))
