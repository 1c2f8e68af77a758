"""How much memory reconstruct and learn-dict take, counted from the sizes of their arrays before
they start (docs/model.md, "Faults, memory and repetition"). What numbers stand for: arrays of eight
bytes a number that are held at the same time, measured where a library makes them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plenocli.base.budget import budget
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.nuisances.pixel_model import CHUNK
from plenocli.inverse.picture.solvers.joint_lmmse import MOST
from plenocli.inverse.picture.solvers.lmmse import SCALES
from plenocli.inverse.sparse.dictionary import Settings as LearnerSettings

NUMBER = 8
"""Bytes of a number."""


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """What the memory of a method depends on.

    lenslets: how many.
    pixels, points: of a superpixel and of an object, all bands together.
    bands: of the object.
    offsets: superpixels that one object sends light to.
    reach: of them, in lenslets.
    directions: through which the joint estimate sees a superpixel.
    atoms: of the dictionary, 0 without one.
    precision: bytes of a number of the matrix.
    """

    lenslets: int
    pixels: int
    points: int
    bands: int
    offsets: int
    reach: int
    directions: int
    atoms: int
    precision: int = NUMBER

    @classmethod
    def of(cls, system: LensletMatrix, lenslets: int, directions: int, atoms: int) -> Sizes:
        """Those of `lenslets` behind a matrix."""
        pixels, points = system.own.shape
        return cls(
            lenslets=lenslets,
            pixels=pixels,
            points=points,
            bands=max(1, len(system.bands)),
            offsets=len(system.blocks),
            reach=int(np.abs(system.offsets).max(initial=0)),
            directions=directions,
            atoms=atoms,
            precision=system.blocks.dtype.itemsize,
        )

    @property
    def blocks(self) -> float:
        """What the matrix takes, in numbers of eight bytes."""
        return self.offsets * self.pixels * self.points * self.precision / NUMBER

    @property
    def least(self) -> int:
        """Singular values of the own block."""
        return min(self.pixels, self.points)

    @property
    def block(self) -> int:
        """Points of an object in one band."""
        return self.points // self.bands

    @property
    def svd(self) -> int:
        """Numbers of the singular value decomposition."""
        return self.least * (self.pixels + self.points)

    @property
    def y(self) -> int:
        """Numbers of the capture."""
        return self.lenslets * self.pixels


Phases = Callable[[Sizes], list[float]]
"""Numbers that are held at the same time, the matrix apart, in each phase of a method."""


def no_more(n: Sizes) -> list[float]:
    """Of a method that needs no more than reading and the decomposition."""
    return []


def lmmse_phases(n: Sizes) -> list[float]:
    """Of LMMSE of each lenslet by itself."""
    return [
        n.y + n.svd + 13 * n.block**2,
        n.svd + n.block**2 + n.lenslets * (2 * n.pixels + 6 * n.points + 4 * n.least + 240),
    ]


def cleaned(phases: Phases) -> Phases:
    """Those of a method whose capture is rid of its nuisances first, by LMMSE of each lenslet."""

    def both(n: Sizes) -> list[float]:
        together = min(n.lenslets, CHUNK) * 6 * n.pixels
        tables = 2 * len(SCALES) * n.pixels + n.svd + n.block**2
        return [*lmmse_phases(n), tables + 4.5 * n.y + together, *phases(n)]

    return both


def joint_phases(n: Sizes) -> list[float]:
    """Of LMMSE over 3x3 lenslets."""
    side = 2 * n.reach + 1
    around = (2 * side**2 + (side + 4) ** 2 + n.offsets + 67) * n.directions * n.points
    return [
        *lmmse_phases(n),
        n.y + n.svd + n.block**2 + around + 511 * n.directions**2,
        n.svd
        + n.block**2
        + 18 * n.directions * n.points
        + 268 * n.directions**2
        + n.lenslets * (2 * n.pixels + 10 * n.points + 240 + 36 * n.directions),
    ]


def nnls_phases(n: Sizes) -> list[float]:
    """Of non-negative least squares."""
    return [n.y + n.svd + 2 * n.least * n.points + n.points**2 + n.lenslets * n.points]


def dictionary_phases(n: Sizes) -> list[float]:
    """Of sparse coding, where there is a dictionary."""
    if not n.atoms:
        return []
    coding = 3 * n.points * n.atoms + n.atoms**2 + 3 * n.least * n.atoms
    return [n.y + n.svd + coding + n.lenslets * n.points]


def tv_phases(n: Sizes) -> list[float]:
    """Of total variation, which starts from LMMSE."""
    return [*lmmse_phases(n), n.svd + n.block**2 + n.lenslets * n.points * 20]


def pnp_phases(n: Sizes) -> list[float]:
    """Of plug and play, which starts from LMMSE, over 3x3 lenslets where noise is strong."""
    return [*joint_phases(n), n.svd + n.block**2 + n.lenslets * n.points * 137]


def reconstruction(n: Sizes, phases: Phases, *, joint: bool = False) -> float:
    """Bytes of a method.

    phases: its own.
    joint: whether the joint estimate is made before or instead.
    """
    held = [
        1.5 * n.blocks,
        n.lenslets * (3.25 * n.pixels + 1.5 * n.points),
        n.y + 4.3 * n.pixels * n.points + n.least**2,
        *(joint_phases(n) if joint else []),
        *phases(n),
    ]
    return NUMBER * (n.blocks + max(held))


def require_reconstruction(
    estimators: Estimators,
    lenslets: int,
    sigma: float | None,
    where: Path,
    phases: Phases,
    *,
    joint: bool,
) -> None:
    """Refuse, before anything is worked out, what does not fit the memory of this process.

    lenslets: that are looked at together.
    sigma: noise of a pixel, None where it is not known.
    where: path of the capture, for the message.
    phases, joint: as in `reconstruction`.

    Raises NumericsError.
    """
    system = estimators.system
    most = min(MOST, *system.own.shape)
    atoms = 0 if estimators.read_dictionary is None else estimators.learnt.atoms.shape[1]
    sizes = Sizes.of(system, lenslets, most, atoms)
    needed = reconstruction(sizes, phases, joint=joint)
    # what stands above the noise decides, and may be much less
    if needed > budget().memory > 3 * NUMBER * system.own.size:
        seen = _directions(system.own, estimators.options.noise_sigma or sigma or 0.0)
        sizes = replace(sizes, directions=min(most, seen))
        needed = reconstruction(sizes, phases, joint=joint)
    budget().require(
        needed,
        "the reconstruction",
        where,
        "take fewer lenslets or points, or another --method",
    )


def pieces_at_once(
    estimators: Estimators, lenslets: int, phases: Phases, *, joint: bool, most: int
) -> int:
    """How many pieces of `lenslets`, `most` at most, the memory holds, in as many threads of this
    process; one where there is no room for more.

    phases, joint: as in `reconstruction`.
    """
    system = estimators.system
    # threads share all that does not go with lenslets
    sizes = Sizes.of(system, lenslets, min(MOST, *system.own.shape), 0)
    for count in range(most, 1, -1):
        # what another one made waits to be kept while it is at the next
        together = replace(sizes, lenslets=(2 * count - 1) * lenslets)
        if reconstruction(together, phases, joint=joint) <= budget().memory:
            return count
    return 1


def _directions(own: np.ndarray, sigma: float) -> int:
    """Singular vectors of `own` (pixel, point) whose signal can exceed a hundredth of the noise,
    about: of photographs of a standard deviation of 0.25.
    """
    strength = 0.25 * np.linalg.svd(own, compute_uv=False) * np.sqrt(own.shape[1])
    return max(1, int(np.count_nonzero(strength > 0.01 * sigma)))


def learning(
    shape: tuple[int, int], offsets: int, atoms: int, batch: int, synthesis: bool
) -> float:
    """Bytes of learn-dict, its neighbours' blocks in hand.

    What a batch is coded and refitted with goes back to the system in part only, before the
    training patches of the LMMSE beside which the dictionary is judged are drawn.

    shape: (pixel, point) of the own block.
    offsets: blocks of the matrix.
    batch: patches of an iteration.
    synthesis: whether atoms that paint are regressed too.
    """
    pixels, points = shape
    held = offsets * pixels * points + min(shape) * (pixels + points)
    step = (
        3.3 * batch * atoms
        + 0.5 * batch * points
        + 4 * atoms**2
        + 3.4 * points * atoms
        + (3 * atoms**2 + 2 * points * atoms if synthesis else 0)
    )
    judged = 12 * points**2
    return NUMBER * (
        held + max(4.3 * pixels * points + min(shape) ** 2, step, judged + min(step, judged))
    )


def require_learning(
    system: LensletMatrix,
    settings: LearnerSettings,
    where: Path,
    *,
    synthesis: bool,
) -> None:
    """Refuse, before the decomposition, learning that does not fit the memory of this process.

    settings: of Algorithm 1.
    where: the pif, for the message.
    synthesis: as in `learning`.

    Raises NumericsError.
    """
    needed = learning(
        system.own.shape, len(system.blocks), settings.atoms, settings.batch, synthesis
    )
    budget().require(
        needed,
        "learning",
        where,
        "take a smaller --batch, fewer --atoms or points",
    )
