"""Methods of reconstruct that look at one lenslet at a time.

Where a lenslet takes long, what is the same for all is worked out first, and the lenslets are
solved in batches, by a function of (estimators, batch, ...) that other processes can run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from plenocli.base.progress import note
from plenocli.base.text import Record
from plenocli.inverse.picture import error_bars, footprint
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.picture.methods.method import Estimate, Estimator, OwnLight, Sees
from plenocli.inverse.picture.reconstruction import Stats
from plenocli.inverse.picture.solvers import least_squares
from plenocli.inverse.sparse.dictionary import Averaged

NNLS_BATCH, NNLS_CONVERGED_BATCH, DICTIONARY_BATCH = 64, 4, 128
"""Lenslets of a batch: some seconds of work. The same however many work, as the last digits depend
on it.
"""
HINDSIGHT = "oracle: least error against the truth, which no camera has"
LOUDER_POWER = 1.75
"""Lambda grows with the noise to this power, by validation; 2 would be the most probable code of
coefficients with one Laplacian density.
"""
TOO_LOUD = 50
"""Times the noise that a dictionary was learnt for, from which on it falls behind lmmse."""

Solve = Callable[
    [Estimators, np.ndarray, OwnLight, np.ndarray | None], tuple[np.ndarray, Stats | None]
]
"""(estimators, y (pixel, signal), the capture they are of, truth (point, signal) or None) ->
(x (point, signal), what there is to tell).
"""


@dataclass(frozen=True, kw_only=True)
class TikhonovStats(Record):
    """alpha: weight of squared detail, in units of A's squared singular values; rule: how it was
    chosen.
    """

    alpha: float
    rule: str


@dataclass(frozen=True, kw_only=True)
class TsvdStats(Record):
    """rank: directions kept; rule: how it was chosen."""

    rank: int
    rule: str


@dataclass(frozen=True, kw_only=True)
class NnlsStats:
    """How far non-negative least squares went.

    iterations: of the gradient method, None for the converged one.
    kkt_violation: the worst of the optimality conditions (solvers.nnls).
    """

    iterations: int | None
    kkt_violation: float

    @property
    def rule(self) -> str:
        """Where it stopped, in words."""
        if self.iterations:
            return f"stopped after {self.iterations} steps of accelerated projected gradient from 0"
        return "converged, optimality conditions checked"

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        return {"kkt_violation": self.kkt_violation, "rule": self.rule}


@dataclass(frozen=True, kw_only=True)
class DictionaryStats:
    """How lenslets were coded.

    lam: weight of |c|_1.
    rule: how it was chosen.
    worst_gap: largest relative duality gap.
    nonzeros: mean number of penalised atoms in use.
    """

    lam: float
    rule: str
    worst_gap: float
    nonzeros: float

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        return {
            "lambda": self.lam,
            "rule": self.rule,
            "average": "over the mirror images of the dictionary",
            "worst_gap": self.worst_gap,
            "nonzeros": self.nonzeros,
        }


def block_mean(
    estimators: Estimators, y: np.ndarray, light: OwnLight, truth: np.ndarray | None
) -> tuple[np.ndarray, None]:
    """One value a lenslet and band."""
    return _means(estimators, y), None


def _means(estimators: Estimators, y: np.ndarray) -> np.ndarray:
    """Means of the lenslets, at all points of a band alike, (point, signal)."""
    return _even(estimators) @ estimators.system.levels(y.T).T


def _even(estimators: Estimators) -> np.ndarray:
    """Objects of brightness one in a band and none in the others, (point, band)."""
    system = estimators.system
    bands, points = max(1, len(system.bands)), int(np.prod(system.object_shape))
    return np.repeat(np.eye(bands), points, axis=0)


def _about_means(estimators: Estimators, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(means, z): means of the lenslets (point, signal), and what of y they leave, compressed, for
    estimates of the detail alone. Estimates of all of the light are drawn towards black.
    """
    svd, even, levels = estimators.svd, _even(estimators), estimators.system.levels(y.T).T
    return even @ levels, svd.compress(y) - svd.shown(even) @ levels


def tikhonov(
    estimators: Estimators, y: np.ndarray, light: OwnLight, truth: np.ndarray | None
) -> tuple[np.ndarray, TikhonovStats]:
    """Detail about the mean of each lenslet; weight given, by the discrepancy principle, or with
    hindsight.
    """
    svd, alpha, rule = estimators.svd, estimators.options.alpha, "given"
    means, z = _about_means(estimators, y)
    common, own = light.data.common, light.counted
    power = common("power", lambda: least_squares.power_of(z[:, own]))
    if alpha is None and truth is not None:
        about = z[:, own], (truth - means)[:, own]
        cross = common("cross", lambda: least_squares.shared_with(svd, *about))
        alpha, rule = least_squares.oracle_alpha(svd, power, cross), HINDSIGHT
    elif alpha is None:
        alpha = least_squares.discrepancy_alpha(svd, power, light.data.known_sigma)
        rule = "discrepancy"
    found = means if light.data.only_means else means + least_squares.tikhonov(svd, z, alpha)
    return found, TikhonovStats(alpha=float(alpha), rule=rule)


def tsvd(
    estimators: Estimators, y: np.ndarray, light: OwnLight, truth: np.ndarray | None
) -> tuple[np.ndarray, TsvdStats]:
    """Detail about the mean of each lenslet; rank given, by the least estimated error, or with
    hindsight.
    """
    svd, rank, rule = estimators.svd, estimators.options.rank, "given"
    means, z = _about_means(estimators, y)
    common, own = light.data.common, light.counted
    power = common("power", lambda: least_squares.power_of(z[:, own]))
    if rank is None and truth is not None:
        about = z[:, own], (truth - means)[:, own]
        cross = common("cross", lambda: least_squares.shared_with(svd, *about))
        rank, rule = least_squares.oracle_rank(svd, power, cross), HINDSIGHT
    elif rank is None:
        rank = least_squares.best_rank(svd, power, light.data.known_sigma)
        rule = "least estimated error"
    rank = min(rank, svd.rank())
    found = means if light.data.only_means else means + least_squares.truncated(svd, z, rank)
    return found, TsvdStats(rank=int(rank), rule=rule)


def nnls(
    estimators: Estimators, y: np.ndarray, light: OwnLight, truth: np.ndarray | None
) -> tuple[np.ndarray, NnlsStats]:
    """Converged, or stopped after so many iterations as the options say."""
    svd, steps = estimators.svd, estimators.options.nnls_iterations
    lenslets, points = y.shape[1], svd.vt.shape[1]
    if not steps and lenslets * points > 50_000:
        note(
            f"converged non-negative least squares of {lenslets} lenslets takes about "
            f"{2 * lenslets * (points / 1600) ** 2.5 / 60:.0f} minutes of CPU; "
            "--nnls-iterations 300 stops early"
        )
    found = estimators.in_batches(
        nnls_batch, svd.compress(y), NNLS_BATCH if steps else NNLS_CONVERGED_BATCH
    )
    worst = max(kkt for _, kkt in found)
    return (
        np.concatenate([x for x, _ in found], axis=1),
        NnlsStats(iterations=steps, kkt_violation=worst),
    )


def nnls_batch(estimators: Estimators, z: np.ndarray) -> tuple[np.ndarray, float]:
    """(x (point, signal), worst violation of the optimality conditions) of compressed signals z
    (direction, signal).
    """
    from plenocli.inverse.picture.solvers import nnls

    svd, steps = estimators.svd, estimators.options.nnls_iterations
    matrix = svd.s[:, None] * svd.vt
    found = (
        nnls.projected_gradient(matrix, z, steps, norm=svd.s[0])
        if steps
        else nnls.converged(matrix, z)
    )
    return found.x, float(found.kkt.max())


def dictionary(
    estimators: Estimators, y: np.ndarray, light: OwnLight, truth: np.ndarray | None
) -> tuple[np.ndarray, DictionaryStats]:
    """The mean over the mirror images of a learnt dictionary."""
    learnt, svd, asked = estimators.learnt, estimators.svd, estimators.options.lam
    sigma, scale = light.data.known_sigma, float(svd.s[0])
    louder = max(1.0, sigma / scale / learnt.sigma) if learnt.sigma > 0 else 1.0
    lam = asked if asked is not None else learnt.lam * louder**LOUDER_POWER
    if louder > TOO_LOUD:
        note(
            f"the dictionary was learnt for {louder:.3g} times less noise than this capture has: "
            "--method lmmse is as good or better here"
        )
    kept = min(svd.rank(), len(svd.s) if learnt.directions is None else learnt.directions)
    z = svd.compress(y)[:kept] / scale
    found = estimators.in_batches(dictionary_batch, z, DICTIONARY_BATCH, lam)
    if asked is not None:
        rule = "given"
    elif louder < 1.01:
        rule = "lambda as learnt"
    else:
        rule = (
            f"lambda as learnt, times {louder**LOUDER_POWER:.3g} for {louder:.3g} times the noise"
        )
    stats = DictionaryStats(
        lam=lam,
        rule=rule,
        worst_gap=max(part.worst_gap for part in found),
        nonzeros=sum(part.nonzeros * part.x.shape[1] for part in found) / z.shape[1],
    )
    return np.concatenate([part.x for part in found], axis=1), stats


def dictionary_batch(estimators: Estimators, z: np.ndarray, lam: float) -> Averaged:
    """The estimate from compressed signals z (direction, signal), relative to the largest singular
    value.
    """
    from plenocli.inverse.sparse.dictionary import averaged

    svd, learnt, kept = estimators.svd, estimators.learnt, len(z)
    return averaged(
        (svd.s[:kept, None] / float(svd.s[0])) * svd.vt[:kept],
        learnt.atoms,
        z,
        lam,
        estimators.system.object_shape,
        synthesis=learnt.synthesis,
        workers=estimators.threads,
    )


def adaptive_lmmse(
    estimators: Estimators, data: Superpixels, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """LMMSE of each lenslet by itself, each with its own contrast.

    data: the capture, its noise known.
    y: (lenslet_row, lenslet_column, pixel).

    Returns (x, its standard deviation), (lenslet_row, lenslet_column, point).
    """
    rows, columns = y.shape[:2]
    lmmse = estimators.prior.lmmse(data.known_sigma, data.scene)
    x, sigma_of_x, _ = lmmse.adaptive(y.reshape(rows * columns, -1).T, data.common)
    return x.T.reshape(rows, columns, -1), sigma_of_x.T.reshape(rows, columns, -1)


def _own_lmmse(estimators: Estimators, light: OwnLight) -> Estimate:
    data, shape = light.data, estimators.system.object_shape
    lmmse = estimators.prior.lmmse(data.known_sigma, data.scene)
    x, sigma = error_bars.posterior(lmmse, light.y[light.inner], shape, data.common)
    return Estimate(value=x, sigma=sigma, from_lmmse=0.0)


def _by_lenslet(solve: Solve, bars: bool, estimators: Estimators, light: OwnLight) -> Estimate:
    """The Estimate of `solve`, on all superpixels at once.

    bars: whether it has a standard deviation, which needs the noise.
    """
    y, truth = light.y[light.inner], light.truth
    rows, columns = y.shape[:2]
    if truth is not None:
        truth = truth[light.inner].reshape(-1, truth.shape[2]).T
    found, stats = solve(estimators, y.reshape(rows * columns, -1).T, light, truth)
    value = found.T.reshape(rows, columns, -1)
    left = error_bars.of_picture(estimators, light.data, y, value) if bars else None
    if light.joint is not None:
        value = _with_border(light, light.joint.value, value)
        left = None if left is None else _with_border(light, light.joint.sigma, left)
    return Estimate(value=value, sigma=left, stats=stats)


def _with_border(light: OwnLight, joint: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """The values (lenslet_row, lenslet_column, point) of a method inside, of the joint estimate at
    the border.
    """
    found = joint.copy()
    found[light.inner] = inside
    return found


BLOCK_MEAN = Estimator(
    name="block-mean",
    sees=Sees.LENSLET_AS_IS,
    phases=footprint.no_more,
    needs_pif=False,
    estimate=partial(_by_lenslet, block_mean, False),
)
TIKHONOV = Estimator(
    name="tikhonov",
    sees=Sees.LENSLET,
    phases=footprint.lmmse_phases,
    options=("alpha",),
    weighs_all=True,
    hindsight=True,
    estimate=partial(_by_lenslet, tikhonov, True),
)
TSVD = Estimator(
    name="tsvd",
    sees=Sees.LENSLET,
    phases=footprint.lmmse_phases,
    options=("rank",),
    weighs_all=True,
    hindsight=True,
    estimate=partial(_by_lenslet, tsvd, True),
)
NNLS = Estimator(
    name="nnls",
    sees=Sees.LENSLET,
    phases=footprint.nnls_phases,
    options=("nnls_iterations",),
    in_batches=True,
    unrestrained=True,
    estimate=partial(_by_lenslet, nnls, True),
)
LMMSE = Estimator(name="lmmse", sees=Sees.RING, phases=footprint.lmmse_phases, estimate=_own_lmmse)
DICTIONARY = Estimator(
    name="dictionary",
    sees=Sees.LENSLET,
    phases=footprint.dictionary_phases,
    needs_dictionary=True,
    options=("lam", "dictionary"),
    in_batches=True,
    estimate=partial(_by_lenslet, dictionary, True),
)
