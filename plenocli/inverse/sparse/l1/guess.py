"""Where the active-set method of plenocli.inverse.sparse.l1.solve begins: a few rounds of
alternating directions for all signals at once.

ADMM converges too slowly on a plenoptic matrix to solve anything, but some rounds, in single
precision, find nine tenths of the atoms in use with their sign, for the price of a few products.
Source: Boyd, Parikh, Chu, Peleato & Eckstein, Found. Trends Mach. Learn. 3 (2011) 1,
sections 3.4.3 and 6.4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plenocli.inverse.sparse.l1.problem import Problem

ROUNDS = 14
"""Of alternating directions in the guess."""

RELAXATION = 1.8
"""Their over-relaxation."""

CONVERTED = 1.3
"""Their penalty times a typical |c|, where the threshold is 1: of 0.6 to 2.1 the one that finds
most of the support in few rounds.
"""

FAINT = 0.3
"""Directions of D of less power than this times the penalty do not count in the guess."""

GUESSED = 1.2
"""Atoms to begin with, at most, as a share of those that a ridge regression determines (its
degrees of freedom).
"""

TOGETHER = 512
"""Signals guessed together: many enough for quick products, few enough for the cache."""

SINGLE = 1e6
"""Largest |D^T y| over the threshold that leaves single precision something to say."""

SMALL = 1_000_000
"""Signals times this must exceed the cube of the rows, or the guess's eigendecomposition costs
more than it saves.
"""


def guess(problem: Problem, threshold: np.ndarray) -> np.ndarray:
    """Coefficients to begin with.

    problem: whose free atoms are projected out.
    threshold: (atom,) lambda w / 2.

    Returns (signal, atom): zero where there are too few signals to pay for it, where the threshold
    is too small a part of D^T y for single precision, and where nothing exceeds it.
    """
    count, atoms = problem.b.shape
    c, rows = np.zeros((count, atoms)), problem.d.shape[0]
    unit, level = (
        np.max(np.abs(problem.d / threshold), initial=0),
        np.max(np.abs(problem.y), initial=0),
    )
    with np.errstate(over="ignore"):
        largest = np.max(
            np.maximum(problem.b.max(axis=0, initial=0), -problem.b.min(axis=0, initial=0))
            / threshold,
            initial=0,
        )
    # unit and level in their own units below, so that squares stay within range
    if count * SMALL < rows**3 or not (
        unit > 0 and level > np.finfo(float).tiny and unit * level < 1e30 and 1 < largest < SINGLE
    ):
        return c
    scaled = problem.d / threshold / unit
    energy, basis = np.linalg.eigh(scaled @ scaled.T)
    energy = np.maximum(energy, 0)
    penalty, determined = _typical(
        energy, np.mean((basis.T @ (problem.y / level)) ** 2, axis=1), unit * level
    )
    keep = min(int(GUESSED * determined), atoms)
    if not keep:
        return c
    used = energy > FAINT * penalty
    half = np.ascontiguousarray(
        (basis[:, used] / np.sqrt(energy[used] + penalty)).T @ scaled, np.float32
    )
    share = (energy[used] / (energy[used] + penalty)).astype(np.float32)
    for first in range(0, count, TOGETHER):
        part = slice(first, first + TOGETHER)
        found = _alternate((problem.b[part] / threshold).astype(np.float32), half, share)
        if keep < atoms:
            size = np.abs(found)
            found[size < np.partition(size, atoms - keep, axis=1)[:, atoms - keep, None]] = 0
        np.divide(found, penalty * unit**2 * threshold, out=c[part])
    return c


def _typical(energy: np.ndarray, power: np.ndarray, level: float) -> tuple[float, float]:
    """(penalty, atoms that the data determine), where thresholds are 1 / level: CONVERTED over the
    coefficients' size.

    energy, power (row,): of the dictionary and of the signals in its singular directions. The size
        is that of a ridge regression whose ridge has, at three times that size, the slope of the l1
        penalty; ridge and size settle each other in a few rounds.
    """
    ridge = energy[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(6):
            determined = np.sum(energy / (energy + ridge))
            ridge = 3 / level / np.sqrt(np.sum(energy * power / (energy + ridge) ** 2) / determined)
        determined = np.sum(energy / (energy + ridge))
    return CONVERTED / 3 * ridge, determined if np.isfinite(ridge) else 0


def _alternate(right: np.ndarray, half: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Penalty times the sparse iterate after ROUNDS of ADMM for  min c^T G c / 2 - right c + |c|_1.

    right: (signal, atom) float32.
    half: (row, atom) float32, with (G + penalty)^-1 = (I - half^T half) / penalty and half half^T =
        diag(share). Everything times the penalty: `total` is the sum of sparse iterate and scaled
        dual variable, `dual` the part of it within +-1; a round takes total to total + RELAXATION
        (right - dual - half^T half (right + total - 2 dual)), and half times each of these is
        carried along, since it is short.
    """
    seen_right = right @ half.T
    dual, step = np.empty_like(right), seen_right @ half
    total, seen_total = right - step, seen_right * (1 - share)
    for _ in range(ROUNDS - 1):
        np.clip(total, -1, 1, out=dual)
        seen_dual = dual @ half.T
        seen = seen_right + seen_total - 2 * seen_dual
        np.matmul(seen, half, out=step)
        step += dual
        np.subtract(right, step, out=step)
        step *= np.float32(RELAXATION)
        total += step
        seen_total += np.float32(RELAXATION) * (seen_right - seen_dual - share * seen)
    np.clip(total, -1, 1, out=dual)
    return np.subtract(total, dual, out=total)
