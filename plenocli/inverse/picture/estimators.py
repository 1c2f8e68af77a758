"""What the methods of reconstruct share: set up once, it serves every capture made with the same
camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, TypeVar

import numpy as np

from plenocli.base.device import CPU, Device
from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.progress import bar
from plenocli.inverse.picture.lenslet_model import Keep, LensletMatrix, work_out
from plenocli.inverse.picture.solvers.least_squares import Svd, decompose
from plenocli.inverse.prior.scene_prior import ReadPictures, ScenePrior
from plenocli.inverse.sparse.dictionary import Dictionary

INNER = (slice(1, -1), slice(1, -1))
"""Lenslets that have all their neighbours."""

TrialKey = tuple[float, float, str | None]
"""Noise over signal, contrast and scene of a trial of methods."""

Elsewhere = Callable[[Callable[..., Any], list[np.ndarray], tuple[Any, ...]], list[Any]]
"""(solve, batches, options) -> what each batch gives, in their order."""

_Solved = TypeVar("_Solved")


@dataclass(frozen=True, kw_only=True)
class Options:
    """What a person may say about the estimate.

    method: name of the method.
    overlap: superpixels (a side) looked at for each block, 1 or 3; None for 3 where the matrix
        knows neighbours.
    noise_sigma: standard deviation of the noise, in units of A x.
    alpha: weight of squared detail of tikhonov, in units of A's squared singular values.
    rank: directions kept.
    lam: weight of |c|_1, in the scaled problem of learn-dict.
    nnls_iterations: gradient steps after which to stop.
    hold_out: share of the pixels that are left out and predicted, to judge the matrix.
    seed: of every random stream.
    """

    method: str = "auto"
    overlap: int | None = None
    noise_sigma: float | None = None
    alpha: float | None = None
    rank: int | None = None
    lam: float | None = None
    nnls_iterations: int | None = None
    hold_out: float | None = None
    seed: int = 0


class Estimators:
    """One system matrix with its decomposition, what photographs look like to it, and a dictionary,
    each made when first asked for.

    elsewhere: set to send batches of lenslets to other processes, see `in_batches`.
    trials: PSNR (dB) of each method that was tried, kept for captures to come.
    through: (rows, what `seen_through` made of them last), for batches and tiles to come.
    """

    elsewhere: Elsewhere | None = None
    through: list[tuple[np.ndarray, Estimators]]

    def __init__(
        self,
        system: LensletMatrix,
        options: Options,
        read_pictures: ReadPictures,
        read_dictionary: Callable[[], Dictionary] | None = None,
        *,
        threads: int | None = None,
        keep: Keep = work_out,
        device: Device = CPU,
    ) -> None:
        """keep: of decompositions, and of what photographs are like.

        read_pictures: gives the training pictures; read_dictionary: the learnt dictionary, None
        where there is none; threads: of compiled code, None for all cores; device: of plug and
        play.
        """
        self.system, self.options, self.threads = system, options, threads
        self.keep, self.device = keep, device
        self.read_pictures, self.read_dictionary = read_pictures, read_dictionary
        self.through = []
        self.trials: dict[TrialKey, dict[str, float]] = {}
        self.coupled = len(system.offsets) > 1
        self.overlap = options.overlap or (3 if self.coupled else 1)

    @cached_property
    def svd(self) -> Svd:
        """Of the own block."""

        def decomposed() -> tuple[np.ndarray, ...]:
            svd = decompose(self.system.own)
            return svd.u, svd.s, svd.vt

        return Svd(*self.keep("svd", [self.system.own], decomposed))

    @cached_property
    def prior(self) -> ScenePrior:
        """What photographs look like to this matrix."""
        return ScenePrior(
            self.system, lambda: self.svd, self.read_pictures, self.options.seed, keep=self.keep
        )

    @cached_property
    def learnt(self) -> Dictionary:
        """The dictionary; ValueError where none was given."""
        if self.read_dictionary is None:
            raise ValueError("no dictionary was given")
        return self.read_dictionary()

    def alone(self, sigma: float) -> Estimators:
        """The same for the own superpixel without neighbours, at noise `sigma`."""
        one = Estimators(
            replace(self.system, blocks=self.system.own[None], offsets=np.zeros((1, 2), int)),
            replace(self.options, noise_sigma=sigma, overlap=1),
            self.read_pictures,
            None if self.read_dictionary is None else lambda: self.learnt,
            threads=self.threads,
            device=self.device,
        )
        one.svd, one.prior = self.svd, self.prior
        return one

    def with_options(self, options: Options) -> Estimators:
        """The same with other options; what was worked out is shared, both ways."""
        other = copy(self)
        other.options = options
        other.svd, other.prior = self.svd, self.prior
        return other

    def with_matrix(self, system: LensletMatrix) -> Estimators:
        """The same with another matrix of the same objects: what photographs are like is shared,
        both ways. Batches stay in this process.
        """
        other = Estimators(
            system,
            self.options,
            self.read_pictures,
            None if self.read_dictionary is None else lambda: self.learnt,
            threads=self.threads,
            device=self.device,
        )
        other.prior.pictures_of = self.prior.pictures_of
        other.prior.statistics = self.prior.statistics
        return other

    def seen_through(self, rows: np.ndarray) -> Estimators:
        """The same for superpixels of which only `rows` (row, pixel) are looked at: their noise is
        white then. What was made last is kept.
        """
        for known, made in self.through:
            if np.array_equal(known, rows) and made.options == self.options:
                return made
        blocks = np.stack([rows @ block for block in self.system.blocks])
        other = self.with_matrix(replace(self.system, blocks=blocks, pixel_shape=(len(rows), 1)))
        if self.elsewhere is not None:
            other.elsewhere = partial(_elsewhere_through, self.elsewhere, rows)
        self.through[:] = [(rows, other)]
        return other

    def sensor(self, count: tuple[int, int]) -> BlockToeplitz:
        """The matrix of `count` lenslets (rows, columns), neighbours' light included."""
        return BlockToeplitz(self.system.blocks, self.system.offsets, count)

    def inner(self, count: tuple[int, int]) -> tuple[slice, slice]:
        """Of `count` lenslets (rows, columns) those that have all neighbours that the matrix knows;
        where none has, those that are not at the border.
        """
        reach = int(np.abs(self.system.offsets).max())
        return (slice(reach, -reach),) * 2 if 0 < 2 * reach < min(count) else INNER

    def without_stray(self, y: np.ndarray) -> np.ndarray:
        """Superpixels y (lenslet_row, lenslet_column, pixel) without the neighbours' light, as
        block means tell it: enough to estimate noise and contrast.
        """
        if not self.coupled:
            return y
        even = BlockToeplitz(self.system.even_blocks, self.system.offsets, y.shape[:2])
        return y - even.neighbours_only().forward(self.system.levels(y))

    def in_batches(
        self, solve: Callable[..., _Solved], z: np.ndarray, size: int, *options: Any
    ) -> Iterable[_Solved]:
        """What `solve` gives for all signals, a batch at a time, in their order.

        solve: (estimators, batch, *options), a function of a module, so that other processes can
            run it.
        z: (row, signal).
        size: signals of a batch. Several batches go to `elsewhere`, where it is set.
        """
        # as they arrive elsewhere: last digits depend on the layout
        batches = [
            np.ascontiguousarray(z[:, start : start + size]) for start in range(0, z.shape[1], size)
        ]
        if self.elsewhere is not None and len(batches) > 1:
            return self.elsewhere(solve, batches, options)
        return [
            solve(self, batch, *options)
            for batch in bar(batches, len(batches), "batches of lenslets")
        ]


def _elsewhere_through(
    elsewhere: Elsewhere,
    rows: np.ndarray,
    solve: Callable[..., Any],
    batches: list[np.ndarray],
    options: tuple[Any, ...],
) -> list[Any]:
    """What each batch gives elsewhere, where superpixels are looked at through `rows` too."""
    return elsewhere(solve_through, batches, (rows, solve, *options))


def solve_through(
    estimators: Estimators,
    batch: np.ndarray,
    rows: np.ndarray,
    solve: Callable[..., _Solved],
    *options: Any,
) -> _Solved:
    """What `solve` gives for a batch of superpixels that are looked at through `rows` (row,
    pixel).
    """
    return solve(estimators.seen_through(rows), batch, *options)


def root_mean_square(values: np.ndarray) -> float:
    """Root mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))
