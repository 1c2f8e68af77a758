"""What a capture says of its matrix, and the noise that follows.

Three witnesses that need no truth: how much lies where the matrix reaches nothing, whether it is
what the picture would show if light moved, and how well that goes on across the lenslets' borders.

docs/model.md, "Spatial reconstruction".
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.budget import both
from plenocli.base.random_streams import stream
from plenocli.inverse.picture.estimators import Estimators, root_mean_square
from plenocli.inverse.picture.solvers.least_squares import Svd
from plenocli.inverse.picture.solvers.lmmse import Lmmse
from plenocli.inverse.picture.trust.continuity import (
    LEAST_REFERENCE,
    Jumps,
    detail_jumps,
    group_factors,
    groups,
    jumps,
    pieces,
    relative_factor,
)
from plenocli.inverse.picture.trust.excess import even_light, with_excess, without_pattern
from plenocli.inverse.picture.trust.moved_light import moved_even_light, moved_light
from plenocli.inverse.picture.trust.noise_level import NoiseLevel
from plenocli.inverse.picture.trust.rough_scene import dark, spoilt_by_matrix

CONTINUOUS = 0.5
"""Factor relative to photographs under the right matrix from which on a picture is believed: of
25 photographs at 60, 40 and 20 dB the right matrix has 0.62 and more; other crops have a little
less.
"""
JUMPS, STRONGEST_JUMP = 0.2, 0.4
"""The same factor below which the scene itself may be none that goes on across borders, and that of
the strongest coordinates, which a wrong matrix hardly spoils.
"""
MISTOLD = 0.03
"""What a capture may be off about its noise, relative."""
MISFIT = 1.5
"""What the joint estimate leaves over, in terms of the noise, where the matrix is right, at the
most: light from beyond the array is in it.
"""
SURE, MOVED, HINT = 4.0, 3.2, 2.5
"""Standard deviations of chance from which on noise found over the capture's own, and light that
moved, speak against the matrix by themselves, and from which on beside a picture that may not go on
across borders.
"""
NOISY = 0.05
"""Noise over a capture's root mean square above which light that moved by a HINT counts."""
CHANCE, ALLOWED = 1.0, 0.5
"""Standard deviations of chance that are taken off a factor where the matrix is not believed, and
that it is allowed where nothing else is found: none where light moved, twice as many where it did
not for sure.
"""
LEAST_PAIRS = 8
"""Borders between lenslets that it takes to judge continuity."""
ROOM = 0.25
"""Directions that the matrix does not reach, over those that stand above the noise, from which on
nothing found there tells something.
"""
ROUNDED = 1e-5
"""Noise over brightness from which on photographs are captured in single precision."""
ROUNDS = 2
LEAST_FACTOR = 1e-3


@dataclass(frozen=True, kw_only=True)
class Belief:
    """How far a capture is believed to be A x and noise.

    level: noise of a pixel.
    lmmse: of a lenslet by itself, with the noise that is believed in each coordinate.
    right: whether nothing speaks against the matrix; the noise is white then.
    continuity: factor of the picture relative to photographs under the right matrix, without
        displaced even light, before anything was raised; None where there are too few lenslets.
    reference: factor of these photographs, for what is made with the noise that is believed; None
        where it is no measure: too few lenslets, or a scene that jumps everywhere.
    raised: root mean square over the coordinates in use of the noise over that of a pixel.
    moved: standard deviations of light that moved, see `moved_light`.
    pattern: (pixel,) what even light of brightness 1 makes beside what the matrix says, None where
        that is nothing.
    displaced: standard deviations of even light that moved, see `moved_even_light`; 0 where it is
        not taken out.
    """

    level: NoiseLevel
    lmmse: Lmmse
    right: bool
    continuity: float | None = None
    reference: float | None = None
    raised: float = 1.0
    moved: float = 0.0
    pattern: np.ndarray | None = None
    displaced: float = 0.0

    def cleared(self, y: np.ndarray) -> np.ndarray:
        """Superpixels y (.., pixel) without the pattern."""
        return y if self.pattern is None else without_pattern(self.lmmse, y, self.pattern)


def believe(
    estimators: Estimators,
    y: np.ndarray,
    level: NoiseLevel,
    scene: str | None,
    *,
    model_error: float = 0.0,
    coupled: bool = False,
) -> Belief:
    """What superpixels say of the matrix that explains them.

    y: (lenslet_row, lenslet_column, pixel), neighbours' light taken away.
    level: their noise; what it found is what an estimate over 3x3 lenslets leaves over, where they
        are `coupled`.
    scene: that training leaves out.
    model_error: of the matrix by its own record, relative; an error above the noise is believed.
    coupled: whether neighbours' light was taken away: what is left of it is in y.
    """
    lmmse = estimators.prior.lmmse(level.sigma, scene)
    stacked = y.reshape(-1, y.shape[-1]).T
    system, svd = estimators.system, estimators.svd
    judge, (shown, even) = both(
        lambda: _Judge.of(estimators, lmmse, y, scene),
        lambda: (None, 0.0) if coupled else moved_even_light(system, lmmse, stacked),
    )
    shown = _displaced(judge, lmmse, shown, even)
    displaced = 0.0 if shown is None else even
    if judge is not None and shown is not None:
        y = without_pattern(lmmse, y, shown)
        stacked, judge = y.reshape(-1, y.shape[-1]).T, replace(judge, y=y)
    first, moved = both(
        lambda: None if judge is None else judge.of_lmmse(lmmse),
        lambda: 0.0 if coupled else moved_light(system, svd, lmmse, stacked, level.sigma),
    )
    beyond = (
        -np.inf if level.found is None else level.found / level.sigma - (MISFIT if coupled else 1)
    )
    chance = 1 / np.sqrt(2 * max(dark(svd) * stacked.shape[1], 1))
    found = beyond > MISTOLD + SURE * chance or model_error * root_mean_square(y) > level.sigma
    found = found or moved > MOVED
    quiet = beyond <= HINT * chance and not displaced
    allowed = ALLOWED * float(np.clip(1 - moved / HINT, 0, 2)) if quiet else 0.0
    continuous = first is None or first.most(allowed) >= CONTINUOUS
    rough = (
        first is not None
        and not continuous
        and quiet
        and even <= SURE
        and (moved <= HINT or level.sigma < NOISY * root_mean_square(y))
        and _scene_jumps(svd, lmmse, stacked, level, first)
    )
    if not found and (continuous or rough):
        return Belief(
            level=level,
            lmmse=lmmse,
            right=True,
            continuity=None if first is None else first.relative,
            reference=None if first is None or rough else first.reference,
            pattern=shown,
            displaced=displaced,
        )
    y = without_pattern(lmmse, y, pattern := even_light(lmmse, stacked))
    stacked = y.reshape(-1, y.shape[-1]).T
    judge = None if judge is None else replace(judge, y=y)
    floor = level.sigma**2 if level.found is None else max(level.found, level.sigma) ** 2
    raised, now = _raised(judge, replace(lmmse, noise=with_excess(lmmse, stacked, floor)), stacked)
    power = float(np.mean(raised.noise)) if len(raised.noise) else level.sigma**2
    return Belief(
        level=level,
        lmmse=raised,
        right=False,
        continuity=None if first is None else first.relative,
        reference=None if now is None else now.reference,
        raised=float(np.sqrt(power)) / level.sigma,
        moved=moved,
        pattern=pattern if shown is None else pattern + shown,
        displaced=displaced,
    )


@dataclass(frozen=True, kw_only=True)
class _Verdict:
    """Jumps of a capture and of photographs under the right matrix."""

    found: Jumps
    right: Jumps

    @property
    def relative(self) -> float:
        return relative_factor(self.found, self.right)

    def most(self, deviations: float = CHANCE) -> float:
        """What the relative factor may be but for so many standard deviations of chance."""
        right = max(self.right.factor, LEAST_REFERENCE)
        return self.relative + deviations * self.found.deviation / right

    @property
    def reference(self) -> float:
        return self.right.factor

    @property
    def strongest(self) -> _Verdict:
        """By the strongest coordinates alone."""
        return _Verdict(found=self.found.strongest, right=self.right.strongest)


@dataclass(frozen=True, kw_only=True)
class _Judge:
    """What continuity is judged by.

    y: (lenslet_row, lenslet_column, pixel) of the capture.
    clear: (piece, 2, 2, pixel) of photographs, without noise.
    noise: the same shape, of variance 1.
    shape: (rows, columns) of an object in one band.
    """

    y: np.ndarray
    clear: np.ndarray
    noise: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(
        cls, estimators: Estimators, lmmse: Lmmse, y: np.ndarray, scene: str | None
    ) -> _Judge | None:
        """None where lenslets or training pictures are too few or too small."""
        system, (rows, columns) = estimators.system, y.shape[:2]
        if rows * (columns - 1) + columns * (rows - 1) < LEAST_PAIRS:
            return None
        stacked = y.reshape(-1, y.shape[-1]).T
        bright = float(np.mean(lmmse.brightness(stacked)))
        if not bright > 0:
            return None
        contrast = lmmse.common_scale(stacked) * float(lmmse.variance.mean()) / bright**2
        rng = stream(estimators.options.seed, "continuity")
        pictures = estimators.prior.pictures(scene)
        grey = pieces(pictures, system.object_shape, contrast, bright, rng)
        if grey is None:
            return None
        # in half the time where noise hides what single precision rounds off
        kind = np.float32 if lmmse.sigma > ROUNDED * bright else np.float64
        objects = np.tile(grey, max(1, len(system.bands))).astype(kind)
        # one product of two matrices: in a stack of them each would read all of A
        clear = objects.reshape(-1, objects.shape[-1]) @ system.own.T.astype(kind, copy=False)
        clear = clear.astype(float).reshape(*objects.shape[:-1], -1)
        return cls(
            y=y,
            clear=clear,
            noise=rng.standard_normal(clear.shape),
            shape=system.object_shape,
        )

    def goes_on(self, lmmse: Lmmse, pattern: np.ndarray) -> float:
        """The factor on what `pattern` (pixel,) times each lenslet's brightness shows that makes
        the picture's jumps least: 0 where that is no part of a continuous scene.
        """
        y = self.y.reshape(-1, self.y.shape[-1]).T
        scales = lmmse.scales(y)
        shown = np.outer(lmmse.analysis @ pattern, lmmse.brightness(y))
        shown = lmmse.gain @ lmmse.shrunk(shown, scales)
        level, detail = (
            jumps(x.T.reshape(*self.y.shape[:2], -1), self.shape)
            for x in (lmmse.apply(y, scales) - shown, shown)
        )
        return Jumps(level=level, detail=detail[:, None]).factor

    def of_lmmse(self, lmmse: Lmmse) -> _Verdict:
        """Noise of the photographs is that of a pixel, and in the coordinates what is believed."""
        more, noise = np.sqrt(lmmse.noise) - lmmse.sigma, lmmse.sigma * self.noise
        if more.any():
            noise = noise + (self.noise @ lmmse.analysis.T) @ (lmmse.analysis.T * more).T
        return _Verdict(
            found=detail_jumps(lmmse, self.y, self.shape),
            right=detail_jumps(lmmse, self.clear + noise, self.shape),
        )


def _displaced(
    judge: _Judge | None, lmmse: Lmmse, shown: np.ndarray | None, deviations: float
) -> np.ndarray | None:
    """Even light that moved, as `moved_even_light` has it; None where it may be a continuous
    scene's.
    """
    if judge is None or shown is None or deviations <= SURE:
        return None
    return None if judge.goes_on(lmmse, shown) >= CONTINUOUS else shown


def _scene_jumps(
    svd: Svd, lmmse: Lmmse, y: np.ndarray, level: NoiseLevel, verdict: _Verdict
) -> bool:
    """Whether the scene makes the jumps, and not the matrix, where nothing is found outside the
    range: there is room enough for it; the strongest coordinates jump as well; and the estimate is
    one that a scene can have. Where nothing stands above the noise it must be clearer.
    y: (pixel, signal).
    """
    loud = np.count_nonzero(lmmse.power > lmmse.sigma**2)
    return (
        level.found is not None
        and bool(dark(svd) >= ROOM * loud)
        and verdict.most() < (JUMPS if loud else JUMPS / 2)
        and verdict.strongest.most() < STRONGEST_JUMP
        and not spoilt_by_matrix(lmmse, y)
    )


def _raised(judge: _Judge | None, raised: Lmmse, y: np.ndarray) -> tuple[Lmmse, _Verdict | None]:
    """(the same with noise raised until pictures go on, the verdict then); y (pixel, signal)."""
    now = None if judge is None else judge.of_lmmse(raised)
    for _ in range(ROUNDS):
        if judge is None or now is None or now.relative >= CONTINUOUS or not len(raised.power):
            break
        raised = _calmer(raised, y, now)
        now = judge.of_lmmse(raised)
    return raised, now


def _calmer(lmmse: Lmmse, y: np.ndarray, verdict: _Verdict) -> Lmmse:
    """The same with noise so raised that the detail of each group shrinks by its factor."""
    scale = float(np.exp(np.mean(np.log(lmmse.scales(y)))))
    noise = lmmse.noise.copy()
    for group, factor in zip(groups(lmmse.power), group_factors(verdict.found, verdict.right)):
        signal = scale * lmmse.power[group]
        noise[group] = (signal + noise[group]) / max(float(factor), LEAST_FACTOR) - signal
    return replace(lmmse, noise=noise)
