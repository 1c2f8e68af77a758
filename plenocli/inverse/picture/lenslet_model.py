"""The model that pictures are estimated from, y = A x + noise: its matrix, and captures in its
units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.sensor.noise import Noise


@dataclass(frozen=True, kw_only=True)
class MatrixOrigin:
    """What a matrix was computed from.

    camera: its description.
    wavelengths: (wavelength,) m.
    weights: (band, wavelength) share of each in a band, None for equal ones of one band.
    coherent_ring: rings of lenslets whose fields add.
    """

    camera: Camera
    wavelengths: tuple[float, ...]
    weights: np.ndarray | None = None
    coherent_ring: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class LensletMatrix:
    """What superpixels see of objects, the wavelengths of a pif gathered into its bands; equal to
    itself alone.

    path: the pif, for messages.
    blocks: (offset, pixel, point), points of several bands one band after the other; in single
        precision where they were stored so.
    offsets: (offset, 2) lenslets (rows, columns) from the object to the superpixel.
    pixel_shape: (rows, columns) of a superpixel.
    object_shape: (rows, columns) of an object block in one band.
    accuracy: how accurate it is, None where that is not known.
    bands: (band,) wavelengths (m) of the pictures that the object has, () where it is one picture
        without a colour.
    illuminant: the light that the bands' shares are for.
    origin: what it was computed from, None where that is not known.
    """

    path: Path
    blocks: np.ndarray
    offsets: np.ndarray
    pixel_shape: tuple[int, int]
    object_shape: tuple[int, int]
    accuracy: AccuracyRecord | None = None
    bands: tuple[float, ...] = ()
    illuminant: str | None = None
    origin: MatrixOrigin | None = None

    @cached_property
    def own(self) -> np.ndarray:
        """(pixel, point) of the superpixel behind the object itself, float64."""
        return np.asarray(self.blocks[np.flatnonzero(np.all(self.offsets == 0, axis=1))[0]], float)

    @cached_property
    def even_blocks(self) -> np.ndarray:
        """The superpixels of an even object, (offset, pixel, band): what light of one band makes of
        them.
        """
        bands = max(1, len(self.bands))
        return self.blocks.reshape(*self.blocks.shape[:2], bands, -1).sum(axis=3, dtype=float)

    @cached_property
    def even(self) -> np.ndarray:
        """The same of the superpixel behind the object itself, (pixel, band)."""
        return self.even_blocks[np.flatnonzero(np.all(self.offsets == 0, axis=1))[0]]

    def levels(self, y: np.ndarray) -> np.ndarray:
        """Brightness of each band, (.., band), behind superpixels y (.., pixel), by least squares
        on `even`.
        """
        return y @ self._to_levels

    @cached_property
    def _to_levels(self) -> np.ndarray:
        """(pixel, band)."""
        return np.linalg.pinv(self.even, rcond=1e-3).T


def gathered(matrices: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """System matrices of several wavelengths as one.

    matrices: (wavelength, offset, pixel, point).
    weights: (band, wavelength) share of each wavelength in a band; None: one band, equal shares.

    Returns (offset, pixel, point) float64, points of several bands one band after the other; the
        one matrix that there is as it is.
    """
    if weights is None and len(matrices) == 1:
        return matrices[0]
    if weights is None:
        weights = np.full((1, len(matrices)), 1 / len(matrices))
    bands = []
    for row in weights:
        bands.append(np.zeros(matrices.shape[1:]))
        for w, a in zip(row, matrices):
            if w:
                bands[-1] += w * np.asarray(a, np.float64)
    return np.concatenate(bands, axis=2) if len(bands) > 1 else bands[0]


Shared = Literal[
    "unit",  # of brightness, what a capture is divided by
    "bright",  # the same again, without defective pixels
    "clipped",  # level at which pixels were
    "pixel noise",  # and
    "signal",  # by which defective pixels are told
    "misfit",  # noise found over it, round by round
    "spread",  # of pixels about what their neighbours tell, defects.Spread
    "brightness",  # variance of lenslets', where a lenslet does not tell its own
    "veil",  # VeilFound, and how far lenslets differ
    "veil believed",
    "noise",  # NoiseLevel
    "belief",  # Belief
    "method",  # that the trial chose, and why
    "kept",  # share of detail
    "seen",  # Seen
    "contrasts",  # probability of each contrast, by estimator
    "power",  # of directions, by which weights go, and
    "cross",  # what they share with the truth, with hindsight
    "start",  # squared error expected of what methods of the picture start from
    "veil level",
    "solver",  # WeightedLmmse, and
    "told",  # what it tells, WeightedStats
    "wider",  # factor of standard deviations, by estimator
]
"""What the pieces of a capture have in common."""
MEANS: tuple[Shared, ...] = ("contrasts", "power", "cross", "start", "veil level", "wider")
"""What is a mean over pieces from all over; the others are those of the one piece."""
Common = Callable[..., Any]
"""(name, what works it out, which of that name): the value, see Superpixels.common."""


Keep = Callable[
    [str, list[np.ndarray], Callable[[], tuple[np.ndarray, ...]]], tuple[np.ndarray, ...]
]
"""(name, all that it depends on, what works it out): the arrays, worked out now or earlier."""


def work_out(
    name: str, inputs: list[np.ndarray], make: Callable[[], tuple[np.ndarray, ...]]
) -> tuple[np.ndarray, ...]:
    """A Keep that keeps nothing."""
    return make()


def alone(name: Shared, work: Callable[[], Any], which: Any = None) -> Any:
    """A Common of no piece."""
    return work()


@dataclass(frozen=True)
class Whole:
    """What holds for all of a capture, whichever piece of it is looked at.

    found: name -> which of that name -> value.
    closed: whether nothing is added: a tile works out by itself what was not found.
    only_means: whether the piece is looked at for these alone, and its picture not wanted.
    """

    found: dict[Shared, dict[Any, Any]]
    closed: bool = False
    only_means: bool = False

    def value(self, name: Shared, work: Callable[[], Any], which: Any) -> Any:
        """As Superpixels.common; the last of a name where this one was not found."""
        known = self.found.get(name, {})
        if which in known or (known and self.closed):
            return known.get(which, [*known.values()][-1])
        made = work()
        if not self.closed:
            self.found.setdefault(name, {})[which] = made
        return made

    def on_trial(self) -> Whole:
        """One that knows the same, and finds what this one need not `take`."""
        found = {name: dict(of) for name, of in self.found.items()}
        return self if self.closed else replace(self, found=found)

    def take(self, trial: Whole) -> None:
        """What a trial found."""
        self.found.update(trial.found)

    def for_means(self) -> Whole:
        """For another piece, which finds its own."""
        known = {name: dict(of) for name, of in self.found.items() if name not in MEANS}
        return Whole(known, only_means=True)

    def means(self) -> Whole:
        """What others need of it for theirs."""
        return Whole({name: self.found[name] for name in MEANS if name in self.found})

    def closed_with(self, others: Sequence[Whole]) -> Whole:
        """With the means over other pieces in place of what the one piece found."""
        found = {name: dict(of) for name, of in self.found.items()}
        for name in MEANS:
            for which in found.get(name, {}):
                of_others = [o.found[name][which] for o in others if which in o.found.get(name, {})]
                if of_others:
                    found[name][which] = np.mean(of_others, axis=0)
        return Whole(found, closed=True)


@dataclass(frozen=True, kw_only=True)
class Superpixels:
    """A capture as the estimators take it.

    y: (lenslet_row, lenslet_column, pixel) in units of A x; NaN where a pixel counts for nothing.
    noise: in these units, white, or None where it is not known.
    scene: name of what was captured, or None.
    accuracy: how accurately a capture was simulated, None of a real one.
    pif_digest: SHA-256 of the pif that a simulated capture was made with.
    saturated: like y, which pixels were clipped at the value that they have; None where the capture
        does not say.
    variance: like y, of every pixel, inf where it counts for nothing; None where all are alike or
        nothing is known.
    own: (rows, columns) of a tile, the lenslets that are not there for their neighbours' sake.
    whole: of a piece of a capture, what is common to all of it.
    """

    y: np.ndarray
    noise: Noise | None = None
    scene: str | None = None
    accuracy: AccuracyRecord | None = None
    pif_digest: str | None = None
    saturated: np.ndarray | None = None
    variance: np.ndarray | None = None
    own: tuple[slice, slice] = (slice(None), slice(None))
    whole: Whole | None = None

    def common(self, name: Shared, work: Callable[[], Any], which: Any = None) -> Any:
        """What `work` gives; of a piece, what the whole has under this name."""
        return work() if self.whole is None else self.whole.value(name, work, which)

    @property
    def only_means(self) -> bool:
        """Whether a piece is looked at for what it adds to means over pieces alone."""
        return self.whole is not None and self.whole.only_means

    @property
    def sigma(self) -> float | None:
        """Standard deviation of the known noise, in units of A x."""
        return None if self.noise is None else self.noise.sigma

    @property
    def known_sigma(self) -> float:
        """The same; ValueError where it is not known."""
        if self.noise is None:
            raise ValueError("the noise of the superpixels is not known")
        return self.noise.sigma
