"""Dictionary learning for incoherent sampling (Berkner et al. 2013, Fig. 4,
Algorithm 1), made sound.

Each iteration draws a batch X of clean training patches, measures them with noise, Y = A X + n,
codes Y sparsely with D = A Phi, and then refits Phi to the clean patches: min (1/B)|X - Phi C|^2 +
delta |A Phi|^2, columns normalised. A is scaled to unit spectral norm and x lies in [0, 1]: lambda
and delta mean nothing before that. Atom 0 is constant and free of the penalty, all others have zero
mean. Iteration i draws from its own random stream, so a resumed run equals an uninterrupted one bit
for bit. What the paper leaves open: docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, fields, replace

import numpy as np

from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.prior.natural_images import draw_patches
from plenocli.inverse.sparse.coherence import column_coherence
from plenocli.inverse.sparse.dictionary_step import (
    decorrelated,
    dictionary_step,
    gradient_step,
    moments,
    pulled,
    ridge_of,
)
from plenocli.inverse.sparse.l1.solve import SparseCode, lambda_path, sparse_code


@dataclass(frozen=True, kw_only=True)
class Progress:
    """What an iteration left.

    objective: mean over the validation patches.
    validation_psnr: dB, peak 1.
    dead_share: share of atoms replaced.
    nonzeros: mean number of penalised atoms in use.
    change: |Phi - previous Phi|_F over the atoms kept.
    coherence_mean, coherence_max: |cosine| of two columns of A Phi, atoms kept.
    worst_gap: largest relative duality gap.
    step_residual: relative residual of the dictionary step's normal equations.
    """

    objective: float
    validation_psnr: float
    dead_share: float
    nonzeros: float
    change: float
    coherence_mean: float
    coherence_max: float
    worst_gap: float
    step_residual: float


HISTORY = tuple(f.name for f in fields(Progress))
"""Names under which artefacts keep the progress, one array each."""

PULL = 8.0
"""Batches that the atoms so far are worth, where nothing else is asked for: half of it takes the
noise of a batch for structure after ten iterations, twice as much learns more slowly.
"""
INCOHERENCE = 0.05
"""Share of a full step that draws atoms apart, where nothing else is asked for: what costs less
than 0.1 dB.
"""

SYNTHESIS_WEIGHT = 4.0
"""Patches an atom that the learnt atoms are worth against the regression of those that paint."""

_DRAW_START, _DRAW_VALIDATION, _DRAW_ITERATION, _DRAW_POWER, _DRAW_SYNTHESIS = range(5)


@dataclass(frozen=True, kw_only=True)
class Dictionary:
    """A learnt dictionary, with what its use needs to know of how it was learnt.

    atoms: (point, atom) that code, the first constant.
    synthesis: (point, atom) that paint what those code.
    lam: weight of |c|_1 that it was learnt with, in the scaled problem.
    sigma: noise of the measurements that it was learnt from, in the scaled problem.
    directions: singular directions of the matrix that were coded, None for all.
    training: file names of the training pictures.
    """

    atoms: np.ndarray
    synthesis: np.ndarray
    lam: float
    sigma: float
    directions: int | None
    training: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What Algorithm 1 is run with.

    atoms: number of atoms, the constant one included.
    batch: patches an iteration (the paper: at least 4 per atom).
    lam, delta: weights in the scaled problem (see `Learner`).
    snr_db: noise, sigma^2 = mean(y^2) 10^(-snr/10) over pixels and patches.
    seed: of every random stream.
    initial: patches or random.
    validation: patches on which progress is measured.
    tol: relative duality gap of the coding.
    gradient_steps: of the dictionary step, in place of the closed form; 0 is the closed form.
    pull: batches that the atoms so far are worth to the closed form.
    incoherence: share of a full step that draws atoms apart after the dictionary step.
    lam_rule: "given", or "validation", which chooses lam at the start and again after the first
        iteration.
    """

    atoms: int
    batch: int
    lam: float
    delta: float
    snr_db: float
    seed: int = 0
    initial: str = "patches"
    validation: int = 256
    tol: float = 1e-6
    gradient_steps: int = 0
    pull: float = 0.0
    incoherence: float = 0.0
    lam_rule: str = "given"


FAINT = 0.01
"""Directions with less than this ratio of signal to noise power (mean over training
patches) are not coded.
"""


@dataclass(frozen=True, kw_only=True)
class Validation:
    """How a dictionary does on the validation patches.

    objective: mean over the patches.
    psnr: dB, peak 1.
    nonzeros: mean number of penalised atoms in use.
    worst_gap: largest relative duality gap.
    """

    objective: float
    psnr: float
    nonzeros: float
    worst_gap: float


@dataclass(frozen=True)
class State:
    """What a resumed run needs.

    iteration: iterations done.
    atoms: (point, atom) float64 of unit norm.
    history: one a done iteration.
    """

    iteration: int
    atoms: np.ndarray
    history: tuple[Progress, ...] = ()

    def column(self, name: str) -> np.ndarray:
        """One of HISTORY after each iteration, float64."""
        return np.array([getattr(done, name) for done in self.history], np.float64)

    def save(self) -> dict[str, np.ndarray]:
        """{name: array}, from which `State.load` restores the same state bit for bit."""
        state = {"iteration": np.array(self.iteration), "atoms": self.atoms.astype(np.float64)}
        return state | {f"history_{name}": self.column(name) for name in HISTORY}

    @classmethod
    def load(cls, saved: Mapping[str, np.ndarray]) -> State:
        """The state that `save` gave; KeyError where something is missing."""
        columns = [np.asarray(saved[f"history_{name}"]).tolist() for name in HISTORY]
        history = tuple(Progress(**dict(zip(HISTORY, row))) for row in zip(*columns))
        iteration, atoms = int(saved["iteration"]), np.array(saved["atoms"], np.float64)
        return cls(iteration, atoms, history)


class Learner:
    """Algorithm 1 for one system matrix and one set of training images.

    A appears only as S V^T / scale acting on patches, `seen` (direction, point): U^T y carries all
    that least squares can see, and noise in it is as white as in y, so it is drawn there. `seen`
    ends where FAINT says: what follows is noise to the coder, and half of its work.
    """

    def __init__(
        self,
        svd: Svd,
        object_shape: tuple[int, int],
        training: Sequence[np.ndarray],
        held_out: Sequence[np.ndarray],
        settings: Settings,
        *,
        workers: int | None = None,
    ) -> None:
        """For one matrix.

        svd: of A (pixel, point), any scale; `scale` is its spectral norm, by which everything is
            divided.
        object_shape: (rows, columns) of a patch.
        training, held_out: linear images (row, column) in [0, 1]; validation patches come from
            `held_out`, which shows other scenes.
        workers: threads, None for all cores.

        Raises ValueError where the settings make no sense.
        """
        self.svd, self.object_shape, self.training = svd, object_shape, training
        self.settings, self.workers, self.scale = settings, workers, float(svd.s[0])
        kept = svd.rank()
        self.seen = (svd.s[:kept, None] / self.scale) * svd.vt[:kept]
        self.pixels = svd.u.shape[0]
        if settings.atoms < 2 or settings.batch < 1:
            raise ValueError("a dictionary needs at least two atoms and a batch of one")
        self._leave_out_faint()
        rng = np.random.default_rng([settings.seed, _DRAW_VALIDATION])
        self.validation = draw_patches(held_out, self.object_shape, settings.validation, rng)
        self.measured, self.sigma = self.measure(self.validation, rng)
        self._step_basis: tuple[np.ndarray, np.ndarray] | None = None

    def _leave_out_faint(self) -> None:
        patches = draw_patches(
            self.training,
            self.object_shape,
            512,
            np.random.default_rng([self.settings.seed, _DRAW_POWER]),
        )
        power = np.mean((self.seen @ patches) ** 2, axis=1)
        strong = np.flatnonzero(power >= FAINT * self._noise_power(np.sum(power)))
        self.seen = np.ascontiguousarray(self.seen[: strong[-1] + 1 if len(strong) else 1])

    def _noise_power(self, signal_power: float) -> float:
        """sigma^2 from the signal's power summed over all directions, which is that
        summed over all pixels.
        """
        return signal_power / self.pixels * 10 ** (-self.settings.snr_db / 10)

    def measure(self, patches: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, float]:
        """(noisy U^T A X / scale, sigma) of patches (point, count)."""
        clean = self.seen @ patches
        sigma = np.sqrt(self._noise_power(np.einsum("ij,ij->", clean, clean) / patches.shape[1]))
        measured = rng.standard_normal(clean.shape)
        measured *= sigma
        measured += clean
        return measured, float(sigma)

    def with_lambda(self, lam: float) -> Learner:
        """This learner with another weight of |c|_1."""
        other = copy(self)
        other.settings = replace(self.settings, lam=lam)
        return other

    def start(self) -> State:
        """The state before the first iteration."""
        rng = np.random.default_rng([self.settings.seed, _DRAW_START])
        points, count = self.seen.shape[1], self.settings.atoms - 1
        if self.settings.initial == "random":
            atoms = rng.uniform(-0.5, 0.5, (points, count))
        else:
            atoms = draw_patches(self.training, self.object_shape, count, rng)
        return State(0, _with_constant(_unit(atoms, rng)))

    def code(self, atoms: np.ndarray, measured: np.ndarray, tol: float | None = None) -> SparseCode:
        """Sparse code of measured patches (direction, patch) with atoms (point, atom), the first of
        which is free.
        """
        return sparse_code(
            self.seen @ atoms,
            measured,
            self.settings.lam,
            free=[0],
            tol=tol or self.settings.tol,
            workers=self.workers,
        )

    def step(self, state: State) -> State:
        """One iteration; `state` is left as it was."""
        settings = self.settings
        rng = np.random.default_rng([settings.seed, _DRAW_ITERATION, state.iteration])
        patches = draw_patches(self.training, self.object_shape, settings.batch, rng)
        measured, _ = self.measure(patches, rng)
        code = self.code(state.atoms, measured)
        refitted, residual = self._refit(patches, code.c[1:], state.atoms[:, 1:])
        refitted = decorrelated(self.seen, refitted, settings.incoherence)
        norm = np.linalg.norm(refitted, axis=0)
        dead = (np.count_nonzero(code.c[1:], axis=1) == 0) | (norm < 1e-9)
        fresh = (
            draw_patches(self.training, self.object_shape, int(dead.sum()), rng)
            if dead.any()
            else np.zeros((len(refitted), 0))
        )
        refitted[:, dead] = fresh
        atoms = _with_constant(_unit(refitted, rng))
        done = self._progress(
            atoms, state.atoms, np.concatenate([[False], dead]), float(code.gap.max()), residual
        )
        return State(state.iteration + 1, atoms, (*state.history, done))

    def validate(self, atoms: np.ndarray) -> Validation:
        """How atoms (point, atom) do on the validation patches."""
        code = self.code(atoms, self.measured)
        return Validation(
            objective=float(code.objective.mean()),
            psnr=psnr(atoms @ code.c, self.validation),
            nonzeros=float(np.count_nonzero(code.c[1:], axis=0).mean()),
            worst_gap=float(code.gap.max()),
        )

    def validate_path(
        self, atoms: np.ndarray, lams: Iterable[float]
    ) -> list[tuple[float, float, float]]:
        """[(lambda, PSNR in dB, mean non-zeros)] on the validation batch for each lambda,
        from the largest down.
        """
        table = []
        for lam, code in lambda_path(
            self.seen @ atoms,
            self.measured,
            lams,
            free=[0],
            tol=self.settings.tol,
            workers=self.workers,
        ):
            table.append(
                (
                    lam,
                    psnr(atoms @ code.c, self.validation),
                    float(np.count_nonzero(code.c[1:], axis=0).mean()),
                )
            )
        return table

    def _progress(
        self,
        atoms: np.ndarray,
        before: np.ndarray,
        dead: np.ndarray,
        gap: float,
        residual: float,
    ) -> Progress:
        """Of an iteration from the atoms `before`.

        dead: (atom,) those replaced.
        gap: the largest of its coding.
        residual: of its dictionary step.
        """
        found = self.validate(atoms)
        largest, mean, _ = column_coherence(self.seen @ atoms[:, 1:])
        return Progress(
            objective=found.objective,
            validation_psnr=found.psnr,
            dead_share=float(dead[1:].mean()),
            nonzeros=found.nonzeros,
            change=float(np.linalg.norm((atoms - before)[:, ~dead])),
            coherence_mean=mean or 0.0,
            coherence_max=largest or 0.0,
            worst_gap=max(gap, found.worst_gap),
            step_residual=residual,
        )

    def synthesis(self, state: State, batches: int = 4) -> np.ndarray:
        """Atoms that give patches back best from codes of `state.atoms`: min |X - Phi' C|^2 + e
        |Phi' - Phi|^2.

        They only paint; the coding keeps the learnt atoms. An l1 code is biased towards zero and
        knows nothing of what the sensor does not see; the regression makes up for both. e pulls
        towards the learnt atoms as strongly as SYNTHESIS_WEIGHT patches an atom would, each with
        the median power of a coefficient.

        batches: fresh ones that are coded.

        Returns (point, atom).
        """
        rng = np.random.default_rng([self.settings.seed, _DRAW_SYNTHESIS, state.iteration])
        gram, right = np.zeros(()), np.zeros(())
        for _ in range(batches):
            patches = draw_patches(self.training, self.object_shape, self.settings.batch, rng)
            part = moments(patches, self.code(state.atoms, self.measure(patches, rng)[0]).c)
            gram, right = gram + part[0] / batches, right + part[1] / batches
        weight = SYNTHESIS_WEIGHT * self.settings.atoms / (batches * self.settings.batch)
        ridge = max(weight * np.median(np.diag(gram)[1:]), ridge_of(gram))
        return (
            state.atoms
            + np.linalg.solve(gram + ridge * np.eye(len(gram)), (right - state.atoms @ gram).T).T
        )

    def _refit(
        self, patches: np.ndarray, c: np.ndarray, atoms: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Zero-mean atoms (point, atom - 1) of the dictionary step, and the relative residual of
        its normal equations.
        """
        if self._step_basis is None:
            centred = self.seen - self.seen.mean(axis=1, keepdims=True)
            strength, basis = np.linalg.svd(centred, full_matrices=False)[1:]
            self._step_basis = strength**2, basis.T
        gram, right = moments(patches, c)
        right -= right.mean(axis=0)  # as if every patch had mean zero
        if self.settings.gradient_steps:
            return gradient_step(
                *self._step_basis,
                gram,
                right,
                self.settings.delta,
                atoms,
                self.settings.gradient_steps,
            )
        gram, right = pulled(gram, right, atoms, self.settings.pull)
        return dictionary_step(*self._step_basis, gram, right, self.settings.delta)


def mirror_images(shape: tuple[int, int]) -> np.ndarray:
    """Permutations (image, point) that mirror an object of `shape` points (rows, columns): 4 of
    them; 8, with the transposes, of a square one.
    """
    index = np.arange(int(np.prod(shape))).reshape(shape)
    images = [index, index[::-1], index[:, ::-1], index[::-1, ::-1]]
    return np.stack(
        [i.ravel() for i in images + ([i.T for i in images] if shape[0] == shape[1] else [])]
    )


@dataclass(frozen=True, kw_only=True)
class Averaged:
    """The mean of the estimates by all mirror images of a dictionary.

    x: (point, signal).
    worst_gap: largest relative duality gap.
    nonzeros: mean number of penalised atoms in use.
    """

    x: np.ndarray
    worst_gap: float
    nonzeros: float


def averaged(
    seen: np.ndarray,
    atoms: np.ndarray,
    measured: np.ndarray,
    lam: float,
    shape: tuple[int, int],
    *,
    synthesis: np.ndarray | None = None,
    tol: float = 1e-6,
    workers: int | None = None,
) -> Averaged:
    """The mean of the estimates by all mirror images of a dictionary.

    A dictionary stands for scenes that may as well be mirrored, so that its images are as good as
    itself; each errs in its own way, as translates do in cycle spinning (Coifman & Donoho 1995).

    seen: (row, point) the matrix, as in `Learner`.
    atoms: (point, atom) that code, the first free.
    measured: (row, signal).
    lam: weight of |c|_1.
    shape: (rows, columns) of an object.
    synthesis: (point, atom) that paint, default those that code.
    tol: relative duality gap to reach.
    workers: threads.
    """
    paint = atoms if synthesis is None else synthesis
    total, worst, nonzeros = np.zeros(()), 0.0, 0.0
    images = mirror_images(shape)
    for image in images:
        code = sparse_code(seen @ atoms[image], measured, lam, free=[0], tol=tol, workers=workers)
        total = total + paint[image] @ code.c
        worst = max(worst, float(code.gap.max()))
        nonzeros += float(np.count_nonzero(code.c[1:], axis=0).mean()) / len(images)
    return Averaged(x=total / len(images), worst_gap=worst, nonzeros=nonzeros)


def psnr(estimate: np.ndarray, truth: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of patches in [0, 1], nothing clipped."""
    return float(-10 * np.log10(max(np.mean((estimate - truth) ** 2), np.finfo(float).tiny)))


def _unit(atoms: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Zero-mean atoms of unit norm; flat ones become random ones."""
    atoms = atoms - atoms.mean(axis=0)
    flat = np.linalg.norm(atoms, axis=0) < 1e-6 * np.sqrt(len(atoms))
    if flat.any():
        atoms[:, flat] = rng.standard_normal((len(atoms), int(flat.sum())))
        atoms[:, flat] -= atoms[:, flat].mean(axis=0)
    return atoms / np.linalg.norm(atoms, axis=0)


def _with_constant(atoms: np.ndarray) -> np.ndarray:
    """The atoms behind the constant one."""
    return np.concatenate([np.full((len(atoms), 1), 1 / np.sqrt(len(atoms))), atoms], axis=1)
