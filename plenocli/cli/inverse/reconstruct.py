"""`plenocli reconstruct`: pictures from captures."""

from pathlib import Path

import click

from plenocli.cli import options

METHODS = (
    "auto",
    "block-mean",
    "tikhonov",
    "tsvd",
    "nnls",
    "lmmse",
    "weighted",
    "dictionary",
    "tv",
    "pnp",
)


@click.command("reconstruct", short_help="Recover the picture behind each lenslet from captures.")
@options.input_path("captures", nargs=-1, required=True)
@click.option("--pif", type=options.FILE, help="System matrix A (from simulate-pif).")
@click.option(
    "--calibration",
    type=options.FILE,
    help="Lenslet grid and white reference of a real camera (from calibrate).",
)
@click.option(
    "--method",
    type=click.Choice(METHODS),
    default="auto",
    show_default=True,
    help=(
        "auto: the best of lmmse, pnp and (where one is given) dictionary on pieces of training "
        "photographs at the capture's noise."
    ),
)
@click.option(
    "--dictionary",
    type=options.FILE,
    help="Dictionary (from learn-dict) for --method dictionary; auto tries it too.",
)
@click.option(
    "--overlap",
    type=click.Choice(["1", "3"]),
    help=(
        "Superpixels looked at for each block: its own, or 3x3; default 3x3 where the pif holds "
        "neighbours. tv and pnp see the whole sensor."
    ),
)
@click.option(
    "--training",
    multiple=True,
    metavar="IMAGE",
    help=(
        "Photograph or skimage:NAME for the statistics of lmmse and the trial of auto. Repeatable; "
        "default those of scikit-image, without the astronaut."
    ),
)
@click.option(
    "--truth",
    type=options.FILE,
    help="Choose the weight of tikhonov or tsvd with hindsight: an upper bound, not a method.",
)
@click.option(
    "--noise-sigma",
    type=options.POSITIVE,
    help=(
        "Standard deviation of the noise, relative like A x; default what the capture "
        "says, else estimated."
    ),
)
@click.option(
    "--alpha",
    type=options.NON_NEGATIVE,
    help="Weight of squared detail for tikhonov; default by the discrepancy principle.",
)
@click.option(
    "--rank",
    type=options.Whole(1),
    help="Directions kept by tsvd; default by the least estimated error.",
)
@click.option(
    "--lambda",
    "lam",
    type=options.POSITIVE,
    help="Weight of |c|_1 for dictionary; default as learnt.",
)
@click.option(
    "--nnls-iterations",
    type=options.Whole(1),
    help="Stop nnls after so many gradient steps; default converged.",
)
@click.option(
    "--hold-out",
    type=options.SHARE,
    help=(
        "Leave this share of the pixels out, such as 0.1, and say how well --method weighted "
        "predicts them: a judgement of the pif on a capture whose truth nobody knows."
    ),
)
@click.option(
    "--fit",
    is_flag=True,
    help=(
        "Fit the camera to each capture first (as fit-camera does) and use its matrix; the pif "
        "says which camera to start from. Where none fits, the pif is used and a note says so."
    ),
)
@click.option(
    "--clip", is_flag=True, help="Set negative values to zero; their share is reported either way."
)
@options.device("Where plug and play works, as pnp or in auto")
@options.file_type("h5", "exr")
@options.output
@options.seed
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
    pif: Path | None,
    calibration: Path | None,
    method: str,
    dictionary: Path | None,
    overlap: str | None,
    training: tuple[str, ...],
    truth: Path | None,
    noise_sigma: float | None,
    alpha: float | None,
    rank: int | None,
    lam: float | None,
    nnls_iterations: int | None,
    hold_out: float | None,
    fit: bool,
    clip: bool,
    device: str,
    suffix: str,
    output: Path,
    seed: int,
    workers: int,
    scheduler: str | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Reconstruct the object from CAPTURE...: y = A x + noise is solved for x in every lenslet,
    relative to white.

    pnp takes turns between the data of every lenslet and a denoiser that sees the whole picture; tv
    prefers flat areas. auto captures pieces of training photographs with this matrix and this
    noise, and takes what does best on them.

    weighted is lmmse for captures of real cameras, with --calibration: superpixels are sampled
    about their lenslets, evened by white, and every pixel counts by its own noise.

    A pif of a camera with filters in its pupil gives a picture for each band, from one linear model
    of all bands: with simulate-pif --spectral-step auto for the whole width of the filters, else
    one wavelength stands for each.

    OUT is an image .h5 (with the predicted standard deviation for all but block-mean, and what of a
    lenslet's object the sensor can see at all) or .exr; with several captures a folder with one
    file each. CAPTURE may be a folder: the captures in it. Finished ones are skipped on a rerun, a
    bad one is reported and does not stop the others. --workers and --scheduler share captures out,
    or of a single one tiles, batches of its lenslets (nnls, dictionary) or strips of its picture.
    A capture of more than some hundred to thousand lenslets is estimated tile by tile, so that
    memory does not grow with the sensor; a run that was killed goes on from its tiles. With
    --calibration and no --pif the picture has one value a lenslet.

    \b
    Examples:
      plenocli reconstruct capture.h5 --pif pif.h5 -o picture.h5
      plenocli reconstruct capture.h5 --pif pif-3x3.h5 --method lmmse -o picture.h5
      plenocli reconstruct capture.h5 --pif pif.h5 --method dictionary \\
          --dictionary d.h5 -o picture.exr
      plenocli reconstruct shots/*.h5 --pif pif.h5 --workers 2 -o pictures/
      plenocli reconstruct shot.png --calibration cal.h5 --pif pif.h5 --method weighted \\
          --hold-out 0.1 -o picture.h5
      plenocli reconstruct shots/*.NEF --calibration cal.h5 --method block-mean -o pictures/
    """
    from plenocli.stages.inverse.reconstruct.recipe import Settings
    from plenocli.stages.inverse.reconstruct.run import run_reconstruct

    with options.partly_told(as_json):
        summary = run_reconstruct(
            captures,
            output,
            Settings(
                overlap=int(overlap) if overlap else None,
                method=method,
                dictionary=dictionary,
                training=training,
                truth=truth,
                noise_sigma=noise_sigma,
                alpha=alpha,
                rank=rank,
                lam=lam,
                nnls_iterations=nnls_iterations,
                hold_out=hold_out,
                fit=fit,
                clip=clip,
                device=device,
                seed=seed,
                workers=workers,
            ),
            pif=pif,
            calibration=calibration,
            suffix=f".{suffix}",
            scheduler=scheduler,
            overwrite=overwrite,
            command=options.command_line(ctx),
        )
    if len(summary.captures) == 1 and not summary.skipped:
        line = summary.captures[0].line(with_reason=method == "auto")
    else:
        done, skipped = len(summary.captures), summary.skipped
        line = f"{output}: {done} reconstructed, {skipped} were finished before"
    options.summary(summary.as_json(), as_json, line)
