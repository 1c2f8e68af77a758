"""Which chain is the cheapest of those that lose no more than is allowed (docs/model.md, "The
cheapest chain").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.inverse.chain.chains import Chain, MatrixOption
from plenocli.inverse.chain.rehearsal import Rehearsal
from plenocli.inverse.picture.methods.method import Sees
from plenocli.inverse.picture.methods.registry import METHODS

PROBE = "lmmse"
"""The method by which matrices are compared, and the neighbourhoods."""
MARGIN, PART = 0.04, 0.25
"""dB, and share of what is allowed, by which a chain must do better, since rehearsals miss."""
FAR = 2.0
"""dB beyond what is allowed from which on matrices without neighbours are not looked at further."""
SLACK = 0.3
"""dB by which the sum of both losses may be mistaken: chains within it are rehearsed themselves."""


@dataclass(frozen=True, kw_only=True)
class Weighed:
    """A chain with what it is predicted to lose.

    loss: dB against the best chain, of the capture where that is most.
    rehearsed: whether the chain itself was, and not its matrix and its method apart.
    """

    chain: Chain
    loss: float
    rehearsed: bool


@dataclass(frozen=True, kw_only=True)
class ChainPlan:
    """What was chosen and what was considered.

    chosen, best: of `weighed`, which is sorted by cost.
    allowed: loss, dB.
    noise: of a pixel relative to the signal, in the rehearsal.
    lenslets, runs: that were captured, and reconstructions of them that were made.
    """

    chosen: Weighed
    best: Weighed
    weighed: tuple[Weighed, ...]
    allowed: float
    noise: float
    lenslets: int
    runs: int


def choose(chains: Sequence[Chain], rehearsal: Rehearsal, allowed: float) -> ChainPlan:
    """The cheapest chain that is predicted to lose at most `allowed` (dB) against the best one.

    chains: the cheapest first; the finest matrix is the one of the last accuracy with neighbours.

    Every method is rehearsed with the finest matrix, and every matrix by one method; losses of
    matrix and method add up to what a chain is expected to lose. From the cheapest on, those that
    may serve are then rehearsed themselves until one does. The best chain serves always.
    """
    matrices = list(dict.fromkeys(chain.matrix for chain in chains))
    finest = min(matrices, key=_fineness)
    methods = list(dict.fromkeys(chain.method for chain in chains))
    by_method = {m: rehearsal.psnr(finest, m) for m in methods}
    by_matrix = _by_matrix(matrices, finest, rehearsal, allowed)

    def expected(chain: Chain) -> np.ndarray:
        if METHODS[chain.method].sees is Sees.LENSLET_AS_IS:
            return by_method[chain.method]  # the mean of a lenslet hardly needs the matrix
        return by_method[chain.method] + by_matrix[chain.matrix] - by_method[PROBE]

    # what is expected to be the best is rehearsed, until nothing else is expected to be better
    known = {
        chain: found
        for chain in chains
        if (found := rehearsal.known(chain.matrix, chain.method)) is not None
    }

    def lost(psnr: np.ndarray) -> float:
        """Against the best chain of each capture, where that is most."""
        return float(np.max(np.max(list(known.values()), axis=0) - psnr))

    def mean(chain: Chain) -> float:
        return float(np.mean(expected(chain)))

    for chain in sorted((c for c in chains if c not in known), key=mean, reverse=True):
        if mean(chain) <= max(float(np.mean(found)) for found in known.values()):
            break
        known[chain] = rehearsal.psnr(chain.matrix, chain.method)
    best = min(known, key=lambda chain: lost(known[chain]))
    limit = aimed_at(allowed)
    chosen = best
    for chain in chains:
        if chain.seconds >= best.seconds:
            break
        if chain not in known and lost(expected(chain)) > limit + SLACK:
            continue
        if chain not in known:
            known[chain] = rehearsal.psnr(chain.matrix, chain.method)
        if lost(known[chain]) <= limit:
            chosen = chain
            break
    weighed = {
        chain: Weighed(
            chain=chain,
            loss=max(lost(known.get(chain, expected(chain))), 0.0),
            rehearsed=chain in known,
        )
        for chain in chains
    }
    return ChainPlan(
        chosen=weighed[chosen],
        best=weighed[best],
        weighed=tuple(weighed.values()),
        allowed=allowed,
        noise=rehearsal.noise,
        lenslets=rehearsal.lenslets,
        runs=rehearsal.runs,
    )


def aimed_at(allowed: float) -> float:
    """dB that a chain may be predicted to lose so that it loses no more than `allowed` (dB)."""
    return max((1 - PART) * allowed - MARGIN, 0.0)


def _by_matrix(
    matrices: Sequence[MatrixOption], finest: MatrixOption, rehearsal: Rehearsal, allowed: float
) -> dict[MatrixOption, np.ndarray]:
    """PSNR (dB) with each matrix by the probe. Without neighbours' light the finest comes first:
    where it loses far too much the others are taken to be no better.
    """
    own = sorted((m for m in matrices if m.own_only and not finest.own_only), key=_fineness)
    found = {m: rehearsal.psnr(m, PROBE) for m in matrices if m not in own}
    for matrix in own:
        far = own[0] in found and float(np.min(found[finest] - found[own[0]])) > allowed + FAR
        found[matrix] = found[own[0]] if far else rehearsal.psnr(matrix, PROBE)
    return found


def _fineness(matrix: MatrixOption) -> tuple[int, int, float]:
    """The least of these is the finest."""
    rank = {"exact": 0, "fresnel": 1, "ray": 2}[matrix.model]
    return -matrix.superpixels[0], rank, matrix.accuracy
