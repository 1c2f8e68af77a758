"""`plenocli learn-dict`: a sparse dictionary that knows the system matrix."""

from pathlib import Path

import click

from plenocli.cli import options


@click.command("learn-dict", short_help="Learn a dictionary of object patches for a system matrix.")
@click.argument("images", nargs=-1, metavar="[IMAGE]...")
@click.option(
    "--pif", required=True, type=options.FILE, help="System matrix A (from simulate-pif)."
)
@options.output
@click.option("--atoms", type=options.Whole(2), help="Atoms L; default one for each object point.")
@click.option(
    "--batch",
    type=options.Whole(1),
    help="Patches an iteration; default 4 an atom, as in the paper.",
)
@click.option(
    "--iterations",
    type=options.Whole(0, 100000),
    default=10,
    show_default=True,
    help="Iterations in all, those of --resume included.",
)
@click.option(
    "--snr",
    "snr_db",
    type=options.DECIBEL,
    default="60dB",
    show_default=True,
    help="Noise of the measurements: sigma^2 = mean(y^2) 10^(-SNR/10).",
)
@click.option(
    "--lambda",
    "lam",
    type=options.POSITIVE,
    help="Weight of |c|_1 with A scaled to unit spectral norm; default chosen on held-out patches.",
)
@click.option(
    "--delta",
    type=options.NON_NEGATIVE,
    default="0.001",
    show_default=True,
    help="The paper's weight of |A Phi|^2, which makes atoms faint to the sensor.",
)
@click.option(
    "--pull",
    type=options.NON_NEGATIVE,
    default="8",
    show_default=True,
    help="Batches that the atoms so far are worth when they are refitted; 0 refits them afresh.",
)
@click.option(
    "--incoherence",
    type=options.NON_NEGATIVE,
    default="0.05",
    show_default=True,
    help=(
        "Draws atoms apart that the sensor sees alike, by this share of a full step in every "
        "iteration; 0 does not."
    ),
)
@click.option(
    "--init",
    "initial",
    type=click.Choice(["patches", "random"]),
    default="patches",
    show_default=True,
    help="Starting atoms; random is the paper's.",
)
@click.option(
    "--gradient-steps",
    type=options.Whole(0),
    default=0,
    show_default=True,
    help=(
        "Refit the atoms by so many gradient steps, as published, without --pull; 0 solves the "
        "equation."
    ),
)
@click.option(
    "--synthesis",
    is_flag=True,
    help="Also regress atoms that paint what the learnt ones code; reconstruct uses them.",
)
@click.option(
    "--resume",
    type=options.FILE,
    help="Go on from this dictionary; the result equals that of one long run.",
)
@click.option(
    "--checkpoint",
    type=options.FILE,
    help=(
        "Keep the state here after every iteration, and go on from it if there is one: the same "
        "command, given again after an interruption, loses no more than an "
        "iteration. Removed at the end."
    ),
)
@options.seed
@click.option(
    "--workers",
    type=options.Whole(1, 1024),
    default=None,
    help="Threads of the compiled solver; default all cores. The result does not depend on it.",
)
@options.mem_limit
@options.overwrite
@options.as_json
@click.pass_context
def command(
    ctx: click.Context,
    images: tuple[str, ...],
    *,
    pif: Path,
    output: Path,
    atoms: int | None,
    batch: int | None,
    iterations: int,
    snr_db: float,
    lam: float | None,
    delta: float,
    pull: float,
    incoherence: float,
    initial: str,
    gradient_steps: int,
    synthesis: bool,
    resume: Path | None,
    checkpoint: Path | None,
    seed: int,
    workers: int | None,
    overwrite: bool,
    as_json: bool,
) -> None:
    """Learn from IMAGEs (photographs, folders of them, or skimage:NAME; default those that ship
    with scikit-image, without the astronaut).

    Every fifth picture is held out; the result is compared there with the LMMSE that reconstruct
    takes of a lenslet by itself (a covariance, and a contrast for every patch), and says so if it
    does not win. The dictionary holds its history and what --resume needs.

    \b
    Examples:
      plenocli learn-dict --pif pif.h5 --iterations 20 -o dictionary.h5
      plenocli learn-dict photos/*.png --pif pif.h5 --atoms 400 --batch 1600 \\
          --snr 40dB -o dictionary.h5
      plenocli learn-dict --pif pif.h5 --init random --gradient-steps 10 --incoherence 0 \\
          -o published.h5
      plenocli learn-dict --pif pif.h5 --resume dictionary.h5 --iterations 40 -o longer.h5
    """
    from plenocli.stages.inverse.learn_dict import Settings, run_learn_dict

    summary = run_learn_dict(
        images,
        output,
        Settings(
            atoms=atoms,
            batch=batch,
            iterations=iterations,
            snr_db=snr_db,
            lam=lam,
            delta=delta,
            pull=pull,
            incoherence=incoherence,
            initial=initial,
            gradient_steps=gradient_steps,
            synthesis=synthesis,
            seed=seed,
            workers=workers,
        ),
        pif=pif,
        resume=resume,
        checkpoint=checkpoint,
        overwrite=overwrite,
        command=options.command_line(ctx),
    )
    options.summary(summary.as_json(), as_json, f"{output}: {summary.line}")
