"""The chains to choose from: a system matrix of some model, accuracy and neighbourhood, and a
method of reconstruction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.accuracy.limiting_error import what_limits
from plenocli.forward.accuracy.scene_needs import visible_accuracy
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.plan import PifPlan
from plenocli.inverse.chain.costs import Effort, inversion_cost, matrix_cost

MODELS = ("ray", "fresnel", "exact")
"""Coarse to fine."""
DECADES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)
"""Accuracies that are considered, beside the finest that the noise lets be seen."""
APART = 1.5
"""Accuracies that are nearer than this factor are one."""
COARSER = 6
"""Doublings of the finest accuracy that are tried where it cannot be reached."""


INVERSIONS = ("block-mean", "tikhonov", "lmmse", "tv", "pnp")
"""The methods that are considered: those that need nothing but a matrix and the photographs that
come along.
"""


@dataclass(frozen=True, kw_only=True, eq=False)
class MatrixOption:
    """A system matrix that might be made.

    model, accuracy, superpixels: as simulate-pif is asked.
    plan: what the dial makes of that.
    """

    model: str
    accuracy: float
    superpixels: tuple[int, int]
    plan: PifPlan

    @property
    def own_only(self) -> bool:
        """Whether it leaves the neighbours' light out."""
        return self.superpixels == (1, 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """A way from a camera's description and its capture to a picture.

    seconds: of one core, nominal, for both.
    bytes: the most that either holds.
    """

    matrix: MatrixOption
    method: str
    seconds: float
    bytes: int

    def commands(self, camera: str, capture: str) -> list[str]:
        """The command lines that carry it out.

        camera, capture: files as a shell reads them.
        """
        rows, columns = self.matrix.superpixels
        return [
            f"plenocli simulate-pif {camera} --model {self.matrix.model} --accuracy "
            f"{self.matrix.accuracy:g} --superpixels {rows}x{columns} -o pif.h5",
            f"plenocli reconstruct {capture} --pif pif.h5 --method {self.method} -o image.h5",
        ]


def matrix_options(camera: Camera, noise: float) -> list[MatrixOption]:
    """The matrices worth considering at a noise (relative to the signal), the finest last.

    A matrix whose own record says that it is off by more than the noise, reconstruct replaces by an
    exact one: where there is one it is left out, as the exact one alone costs less.

    Raises NumericsError where no matrix of this camera can be made.
    """
    finest = float(f"{visible_accuracy(noise):.2g}")
    accuracies = [a for a in DECADES if a > APART * finest]
    found: list[MatrixOption] = []
    wide = _finest(camera, finest)
    around = {wide.superpixels, (1, 1)}
    for superpixels in sorted(around):
        last = max(finest, wide.accuracy)
        for model in MODELS:
            for accuracy in [*(a for a in accuracies if a > APART * last), last]:
                option = _option(camera, model, accuracy, superpixels)
                if option is not None:
                    found.append(option)
                if model == "ray":  # exact areas: no accuracy to choose
                    break
    exact = any(option.model == "exact" for option in found)
    return [option for option in found if not (exact and _replaced(option, noise))]


def _finest(camera: Camera, accuracy: float) -> PifPlan:
    """The plan of the finest accuracy that is reached, with all superpixels that light reaches."""
    for _ in range(COARSER):
        try:
            return plan_pif(camera, accuracy=accuracy)
        except NumericsError:
            accuracy = float(f"{2 * accuracy:.2g}")
            if accuracy >= 1:
                break
    return plan_pif(camera)


def _option(
    camera: Camera, model: str, accuracy: float, superpixels: tuple[int, int]
) -> MatrixOption | None:
    try:
        plan = plan_pif(camera, model=model, accuracy=accuracy, superpixels=superpixels)
    except NumericsError:
        return None
    return MatrixOption(model=model, accuracy=accuracy, superpixels=superpixels, plan=plan)


def _replaced(option: MatrixOption, noise: float) -> bool:
    """Whether reconstruct would take a finer matrix in its place."""
    limits = what_limits(noise, option.plan.accuracy_record())
    return option.model != "exact" and limits is not None and limits.limited_by == "model"


def chains_of(
    camera: Camera, matrices: Sequence[MatrixOption], methods: Sequence[str] = INVERSIONS
) -> list[Chain]:
    """Every matrix with every method, the cheapest first.

    The mean of a lenslet looks at its own superpixel alone: matrices with neighbours are no other.
    """
    lenslets = int(np.prod(camera.lenslet_array.count))
    found = []
    for matrix in matrices:
        for method in methods:
            if method == "block-mean" and not matrix.own_only and len(matrices) > 1:
                continue
            effort = Effort.of(matrix.plan, lenslets)
            making, solving = (
                matrix_cost(matrix.plan),
                inversion_cost(method, effort),
            )
            found.append(
                Chain(
                    matrix=matrix,
                    method=method,
                    seconds=making.seconds + solving.seconds,
                    bytes=max(making.bytes, solving.bytes),
                )
            )
    return sorted(found, key=lambda chain: chain.seconds)
