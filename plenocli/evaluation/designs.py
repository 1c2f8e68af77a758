"""A design space as one table: what varied, what came of it, and which designs none beats."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plenocli.base.text import Record


@dataclass(frozen=True)
class Parameter:
    """A column of what varied.

    key: of the camera or of a stage's option.
    unit: of its numbers, "" for none.
    choices: values that are no numbers, by the place that stands in the column; None for numbers.
    """

    key: str
    unit: str = ""
    choices: Sequence[Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """As artefacts hold it."""
        told: dict[str, Any] = {"key": self.key, "unit": self.unit}
        return told if self.choices is None else told | {"choices": list(self.choices)}


@dataclass(frozen=True)
class Metric(Record):
    """A column of figures: its name and what it means."""

    name: str
    meaning: str


@dataclass(frozen=True, kw_only=True)
class DesignTable:
    """Points of a sweep with their figures.

    parameters: (parameter,) columns of values.
    metrics: (metric,) columns of figures.
    objectives: metric or key -> "max" or "min".
    values: (point, parameter), NaN where there is nothing.
    figures: (point, metric), NaN where there is nothing.
    status: (point,) exit code, 0 where all went well.
    ahead: (point,) bool, those that no other beats.
    keys: (point,) text, SHA-256 of all that a point's figures depend on.
    chain: "spatial" or "spectral".
    reasons: point -> why a stage refused it.
    notes: point -> what the stages said.
    description: the sweep file.
    """

    parameters: Sequence[Parameter]
    metrics: Sequence[Metric]
    objectives: Mapping[str, str]
    values: np.ndarray
    figures: np.ndarray
    status: np.ndarray
    ahead: np.ndarray
    keys: np.ndarray
    chain: str = ""
    reasons: Mapping[str, str] = field(default_factory=dict)
    notes: Mapping[str, list[str]] = field(default_factory=dict)
    description: Mapping[str, Any] = field(default_factory=dict)

    def column(self, name: str) -> np.ndarray | None:
        """(point,) values of a metric, or of a parameter by its key; None where there is none."""
        names = [metric.name for metric in self.metrics]
        if name in names:
            return self.figures[:, names.index(name)]
        keys = [parameter.key for parameter in self.parameters]
        return self.values[:, keys.index(name)] if name in keys else None
