"""What is told of a system matrix and of its plan."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.text import Record

if TYPE_CHECKING:
    from plenocli.forward.accuracy.depth_planes import DepthPlanes
    from plenocli.forward.accuracy.explain import PlaneCost
    from plenocli.forward.accuracy.field_nodes import FieldNodes
    from plenocli.forward.propagation.accuracy_record import AccuracyRecord
    from plenocli.forward.propagation.diagnosis import Diagnosis
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.propagation.system_matrix import SystemMatrix


@dataclass(frozen=True, kw_only=True)
class PlanSummary(Record):
    """What --explain tells; no matrix was computed.

    plan: several lines of text;
    memory, bytes: at work, and of the result;
    seconds: of one core of this machine, diagnosis, start and writing included;
    planes: of a scene's depth, where it takes several, as places of the field do: `memory` is that
        of the dearest, `bytes` and `seconds` are those of all, the rest tells of the one that takes
        longest.
    """

    plan: str
    memory: int
    accuracy: AccuracyRecord
    considered: list[dict[str, Any]]
    seconds: float
    bytes: int
    superpixels: tuple[int, int]
    coherent_ring: int
    estimated_accuracy: float
    planes: list[PlaneCost] = field(default_factory=list)

    def line(self) -> str:
        """What people read."""
        return self.plan


@dataclass(frozen=True, kw_only=True)
class PifSummary:
    """What was computed and written.

    pixels, points: of a superpixel and of the object under one lenslet;
    wavelengths: (band,) m;
    kappa, eps: 1/m;
    dtype: that A is stored in;
    nominal_seconds: of one core at nominal rates, as planned.
    """

    output: str
    bands: int
    superpixels: tuple[int, int]
    pixels: int
    points: int
    wavelengths: list[float]
    model: str
    rung: str
    coherent_ring: int
    accuracy: float
    estimated_accuracy: float
    kappa: float
    eps: float
    bytes: int
    dtype: str
    nominal_seconds: float
    quartic_phase_rad: float
    warnings: list[str]
    diagnosis: Diagnosis

    def as_json(self) -> dict[str, Any]:
        """The fields by name, those of the diagnosis that are known among them."""
        found = self.diagnosis
        known = {
            "rank": found.rank,
            "rank_60db": found.rank_60db,
            "condition": found.condition,
            "condition_is_bound": found.condition_is_bound,
            "resolution": found.resolution,
            "symmetry_defect": found.symmetry_defect,
            "energy_min": found.energy_min,
            "energy_max": found.energy_max,
        }
        report = {field.name: getattr(self, field.name) for field in fields(self)}
        del report["diagnosis"]
        return report | {name: value for name, value in known.items() if value is not None}

    def line(self) -> str:
        """One sentence for people."""
        found, (rows, columns) = self.diagnosis, self.superpixels
        text = (
            f"{Path(self.output)}: A of {self.bands} band(s), {rows}x{columns} superpixels, "
            f"{self.pixels} pixels, {self.points} points; column energy "
            f"{_share(min(found.energy_min))} to {_share(max(found.energy_max))}"
        )
        if not (found.rank is None or found.rank_60db is None or found.condition is None):
            text += (
                f"; rank {min(found.rank)} ({min(found.rank_60db)} above 60 dB noise), "
                f"condition {_condition(found, self.dtype)}"
            )
        if found.symmetry_defect is not None:
            text += f"; symmetry defect {min(found.symmetry_defect):.1e}"
        return f"{text}; {self.rung}, estimated error {self.estimated_accuracy:.1g}"


@dataclass(frozen=True, kw_only=True)
class SeveralSummary:
    """What was computed and written for a scene's depth or for a whole array.

    several: its planes, or the places of the field;
    made: the matrix of each.
    """

    output: str
    several: DepthPlanes | FieldNodes
    made: list[PifSummary]

    def as_json(self) -> dict[str, Any]:
        """The fields by name."""
        return {
            "output": self.output,
            **self.several.as_json(),
            "interpolation_error": self.several.error,
            self.several.kind: [one.as_json() for one in self.made],
        }

    def line(self) -> str:
        """One sentence for people."""
        error = max(one.estimated_accuracy for one in self.made)
        return (
            f"{Path(self.output)}: A in {len(self.made)} files beside it; {self.several.line()}; "
            f"estimated error {error:.1g}, that included"
        )


def _share(energy: float) -> str:
    return f"{energy:.3f}" if energy >= 0.001 else f"{energy:.1e}"


def _condition(found: Diagnosis, dtype: str) -> str:
    """The worst condition of all bands, and why it is a bound where it is one."""
    assert found.condition is not None and found.condition_is_bound is not None
    worst = max(range(len(found.condition)), key=found.condition.__getitem__)
    if not found.condition_is_bound[worst]:
        return f"{found.condition[worst]:.1e}"
    return (
        f"at least {found.condition[worst]:.1e} (smaller singular values are the rounding "
        f"of {dtype})"
    )


def summary_of(output: str, matrix: SystemMatrix, found: Diagnosis, plan: PifPlan) -> PifSummary:
    """What is told of a matrix that was written to `output`."""
    bands, _, pixels, points = plan.shape
    return PifSummary(
        output=output,
        bands=bands,
        superpixels=plan.superpixels,
        pixels=pixels,
        points=points,
        wavelengths=matrix.wavelengths.tolist(),
        model=plan.model,
        rung=plan.rung,
        coherent_ring=plan.coherent_ring,
        accuracy=plan.accuracy,
        estimated_accuracy=plan.estimated,
        kappa=matrix.notes.kappa,
        eps=matrix.notes.eps,
        bytes=plan.bytes,
        dtype=plan.dtype,
        nominal_seconds=plan.chosen.seconds(),
        quartic_phase_rad=matrix.notes.quartic_phase_rad,
        warnings=[*plan.warnings, *found.warnings],
        diagnosis=found,
    )
