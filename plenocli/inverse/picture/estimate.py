"""The picture behind a capture: what every method is given, and what becomes of its estimate.

A capture is brought to the brightness of photographs, so that no result depends on its unit; its
noise is settled (trust); a method then meets superpixels that are A x and white noise of a known
standard deviation, whatever the model's error; and what it makes of them is kept as far as it goes
on across the borders of lenslets.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from plenocli.base.progress import note
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.diagnosis import Seen, what_is_seen
from plenocli.inverse.picture.error_bars import of_picture, posterior
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.joint import JointEstimate, estimate_jointly, left_over
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.methods.method import Method, Sees
from plenocli.inverse.picture.nuisances.clean import Cleaned, clean
from plenocli.inverse.picture.nuisances.veil import VeilFound
from plenocli.inverse.picture.reconstruction import Reconstruction
from plenocli.inverse.picture.trust.believe import MOVED, Belief, believe
from plenocli.inverse.picture.trust.guard import guarded
from plenocli.inverse.picture.trust.noise_level import NoiseLevel, noise_level

BRIGHTNESS = 0.2
"""Mean of the photographs that the statistics are from, about: captures are estimated at it."""
DEFECTIVE = 0.1
"""What defective pixels may add to the brightness before it is settled anew."""

Explain = Callable[[np.ndarray, float, str | None], str | None]
"""(superpixels (lenslet_row, lenslet_column, pixel), their noise, scene) -> what may be wrong."""


@dataclass(frozen=True, kw_only=True)
class Trusted:
    """How far the matrix was trusted.

    level: noise of a pixel.
    right, continuity, raised: as in Belief.
    kept: share of the picture's detail that was kept.
    """

    level: NoiseLevel
    right: bool
    continuity: float | None
    raised: float
    kept: float

    @classmethod
    def of(cls, belief: Belief, kept: float, unit: float) -> Trusted:
        """In the units of the capture, one of which is `unit` times what was estimated with."""
        level = belief.level
        return cls(
            level=replace(
                level,
                sigma=level.sigma * unit,
                found=None if level.found is None else level.found * unit,
            ),
            right=belief.right,
            continuity=belief.continuity,
            raised=belief.raised,
            kept=kept,
        )

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        told: dict[str, Any] = self.level.as_json() | {"matrix_believed": self.right}
        told |= {} if self.continuity is None else {"continuity": self.continuity}
        return told | {"noise_raised": self.raised, "detail_kept": self.kept}


@dataclass(frozen=True, kw_only=True)
class _Settled:
    """A capture whose noise is settled.

    belief: what it says of the matrix.
    own: (lenslet_row, lenslet_column, pixel) without the neighbours' light.
    joint: LMMSE over 3x3 lenslets with the noise as told, where that was made.
    """

    belief: Belief
    own: np.ndarray
    joint: JointEstimate | None


def estimate(
    estimators: Estimators,
    method: Method,
    data: Superpixels,
    truth: np.ndarray | None = None,
    *,
    model_error: float = 0.0,
    explain: Explain | None = None,
    guard: bool = True,
) -> tuple[Reconstruction, Seen | None]:
    """The picture behind a capture by a method, and what of the objects can be seen.

    data: the capture.
    truth: (lenslet_row, lenslet_column, point) chooses the weight with hindsight.
    model_error: of the matrix against this capture by their records, relative.
    explain: says what is likely to be wrong with the camera, where the matrix is not believed.
    guard: whether detail that does not go on across the lenslets' borders is given up: a few
        lenslets are too few to tell.

    Raises NumericsError where the noise is not known and cannot be found.
    docs/model.md, "Spatial reconstruction".
    """
    if method.sees is Sees.LENSLET_AS_IS:
        bare = clean(estimators, data, look=False)
        _tell_of(bare)
        data = bare.data
        if data.noise is not None:
            data = replace(data, noise=replace(data.noise, model=model_error))
        found = method.reconstruct(estimators, data, truth)
        return replace(found, trace=(*bare.findings, *found.trace)), None
    unit = data.common("unit", lambda: unit_of(estimators.system, data.y))
    estimators, data = _at_unit(estimators, data, unit)
    bare = _cleaned(estimators, data)
    _tell_of(bare)
    data = bare.data
    bright = data.common("bright", lambda: unit_of(estimators.system, bare.data.y))
    if abs(bright - 1) > DEFECTIVE:
        estimators, data = _at_unit(estimators, data, bright)
        unit *= bright
    settled = _settle(estimators, method, data, model_error)
    belief, joint, own = settled.belief, settled.joint, settled.own
    data = replace(data, noise=Noise.of_sigma(belief.level.sigma))
    looked_through = estimators
    if belief.pattern is not None:
        cause = None if explain is None else explain(own, belief.level.sigma, data.scene)
        taken_away = estimators.coupled and estimators.overlap == 3
        _tell(belief, model_error, cause, coupled=taken_away)
        data, joint = replace(data, y=belief.cleared(data.y)), None
        own = belief.cleared(own)
    if not belief.right:
        rows = belief.lmmse.whitening()
        looked_through = estimators.seen_through(rows)
        data = replace(data, y=data.y @ rows.T)
        joint = None if joint is None else replace(joint, own=joint.own @ rows.T)
    truth = None if truth is None else truth / unit
    found = method.reconstruct(looked_through, data, truth, joint=joint)
    if found.sigma is not None and not belief.right:
        # noise that was raised swallows contrast: the bars are no shorter than with the noise told
        told = estimators.prior.lmmse(belief.level.sigma, data.scene)
        _, left = posterior(told, own, estimators.system.object_shape, data.common)
        found = replace(found, sigma=np.maximum(found.sigma, left))
    kept = 1.0
    if guard:
        shape = estimators.system.object_shape
        svd = looked_through.svd if method.unrestrained else None
        found, kept = guarded(found, own, belief, shape, data.common, svd)
    if kept < 1 and belief.right and not estimators.coupled and found.sigma is not None:
        # what was drawn back is nearer to LMMSE, about which the truth lies, than what was found
        sigma = of_picture(estimators, data, own, found.value)
        found = replace(found, sigma=sigma)
    if kept < 1:
        note(
            f"{kept:.0%} of the detail that {found.method} gives is kept, towards the mean of each "
            "lenslet: more of it would be noise, or not go on across the lenslets' borders"
        )
    seen = data.common("seen", lambda: what_is_seen(looked_through, own, belief.lmmse))
    found = replace(found, trace=(*bare.findings, *found.trace))
    return _in_unit(found, Trusted.of(belief, kept, unit), unit), seen


def _cleaned(estimators: Estimators, piece: Superpixels) -> Cleaned:
    """The capture without its nuisances. Neighbours' light that block means take away badly looks
    like a veil, and so does what a wrong matrix leaves: where the matrix knows neighbours, a veil
    is believed only if LMMSE over 3x3 lenslets leaves less over without it, else only if the
    matrix is believed without it.
    """
    tried: dict[bool, Cleaned] = {}

    def cleaned(veil: bool) -> Cleaned:
        if veil not in tried:
            whole = None if piece.whole is None else piece.whole.on_trial()
            tried[veil] = clean(estimators, replace(piece, whole=whole), veil=veil)
        return tried[veil]

    def left(found: Cleaned) -> float:
        alone = replace(found.data, whole=None)
        return left_over(estimators, estimate_jointly(estimators, alone))

    def veil_believed() -> bool:
        bare = cleaned(True)
        if not any(isinstance(f, VeilFound) and f.removed for f in bare.findings):
            return True
        if estimators.coupled and estimators.overlap == 3:
            return piece.noise is not None and left(bare) < left(cleaned(False))
        level = _noise(estimators, bare.data, bare.data.y)
        return believe(estimators, bare.data.y, level, piece.scene).right

    found = cleaned(piece.common("veil believed", veil_believed))
    if piece.whole is not None and found.data.whole is not None:
        piece.whole.take(found.data.whole)
        found = replace(found, data=replace(found.data, whole=piece.whole))
    return found


def _noise(estimators: Estimators, data: Superpixels, own: np.ndarray) -> NoiseLevel:
    """The noise of a capture, of which `own` is without the neighbours' light."""
    return noise_level(data.y, estimators.options.noise_sigma, data.sigma, estimators.svd, own)


def _tell_of(bare: Cleaned) -> None:
    """What was found of nuisances; of pieces, whoever puts them together says it."""
    if bare.data.whole is None:
        bare.tell()


def unit_of(system: LensletMatrix, y: np.ndarray) -> float:
    """What a capture y (lenslet_row, lenslet_column, pixel) is divided by to have the brightness of
    photographs; 1 for an empty one.
    """
    levels = system.levels(np.where(np.isfinite(y), y, 0))
    largest = float(np.abs(levels).max()) or 1.0  # beyond 1e154 squares overflow
    found = float(np.sqrt(np.mean((levels / largest) ** 2))) * largest / BRIGHTNESS
    return found if found > 0 else 1.0


def _at_unit(
    estimators: Estimators, data: Superpixels, unit: float
) -> tuple[Estimators, Superpixels]:
    """The same, the capture and what a person gave in its units divided by `unit`."""
    options = estimators.options
    sigma, lam = options.noise_sigma, options.lam
    scaled = replace(
        options,
        noise_sigma=None if sigma is None else sigma / unit,
        lam=None if lam is None else lam / unit,
    )
    noise = None if data.noise is None else data.noise.scaled(1 / unit)
    return estimators.with_options(scaled), replace(data, y=data.y / unit, noise=noise)


def _in_unit(found: Reconstruction, trusted: Trusted, unit: float) -> Reconstruction:
    """A picture in the unit of its capture, with what is told of its noise."""
    distance = found.from_lmmse
    return replace(
        found,
        value=found.value * unit,
        sigma=None if found.sigma is None else found.sigma * unit,
        from_lmmse=None if distance is None else distance * unit,
        noise_level=trusted.level,
        trace=(*found.trace, trusted),
    )


def _settle(
    estimators: Estimators, method: Method, data: Superpixels, model_error: float
) -> _Settled:
    """The noise of a capture, by the light of each lenslet alone: that of the neighbours is taken
    away, as the joint estimate with the noise as told sees it.
    """
    takes_away = estimators.coupled and estimators.overlap == 3
    plain = estimators.without_stray(data.y) if takes_away else data.y
    level = data.common("noise", lambda: _noise(estimators, data, plain))
    told = replace(data, noise=Noise.of_sigma(level.sigma))
    if not takes_away:
        jointly = method.makes_joint_estimate(estimators)
        joint = estimate_jointly(estimators, told) if jointly else None
        belief = data.common(
            "belief",
            lambda: believe(estimators, plain, level, data.scene, model_error=model_error),
        )
        return _Settled(belief=belief, own=plain, joint=joint)
    joint = estimate_jointly(estimators, told)
    own = joint.own

    def believed() -> Belief:
        found = replace(level, found=left_over(estimators, joint))
        inner = own[estimators.inner(own.shape[:2])] if min(own.shape[:2]) > 3 else own
        scene = data.scene
        return believe(estimators, inner, found, scene, model_error=model_error, coupled=True)

    return _Settled(belief=data.common("belief", believed), own=own, joint=joint)


def _tell(belief: Belief, model_error: float, cause: str | None, *, coupled: bool) -> None:
    """A note of what speaks against the matrix, what may be the cause, and what was done."""
    level, against, advice = belief.level, [], cause or "--fit finds the camera that fits"
    if cause is None and not coupled:
        advice += "; neighbours' light takes a pif of --superpixels 3x3 and --overlap 3"
    if level.found is not None and level.found > level.sigma:
        against.append(f"what it cannot produce is {level.found / level.sigma:.3g} times the noise")
    if belief.moved > MOVED:
        against.append(
            "it is likelier that the picture's light is displaced "
            f"({belief.moved:.2g} standard deviations)"
        )
    if belief.displaced:
        against.append(f"even light is displaced ({belief.displaced:.2g} standard deviations)")
    if belief.continuity is not None and not belief.right:
        against.append(
            "across the lenslets' borders the picture goes on "
            f"{max(belief.continuity, 0):.2g} times as well as with a right matrix"
        )
    if model_error > 0:
        against.append(f"its own record says it is off by {model_error:.2g}")
    done = "what it leaves in proportion to the lenslets' brightness is taken out"
    if belief.raised > 1.001:
        done = (
            f"where that does harm the noise is taken {belief.raised:.3g} times as large, at the "
            "cost of detail"
        )
    note(f"the system matrix is not quite this camera's ({'; '.join(against)}): {done}; " + advice)
