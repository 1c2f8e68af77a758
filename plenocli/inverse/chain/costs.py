"""What a matrix and a method cost, counted from their sizes: seconds of one core at nominal speed
by a law whose coefficients are fitted, bytes as reconstruct counts them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from plenocli.forward.propagation.costs import Law, priced, read
from plenocli.forward.propagation.plan import PifPlan
from plenocli.inverse.picture import footprint
from plenocli.inverse.picture.footprint import Sizes, cleaned
from plenocli.inverse.picture.methods.method import Sees
from plenocli.inverse.picture.methods.registry import METHODS
from plenocli.inverse.picture.solvers.joint_lmmse import MOST

FITTED = Path(__file__).with_name("costs.toml")
"""Coefficients, by pipelines/benchmarks/plan.py --fit."""


@dataclass(frozen=True)
class Spent:
    """Seconds of one core at nominal speed, and bytes held at once."""

    seconds: float
    bytes: int


@dataclass(frozen=True, kw_only=True)
class Effort:
    """What the work of a method depends on.

    sizes: of matrix and capture.
    coupled: whether the matrix knows neighbours.
    """

    sizes: Sizes
    coupled: bool

    @classmethod
    def of(cls, plan: PifPlan, lenslets: int) -> Effort:
        """With the matrix of a plan and `lenslets` of a capture."""
        _, superpixels, pixels, points = plan.shape
        sizes = Sizes(
            lenslets=lenslets,
            pixels=pixels,
            points=points,
            bands=1,
            offsets=superpixels,
            reach=(max(plan.superpixels) - 1) // 2,
            directions=min(MOST, pixels, points),
            atoms=0,
        )
        return cls(sizes=sizes, coupled=superpixels > 1)

    def features(self) -> dict[str, float]:
        """Number of each thing that takes time."""
        n = self.sizes
        joint = float(self.coupled)
        return {
            "start": 1.0,
            "decomposition": float(n.pixels * n.points * n.least),
            "covariance": float(n.points) ** 3,
            "lenslet values": float(n.lenslets * n.points),
            "lenslet products": float(n.lenslets * n.pixels * n.points),
            "joint start": joint,
            "joint directions": joint * n.directions * n.points * n.offsets,
            "joint products": joint * n.directions**2 * n.points,
            "joint lenslets": joint * n.lenslets * n.pixels * n.points,
        }


@cache
def laws(path: Path = FITTED) -> dict[str, Law]:
    """The law of every method by name, and that of "simulate-pif"."""
    return read(path)


def inversion_cost(method: str, effort: Effort) -> Spent:
    """What reconstruct costs with a matrix that is there."""
    seconds = priced(laws()[method].seconds, effort.features())
    one = METHODS[method]
    looks = one.sees is not Sees.LENSLET_AS_IS
    phases = cleaned(one.phases) if looks else one.phases
    held = footprint.reconstruction(effort.sizes, phases, joint=effort.coupled and looks)
    return Spent(seconds, int(held))


def matrix_features(plan: PifPlan) -> dict[str, float]:
    """Number of each thing that takes time in simulate-pif, its own estimate among them."""
    bands, superpixels, pixels, points = plan.shape
    return {
        "start": 1.0,
        "planned seconds": plan.chosen.seconds(),
        "decomposition": float(bands * pixels * points * min(pixels, points)),
        "values": float(bands * superpixels * pixels * points),
    }


def matrix_cost(plan: PifPlan) -> Spent:
    """What simulate-pif costs: as it plans, and the diagnosis."""
    return Spent(priced(laws()["simulate-pif"].seconds, matrix_features(plan)), plan.memory)
