"""`plenocli demux`: spectra behind the lenslets of captures."""

from pathlib import Path

import click

from plenocli.cli import options
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE


@click.command(
    "demux", short_help="Recover band radiances or reflectances per lenslet from captures."
)
@options.input_path("captures", nargs=-1, required=True)
@click.option(
    "--calibration",
    required=True,
    type=options.FILE,
    help="Calibration with a response F (from calibrate).",
)
@click.option(
    "--method",
    type=click.Choice(["auto", "pinv", "single-pixel", "wls", "lmmse", "nnls", "coupled", "fine"]),
    default="auto",
    show_default=True,
    help=(
        "auto takes the one with the least predicted error and says so; coupled and fine solve "
        "all lenslets together, with one value or several behind each."
    ),
)
@click.option(
    "--camera",
    type=options.FILE,
    help=(
        "Description (.toml) of the calibrated camera, from which the light that lenslets throw "
        "on their neighbours is predicted and taken off (default: as the calibration has it)."
    ),
)
@options.prior
@click.option(
    "--reference",
    type=options.FILE,
    help="Capture of a white reference: the result is reflectance instead of radiance.",
)
@click.option(
    "--reference-reflectance",
    type=options.FRACTION,
    default=REFERENCE_REFLECTANCE,
    show_default=True,
    help="Reflectance of that white reference.",
)
@click.option(
    "--register",
    type=click.Choice(["auto", "on", "off"]),
    default="auto",
    show_default=True,
    help=(
        "Bring captures into line with the calibration (moved lenslets, offset, stray light); "
        "auto: where they show it by more than chance."
    ),
)
@options.file_type("exr", "h5")
@options.output
@options.workers
@options.scheduler
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    captures: tuple[Path, ...],
    *,
    calibration: Path,
    method: str,
    camera: Path | None,
    prior: Path | None,
    reference: Path | None,
    reference_reflectance: float,
    register: str,
    suffix: str,
    output: Path,
    workers: int,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Demultiplex CAPTURE...: x = F b + noise is solved for the band radiances b of every lenslet,
    with standard deviations.

    OUT is a spectral EXR or an .h5 file; with several captures a folder with one file each. CAPTURE
    may be a folder: the captures in it. Finished ones are skipped on a rerun, a bad one is reported
    and does not stop the others; where there is one, and it is large, a run that was killed goes on
    from its tiles. Lenslets partly off the sensor are NaN.

    A lenslet's light reaches its neighbours' superpixels, which is wrong by one part in a hundred
    where neighbours differ. Where the camera's description is known (calibrate --camera keeps it,
    simulate-response too), that light is predicted and taken off.

    \b
    Examples:
      plenocli demux chart.NEF --calibration cal.h5 --reference white.NEF -o chart.exr
      plenocli demux captures/ --calibration cal.h5 --method wls --workers 2 -o spectra/
      plenocli demux captures/*.NEF --calibration cal.h5 --scheduler tcp://10.0.0.1:8786 -o spectra/
      plenocli demux chart.dng --calibration cal.h5 --method lmmse --prior paints.csv -o chart.h5
      plenocli demux chart.dng --calibration cal.h5 --method single-pixel -o chart.h5
      plenocli demux chart.dng --calibration cal.h5 --camera camera.toml -o chart.h5
    """
    from plenocli.stages.inverse.demux import Settings, run_demux

    with options.partly_told(as_json):
        summary = run_demux(
            captures,
            output,
            calibration=calibration,
            settings=Settings(
                method=method,
                reference=reference,
                reference_reflectance=reference_reflectance,
                register=register,
                camera=camera,
                prior=prior,
            ),
            suffix=f".{suffix}",
            workers=workers,
            scheduler=scheduler,
            overwrite=overwrite,
            command=options.command_line(ctx),
        )
    if summary.done == 1 and not summary.skipped:
        one = summary.captures[0]
        line = (
            f"{one.output}: {one.quantity} in {len(one.bands_nm)} bands behind "
            f"{one.lenslets} lenslets, {one.method} ({one.reason})"
        )
        if min(one.known) < max(one.known):
            line += "; lenslets with a value: " + ", ".join(
                f"{nm:.4g} nm {count}" for nm, count in zip(one.bands_nm, one.known)
            )
        registration = one.registration
        if registration and registration.motion and registration.corrected:
            line += (
                f"; corrected: {', '.join(registration.corrected)} (lenslets moved by up "
                f"to {registration.motion.reach:.3g} px)"
            )
    else:
        line = f"{output}: {summary.done} demultiplexed, {summary.skipped} were finished before"
    options.summary(summary.as_json(), as_json, line)
