"""What a method of reconstruct is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from types import EllipsisType

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.picture.estimators import Estimators, root_mean_square
from plenocli.inverse.picture.footprint import Phases, cleaned
from plenocli.inverse.picture.joint import JointEstimate, estimate_jointly
from plenocli.inverse.picture.lenslet_model import Superpixels
from plenocli.inverse.picture.reconstruction import (
    Choice,
    ContrastScale,
    NeighboursTaken,
    Reconstruction,
    Stats,
)


class Sees(Enum):
    """What of the sensor a method looks at for one object."""

    LENSLET_AS_IS = "its superpixel, neighbours' light included"
    LENSLET = "its superpixel, neighbours' light taken away"
    RING = "the 3x3 superpixels around it, at once"
    PICTURE = "all superpixels, neighbours' light taken away"


@dataclass(frozen=True, kw_only=True)
class OwnLight:
    """What a method is given once the neighbours' light is away.

    data: the capture.
    y: (lenslet_row, lenslet_column, pixel) own light, in units of A x.
    truth: (lenslet_row, lenslet_column, point) the true objects, to choose a weight with hindsight.
    joint: the estimate that took the neighbours' light away, None where there is none of it; then
        lenslets that light from beyond the array reaches stay what they are there.
    inner: the lenslets that the method estimates.
    """

    data: Superpixels
    y: np.ndarray
    truth: np.ndarray | None = None
    joint: JointEstimate | None = None
    inner: tuple[slice, slice] | EllipsisType = ...

    @property
    def counted(self) -> np.ndarray:
        """(lenslet,) which of these are not there for their neighbours' sake."""
        own = np.zeros(self.y.shape[:2], bool)
        own[self.data.own] = True
        return own[self.inner].ravel()


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """What a method makes of own light.

    value: (lenslet_row, lenslet_column, point).
    sigma: its standard deviation, or None.
    from_lmmse: root mean square distance from LMMSE of each lenslet, where that is known.
    stats: of the method.
    """

    value: np.ndarray
    sigma: np.ndarray | None = None
    from_lmmse: float | None = None
    stats: Stats | None = None


@dataclass(frozen=True, kw_only=True)
class Method(ABC):
    """A method of reconstruct, all that the command needs to know of it.

    name: as --method takes it.
    sees: what of the sensor it looks at.
    phases: its memory.
    needs_pif: whether it does nothing without a system matrix.
    needs_dictionary: whether it does nothing without a dictionary.
    options: names of the Options and inputs that mean something to it alone.
    hindsight: whether the truth may choose its weight.
    each_pixel: whether every pixel counts by its own noise.
    in_batches: whether its lenslets are solved in batches, which processes may share.
    weighs_all: whether one weight goes by the power, or the error, of all lenslets, which some do
        not tell.
    lenslets_around: how many on either side its own depend on, beside what `sees` says.
    points_around: of a method that sees the whole picture, how far a point looks.
    unrestrained: whether a picture that explains its capture may be noise for the most part.
    """

    name: str
    sees: Sees
    phases: Phases
    needs_pif: bool = True
    needs_dictionary: bool = False
    options: tuple[str, ...] = ()
    hindsight: bool = False
    each_pixel: bool = False
    in_batches: bool = False
    weighs_all: bool = False
    lenslets_around: int = 0
    points_around: int = 0
    unrestrained: bool = False

    @property
    def all_phases(self) -> Phases:
        """Its memory, that of what rids captures of their nuisances before included."""
        return self.phases if self.sees is Sees.LENSLET_AS_IS else cleaned(self.phases)

    @property
    def by_noise(self) -> bool:
        """Whether it goes by the noise, to which that of the matrix is compared."""
        return self.each_pixel or self.sees is not Sees.LENSLET_AS_IS

    @property
    def in_threads(self) -> bool:
        """Whether threads share its tiles as well as processes, which start late and hold all that
        tiles have in common once each: it does little but multiply matrices.
        """
        return self.sees is not Sees.PICTURE and not self.in_batches and not self.each_pixel

    def makes_joint_estimate(self, estimators: Estimators) -> bool:
        """Whether LMMSE over 3x3 lenslets is made, before the method or instead of it."""
        if estimators.overlap != 3 or self.sees is Sees.LENSLET_AS_IS:
            return False
        return estimators.coupled or self.sees is Sees.RING

    @abstractmethod
    def reconstruct(
        self,
        estimators: Estimators,
        data: Superpixels,
        truth: np.ndarray | None = None,
        choice: Choice | None = None,
        joint: JointEstimate | None = None,
    ) -> Reconstruction:
        """The picture of a capture whose noise is known, all of A x and white noise.

        truth: (lenslet_row, lenslet_column, point) chooses the weight with hindsight.
        choice: why this method was taken; None: it was asked for.
        joint: LMMSE over 3x3 lenslets, where it was made before.
        """


@dataclass(frozen=True, kw_only=True)
class Estimator(Method):
    """A method with an estimate of its own.

    estimate: from own light.
    """

    estimate: Callable[[Estimators, OwnLight], Estimate]

    def reconstruct(
        self,
        estimators: Estimators,
        data: Superpixels,
        truth: np.ndarray | None = None,
        choice: Choice | None = None,
        joint: JointEstimate | None = None,
    ) -> Reconstruction:
        """As in Method: the neighbours' light is taken away first, where the matrix knows it."""
        choice = choice or Choice(method=self.name, reason="asked for")
        self._note_overlap(estimators)
        if not self.makes_joint_estimate(estimators):
            own = self.estimate(estimators, OwnLight(data=data, y=data.y, truth=truth))
            return self._result(estimators, choice, own)
        joint = joint or estimate_jointly(estimators, data)
        if self.sees is Sees.RING:
            return Reconstruction(
                value=joint.value,
                sigma=joint.sigma,
                method=self.name,
                overlap=estimators.overlap,
                scale=joint.scale,
                from_lmmse=0.0,
                trace=(choice, ContrastScale(joint.scale)),
            )
        taken = NeighboursTaken(scale=joint.scale)
        y = joint.own
        if min(y.shape[:2]) <= 2:
            border = Estimate(value=joint.value, sigma=joint.sigma)
            return self._result(estimators, choice, border, taken)
        inner = estimators.inner(y.shape[:2])
        light = OwnLight(data=data, y=y, truth=truth, joint=joint, inner=inner)
        own = self.estimate(estimators, light)
        distance = root_mean_square(own.value - joint.value)
        return self._result(estimators, choice, own, taken, distance)

    def _result(
        self,
        estimators: Estimators,
        choice: Choice,
        own: Estimate,
        taken: NeighboursTaken | None = None,
        from_lmmse: float | None = None,
    ) -> Reconstruction:
        return Reconstruction(
            value=own.value,
            sigma=own.sigma,
            method=self.name,
            overlap=estimators.overlap,
            scale=None if taken is None else taken.scale,
            from_lmmse=own.from_lmmse if from_lmmse is None else from_lmmse,
            stats=own.stats,
            trace=(choice,) if taken is None else (choice, taken),
        )

    def _note_overlap(self, estimators: Estimators) -> None:
        """Say where the options leave something to be had."""
        if estimators.overlap == 3 and not estimators.coupled and self.sees is not Sees.RING:
            note(
                "--overlap 3: the pif holds own superpixels only, so there is no neighbours' "
                "light to take away (simulate-pif --superpixels 3x3)"
            )
        if estimators.overlap == 1 and estimators.coupled and self.sees is not Sees.LENSLET_AS_IS:
            note(
                "--overlap 1: the neighbours' light, which the pif knows, stays in the "
                "superpixels and is taken for the object's; --overlap 3 takes it away"
            )
