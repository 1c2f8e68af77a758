"""A learner set up for one system matrix, with the weight of its l1 term chosen."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.sparse.dictionary import Learner, Settings
from plenocli.inverse.sparse.l1.solve import noise_lambda

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
    rule: float | str | None = None,
    workers: int | None = None,
) -> Learner:
    """The Learner of one system matrix, its lambda chosen where the settings have NaN for it.

    svd: of the matrix.
    object_shape: points (rows, columns) of an object.
    training, held_out: pictures (row, column) to learn from, and to choose and judge with.
    rule: "noise" takes lambda from the noise; else the best on the validation patches.
    workers: threads, None for all cores.
    """

    def learner(lam: float) -> Learner:
        return Learner(
            svd,
            object_shape,
            training,
            held_out,
            replace(settings, lam=lam),
            workers=workers,
        )

    given = not math.isnan(settings.lam)
    return learner(settings.lam if given else _choose_lambda(learner(1.0), rule))


def _choose_lambda(machine: Learner, rule: float | str | None) -> float:
    """The largest lambda with the best validation PSNR for the starting dictionary, or
    lambda by the noise.
    """
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
