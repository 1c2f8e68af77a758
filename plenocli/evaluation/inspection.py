"""What a file holds, in words and numbers, for inspect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Statistics:
    """Of the values that are no NaN.

    minimum, maximum, mean: None where there are none.
    nan: number of NaN.
    value: the values themselves where they are no numbers.
    """

    minimum: float | None = None
    maximum: float | None = None
    mean: float | None = None
    nan: int = 0
    value: Any = None

    def as_json(self) -> dict[str, Any]:
        """What applies, by the names of the report."""
        if self.minimum is None:
            return {"nan": self.nan} if self.nan else {"value": self.value}
        told = {"min": self.minimum, "max": self.maximum, "mean": self.mean}
        return told | ({"nan": self.nan} if self.nan else {})

    def text(self) -> str:
        """In words."""
        if self.minimum is None:
            return "all NaN" if self.nan else short(self.value)
        range_ = f"min {self.minimum:.6g} max {self.maximum:.6g} mean {self.mean:.6g}"
        return range_ + (f" NaN {self.nan}" if self.nan else "")


def statistics(values: np.ndarray) -> Statistics:
    """Smallest, largest and mean value, and the number of NaN; the values where they are text."""
    if values.dtype.kind not in "iufb" or values.size == 0:
        return Statistics(value=as_plain(values))
    known = values[~np.isnan(values)] if values.dtype.kind == "f" else values
    if known.size == 0:
        return Statistics(nan=int(values.size))
    return Statistics(
        minimum=float(known.min()),
        maximum=float(known.max()),
        mean=float(known.mean(dtype=np.float64)),
        nan=int(values.size - known.size),
    )


def as_plain(value: Any) -> Any:
    """A value as JSON may hold it: lists for arrays, text for bytes."""
    if isinstance(value, dict):
        return {str(k): as_plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [as_plain(v) for v in value]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else value


def short(value: Any) -> str:
    """A value in at most a hundred letters."""
    text = f"{value:.8g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 100 else text[:97] + "..."


@dataclass(frozen=True, kw_only=True)
class DatasetReport:
    """One dataset of an artefact."""

    shape: Sequence[int]
    dtype: str
    unit: str
    meaning: str
    statistics: Statistics

    def as_json(self) -> dict[str, Any]:
        """By name, with the statistics among them."""
        return {
            "shape": list(self.shape),
            "dtype": self.dtype,
            "unit": self.unit,
            "meaning": self.meaning,
        } | self.statistics.as_json()


@dataclass(frozen=True)
class AttributeReport:
    """One attribute of an artefact: its value, JSON-able, and unit."""

    value: Any
    unit: str


@dataclass(frozen=True, kw_only=True)
class ArtefactReport:
    """An artefact.

    what: the kind in words.
    inputs, accuracy: as its provenance has them, JSON-able.
    attributes: group or dataset -> name -> attribute.
    """

    kind: str
    schema_version: int
    what: str
    command: str
    seed: int | None
    inputs: Mapping[str, Any]
    accuracy: Mapping[str, Any]
    config: str
    datasets: Mapping[str, DatasetReport]
    attributes: Mapping[str, Mapping[str, AttributeReport]]
    type: str = "artefact"
    verified: bool = True

    def as_json(self) -> dict[str, Any]:
        """The report by name."""
        return {
            "type": self.type,
            "kind": self.kind,
            "schema_version": self.schema_version,
            "what": self.what,
            "verified": self.verified,
            "command": self.command,
            "seed": self.seed,
            "inputs": self.inputs,
            "accuracy": self.accuracy,
            "config": self.config,
            "datasets": {name: data.as_json() for name, data in self.datasets.items()},
            "attributes": {
                where: {name: asdict(attribute) for name, attribute in named.items()}
                for where, named in self.attributes.items()
            },
        }

    def headline(self) -> str:
        """What it is."""
        return f"{self.kind} (version {self.schema_version}): {self.what.rstrip('.')}"

    def lines(self) -> list[str]:
        """What it holds."""
        lines = [
            f"  command   {self.command or '-'}",
            f"  seed      {'-' if self.seed is None else self.seed}",
        ]
        lines += [
            f"  input     {role}: {about.get('name')} sha256 {about.get('sha256')[:16]}..."
            for role, about in self.inputs.items()
        ]
        lines += [f"  accuracy  {name}: {short(value)}" for name, value in self.accuracy.items()]
        lines += [
            f"  /{where} @{name} = {short(attribute.value)} {attribute.unit}".rstrip()
            for where, named in self.attributes.items()
            for name, attribute in named.items()
        ]
        for name, data in self.datasets.items():
            shape = " x ".join(map(str, data.shape)) or "scalar"
            lines.append(
                f"  /{name}  {shape} {data.dtype} [{data.unit}]  "
                f"{data.statistics.text()}  {data.meaning}"
            )
        return lines


@dataclass(frozen=True, kw_only=True)
class BandsReport:
    """What a spectral EXR says: quantity, band centres (m), whether deviations are known."""

    quantity: str
    wavelengths_m: Sequence[float]
    has_sigma: bool


@dataclass(frozen=True, kw_only=True)
class ChannelsReport:
    """An EXR, or a photograph of a few bits.

    bits, dtype: of a photograph, else None.
    attributes: of an EXR, else None.
    bands: of a spectral EXR, else None.
    """

    type: str
    rows: int
    columns: int
    verified: bool
    channels: Mapping[str, Statistics]
    bits: int | None = None
    dtype: str | None = None
    attributes: Mapping[str, Any] | None = None
    bands: BandsReport | None = None

    def as_json(self) -> dict[str, Any]:
        """The report by name."""
        told = {
            "type": self.type,
            "rows": self.rows,
            "columns": self.columns,
            "verified": self.verified,
            "channels": {name: channel.as_json() for name, channel in self.channels.items()},
        }
        if self.attributes is None:
            return told | {"bits": self.bits, "dtype": self.dtype}
        bands = {} if self.bands is None else asdict(self.bands)
        return told | {"attributes": self.attributes} | bands

    def headline(self) -> str:
        """What it is."""
        return f"{self.type}, {self.rows} x {self.columns} pixels (rows x columns)"

    def lines(self) -> list[str]:
        """What it holds."""
        lines = [f"  bits      {self.bits}"] if self.attributes is None else []
        if self.bands is not None:
            nm = [w * 1e9 for w in self.bands.wavelengths_m]
            lines.append(
                f"  {self.bands.quantity}, {len(nm)} bands, {nm[0]:.6g} to {nm[-1]:.6g} "
                f"nm{', with sigma' if self.bands.has_sigma else ''}"
            )
        lines += [f"  {name:<18} {channel.text()}" for name, channel in self.channels.items()]
        return lines + [f"  @{name} = {short(v)}" for name, v in (self.attributes or {}).items()]


@dataclass(frozen=True)
class PositionReport:
    """Pixels of one place in the 2x2 cell: statistics, and the level of no light, DN."""

    statistics: Statistics
    black: float

    def as_json(self) -> dict[str, Any]:
        """The report by name."""
        return self.statistics.as_json() | {"black": self.black}


@dataclass(frozen=True, kw_only=True)
class RawReport:
    """A camera RAW or DNG.

    black: (2, 2) DN by position; white: DN.
    zeros, saturated: shares of the pixels.
    positions: by letter and place in the 2x2 cell.
    meta: whatever else it says, JSON-able.
    """

    type: str
    rows: int
    columns: int
    cfa: str
    black: list[list[float]]
    white: float
    exposure_s: float | None
    iso: float | None
    f_number: float | None
    focal_length_m: float | None
    camera: str | None
    dtype: str
    verified: bool
    zeros: float
    saturated: float
    positions: Mapping[str, PositionReport]
    meta: Mapping[str, Any] = field(default_factory=dict)

    def as_json(self) -> dict[str, Any]:
        """The report by name."""
        return {
            "type": self.type,
            "rows": self.rows,
            "columns": self.columns,
            "cfa": self.cfa,
            "black": self.black,
            "white": self.white,
            "exposure_s": self.exposure_s,
            "iso": self.iso,
            "f_number": self.f_number,
            "focal_length_m": self.focal_length_m,
            "camera": self.camera,
            "dtype": self.dtype,
            "verified": self.verified,
            "zeros": self.zeros,
            "saturated": self.saturated,
            "positions": {name: position.as_json() for name, position in self.positions.items()},
            "meta": self.meta,
        }

    def headline(self) -> str:
        """What it is."""
        return f"{self.type}, {self.rows} x {self.columns} pixels (rows x columns)"

    def lines(self) -> list[str]:
        """What it holds."""
        (a, b), (c, d) = self.black
        lines = [
            f"  camera         {self.camera or 'unknown'}",
            f"  cfa            {self.cfa}",
            f"  black          {a:g} {b:g} / {c:g} {d:g} DN (rows of the 2x2 cell)",
            f"  white          {self.white:g} DN",
        ]
        lines += [
            f"  {name:<14} {'unknown' if value is None else f'{value:.6g} {unit}'.rstrip()}"
            for name, value, unit in (
                ("exposure_s", self.exposure_s, "s"),
                ("f_number", self.f_number, ""),
                ("focal_length_m", self.focal_length_m, "m"),
                ("iso", self.iso, ""),
            )
        ]
        lines.append(f"  zeros          {self.zeros:.3%}, saturated {self.saturated:.3%}")
        return lines + [
            f"  {name:<14} {position.statistics.text()}"
            for name, position in self.positions.items()
        ]


@dataclass(frozen=True, kw_only=True)
class FileReport:
    """What a file holds: its name without folder, its size, and what its kind has."""

    file: str
    bytes: int
    content: ArtefactReport | ChannelsReport | RawReport

    def as_json(self) -> dict[str, Any]:
        """The report of --json."""
        return {"file": self.file, "bytes": self.bytes} | self.content.as_json()

    def text(self) -> str:
        """The report as lines for a terminal."""
        seen = (
            "digest verified"
            if self.content.verified
            else "no digest in the file: damage to its values would go unseen"
        )
        head = f"{self.file}: {self.content.headline()}, {self.bytes} bytes"
        return "\n".join([head, f"  {seen}", *self.content.lines()])
