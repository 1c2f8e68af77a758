"""Even light on top of A x: a veil of stray light over the sensor, and an offset of each lenslet's
own, by generalised least squares under the model of LMMSE.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np

from plenocli.base.tiling import spread_bands
from plenocli.inverse.picture.lenslet_model import Common, alone
from plenocli.inverse.picture.nuisances.defects import NORMAL, by_lenslet
from plenocli.inverse.picture.nuisances.pixel_model import CHUNK, PixelModel

SURE = 4.0
"""Standard deviations from which on a veil is said to be there."""
KNOWN = 0.03
"""Share of the mean to which a veil must be known, noise alone: an error of the matrix passes for a
bright one where it is not.
"""
EXPLAINED = 1.3
"""Noise found over noise expected, median of the lenslets, up to which the model explains a
capture but for its veil.
"""
DARKEST = 0.01
"""Share of the pixels that count as the darkest."""
LOUD = 3.0
"""Variance of lenslets' own offsets, over that of their noise, from which on they are believed."""
NOT_STRAIGHT = 0.1
"""Of offsets that go with a lenslet's brightness, what does not do so in proportion."""


@dataclass(frozen=True, kw_only=True)
class VeilFound:
    """Even light on top of A x.

    level: common to all lenslets, in units of y; sigma: its standard deviation.
    spread: of the lenslets' own offsets about it, standard deviation; 0 where they are not told
        apart from noise, or from an error of the matrix.
    mean: of the capture without it, which all is told relative to.
    removed: whether it was taken away.
    """

    level: float
    sigma: float
    spread: float
    mean: float
    removed: bool

    @property
    def found(self) -> bool:
        """Whether there is anything to tell."""
        return self.removed

    @property
    def sentence(self) -> str:
        """What was found, for a person."""
        told = self.as_json()["veil"]
        own = f", {told['spread']:.2%} more or less by lenslet" if self.spread else ""
        return (
            f"an even light of {told['share']:.2%} of the mean (+- {told['sigma']:.2%}{own}) lies "
            "over the superpixels: it was taken away"
        )

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them; shares of the capture's mean."""
        mean = abs(self.mean) or 1.0
        return {
            "veil": {
                "share": self.level / mean,
                "sigma": self.sigma / mean,
                "spread": self.spread / mean,
                "removed": self.removed,
            }
        }


@dataclass(frozen=True)
class _Offsets:
    """Even light of each lenslet, (signal,).

    value, variance: by generalised least squares; brightness: of what the free patterns see.
    misfit: noise found over noise expected.
    """

    value: np.ndarray
    variance: np.ndarray
    brightness: np.ndarray
    misfit: np.ndarray


def find_veil(
    model: PixelModel, y: np.ndarray, *, unsure: float = 0.0, common: Common = alone
) -> tuple[VeilFound | None, np.ndarray]:
    """The even light over superpixels.

    Where the model explains what else there is, each lenslet has an offset of its own, drawn
    towards the common one by how far they differ beyond their noise. Where it does not, or where
    the offsets go with the lenslets' brightness, the matrix is wrong: its error looks like an
    offset in proportion to the brightness. Then only what is there without brightness is a veil.
    Light has no negative values: an offset that is brighter than the darkest pixels, or below zero
    where no pixel is, is an error of the matrix.

    model: veiled.
    y: (pixel, signal) without defects.
    unsure: what all offsets may be wrong by, as light of neighbours was taken away that is not
        known exactly; then lenslets have no offsets of their own.
    common: gives the common one, of superpixels that are a part.

    Returns (what was found, None where an even object and an even light look alike; the light to
    take away, (signal,)).
    """
    offsets = cache(partial(_offsets, model, y))  # a part need not look where there is no veil
    veil, extra = common("veil", lambda: _common_veil(model, y, offsets(), unsure))
    if veil is None or not veil.removed:
        return veil, np.zeros(y.shape[1])
    found = offsets()

    def level() -> float:
        own = _common_veil(model, y, found, unsure)[0]
        return own.level if own is not None and own.removed else 0.0

    veil = replace(veil, level=common("veil level", level))
    told = np.isfinite(found.variance)
    own = np.full(y.shape[1], veil.level)
    value, variance = found.value[told], found.variance[told]
    own[told] += extra / (extra + variance) * (value - veil.level)
    return veil, own


def _common_veil(
    model: PixelModel, y: np.ndarray, found: _Offsets, unsure: float
) -> tuple[VeilFound | None, float]:
    """(the even light, None where it cannot be told; variance of the lenslets' own about it)."""
    told = np.isfinite(found.variance)
    if not told.any():
        return None, 0.0
    value, variance = found.value[told], found.variance[told]
    line, extra = _straight_line(value, found.brightness[told]), 0.0
    if np.median(found.misfit) > EXPLAINED or line.falls:
        level, sigma = max(line.level, 0.0), line.sigma  # what is left over may be of either sign
    else:
        extra = _beyond_noise(value - np.median(value), variance)
        level, sigma = _mean(value, variance + extra)
        extra, sigma = 0.0 if unsure else extra, float(np.hypot(sigma, unsure))
    known = _possible(level, y, model.sigma) and sigma < KNOWN * abs(float(np.mean(y)) - level)
    removed = known and (abs(level) > SURE * sigma or extra > 0)
    told_of = VeilFound(
        level=level,
        sigma=sigma,
        spread=float(np.sqrt(extra)),
        mean=float(np.mean(y)) - level,
        removed=bool(removed),
    )
    return told_of, extra


def _possible(level: float, y: np.ndarray, sigma: float) -> bool:
    """Whether a veil can be on top of light, which is nowhere negative: pixels hold at least the
    veil, but for their noise, and where it is negative, a black level that is too high, some are
    below zero.
    """
    darkest, noise = float(np.quantile(y, DARKEST)), SURE * sigma
    return level <= max(0.0, darkest) + noise and (level >= -noise or darkest < -noise)


def _offsets(model: PixelModel, y: np.ndarray) -> _Offsets:
    value, variance, brightness, misfit = np.empty((4, y.shape[1]))
    even = model.free @ model.free.sum(axis=0)

    def look(part: slice) -> None:
        rest = model.rest(y[:, part])
        value[part], variance[part] = rest.offset, rest.offset_variance
        misfit[part] = by_lenslet(np.abs(rest.value) / (model.sigma * np.sqrt(rest.open)))
        brightness[part] = even @ y[:, part] / (even @ even)

    spread_bands(y.shape[1], CHUNK, look)
    return _Offsets(value, variance, brightness, misfit)


def _mean(value: np.ndarray, variance: np.ndarray) -> tuple[float, float]:
    """Mean of values of different variance and its standard deviation, outliers counting less
    (Huber).
    """
    level = float(np.median(value))
    for _ in range(10):
        weight = 1 / variance / np.maximum(1, np.abs(value - level) / (1.5 * np.sqrt(variance)))
        level = float(weight @ value / weight.sum())
    return level, float(1 / np.sqrt(weight.sum()))


def _beyond_noise(difference: np.ndarray, variance: np.ndarray) -> float:
    """Variance of offsets about their mean beyond that of their noise, by medians; 0 unless that is
    LOUD times as much, surely: the noise's variance rests on what photographs have in common.
    """
    count = len(difference)
    far = NORMAL**2 * float(np.median(difference**2 / variance))
    if count < 4 or far < 1 + LOUD + SURE * np.sqrt(2 / count):
        return 0.0
    return max(NORMAL**2 * float(np.median(difference**2)) - float(np.median(variance)), 0.0)


@dataclass(frozen=True)
class _Line:
    """A straight line through offsets over brightness.

    level, sigma: what is there without brightness, and how surely it is known.
    falls: whether offsets go with the brightness.
    """

    level: float
    sigma: float
    falls: bool


def _straight_line(value: np.ndarray, brightness: np.ndarray) -> _Line:
    """The line, outliers counting less (Huber). What goes with the brightness does so in
    proportion only up to NOT_STRAIGHT of it, which the level is uncertain by.
    """
    if len(value) < 4:
        return _Line(0.0, np.inf, False)
    design = np.stack([np.ones_like(brightness), brightness], axis=1)
    weight = np.ones_like(value)
    for _ in range(10):
        normal = design.T @ (weight[:, None] * design)
        if np.linalg.cond(normal) > 1e12:
            return _Line(0.0, np.inf, False)
        level, slope = np.linalg.solve(normal, design.T @ (weight * value))
        far = np.abs(value - level - slope * brightness)
        usual = max(NORMAL * float(np.median(far)), np.finfo(float).tiny)
        weight = 1 / np.maximum(1, far / (1.5 * usual))
    own, of_slope = usual * np.sqrt(np.diag(np.linalg.inv(normal)))
    bent = NOT_STRAIGHT * slope * float(np.mean(brightness))
    return _Line(float(level), float(np.hypot(own, bent)), bool(abs(slope) > SURE * of_slope))
