"""learn-dict: a dictionary of object patches for one system matrix, from training pictures."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.files.read.dictionaries import read_unfinished
from plenocli.files.read.system_matrices import read_lenslet_matrix
from plenocli.files.read.training import files_of, read_training, split_by_scene
from plenocli.inverse.picture.footprint import require_learning
from plenocli.inverse.prior.natural_images import at_scales

LAMBDAS = np.logspace(-7, -4, 13)
"""Values among which `lam=None` chooses by validation PSNR, in the scaled problem."""

INDIFFERENT_DB = 0.02
"""Differences in validation PSNR below this do not count: the larger lambda is sparser, and
cheaper, for nothing.
"""


@dataclass(frozen=True)
class Settings:
    """atoms: None means one an object point.
    lam: None chooses on the validation patches, "noise" takes it from the noise.
    snr_db: noise of the measurement.
    gradient_steps: of the dictionary step; 0 is its closed form.
    synthesis: also regress atoms that paint.
    """

    atoms: int | None = None
    batch: int | None = None
    iterations: int = 10
    lam: float | str | None = None
    delta: float = 1e-3
    snr_db: float = 60.0
    initial: str = "patches"
    gradient_steps: int = 0
    synthesis: bool = False
    seed: int = 0
    workers: int | None = None


def run_learn_dict(
    images, output, settings, *, pif, resume=None, checkpoint=None, overwrite=False, command=""
):
    """Learn, or go on learning from `resume`, and write a dictionary artefact;
    returns a summary dict.

    `settings.iterations` counts all iterations, those of `resume` included, so that an interrupted
    run and its continuation end with the same atoms as one that was left alone.
    checkpoint: a file that keeps the state after every iteration, from which the run goes on where
        there is one; removed at the end.
    """
    from plenocli.files.atomic import check_output
    from plenocli.inverse.picture.solvers.least_squares import decompose
    from plenocli.inverse.sparse.dictionary import Learner

    files = files_of(images)
    check_output(
        output,
        overwrite=overwrite,
        inputs=[
            pif,
            *(files or ()),
            *([resume] if resume and Path(resume) != Path(output) else []),
        ],
        suffixes=(".h5",),
    )
    kept = checkpoint is not None and Path(checkpoint).exists()
    if checkpoint is not None:
        if Path(checkpoint).resolve() == Path(output).resolve():
            raise UsageError(
                f"{Path(checkpoint).name} is the result too",
                "--checkpoint",
                "give it another name; it is removed at the end",
            )
        check_output(
            checkpoint,
            overwrite=True,
            inputs=[pif, output, *(files or ()), *([resume] if resume else [])],
            suffixes=(".h5",),
        )
        resume = checkpoint if kept else resume
    system = read_lenslet_matrix(pif)
    pictures = read_training(images, system.object_shape)
    training, held = (at_scales(part, system.object_shape) for part in split_by_scene(pictures))
    earlier = read_unfinished(resume, system) if resume else None
    chosen = _resolve(settings, system, earlier, same=kept)
    names = sorted({Path(n).name for n, _ in training})
    if earlier and names != list(earlier.training):
        raise UsageError(
            f"the resumed dictionary was trained on {', '.join(earlier.training)}",
            "--resume",
            "give the same pictures",
        )
    require_learning(system, chosen, pif, synthesis=settings.synthesis)
    svd = decompose(system.own)

    def learner(lam):
        return Learner(
            svd,
            system.object_shape,
            [p for _, p in training],
            [p for _, p in held],
            replace(chosen, lam=lam),
            workers=settings.workers,
        )

    if not isinstance(chosen.lam, float):
        chosen = replace(chosen, lam=_choose_lambda(learner(1.0), chosen.lam))
    machine = learner(chosen.lam)
    state = earlier.state if earlier else machine.start()
    if state.iteration > settings.iterations:
        raise UsageError(
            (
                f"{Path(resume).name} has done {state.iteration} iterations, more than "
                f"{settings.iterations}"
            ),
            "--iterations",
            "ask for more",
        )
    origin = dict(
        command=command,
        pif=pif,
        files=files,
        seed=chosen.seed,
        names=[n for n, _ in training],
        held=[n for n, _ in held],
    )
    for _ in bar(
        range(settings.iterations - state.iteration),
        settings.iterations - state.iteration,
        "iterations",
    ):
        state = machine.step(state)
        _tell(state)
        if checkpoint is not None:
            _write(checkpoint, state, None, machine, chosen, system, {}, origin, True)
    synthesis = machine.synthesis(state) if settings.synthesis else None
    summary = _judge(machine, state, synthesis, svd, training, chosen)
    _write(output, state, synthesis, machine, chosen, system, summary, origin, overwrite)
    if checkpoint is not None:
        Path(checkpoint).unlink(missing_ok=True)
    if not summary["beats_lmmse"]:
        note(
            "the dictionary does NOT beat LMMSE with a contrast for every patch on held-out "
            f"pictures ({summary['averaged_psnr_db']:.2f} against {summary['lmmse_psnr_db']:.2f} "
            "dB): reconstruct --method lmmse is the better choice"
        )
    return summary | {"output": str(output)}


def _resolve(settings, system, earlier, same=False):
    """solvers.dictionary.Settings from the command line and, for a resumed run, from the file.

    same: defaults may not differ either.
    """
    from plenocli.inverse.sparse import dictionary

    points = int(np.prod(system.object_shape))
    if earlier:
        stored = earlier.settings
        wanted = {
            name: getattr(settings, name)
            for name in ("atoms", "batch", "lam")
            if getattr(settings, name) not in (None, "noise")
        }
        wanted |= {
            name: getattr(settings, name)
            for name in ("delta", "snr_db", "seed", "initial", "gradient_steps")
            if same or getattr(settings, name) != getattr(Settings, name)
        }
        for name, value in wanted.items():
            if value != getattr(stored, name):
                raise UsageError(
                    (
                        f"the resumed dictionary was learnt with {name} = "
                        f"{getattr(stored, name)}, not {value}"
                    ),
                    *(
                        ("--checkpoint", "give the same options, or remove the file")
                        if same
                        else ("--resume", "leave the option out")
                    ),
                )
        return stored
    atoms = settings.atoms or points
    return dictionary.Settings(
        atoms=atoms,
        batch=settings.batch or 4 * atoms,
        lam=settings.lam,
        delta=settings.delta,
        snr_db=settings.snr_db,
        seed=settings.seed,
        initial=settings.initial,
        gradient_steps=settings.gradient_steps,
    )


def _choose_lambda(machine, rule):
    """The largest lambda with the best validation PSNR for the starting dictionary, or
    lambda by the noise.
    """
    from plenocli.inverse.sparse.l1.solve import noise_lambda

    atoms = machine.start().atoms
    if rule == "noise":
        lam = noise_lambda(machine.seen @ atoms[:, 1:], machine.sigma)
        note(f"lambda = {lam:.2e}, from the noise")
        return lam
    table = machine.validate_path(atoms, LAMBDAS)
    top = max(quality for _, quality, _ in table)
    best, quality, nonzeros = max(row for row in table if row[1] > top - INDIFFERENT_DB)
    note(
        f"lambda = {best:.2e}: validation {quality:.2f} dB with the starting atoms "
        f"({nonzeros:.0f} of them a patch), out of {len(LAMBDAS)} values"
    )
    return best


def _tell(state):
    last = {name: values[-1] for name, values in state.history.items()}
    note(
        f"iteration {state.iteration}: validation {last['validation_psnr']:.2f} dB, objective "
        f"{last['objective']:.3e}, {last['nonzeros']:.0f} atoms a patch, {last['dead_share']:.1%} "
        f"dead, coherence mean {last['coherence_mean']:.3f} max {last['coherence_max']:.4f}, gap "
        f"{last['worst_gap']:.0e}, step residual {last['step_residual']:.0e}"
    )


def _judge(machine, state, synthesis, svd, training, chosen):
    """Summary: validation PSNR of one coding, and of the mean over mirror images that reconstruct
    takes, beside the LMMSE that reconstruct takes of a lenslet by itself: statistics of the same
    training pictures, a contrast for every patch; coherence.
    """
    from plenocli.evaluation.metrics.coherence import coherence
    from plenocli.inverse.picture.solvers.least_squares import Svd
    from plenocli.inverse.picture.solvers.lmmse import prepare
    from plenocli.inverse.prior.natural_images import draw_patches, mean_covariance
    from plenocli.inverse.prior.scene_prior import PATCHES_A_POINT
    from plenocli.inverse.sparse.dictionary import averaged, psnr

    points = machine.seen.shape[1]
    patches = draw_patches(
        [p for _, p in training],
        machine.object_shape,
        PATCHES_A_POINT * points,
        stream(chosen.seed, "learn-dict"),
    )
    kept = len(machine.seen)
    scaled = Svd(np.eye(kept), svd.s[:kept] / machine.scale, svd.vt[:kept])
    linear, _, _ = prepare(scaled, *mean_covariance(patches), machine.sigma).adaptive(
        machine.measured
    )
    lmmse = psnr(linear, machine.validation)
    objective, quality, nonzeros, gap = machine.validate(state.atoms)
    mean = averaged(
        machine.seen,
        state.atoms,
        machine.measured,
        chosen.lam,
        machine.object_shape,
        synthesis=synthesis,
        tol=chosen.tol,
        workers=machine.workers,
    )
    best = psnr(mean.x, machine.validation)
    measures = coherence(svd.u @ (svd.s[:, None] * svd.vt), state.atoms)
    return {
        "iterations": state.iteration,
        "atoms": state.atoms.shape[1],
        "batch": chosen.batch,
        "lambda": chosen.lam,
        "delta": chosen.delta,
        "validation_psnr_db": quality,
        "averaged_psnr_db": best,
        "lmmse_psnr_db": lmmse,
        "beats_lmmse": bool(best > lmmse),
        "nonzeros": nonzeros,
        "worst_gap": gap,
        "objective": objective,
        "dead_share": state.history["dead_share"][-1] if state.iteration else None,
        "coherence": measures,
    }


def _write(output, state, synthesis, machine, chosen, system, summary, origin, overwrite):
    """The artefact of a state;

    summary: of `_judge`, {} where the run goes on.
    """
    from dataclasses import asdict

    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs

    data = {"dictionary/atoms": state.atoms} | (
        {} if synthesis is None else {"dictionary/synthesis": synthesis}
    )
    data |= {
        f"dictionary/history/{name}": np.array(values) for name, values in state.history.items()
    }
    data |= {f"dictionary/state/{name}": value for name, value in state.save().items()}
    attrs = {
        "delta": chosen.delta,
        "lambda": chosen.lam,
        "object_shape": list(system.object_shape),
        "iterations": state.iteration,
        "scale": machine.scale,
        "parameters": {
            "settings": asdict(chosen),
            "sigma": machine.sigma,
            "directions": len(machine.seen),
            "training": sorted({Path(n).name for n in origin["names"]}),
            "validation": sorted({Path(n).name for n in origin["held"]}),
        },
        "notes": {
            k: summary[k]
            for k in (
                "validation_psnr_db",
                "averaged_psnr_db",
                "lmmse_psnr_db",
                "beats_lmmse",
                "worst_gap",
            )
            if k in summary
        },
    }
    if summary:
        measures = summary["coherence"]
        attrs |= {
            "coherence_effective": measures["coherence_effective"],
            "coherence_average": measures["coherence_effective_mean"],
            "coherence_raw": measures["coherence_raw"],
            "coherence_mutual": measures["coherence_candes_romberg"] / np.sqrt(measures["points"]),
            "coherence_welch": measures["welch_bound"],
            "coherence": measures,
        }
    attrs = {k: v for k, v in attrs.items() if v is not None}
    provenance = Provenance(
        origin["command"],
        describe_inputs({"pif": origin["pif"], "image": origin["files"]}),
        origin["seed"],
    )
    write_artefact(
        output, Artefact("dictionary", data, {"dictionary": attrs}, provenance), overwrite=overwrite
    )
