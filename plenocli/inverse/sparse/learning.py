"""A learner set up for one system matrix, with the weight of its l1 term chosen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.sparse.dictionary import Learner, Settings, State

LAMBDAS = np.logspace(-7, -4, 13)
"""Values among which `lam=None` chooses by validation PSNR, in the scaled problem."""
INDIFFERENT_DB = 0.02
"""Differences in validation PSNR below this do not count: the larger lambda is sparser, and
cheaper, for nothing.
"""


def learner_for(
    svd: Svd,
    object_shape: tuple[int, int],
    settings: Settings,
    training: Sequence[np.ndarray],
    held_out: Sequence[np.ndarray],
    *,
    workers: int | None = None,
) -> Learner:
    """The Learner of one system matrix, its lambda chosen where the settings have NaN for it.

    svd: of the matrix.
    object_shape: points (rows, columns) of an object.
    training, held_out: pictures (row, column) to learn from, and to choose and judge with.
    workers: threads, None for all cores.
    """
    known = not math.isnan(settings.lam)
    start = settings if known else replace(settings, lam=1.0)
    machine = Learner(svd, object_shape, training, held_out, start, workers=workers)
    return machine if known else _with_chosen_lambda(machine, machine.start().atoms)


def advance(machine: Learner, state: State) -> tuple[Learner, State]:
    """One iteration, and after the first lambda chosen again where it is not given: what is best
    for starting atoms, above all random ones, is not for those that were learnt.
    """
    state = machine.step(state)
    again = state.iteration == 1 and machine.settings.lam_rule != "given"
    return (_with_chosen_lambda(machine, state.atoms) if again else machine), state


def _with_chosen_lambda(machine: Learner, atoms: np.ndarray) -> Learner:
    """The learner with the largest lambda of the best validation PSNR for some atoms."""
    table = machine.validate_path(atoms, LAMBDAS)
    top = max(quality for _, quality, _ in table)
    best, quality, nonzeros = max(row for row in table if row[1] > top - INDIFFERENT_DB)
    note(
        f"lambda = {best:.2e}: validation {quality:.2f} dB with the atoms so far "
        f"({nonzeros:.0f} of them a patch), out of {len(LAMBDAS)} values"
    )
    return machine.with_lambda(best)
