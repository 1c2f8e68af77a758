"""What a computation costs: operations in matrix products, seconds of all else, memory.

Each model counts what its computation consists of (Features); costs.toml beside this file has what
one of each costs, as pipelines/benchmarks/fit_costs.py fits it to measurements.
"""

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

FITTED = Path(__file__).with_name("costs.toml")
"""The coefficients that plans are made with."""


@dataclass(frozen=True)
class Cost:
    """What the matrix of one wavelength costs.

    operations: real ones in complex matrix products (8 for a complex multiply-add);
    seconds: of one core for all that does not scale with these;
    bytes: held at once beyond the result.
    """

    operations: float
    seconds: float
    bytes: int


@dataclass(frozen=True)
class Features:
    """What the matrix of one wavelength consists of: number of each thing that has a cost.

    operations: products, each in real operations of an ideal implementation;
    seconds: values, calls and the like;
    bytes: what is held, in bytes or values, at each of several moments, of which the highest
        counts.
    """

    operations: Mapping[str, float]
    seconds: Mapping[str, float]
    bytes: tuple[Mapping[str, float], ...]


@dataclass(frozen=True, kw_only=True)
class Law:
    """What one of each feature of a model costs.

    operations, seconds, bytes: coefficient of each feature (seconds of one core);
    counts: numbers of the laws that expect counts which are not known before the computation;
    fit: how these were found, for people.
    """

    operations: Mapping[str, float] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    bytes: Mapping[str, float] = field(default_factory=dict)
    counts: Mapping[str, float] = field(default_factory=dict)
    fit: Mapping[str, object] = field(default_factory=dict)

    def cost(self, features: Features) -> Cost:
        """The Cost of a computation with such Features."""
        return Cost(
            operations=priced(self.operations, features.operations),
            seconds=priced(self.seconds, features.seconds),
            bytes=int(max(priced(self.bytes, moment) for moment in features.bytes)),
        )


def priced(coefficients: Mapping[str, float], features: Mapping[str, float]) -> float:
    """Sum of all features, each times its coefficient."""
    return sum((coefficients[name] * number for name, number in features.items()), 0.0)


def summed(parts: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Features of several parts together."""
    total: dict[str, float] = {}
    for part in parts:
        for name, number in part.items():
            total[name] = total.get(name, 0.0) + number
    return total


def read(path: Path) -> dict[str, Law]:
    """The Law of every model, and of the spread function, by name from a file as costs.toml."""
    return {name: Law(**parts) for name, parts in tomllib.loads(path.read_text()).items()}


@cache
def _fitted() -> dict[str, Law]:
    return read(FITTED)


def law(model: str) -> Law:
    """The Law of this name that plans are made with."""
    return _fitted()[model]
