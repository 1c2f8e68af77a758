"""The picture of one capture, and what is told of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.inverse.picture.diagnosis import Seen
from plenocli.inverse.picture.reconstruction import Account, Reconstruction

if TYPE_CHECKING:
    from plenocli.forward.accuracy.limiting_error import Limits


@dataclass(frozen=True, kw_only=True)
class Solved:
    """The picture of a capture.

    found: its value (row, column) or (band, row, column).
    capture: what it was made from, as describe_capture has it.
    seen: what of an object the sensor tells apart, None where the noise is not known.
    limits: what limits it, None where that is not known.
    negative_share: of the values, before they are clipped.
    block: points (rows, columns) of an object, None without a system matrix.
    bands: wavelengths (m) of the bands, () for one picture.
    rgb: (3, row, column) linear sRGB of a capture whose pixels have colours; None of others.
    """

    found: Reconstruction
    capture: dict[str, Any]
    seen: Seen | None = None
    limits: Limits | None = None
    negative_share: float
    block: tuple[int, int] | None = None
    bands: tuple[float, ...] = ()
    rgb: np.ndarray | None = None

    def summary(self, output: Path, *, clipped: bool) -> PictureSummary:
        """What there is to tell of it once it is written to `output`."""
        rows, columns = self.found.value.shape[-2:]
        return PictureSummary(
            output=str(output),
            account=self.found.account,
            limits=self.limits,
            seen=self.seen,
            rows=rows,
            columns=columns,
            bands=self.bands,
            negative_share=self.negative_share,
            clipped=clipped,
        )


@dataclass(frozen=True, kw_only=True)
class PictureSummary:
    """One picture that was written.

    output: its file.
    account: how it came about.
    limits, seen, bands, negative_share: as in Solved.
    rows, columns: of points.
    clipped: whether negative values were set to zero.
    """

    output: str
    account: Account
    limits: Limits | None
    seen: Seen | None
    rows: int
    columns: int
    bands: tuple[float, ...]
    negative_share: float
    clipped: bool

    def told(self) -> dict[str, Any]:
        """How the picture came about, as its artefact holds it."""
        told = self.account.as_json()
        told |= {} if self.limits is None else {"limits": self.limits.as_json()}
        return told | ({} if self.seen is None else {"seen": self.seen.as_json()})

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        return self.told() | {
            "output": self.output,
            "rows": self.rows,
            "columns": self.columns,
            "bands_nm": [w * 1e9 for w in self.bands],
            "negative_share": self.negative_share,
            "clipped": self.clipped,
        }

    def line(self, *, with_reason: bool) -> str:
        """One line for a person; with_reason: why this method was taken, too."""
        rule = f" ({self.account.reason})" if with_reason else ""
        rule += f", {self.account.rule}" if self.account.rule else ""
        seen = bands = ""
        if self.seen is not None:
            seen = (
                f", {self.seen.degrees:.0f} degrees of freedom of {self.seen.points} points above "
                "the noise"
            )
        if len(self.bands) > 1:
            bands = f" in bands of {', '.join(f'{w * 1e9:.4g}' for w in self.bands)} nm"
        return (
            f"{self.output}: {self.rows} x {self.columns} points{bands}, "
            f"{self.account.method}{rule}, {self.negative_share:.1%} negative{seen}"
        )


@dataclass(frozen=True, kw_only=True)
class ReconstructSummary:
    """What a run did.

    output: file or folder.
    skipped: captures that were finished before.
    captures: pictures that were written, in the order of their captures.
    """

    output: str
    skipped: int
    captures: tuple[PictureSummary, ...]

    def as_json(self) -> dict[str, Any]:
        """Names and values of --json."""
        return {
            "output": self.output,
            "done": len(self.captures),
            "skipped": self.skipped,
            "captures": [picture.as_json() for picture in self.captures],
        }
