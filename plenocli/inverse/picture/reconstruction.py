"""What a method gives: the picture, how sure it is, and what was tried, chosen and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from plenocli.base.text import Record
from plenocli.base.tiling import to_plane
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture.trust.noise_level import NoiseLevel


class Entry(Protocol):
    """What a result's attributes tell of: a choice, a finding."""

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        ...


class Stats(Entry, Protocol):
    """What a method tells of itself."""

    @property
    def rule(self) -> str:
        """How its parameter was chosen, or where it stopped, in words."""
        ...


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which method was taken.

    method: its name.
    reason: why, in words.
    trial_db: PSNR (dB) of every method that was tried, where there was a trial.
    """

    method: str
    reason: str
    trial_db: Mapping[str, float] | None = None

    def as_json(self) -> dict[str, Any]:
        """The fields by name."""
        told: dict[str, Any] = {"method": self.method, "reason": self.reason}
        return told if self.trial_db is None else told | {"trial_db": dict(self.trial_db)}


@dataclass(frozen=True)
class ContrastScale(Record):
    """The factor of the photographs' covariance that the whole capture was given."""

    scale: float


@dataclass(frozen=True, kw_only=True)
class NeighboursTaken:
    """The neighbours' light was taken away before the method itself, as the joint estimate sees
    it; scale: that estimate's factor of the covariance.
    """

    scale: float

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts hold them."""
        return {
            "neighbours": "their light is taken away as LMMSE over 3x3 lenslets sees it",
            "border": "lenslets that lack neighbours are those of LMMSE over 3x3 lenslets: light "
            "from beyond the array cannot be taken away",
            "scale": self.scale,
        }


@dataclass(frozen=True, kw_only=True)
class Account:
    """How a picture came about.

    method: name of the method that made it.
    overlap: superpixels (a side) looked at for each block; None without a system matrix.
    noise_level: what was taken for noise, None where the method does not ask.
    scale: factor of the photographs' covariance, where the method has one.
    from_lmmse: root mean square distance from the picture of LMMSE, None where that is not known.
    stats: of the method itself.
    trace: what was tried and chosen, in this order.
    """

    method: str
    overlap: int | None = None
    noise_level: NoiseLevel | None = None
    scale: float | None = None
    from_lmmse: float | None = None
    stats: Stats | None = None
    trace: tuple[Entry, ...] = ()

    @property
    def noise(self) -> Noise | None:
        """The noise that was used, in units of A x."""
        return None if self.noise_level is None else Noise.of_sigma(self.noise_level.sigma)

    @property
    def reason(self) -> str | None:
        """Why this method was taken, in words."""
        return next((entry.reason for entry in self.trace if isinstance(entry, Choice)), None)

    @property
    def rule(self) -> str | None:
        """How the method's parameter was chosen, in words."""
        return None if self.stats is None else self.stats.rule

    def as_json(self) -> dict[str, Any]:
        """Names and values, as artefacts and summaries hold them; later entries of the trace
        overrule earlier ones.
        """
        told: dict[str, Any] = {}
        for entry in (*self.trace, *(() if self.stats is None else (self.stats,))):
            told |= entry.as_json()
        told |= {} if self.overlap is None else {"overlap": self.overlap}
        return told | ({} if self.from_lmmse is None else {"from_lmmse": self.from_lmmse})


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Account):
    """A picture, and how it came about.

    value: (lenslet_row, lenslet_column, point); after `as_picture` (row, column) or (band, row,
        column), and InParts of a picture that is put together of tiles. Relative to white.
    sigma: predicted standard deviation, like value, or None.
    """

    value: np.ndarray
    sigma: np.ndarray | None = None

    @property
    def account(self) -> Account:
        """How it came about, without the picture."""
        return Account(**{f.name: getattr(self, f.name) for f in fields(Account)})

    def as_picture(self, object_shape: tuple[int, int]) -> Reconstruction:
        """The same with its blocks of `object_shape` points (rows, columns) put together."""
        return replace(
            self,
            value=to_plane(self.value, object_shape),
            sigma=None if self.sigma is None else to_plane(self.sigma, object_shape),
        )
