"""LMMSE over 3x3 lenslets with every pixel's own noise: for captures of real cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.inverse.picture import hold_out
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.footprint import Sizes, lmmse_phases
from plenocli.inverse.picture.hold_out import HeldOut
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.picture.methods.method import Estimate, Estimator, OwnLight, Sees
from plenocli.inverse.picture.solvers.joint_lmmse import RING, needed_reach
from plenocli.inverse.picture.solvers.lmmse import require_noise
from plenocli.inverse.picture.solvers.weighted_lmmse import (
    CHUNK,
    MOST,
    SCALES,
    Coordinates,
    WeightedLmmse,
    prepare_weighted,
)
from plenocli.inverse.prior.natural_images import autocovariance

BRIGHTNESS = 0.2
"""Mean of the photographs that the statistics are from, about."""
ROUNDS = 1
"""Of what the matrix does not explain and the contrast in turn."""
LOOK = RING * (ROUNDS + 1)
"""Lenslets on either side that one depends on: its ring, and theirs for what these leave over."""
FEW = 3
"""Of this many lenslets along an axis one tells means over a capture, after the first round."""


@dataclass(frozen=True, kw_only=True)
class WeightedStats:
    """What LMMSE with weights found.

    scale: factor of the photographs' covariance, geometric mean of the lenslets.
    misfit: what the matrix leaves over, in terms of the noise of each pixel, median of the
        lenslets; the noise of each is taken to be so much larger.
    held_out: predictions of pixels that were left out.
    """

    scale: float
    misfit: float
    held_out: tuple[HeldOut, ...]

    @property
    def rule(self) -> str:
        """In words, of pixels that were left out the widest patches, which tell the most."""
        left = f"every pixel with its own noise, of which {self.misfit:.2f} times is left over"
        return "; ".join([left, *(one.sentence for one in self.held_out[-1:])])

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        told: dict[str, Any] = {"scale": self.scale, "misfit": self.misfit, "rule": self.rule}
        held = {"held_out": [one.as_json() for one in self.held_out]}
        return told | (held if self.held_out else {})


def weighted(estimators: Estimators, light: OwnLight) -> Estimate:
    """LMMSE from the superpixels as they are, neighbours' light included.

    light: of a real capture, with a variance for every pixel; or of another, whose noise is known.

    Raises NumericsError where the noise is not known.
    """
    data, common = light.data, light.data.common
    recorded, unit = _weights(estimators, data), common("unit", lambda: _unit(estimators, light.y))
    y, weight = np.where(recorded > 0, light.y, 0) / unit, _rounded(recorded * unit**2)
    solver = common("solver", lambda: _prepare(estimators, data, weight))
    misfit = np.ones((*y.shape[:2], 1))

    def seen(number: int) -> tuple[Coordinates, np.ndarray]:
        found = solver.coordinates(y, _rounded(weight / misfit**2))
        counted = _own(data, 0, thin=number > 0)
        return found, _rounded(solver.contrasts(found, common, number, counted))

    for number in range(ROUNDS):
        near = np.argwhere(_own(data, RING * (ROUNDS - number), thin=True)).tolist()
        made = solver.apply(*seen(number), only_superpixels=True, lenslets=near).superpixels
        misfit = np.fmax(misfit, _left_over(solver, y, weight, made))
    found, scale = seen(ROUNDS)
    own = [] if data.only_means else np.argwhere(_own(data, 0)).tolist()
    picture = solver.apply(found, scale, lenslets=own)
    del found

    def stats() -> WeightedStats:
        def predict(kept: np.ndarray) -> np.ndarray:
            left = solver.coordinates(y, _rounded(kept * (unit / misfit) ** 2))
            return solver.apply(left, scale, only_superpixels=True).superpixels * unit

        share = estimators.options.hold_out
        held_out: tuple[HeldOut, ...] = ()
        if share:
            rng = stream(estimators.options.seed, "hold out")
            held_out = hold_out.judge(
                estimators.system, y * unit, recorded, predict, share, rng, hold_out.PATCHES
            )
        lit = weight.any(axis=2)
        return WeightedStats(
            scale=float(np.exp(np.mean(np.log(scale[lit])))) if lit.any() else 1.0,
            misfit=float(np.median(misfit[lit])) if lit.any() else 1.0,
            held_out=held_out,
        )

    told = common("told", stats)
    return Estimate(value=picture.value * unit, sigma=picture.sigma * unit, stats=told)


def _own(data: Superpixels, around: int, *, thin: bool = False) -> np.ndarray:
    """(lenslet_row, lenslet_column), a piece's own lenslets and `around` more on either side; thin:
    a few of its own, where these are for means alone.
    """
    few, count = thin and data.only_means, data.y.shape[:2]
    around = 0 if few else around
    ends = (part.indices(n) for part, n in zip(data.own, count))
    rows, columns = (
        slice(max(0, first - around), last + around, FEW if few else 1) for first, last, _ in ends
    )
    found = np.zeros(count, bool)
    found[rows, columns] = True
    return found


def _unit(estimators: Estimators, y: np.ndarray) -> float:
    """What a capture is divided by to have the brightness of photographs; 1 for an empty one."""
    levels = estimators.system.levels(np.where(np.isfinite(y), y, 0))
    return float(np.sqrt(np.mean(levels**2))) / BRIGHTNESS or 1.0


def _rounded(values: np.ndarray) -> np.ndarray:
    """To single precision, which noise and contrast are not known to: that a unit's last digits do
    not make other systems of equations, whose solutions differ by more.
    """
    return np.asarray(values, np.float32).astype(float)


def _weights(estimators: Estimators, data: Superpixels) -> np.ndarray:
    """One over the variance of every pixel, with that of the matrix by its own record and of its
    model, as far as that is in the noise; 0 where it counts for nothing.
    """
    record = estimators.system.accuracy
    error = 0.0 if record is None or record.estimated is None else record.estimated
    of_model = 0.0 if data.noise is None else data.noise.model
    model = (max(error, of_model) * np.nan_to_num(data.y)) ** 2
    if data.variance is not None:
        return np.where(np.isfinite(data.variance), 1 / (data.variance + model), 0.0)
    sigma = estimators.options.noise_sigma or data.sigma or 0.0
    require_noise(sigma)
    return 1 / (sigma**2 + model)


def _prepare(estimators: Estimators, data: Superpixels, weight: np.ndarray) -> WeightedLmmse:
    """The solver, for the noise that this capture has."""
    system = estimators.system
    seen = weight.any(axis=2)
    typical = np.median(weight[seen], axis=0) if seen.any() else np.zeros(weight.shape[2])
    least = 1e-6 * max(float(typical.max()), np.finfo(float).tiny)
    reach = needed_reach(system.object_shape, system.offsets)
    _, covariance = autocovariance(estimators.prior.pictures(data.scene), reach)
    return prepare_weighted(
        system,
        covariance,
        _rounded(1 / np.sqrt(np.maximum(typical, least))),
        estimators.prior.bands(),
    )


def _left_over(
    solver: WeightedLmmse, y: np.ndarray, weight: np.ndarray, made: np.ndarray
) -> np.ndarray:
    """What each lenslet leaves over, in terms of the noise, at least 1: (lenslet_row,
    lenslet_column, 1).

    made: like y, A x.
    """
    square = np.where(weight > 0, weight * (made - y) ** 2, 0).sum(axis=2, keepdims=True)
    free = (weight > 0).sum(axis=2, keepdims=True) - solver.basis.shape[1] / 2
    return np.sqrt(np.maximum(square / np.maximum(free, 1), 1.0))


def weighted_phases(n: Sizes) -> list[float]:
    """Numbers held: every lenslet has a matrix of its coordinates."""
    used, wide = min(MOST + 1, n.pixels), 2 * n.reach + 1
    ring = (9 * used) ** 2 + 9 * used * n.points
    footprints = (2 * wide**2 + (wide + 4) ** 2 + n.offsets + 18) * used * n.points
    own = n.lenslets * (used**2 + 4 * used + 3 * len(SCALES) + 12 * n.pixels + 3 * n.points)
    at_once = min(n.lenslets, CHUNK) * (4 * used**2 + 4 * n.pixels)
    return [
        *lmmse_phases(n),
        n.offsets * n.pixels * n.points + 4 * n.pixels**2 + 3 * n.points**2,
        n.y + footprints + 3 * ring,
        2 * ring + own + at_once,
    ]


WEIGHTED = Estimator(
    name="weighted",
    sees=Sees.LENSLET_AS_IS,
    phases=weighted_phases,
    options=("hold_out",),
    each_pixel=True,
    weighs_all=True,
    lenslets_around=LOOK,
    estimate=weighted,
)
