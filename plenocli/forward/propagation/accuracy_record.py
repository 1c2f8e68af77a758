"""What a result says of the accuracy that it was computed with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any


@dataclass(frozen=True, kw_only=True)
class AccuracyRecord:
    """How accurate a system matrix is, and why; None where it is not known.

    asked: relative L2 error of the worst column that was asked for, by `asked_by`;
    estimated: that error as expected, of which by_source names the parts;
    model: the kind of propagation, "ray", "fresnel" or "exact";
    rung: the name of the model, such as "fresnel, low rank";
    model_error: of the model itself against the finest one, whether asked for by name or not;
    field_error: of one matrix for all lenslets at the array's corner, 0 where it is for one only;
    reasons, left_out: a sentence each.
    """

    asked: float | None = None
    asked_by: str | None = None
    estimated: float | None = None
    by_source: Mapping[str, float] | None = None
    model: str | None = None
    model_error: float | None = None
    field_error: float | None = None
    rung: str | None = None
    reasons: tuple[str, ...] | None = None
    left_out: tuple[str, ...] | None = None

    def as_json(self) -> dict[str, Any]:
        """The record as artefacts hold it; what is not known is left out."""
        record = {
            "asked": self.asked,
            "asked_by": self.asked_by,
            "estimated": self.estimated,
            "by_source": None if self.by_source is None else dict(self.by_source),
            "model": self.model,
            "model_error": self.model_error,
            "field_error": self.field_error,
            "rung": self.rung,
            "reasons": None if self.reasons is None else list(self.reasons),
            "left_out": None if self.left_out is None else list(self.left_out),
        }
        return {name: value for name, value in record.items() if value is not None}

    @classmethod
    def from_json(cls, record: Mapping[str, Any] | None) -> AccuracyRecord | None:
        """The record that as_json wrote; None for an empty one. Names that it does not know are
        left out.
        """
        if not record:
            return None
        known: dict[str, Any] = {field.name: record.get(field.name) for field in fields(cls)}
        for name in ("reasons", "left_out"):
            known[name] = None if known[name] is None else tuple(known[name])
        return cls(**known)
