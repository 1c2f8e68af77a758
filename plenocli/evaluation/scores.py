"""What a score document says: figures of each result, what they mean, and what was compared."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from plenocli.base.text import Record
from plenocli.evaluation.metrics.figures import Figure


@dataclass(frozen=True, kw_only=True)
class PatchScore(Record):
    """What one patch of a chart shows beside its truth, lists by band.

    label: 1 to 24, row by row.
    truth: None where nobody knows it.
    one_of_six: of the paper's six patches.
    """

    label: int
    name: str
    lenslets: int | None = None
    mean: list[float]
    std: list[float]
    truth: list[float] | None = None
    one_of_six: bool


@dataclass(frozen=True, kw_only=True)
class ResultScore:
    """Figures of one result.

    name: its file without folder; label: shorter, and no other's in the document.
    kind: "image", "spectra", "dictionary", "calibration", "lightfield" or "volume".
    method: how it was computed, "" where nobody says.
    wavelengths_nm: of its bands; empty for what has none.
    figures: by the names of the DEFINITIONS.
    patches: None where no label map is known.
    error: why there are no figures, or "".
    """

    name: str
    label: str = ""
    kind: str = ""
    method: str = ""
    wavelengths_nm: tuple[float, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)
    patches: tuple[PatchScore, ...] | None = None
    error: str = ""

    def number(self, name: str) -> float | None:
        """A figure that is one number; None where it is not there or does not apply."""
        value = self.figures.get(name)
        return value if isinstance(value, (int, float)) else None

    def bands(self, name: str) -> list[float | None]:
        """A figure by band; empty where there is none."""
        value = self.figures.get(name)
        return value if isinstance(value, list) else []

    def as_json(self) -> dict[str, Any]:
        """As it stands in a score document."""
        if self.error:
            return {"name": self.name, "error": self.error, "metrics": {}, "label": self.label}
        head: dict[str, Any] = {"name": self.name, "kind": self.kind}
        if self.method:
            head |= {"method": self.method}
        bands: dict[str, Any] = (
            {"wavelengths_nm": list(self.wavelengths_nm)} if self.wavelengths_nm else {}
        )
        metrics: dict[str, Any] = {"metrics": dict(self.figures)}
        body = metrics | bands if self.kind == "calibration" else bands | metrics
        if self.patches is not None:
            body |= {"patches": [patch.as_json() for patch in self.patches]}
        return head | body | {"label": self.label}


@dataclass(frozen=True)
class InputFile:
    """A file that was read: its name without folder, and its SHA-256 as hex."""

    name: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class ScoreDocument:
    """All that one run of score found.

    definitions: what each figure means.
    command: that made it.
    inputs: role -> file.
    """

    results: Sequence[ResultScore]
    definitions: Mapping[str, str] = field(default_factory=dict)
    command: str = ""
    inputs: Mapping[str, InputFile] = field(default_factory=dict)

    @property
    def figures(self) -> Mapping[str, Figure]:
        """Those of the first result that has any."""
        return next((one.figures for one in self.results if not one.error), {})

    def as_json(self) -> dict[str, Any]:
        """The document as it is written."""
        return {
            "metrics": dict(self.figures),
            "results": [one.as_json() for one in self.results],
            "definitions": dict(self.definitions),
            "command": self.command,
            "inputs": {
                role: {"name": file.name, "sha256": file.sha256}
                for role, file in self.inputs.items()
            },
        }
