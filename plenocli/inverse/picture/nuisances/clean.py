"""One call before any method: superpixels without defective and saturated pixels and without a
veil, and what was found. All methods see the same data, so all profit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from plenocli.base.errors import PlenoError
from plenocli.base.progress import note
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.estimators import Estimators, root_mean_square
from plenocli.inverse.picture.joint import estimate_jointly, own_light
from plenocli.inverse.picture.lenslet_model import Common, Shared, Superpixels
from plenocli.inverse.picture.nuisances.defects import (
    NORMAL,
    DefectsFound,
    by_lenslet,
    defects_among,
    deviation,
    find_defects,
)
from plenocli.inverse.picture.nuisances.pixel_model import PixelModel
from plenocli.inverse.picture.nuisances.saturation import censored, piled_up, saturation
from plenocli.inverse.picture.nuisances.veil import VeilFound, find_veil
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import Lmmse

BLIND = 0.5
"""Share of a superpixel's pixels without which a lenslet is given up, and dark."""
LEAST_NOISE = 1e-6
"""Of the signal, root mean square: less noise than this is rounding."""
STRAY_ROUNDS = 3
"""Estimates of the neighbours, one after the other, for their light."""
STRAY_UNSURE = 0.02
"""Share of the neighbours' light by which it may be wrong everywhere."""
SOME = 64
"""Lenslets from which an unknown noise is estimated."""


class Finding(Protocol):
    """What was found of one nuisance."""

    @property
    def found(self) -> bool:
        """Whether there is anything to tell."""
        ...

    @property
    def sentence(self) -> str:
        """What was found, for a person."""
        ...

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        ...


@dataclass(frozen=True)
class Cleaned:
    """A capture without its nuisances.

    data: the superpixels, all finite.
    findings: what was looked for.
    """

    data: Superpixels
    findings: tuple[Finding, ...] = ()

    def tell(self) -> None:
        """A note for each nuisance that was found."""
        for finding in self.findings:
            if finding.found:
                note(finding.sentence)


def clean(
    estimators: Estimators, data: Superpixels, *, look: bool = True, veil: bool = True
) -> Cleaned:
    """A capture without defective and saturated pixels and without a veil.

    The pixels go by what LMMSE of their lenslet tells of them from all others, so that LMMSE is as
    if they did not exist; other methods take them for measured. Where the matrix knows neighbours,
    the lenslets' own light is looked at, as block means tell it.

    data: pixels that are not finite count for nothing; a lenslet with fewer than BLIND of its
        pixels is dark.
    look: for nuisances; otherwise pixels that count for nothing go by their lenslet's brightness.
    veil: whether one is looked for.
    """
    y = data.y.reshape(-1, data.y.shape[2])
    unknown = ~np.isfinite(y)
    blind = unknown.mean(axis=1) > BLIND
    counted = np.zeros(data.y.shape[:2], bool)
    counted[data.own] = True
    own = counted.ravel()
    known = int(np.count_nonzero((unknown & ~blind[:, None])[own]))
    filled = replace(data, y=_filled(estimators, y, unknown, blind).reshape(data.y.shape))
    declared = data.saturated is not None
    if data.saturated is not None:
        clipped = data.saturated.reshape(y.shape)
    else:
        level = data.common("clipped", lambda: piled_up(y))
        clipped = np.zeros(y.shape, bool) if level is None else y == level
    before = _known_before(known, int(own.sum()) * y.shape[1])
    bare = Cleaned(filled, (*before, *saturation(clipped[own], declared=declared)))
    if not look or blind.all() or not filled.y.any():
        return bare
    try:
        sigma = data.common("pixel noise", lambda: _noise(estimators, filled))
        lmmse = estimators.prior.lmmse(sigma, data.scene)
    except PlenoError:  # the method itself will say so, where it needs them
        return bare
    loud = data.common("signal", lambda: root_mean_square(filled.y))
    model = estimators.prior.pixels(sigma, data.scene, max(sigma, LEAST_NOISE * loud))
    inner = np.zeros(data.y.shape[:2], bool)
    inner[estimators.inner(data.y.shape[:2])] = True
    task = _Task(
        estimators=estimators,
        data=data,
        common=data.common,
        lmmse=lmmse,
        model=model,
        unknown=unknown,
        blind=blind,
        inner=inner.ravel(),
        counted=own,
        clipped=clipped & ~unknown,
        declared=declared,
        veil=veil,
    )
    found = task.solve(filled.y, filled.y)
    if estimators.coupled and any(finding.found for finding in found.findings):
        found = replace(task, common=partial(_again, data.common)).solve(filled.y, found.data)
    return Cleaned(replace(data, y=found.data, saturated=None), found.findings)


def _again(common: Common, name: Shared, work: Callable[[], Any], which: Any = 0) -> Any:
    """A Common of what is worked out a second time."""
    return common(name, work, ("again", which))


def _known_before(known: int, pixels: int) -> tuple[Finding, ...]:
    return (DefectsFound(dark=0, bright=0, known=known, pixels=pixels),) if known else ()


def _filled(
    estimators: Estimators, y: np.ndarray, unknown: np.ndarray, blind: np.ndarray
) -> np.ndarray:
    """y (lenslet, pixel) with unknown pixels as an even object of the lenslet's brightness has
    them; 0 in blind lenslets.
    """
    y = np.where(unknown, 0.0, y)
    at = np.flatnonzero(unknown.any(axis=1) & ~blind)
    if len(at):
        even = estimators.system.even.sum(axis=1)
        power = np.where(unknown[at], 0.0, even**2).sum(axis=1)
        level = np.divide(y[at] @ even, power, out=np.zeros(len(at)), where=power > 0)
        y[at] = np.where(unknown[at], level[:, None] * even, y[at])
    y[blind] = 0.0
    return y


def _noise(estimators: Estimators, data: Superpixels) -> float:
    """Standard deviation of a pixel: as given, as the capture tells, or as most pixels of some
    lenslets show it in what no object gives.
    """
    known = estimators.options.noise_sigma or data.sigma
    floor = max(1e-9 * float(np.abs(data.y).max()), np.finfo(float).tiny)
    if known is not None:
        return max(float(known), floor)
    y = estimators.without_stray(data.y).reshape(-1, data.y.shape[2])
    some = np.unique(np.linspace(0, len(y) - 1, min(len(y), SOME)).round().astype(int))
    return max(_typical_outside(estimators.svd, y[some].T), floor)


def _typical_outside(svd: Svd, y: np.ndarray) -> float:
    """Noise of y (pixel, signal) from what no object gives, by medians; 0 where there is none."""
    u = svd.u[:, : svd.rank(1e-6)]
    free = 1 - np.sum(u**2, axis=1)
    seen = free > 0.01
    if not seen.any():
        return 0.0
    rest = (y - u @ (u.T @ y))[seen] / np.sqrt(free[seen, None])
    return NORMAL * float(np.median(np.abs(rest)))


@dataclass(frozen=True)
class _Found:
    """data: (lenslet_row, lenslet_column, pixel) cleaned; findings: of it."""

    data: np.ndarray
    findings: tuple[Finding, ...]


@dataclass(frozen=True, kw_only=True)
class _Task:
    """What is looked for, and with what.

    data: the capture.
    common: gives what superpixels that are a part have in common.
    unknown, clipped: (lenslet, pixel).
    blind, inner, counted: (lenslet,), those given up, those that have all their neighbours, and
        those that findings count.
    declared: whether the capture says where its sensor saturates.
    veil: whether one is looked for.
    """

    estimators: Estimators
    data: Superpixels
    common: Common
    lmmse: Lmmse
    model: PixelModel
    unknown: np.ndarray
    blind: np.ndarray
    inner: np.ndarray
    counted: np.ndarray
    clipped: np.ndarray
    declared: bool
    veil: bool = True

    def solve(self, y: np.ndarray, guess: np.ndarray) -> _Found:
        """Find and clean.

        y: (lenslet_row, lenslet_column, pixel), finite, 0 in blind lenslets.
        guess: likewise, of which the neighbours' light is reckoned.
        """
        shape, seen = y.shape, ~self.blind
        stray, typical, own = np.broadcast_to(0.0, shape), 0.0, y.reshape(-1, shape[2])
        if self.estimators.coupled:
            stray = guess - self._own_light(guess)
            typical, own = float(np.mean(np.abs(stray))), (y - stray).reshape(-1, shape[2])
        own = (own if seen.all() else own[seen]).T
        unknown, clipped = self.unknown[seen].T, self.clipped[seen].T
        sign, clean = find_defects(
            self.model, own, unknown | clipped, self.estimators.system.pixel_shape, self.common
        )
        if sign.any():
            sign[self._unsure(y, stray, own - clean)] = 0
        hot = defects_among(self.model, own, clipped, (sign != 0) | unknown)
        sign[hot], clipped = 1, clipped & ~hot
        lost = unknown | (sign != 0)
        if hot.any():
            clean = self.model.impute(own, lost | clipped)
        veil, light = self._veil(clean, clipped.any(axis=0), typical)
        out, better = y, own
        if lost.any() or clipped.any() or light.any():
            better = self._without(own - light, lost, clipped)
            out = y.copy()
            out.reshape(-1, shape[2])[seen] += (better - own).T
        counted = self.counted[seen]
        sign, clipped = sign[:, counted], clipped[:, counted]
        findings: list[Finding] = [
            DefectsFound(
                dark=int(np.count_nonzero(sign < 0)),
                bright=int(np.count_nonzero(sign > 0)),
                known=int(np.count_nonzero(unknown[:, counted])),
                pixels=int(self.counted.sum()) * self.unknown.shape[1],
            )
        ]
        findings += [] if veil is None else [veil]
        if clipped.any():
            own = own[:, counted]
            rise = (better[:, counted] - own + light[counted])[clipped]
            raised = np.mean(rise) / np.mean(np.abs(own[clipped]))
            findings += saturation(clipped.T, declared=self.declared, raised=float(raised))
        return _Found(out, tuple(findings))

    def _without(self, own: np.ndarray, lost: np.ndarray, clipped: np.ndarray) -> np.ndarray:
        """Own light (pixel, signal), the veil taken away, with lost and clipped pixels as the
        others tell them.
        """
        bare = replace(self.model, veiled=False)
        if clipped.any():
            return _uncensored(bare, own, lost, clipped, self.common)
        return bare.impute(own, lost)

    def _own_light(self, y: np.ndarray) -> np.ndarray:
        """Superpixels y (lenslet_row, lenslet_column, pixel) without the neighbours' light, as
        LMMSE of each lenslet sees the neighbours: first without the light that block means tell,
        then again without what it told itself. Of several bands, in which neighbours may be quite
        unlike, as the joint estimate sees them.
        """
        own = self.estimators.without_stray(y)
        if not self.estimators.coupled:
            return own
        if len(self.estimators.system.bands) > 1:
            seen = replace(self.data, y=y, noise=Noise.of_sigma(self.model.sigma))
            return own_light(self.estimators, y, estimate_jointly(self.estimators, seen).value)
        for k in range(STRAY_ROUNDS):
            stacked = own.reshape(-1, own.shape[2]).T
            misfit = self.common("misfit", partial(self._misfit, stacked), k)
            # with the noise that is left the estimate does not amplify it
            lmmse = replace(self.lmmse, sigma=self.model.sigma * max(1.0, misfit))
            x = lmmse.likely(stacked, self.common)
            own = own_light(self.estimators, y, x.T.reshape(*y.shape[:2], -1))
        return own

    def _unsure(self, y: np.ndarray, stray: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Which deviations may be the neighbours' light, which comes from guesses: those that are
        no larger, and above what the others tell those that are no more than the brightest
        neighbours would send from beyond the array.

        y, stray: (lenslet_row, lenslet_column, pixel), superpixels and neighbours' light in them.
        off: (pixel, signal) deviations, of lenslets that are not blind.
        """
        system, most = self.estimators.system, np.abs(stray).reshape(-1, y.shape[2])
        unsure = np.abs(off) < most[~self.blind].T
        if self.estimators.coupled:
            neighbours = system.even_blocks.sum(axis=0) - system.even
            beyond = neighbours @ system.levels(y).max(axis=(0, 1))
            unsure |= (off < beyond[:, None]) & (off > 0) & ~self.inner[~self.blind]
        return unsure

    def _misfit(self, stacked: np.ndarray) -> float:
        return float(np.median(by_lenslet(np.abs(deviation(self.model, stacked)))))

    def _veil(
        self, y: np.ndarray, guessed: np.ndarray, stray: float
    ) -> tuple[VeilFound | None, np.ndarray]:
        """Veil and light to take away (signal,), from lenslets that are wholly measured and know
        all their neighbours, where there are some; stray: mean light of the neighbours.
        """
        coupled = self.estimators.coupled
        sure = ~guessed & self.inner[~self.blind] if coupled else ~guessed
        if np.count_nonzero(sure) < min(4, len(sure)):
            sure = np.ones(len(sure), bool)
        if not self.veil:
            return None, np.zeros(y.shape[1])
        unsure = STRAY_UNSURE * stray
        veil, light = find_veil(self.model, y[:, sure], unsure=unsure, common=self.common)
        every = np.full(y.shape[1], veil.level if veil is not None and veil.removed else 0.0)
        every[sure] = light
        return veil, every


def _uncensored(
    model: PixelModel, y: np.ndarray, lost: np.ndarray, clipped: np.ndarray, common: Common
) -> np.ndarray:
    """y (pixel, signal) with lost and clipped pixels imputed; a brightness that nothing else tells
    is about that of the other lenslets.
    """

    def variance() -> float:
        return float(np.mean((model.free.T @ np.where(lost, 0.0, y)) ** 2))

    model = replace(model, free_variance=common("brightness", variance))
    y = y.copy()
    for column in np.flatnonzero((lost | clipped).any(axis=0)):
        y[:, column] = censored(model, y[:, column], clipped[:, column], lost[:, column])
    return y
