"""A plan in words and as a table: which models were considered, which serve and why not, and
what each would cost.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from plenocli.forward.accuracy.dial import seconds_here
from plenocli.forward.propagation.costs import law
from plenocli.forward.propagation.diagnosis import seconds as diagnosis_seconds

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import Candidate, PifPlan

ENDS = 5
"""Planes told at either end of a long list."""
LONG = 20.0
"""Seconds at nominal speed from which on a plan is told before the work starts."""


@dataclass(frozen=True, kw_only=True)
class CommandSeconds:
    """What a command takes on one core of this machine, s.

    plan: of A;
    diagnosis, writing: to find its singular values, and to write the file;
    start: of the command, once for all its matrices.
    """

    plan: PifPlan
    diagnosis: float
    writing: float
    start: float

    @property
    def matrix(self) -> float:
        """To compute A. The machine's speed is measured when it is first asked for."""
        return seconds_here(self.plan.chosen)

    @property
    def beside(self) -> float:
        """All but the matrix."""
        return self.diagnosis + self.writing + self.start

    @property
    def together(self) -> float:
        """All of it."""
        return self.matrix + self.beside

    def line(self) -> str:
        """One line for people."""
        return (
            f"time: about {duration(self.together)} on one core: {duration(self.matrix)} the "
            f"matrix, {duration(self.diagnosis)} rank and condition, "
            f"{duration(self.writing + self.start)} to start and to write"
        )


def command_seconds(camera: Camera, plan: PifPlan) -> CommandSeconds:
    """What simulate-pif takes for one matrix."""
    each = law("whole command").seconds
    return CommandSeconds(
        plan=plan,
        diagnosis=diagnosis_seconds(camera, plan),
        writing=each["written"] * plan.bytes,
        start=each["start"],
    )


def explain(plan: PifPlan, memory: int | None = None, took: CommandSeconds | None = None) -> str:
    """A plan as several lines of text: the models considered, the error by source, what was left
    out, warnings.

    memory: bytes that the chosen one takes as it is written, None where that is not known;
    took: what the whole command takes, None where that is not known.
    """
    rows, columns = plan.superpixels
    head = [
        f"asked: accuracy {plan.accuracy:.2g} ({plan.asked_by})",
        (
            f"matrix: {plan.shape[0]} band(s) x {plan.shape[1]} superpixels ({rows}x{columns}) x "
            f"{plan.shape[2]} pixels x {plan.shape[3]} points, {_size(plan.bytes)} as "
            f"{plan.dtype}; {'double' if plan.double else 'single'} precision, coherent ring "
            f"{plan.coherent_ring}"
        ),
        "",
        *_table(plan.candidates),
        "",
        *(
            []
            if memory is None
            else [
                f"memory: about {_size(memory)}"
                + (", written in pieces" if memory < plan.bytes else "")
            ]
        ),
        *([] if took is None else [took.line()]),
        "error by source: "
        + ", ".join(f"{name} {value:.1g}" for name, value in plan.split.items())
        + f"; together {plan.estimated:.1g}",
    ]
    nodes = [
        (
            f"{b.wavelength * 1e9:.1f} nm: {b.lenslet_nodes} nodes across a lenslet, "
            f"{b.pixel_nodes} across a pixel, {b.psf_nodes} across the spread function, "
            f"about {b.terms} terms"
        )
        for b in plan.bands
    ]
    if plan.band_nodes:
        nodes.append(f"the band is the sum of {plan.band_nodes} wavelength(s)")
    return "\n".join(
        [
            *head,
            *(f"- {r}" for r in plan.reasons),
            *(f"- left out: {t}" for t in plan.left_out),
            *(f"- {n}" for n in nodes),
            *(f"! {w}" for w in plan.warnings),
        ]
    )


@dataclass(frozen=True, kw_only=True)
class PlaneCost:
    """One plane of a scene's depth.

    distance: m from the main lens;
    superpixels: (rows, columns) kept;
    seconds: of one core of this machine;
    bytes, memory: of the result, and at work.
    """

    distance: float
    superpixels: tuple[int, int]
    seconds: float
    bytes: int
    memory: int


def planes_table(planes: list[PlaneCost]) -> list[str]:
    """Planes as lines of text, of many the first and the last ones, and their sum."""
    lines = [
        f"{p.distance:10.4g} m  {p.superpixels[0]}x{p.superpixels[1]} superpixels  "
        f"{duration(p.seconds)}  {_size(p.bytes)}"
        for p in planes
    ]
    if len(lines) > 2 * ENDS + 1:
        lines[ENDS:-ENDS] = ["       ..."]
    seconds, size = sum(p.seconds for p in planes), sum(p.bytes for p in planes)
    return [*lines, f"in all {duration(seconds)}, {_size(size)}"]


def considered(plan: PifPlan) -> list[dict[str, Any]]:
    """The models that a plan considered, coarse to fine, as JSON has them: name, kind, whether and
    why not chosen; error by source, rings, seconds of one core of this machine, bytes at work, None
    where a model does not serve.
    """
    found: list[dict[str, Any]] = []
    for c in plan.candidates:
        numbers: dict[str, Any] = dict.fromkeys(
            ("error", "split", "coherent_ring", "seconds", "bytes")
        )
        if c.split is not None:
            known = c.error, c.split, c.ring, seconds_here(c), c.bytes
            numbers = dict(zip(numbers, known, strict=True))
        found.append(
            {"rung": c.name, "model": c.model, "chosen": c.why is None, "reason": c.why} | numbers
        )
    return found


def expectation(
    plan: PifPlan, memory: int | None = None, times: int = 1, beside: float = 0.0
) -> str | None:
    """One line about work that takes long, and the model that would take much less.

    memory: bytes, None where they are not known;
    times: how often such a plan is carried out;
    beside: seconds that go with it whatever the model.

    Returns None where the work does not take long.
    """
    chosen = plan.chosen
    if times * chosen.seconds() + beside < LONG:
        return None
    text = (
        f"about {duration(times * seconds_here(chosen) + beside)} on one core"
        + ("" if memory is None else f" and {_size(memory)} of memory")
        + f" ({chosen.name}, error {chosen.error:.1g})"
    )
    quicker = [
        c
        for c in plan.candidates
        if c.model != chosen.model
        and c.split is not None
        and c.error < 0.5
        and c.seconds() < chosen.seconds() / 4
    ]
    if not quicker:
        return text
    other = min(quicker, key=lambda c: (c.error, c.seconds()))
    return (
        f"{text}; --model {other.model} takes {duration(times * seconds_here(other) + beside)} at "
        f"an error of {other.error:.1g}"
    )


def _table(rows: Sequence[Candidate]) -> list[str]:
    cells = [("rung", "error", "time", "memory", "")]
    for c in rows:
        numbers = ("-", "-", "-")
        if c.split is not None:
            numbers = (f"{c.error:.1g}", duration(seconds_here(c)), _size(c.bytes))
        cells.append((c.name, *numbers, "chosen" if c.why is None else c.why))
    widths = [max(len(row[i]) for row in cells) for i in range(4)]
    return [
        "  ".join(
            (row[0].ljust(widths[0]), *(row[i].rjust(widths[i]) for i in (1, 2, 3)), row[4])
        ).rstrip()
        for row in cells
    ]


def duration(seconds: float) -> str:
    """Seconds in a unit that a person would take."""
    units = (("s", 1, 100), ("min", 60, 100), ("h", 3600, 72), ("days", 86400, math.inf))
    unit, size, _ = next(known for known in units if seconds < (known[2] - 0.5) * known[1])
    return f"{seconds / size:.2g} {unit}" if seconds < 10 * size else f"{seconds / size:.0f} {unit}"


def _size(count: float) -> str:
    return f"{count / 2**30:.2f} GiB" if count >= 2**30 else f"{count / 2**20:.0f} MiB"
