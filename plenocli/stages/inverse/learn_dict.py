"""learn-dict: a dictionary of object patches for one system matrix, from training pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.errors import UsageError
from plenocli.base.progress import bar, note
from plenocli.base.random_streams import stream
from plenocli.evaluation.metrics.coherence import CoherenceScore, dictionary_coherence
from plenocli.evaluation.metrics.figures import figures
from plenocli.files.read.dictionaries import Unfinished, read_unfinished
from plenocli.files.read.system_matrices import read_lenslet_matrix
from plenocli.files.read.training import files_of, read_training
from plenocli.inverse.picture.footprint import require_learning
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.solvers.least_squares import Svd, decompose
from plenocli.inverse.prior.natural_images import TrainingPicture, at_scales, split_by_scene
from plenocli.inverse.sparse.dictionary import HISTORY, INCOHERENCE, PULL, Learner, State
from plenocli.inverse.sparse.dictionary import Settings as LearnerSettings
from plenocli.inverse.sparse.learning import advance, learner_for

FALLEN = 0.1
"""dB of held-out quality lost since the best iteration that are told."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Options of the command.

    atoms: None for one an object point.
    batch: patches an iteration, None for 4 an atom.
    iterations: in all.
    lam: None chooses on the validation patches.
    delta: weight of |A Phi|^2.
    snr_db: noise of the measurements.
    initial: patches or random.
    gradient_steps: of the dictionary step; 0 is its closed form.
    pull: batches that the atoms so far are worth to the closed form.
    incoherence: share of a full step that draws atoms apart.
    synthesis: also regress atoms that paint.
    seed: of every random stream.
    workers: threads, None for all cores.
    """

    atoms: int | None = None
    batch: int | None = None
    iterations: int = 10
    lam: float | None = None
    delta: float = 1e-3
    snr_db: float = 60.0
    initial: str = "patches"
    gradient_steps: int = 0
    pull: float = PULL
    incoherence: float = INCOHERENCE
    synthesis: bool = False
    seed: int = 0
    workers: int | None = None


@dataclass(frozen=True)
class Origin:
    """What a dictionary comes from: for its provenance and its attributes.

    command: of the command line.
    pif: path.
    images: paths of training pictures, None where they ship with scikit-image.
    """

    command: str
    pif: Path
    images: list[str] | None


@dataclass(frozen=True)
class Scenes:
    """Training pictures at several scales, and those that judge."""

    training: list[TrainingPicture]
    held_out: list[TrainingPicture]

    @property
    def training_names(self) -> list[str]:
        """File names, sorted."""
        return sorted({Path(name).name for name, _ in self.training})

    @property
    def held_out_names(self) -> list[str]:
        """File names, sorted."""
        return sorted({Path(name).name for name, _ in self.held_out})


@dataclass(frozen=True, kw_only=True)
class LearnSummary:
    """How a dictionary does.

    iterations, atoms, batch, lam, delta: as it was learnt.
    validation_psnr_db: of one coding of the held-out patches.
    start_psnr_db: the same of the atoms that learning started with.
    averaged_psnr_db: of the mean over mirror images, which reconstruct takes.
    lmmse_psnr_db: of the LMMSE that reconstruct takes of a lenslet by itself.
    nonzeros, worst_gap, objective: of the coding (Validation).
    dead_share: of atoms replaced in the last iteration, None before the first.
    coherence: of the dictionary with the matrix.
    output: the file.
    """

    iterations: int
    atoms: int
    batch: int
    lam: float
    delta: float
    validation_psnr_db: float
    start_psnr_db: float
    averaged_psnr_db: float
    lmmse_psnr_db: float
    nonzeros: float
    worst_gap: float
    objective: float
    dead_share: float | None
    coherence: CoherenceScore
    output: str

    @property
    def beats_lmmse(self) -> bool:
        """Whether it is better than LMMSE."""
        return bool(self.averaged_psnr_db > self.lmmse_psnr_db)

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        told = {"lambda" if k == "lam" else k: v for k, v in asdict(self).items()}
        measures = figures(self.coherence)
        return told | {"beats_lmmse": self.beats_lmmse, "coherence": measures}

    @property
    def line(self) -> str:
        """For a person, without the file."""
        verdict = "above" if self.beats_lmmse else "NOT above"
        return (
            f"{self.atoms} atoms, {self.iterations} iterations, lambda {self.lam:.2e}, held out "
            f"{self.validation_psnr_db:.2f} dB ({self.start_psnr_db:.2f} before learning), "
            "averaged over mirror images "
            f"{self.averaged_psnr_db:.2f} dB, {verdict} LMMSE {self.lmmse_psnr_db:.2f} dB; "
            f"coherence of A Phi: largest {self.coherence.coherence_effective:.3f}, mean "
            f"{self.coherence.coherence_effective_mean:.3f}; of A and Phi "
            f"{self.coherence.mutual:.2f} (random atoms {self.coherence.random_mutual:.2f})"
        )


def run_learn_dict(
    images: Sequence[str],
    output: Path,
    settings: Settings,
    *,
    pif: Path,
    resume: Path | None = None,
    checkpoint: Path | None = None,
    overwrite: bool = False,
    command: str = "",
) -> LearnSummary:
    """Learn, or go on learning, and write a dictionary artefact.

    `settings.iterations` counts all iterations, those of `resume` included, so that an interrupted
    run and its continuation end with the same atoms as one that was left alone.

    images: training pictures, () for those of scikit-image.
    pif: the system matrix.
    resume: a dictionary to go on from.
    checkpoint: a file that keeps the state after every iteration, from which the run goes on where
        there is one; removed at the end.
    command: for the provenance.
    """
    origin = Origin(command, pif, files_of(images))
    kept = _check_files(output, origin, resume, checkpoint, overwrite)
    resume = checkpoint if kept else resume
    learning = _begin(images, settings, pif, resume, same=kept)
    machine, scenes, state = learning.machine, learning.scenes, learning.state
    left = settings.iterations - state.iteration
    for _ in bar(range(left), left, "iterations"):
        machine, state = advance(machine, state)
        _tell(state)
        if checkpoint is not None:
            _write(checkpoint, state, machine, scenes, origin, kind="checkpoint", overwrite=True)
    synthesis = machine.synthesis(state) if settings.synthesis else None
    summary = _judge(replace(learning, machine=machine), state, synthesis, output)
    _write(
        output,
        state,
        machine,
        scenes,
        origin,
        synthesis=synthesis,
        summary=summary,
        overwrite=overwrite,
    )
    if checkpoint is not None:
        Path(checkpoint).unlink(missing_ok=True)
    _warn_of_a_fall(state, summary)
    if not summary.beats_lmmse:
        note(
            "the dictionary does NOT beat LMMSE with a contrast for every patch on held-out "
            f"pictures ({summary.averaged_psnr_db:.2f} against {summary.lmmse_psnr_db:.2f} "
            "dB): reconstruct --method lmmse is the better choice"
        )
    return summary


@dataclass(frozen=True, kw_only=True)
class Learning:
    """A run that has not begun to iterate; svd: of the own block."""

    machine: Learner
    scenes: Scenes
    state: State
    svd: Svd


def _begin(
    images: Sequence[str], settings: Settings, pif: Path, resume: Path | None, *, same: bool
) -> Learning:
    """Read what is learnt from, and go on from `resume` where it is given.

    same: as in `_resolve`.
    """
    system = read_lenslet_matrix(pif)
    pictures = split_by_scene(read_training(images, system.object_shape))
    scenes = Scenes(*(at_scales(part, system.object_shape) for part in pictures))
    earlier = read_unfinished(resume, system, kept=same) if resume else None
    chosen = _resolve(settings, system, earlier, same=same)
    if earlier and scenes.training_names != list(earlier.training):
        raise UsageError(
            f"the resumed dictionary was trained on {', '.join(earlier.training)}",
            "--resume",
            "give the same pictures",
        )
    require_learning(system, chosen, pif, synthesis=settings.synthesis)
    svd = decompose(system.own)
    machine = learner_for(
        svd,
        system.object_shape,
        chosen,
        [p for _, p in scenes.training],
        [p for _, p in scenes.held_out],
        workers=settings.workers,
    )
    state = earlier.state if earlier else machine.start()
    if state.iteration > settings.iterations:
        raise UsageError(
            f"{Path(resume or pif).name} has done {state.iteration} iterations, more than "
            f"{settings.iterations}",
            "--iterations",
            "ask for more",
        )
    return Learning(machine=machine, scenes=scenes, state=state, svd=svd)


def _check_files(
    output: Path,
    origin: Origin,
    resume: Path | None,
    checkpoint: Path | None,
    overwrite: bool,
) -> bool:
    """Whether there is a checkpoint to go on from; refuses files that may not be written."""
    from plenocli.files.atomic import check_output

    read = [origin.pif, *(origin.images or ())]
    check_output(
        output,
        overwrite=overwrite,
        inputs=[*read, *([resume] if resume and Path(resume) != Path(output) else [])],
        suffixes=(".h5",),
    )
    if checkpoint is None:
        return False
    kept = Path(checkpoint).exists()
    check_output(
        checkpoint,
        overwrite=True,
        inputs=[*read, resume],
        others=[output],
        suffixes=(".h5",),
    )
    return kept


def _resolve(
    settings: Settings, system: LensletMatrix, earlier: Unfinished | None, same: bool = False
) -> LearnerSettings:
    """What is learnt with, from the command line and, for a resumed run, from the file; lam is NaN
    where it is still to be chosen.

    same: defaults may not differ either.
    """
    if earlier is None:
        atoms = settings.atoms or int(np.prod(system.object_shape))
        return LearnerSettings(
            atoms=atoms,
            batch=settings.batch or 4 * atoms,
            lam=math.nan if settings.lam is None else settings.lam,
            delta=settings.delta,
            snr_db=settings.snr_db,
            seed=settings.seed,
            initial=settings.initial,
            gradient_steps=settings.gradient_steps,
            pull=settings.pull,
            incoherence=settings.incoherence,
            lam_rule="validation" if settings.lam is None else "given",
        )
    asked, stored, default = asdict(settings), asdict(earlier.settings), asdict(Settings())
    wanted = [name for name in ("atoms", "batch", "lam") if asked[name] is not None]
    wanted += [
        name
        for name in (
            "delta",
            "snr_db",
            "seed",
            "initial",
            "gradient_steps",
            "pull",
            "incoherence",
        )
        if same or asked[name] != default[name]
    ]
    for name in wanted:
        if asked[name] != stored[name]:
            raise UsageError(
                f"the resumed dictionary was learnt with {name} = {stored[name]}, not "
                f"{asked[name]}",
                *(
                    ("--checkpoint", "give the same options, or remove the file")
                    if same
                    else ("--resume", "leave the option out")
                ),
            )
    return earlier.settings


def _tell(state: State) -> None:
    """One line about the last iteration."""
    last = state.history[-1]
    note(
        f"iteration {state.iteration}: validation {last.validation_psnr:.2f} dB, objective "
        f"{last.objective:.3e}, {last.nonzeros:.0f} atoms a patch, {last.dead_share:.1%} "
        f"dead, coherence mean {last.coherence_mean:.3f} max {last.coherence_max:.4f}, gap "
        f"{last.worst_gap:.0e}, step residual {last.step_residual:.0e}"
    )


def _warn_of_a_fall(state: State, summary: LearnSummary) -> None:
    """Say where held-out patches were better before."""
    quality = [summary.start_psnr_db, *(done.validation_psnr for done in state.history)]
    best = int(np.argmax(quality))
    if quality[best] > quality[-1] + FALLEN:
        note(
            f"warning: held-out patches had {quality[best]:.2f} dB after {best} iterations and "
            f"have {quality[-1]:.2f} dB now: what is learnt is the noise of its batches; give "
            f"--iterations {best}, more pictures, a larger --batch or --pull"
        )


def _judge(
    learning: Learning, state: State, synthesis: np.ndarray | None, output: Path
) -> LearnSummary:
    """Validation PSNR of one coding, and of the mean over mirror images that reconstruct takes,
    beside the LMMSE that reconstruct takes of a lenslet by itself: statistics of the same training
    pictures, a contrast for every patch; coherence.
    """
    from plenocli.inverse.picture.solvers.lmmse import prepare
    from plenocli.inverse.prior.natural_images import draw_patches, mean_covariance
    from plenocli.inverse.prior.scene_prior import PATCHES_A_POINT
    from plenocli.inverse.sparse.dictionary import averaged, psnr

    machine, scenes, svd = learning.machine, learning.scenes, learning.svd
    chosen = machine.settings
    patches = draw_patches(
        [p for _, p in scenes.training],
        machine.object_shape,
        PATCHES_A_POINT * machine.seen.shape[1],
        stream(chosen.seed, "learn-dict"),
    )
    kept = len(machine.seen)
    scaled = Svd(np.eye(kept), svd.s[:kept] / machine.scale, svd.vt[:kept])
    linear, _, _ = prepare(scaled, *mean_covariance(patches), machine.sigma).adaptive(
        machine.measured
    )
    lmmse = psnr(linear, machine.validation)
    found = machine.validate(state.atoms)
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
    return LearnSummary(
        iterations=state.iteration,
        atoms=state.atoms.shape[1],
        batch=chosen.batch,
        lam=chosen.lam,
        delta=chosen.delta,
        validation_psnr_db=found.psnr,
        averaged_psnr_db=psnr(mean.x, machine.validation),
        lmmse_psnr_db=lmmse,
        nonzeros=found.nonzeros,
        worst_gap=found.worst_gap,
        objective=found.objective,
        dead_share=state.history[-1].dead_share if state.history else None,
        coherence=dictionary_coherence(svd.u @ (svd.s[:, None] * svd.vt), state.atoms),
        start_psnr_db=machine.validate(machine.start().atoms).psnr,
        output=str(output),
    )


def _write(
    output: Path,
    state: State,
    machine: Learner,
    scenes: Scenes,
    origin: Origin,
    *,
    kind: str = "dictionary",
    synthesis: np.ndarray | None = None,
    summary: LearnSummary | None = None,
    overwrite: bool,
) -> None:
    """The artefact of a state.

    kind: dictionary or checkpoint.
    synthesis: atoms that paint.
    summary: None where the run goes on.
    """
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.artefacts.writing import write_artefact

    data = {"dictionary/atoms": state.atoms}
    data |= {} if synthesis is None else {"dictionary/synthesis": synthesis}
    data |= {f"dictionary/history/{name}": state.column(name) for name in HISTORY}
    data |= {f"dictionary/state/{name}": value for name, value in state.save().items()}
    chosen = machine.settings
    attrs = {
        "delta": chosen.delta,
        "lambda": chosen.lam,
        "object_shape": list(machine.object_shape),
        "iterations": state.iteration,
        "scale": machine.scale,
        "parameters": {
            "settings": asdict(chosen),
            "sigma": machine.sigma,
            "directions": len(machine.seen),
            "training": scenes.training_names,
            "validation": scenes.held_out_names,
        },
        "notes": {},
    } | ({} if summary is None else _judgement(summary))
    provenance = Provenance(
        command=origin.command,
        inputs=describe_inputs({"pif": origin.pif, "image": origin.images}),
        seed=chosen.seed,
    )
    attrs = {k: v for k, v in attrs.items() if v is not None}
    write_artefact(
        output, Artefact(kind, data, {"dictionary": attrs}, provenance), overwrite=overwrite
    )


def _judgement(summary: LearnSummary) -> dict[str, Any]:
    """Attributes of a dictionary that is done."""
    found = summary.coherence
    measures = {
        "coherence_effective": found.coherence_effective,
        "coherence_average": found.coherence_effective_mean,
        "coherence_raw": found.coherence_raw,
        "coherence_mutual": found.mutual,
        "coherence_welch": found.welch_bound,
    }
    return {k: v for k, v in measures.items() if math.isfinite(v)} | {
        "notes": {
            "validation_psnr_db": summary.validation_psnr_db,
            "start_psnr_db": summary.start_psnr_db,
            "averaged_psnr_db": summary.averaged_psnr_db,
            "lmmse_psnr_db": summary.lmmse_psnr_db,
            "beats_lmmse": summary.beats_lmmse,
            "worst_gap": summary.worst_gap,
        },
        "coherence": figures(found),
    }
