"""What comes of a sweep: one table with a row a point, as artefact and CSV, and the front of those
that none beats.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import ConfigError, InputError, NumericsError
from plenocli.base.progress import note
from plenocli.base.text import counted, json_value
from plenocli.evaluation.designs import DesignTable, Metric, Parameter
from plenocli.files.results.measured_seconds import measured_path
from plenocli.stages.sweep.store import SHARED
from plenocli.stages.sweep.task import DESIGN, PointResult

if TYPE_CHECKING:
    from plenocli.stages.sweep.space import DesignPoint, Space
    from plenocli.stages.sweep.store import Store

FRONTS = {
    "spatial": {"psnr_db": "max", "sensor_pixels": "min"},
    "spectral": {"six_patch_rmse": "min", "lenslet_field_m": "min"},
    "joint": {"psnr_db": "max", "six_patch_rmse": "min"},
    "expected": {"class_accuracy_expected": "max", "rmse_expected": "min"},
    "depth": {"depth_slope_error": "min", "sensor_pixels": "min"},
    "volume": {"volume_snr_db": "max", "object_points": "max"},
}
"""What counts as better where the file does not say."""
MOST_SHOWN, WIDTH = 20, 100
"""Rows of the front that people are shown, and characters of a row."""


@dataclass(frozen=True, kw_only=True)
class SweepSummary:
    """What a sweep did.

    output: the table; plot: picture of its front, None where there is none.
    points: in the table, of which `computed` are new, `refused` were refused by a stage and
        `with_remarks` have remarks; the first reason and the first remark.
    objectives: metric or key -> "max" or "min".
    front: number, objectives and values of the points that none beats, best first.
    cpu_seconds: of all points, when they were computed.
    """

    output: str
    points: int
    computed: int
    refused: int
    with_remarks: int
    first_reason: str
    first_remark: str
    objectives: Mapping[str, str]
    front: list[dict[str, Any]]
    cpu_seconds: float
    plot: str | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary of --json."""
        return {
            "output": self.output,
            "points": self.points,
            "computed": self.computed,
            "refused": self.refused,
            "with_remarks": self.with_remarks,
            "first_reason": self.first_reason,
            "first_remark": self.first_remark,
            "objectives": dict(self.objectives),
            "front": self.front,
            "cpu_seconds": self.cpu_seconds,
        } | ({} if self.plot is None else {"plot": self.plot})


def _definitions() -> dict[str, str]:
    """What the figures of a point mean."""
    from plenocli.evaluation.chosen import every_definition

    return every_definition() | DESIGN


def objectives_of(space: Space, points: Sequence[DesignPoint]) -> dict[str, str]:
    """Metric or numeric key -> "max" or "min".

    Raises ConfigError for a name that no point can have.
    """
    import difflib

    from plenocli.files.config.sweep_file import number

    wanted = space.sweep.front or FRONTS[space.chain]
    numeric = [
        key
        for key in space.sweep.varied
        if points and all(number(point.values.get(key)) is not None for point in points)
    ]
    known = [*_definitions(), *numeric]
    for name in wanted:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            raise ConfigError(
                f"front.{name}: no metric of that name; "
                + (f"did you mean {near[0]}?" if near else f"known: {', '.join(known)}"),
                space.path,
            )
    return dict(wanted)


def result_of(point: DesignPoint) -> PointResult:
    """What came of a point that was evaluated."""
    if point.result is None:
        raise ValueError(f"point {point.number} has no result")
    return point.result


def _parameter(key: str, given: Sequence[Any]) -> tuple[Parameter, list[float]]:
    """A column of what varied: numbers, or places in a list of choices; NaN where there is
    nothing.
    """
    from plenocli.files.config.sweep_file import number, unit

    numbers = [None if value is None else number(value) for value in given]
    if all(value is None or n is not None for value, n in zip(given, numbers)):
        of = next((unit(v) for v in given if v is not None), "")
        return Parameter(key, of), [np.nan if n is None else n for n in numbers]
    choices = list({json.dumps(v): v for v in given if v is not None}.values())
    places = [
        np.nan
        if v is None
        else next(i for i, c in enumerate(choices) if c == v and type(c) is type(v))
        for v in given
    ]
    return Parameter(key, "", choices), places


def design_table(
    space: Space, points: Sequence[DesignPoint], objectives: Mapping[str, str]
) -> DesignTable:
    """The table of points that were evaluated."""
    from plenocli.evaluation.metrics.pareto import front

    results = [result_of(point) for point in points]
    columns = [
        _parameter(key, [point.values.get(key) for point in points]) for key in space.sweep.varied
    ]
    names = dict.fromkeys(name for result in results for name in result.metrics)
    order = [
        *(name for name in names if name not in DESIGN),
        *(name for name in DESIGN if name in names),
    ]
    known = _definitions()
    figures = [
        [np.nan if (v := result.metrics.get(name)) is None else v for name in order]
        for result in results
    ]
    status = np.array([result.status for result in results])
    table = DesignTable(
        parameters=[parameter for parameter, _ in columns],
        metrics=[Metric(name, known.get(name, "")) for name in order],
        objectives=objectives,
        values=np.array([v for _, v in columns], float).reshape(len(columns), len(points)).T,
        figures=np.array(figures, float).reshape(len(points), len(order)),
        status=status,
        ahead=np.zeros(len(points), bool),
        keys=np.array([point.key for point in points], dtype="S64"),
        chain=space.chain,
        reasons={
            str(point.number): result.reason
            for point, result in zip(points, results)
            if result.status
        },
        notes={
            str(point.number): list(result.notes)
            for point, result in zip(points, results)
            if result.notes
        },
        description=json_value(space.sweep.model_dump(by_alias=True, exclude_none=True)),
    )
    signs = [1 if aim == "max" else -1 for aim in objectives.values()]
    merit = np.where(status[:, None] == 0, _merit(table).T, np.nan)
    return replace(table, ahead=front(merit, signs))


def _merit(table: DesignTable) -> np.ndarray:
    """(objective, point) figures that the front is drawn from, NaN where there is nothing."""
    columns = [table.column(name) for name in table.objectives]
    return np.array(
        [np.full(len(table.status), np.nan) if column is None else column for column in columns]
    )


def finish(
    space: Space,
    points: Sequence[DesignPoint],
    objectives: Mapping[str, str],
    store: Store,
    computed: int,
    command: str,
) -> SweepSummary:
    """Write table, CSV and picture.

    points: evaluated.
    objectives: metric or key -> "max" or "min".
    computed: number of points that are new.

    Raises the error of the first point where no point worked.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.artefacts.writing import write_artefact
    from plenocli.files.atomic import publish, together
    from plenocli.files.results.design_tables import design_artefact

    table = design_table(space, points, objectives)
    inputs = {"sweep": space.path, "camera": space.camera_path, "file": sorted(space.files) or None}
    provenance = Provenance(
        command=command, inputs=describe_inputs(inputs), seed=space.seed, config=_base_text(space)
    )
    with together():
        publish(
            store.output.with_suffix(".csv"), _csv(points, table).encode(), overwrite=store.again
        )
        publish(measured_path(store.output), _measured(points).encode(), overwrite=True)
        if store.plot is not None and not table.ahead.any():
            note("no point has all figures of the front: there is nothing to draw")
        elif store.plot is not None:
            from plenocli.report.front import front_picture

            publish(store.plot, front_picture(table), overwrite=store.again)
        write_artefact(store.output, design_artefact(table, provenance), overwrite=store.overwrite)
    for shared in SHARED:
        shutil.rmtree(store.folder / shared, ignore_errors=True)
    results = [result_of(point) for point in points]
    if not (table.status == 0).any():
        worst = max(result.status for result in results)
        raise _CLASSES[worst](
            f"none of {len(points)} points could be computed; the first: {results[0].reason}",
            space.path,
            f"{store.output} holds all reasons",
        )
    return SweepSummary(
        output=str(store.output),
        points=len(points),
        computed=computed,
        refused=len(table.reasons),
        with_remarks=len(table.notes),
        first_reason=next(iter(table.reasons.values()), ""),
        first_remark=next(iter(table.notes.values()), [""])[0],
        objectives=objectives,
        front=_front(points, table),
        cpu_seconds=sum(result.seconds for result in results),
        plot=str(store.plot) if store.plot is not None and table.ahead.any() else None,
    )


def _front(points: Sequence[DesignPoint], table: DesignTable) -> list[dict[str, Any]]:
    """Number, objectives and values of the points that none beats, best first."""
    merit, aims = _merit(table), table.objectives
    keys = [parameter.key for parameter in table.parameters]
    best = sorted(
        np.flatnonzero(table.ahead),
        key=lambda i: tuple(
            -m[i] if aim == "max" else m[i] for m, aim in zip(merit, aims.values())
        ),
    )
    return [
        {
            "point": points[i].number,
            **{name: float(m[i]) for name, m in zip(aims, merit) if name not in keys},
            **points[i].values,
        }
        for i in map(int, best)
    ]


_CLASSES = {error.exit_code: error for error in (ConfigError, InputError, NumericsError)}


def _base_text(space: Space) -> str:
    """The camera that all points start from, as resolved TOML; as it stands where it is no camera
    before something is put in.
    """
    from plenocli.files.config.camera_file import parse_camera, to_toml

    text = space.camera_path.read_text(encoding="utf-8")
    try:
        return to_toml(parse_camera(text, space.camera_path))
    except ConfigError:
        return text


def _csv(points: Sequence[DesignPoint], table: DesignTable) -> str:
    """The table as text: values as they stand in the sweep file, figures to the last digit,
    nothing for what is not there.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    keys = [parameter.key for parameter in table.parameters]
    names = [metric.name for metric in table.metrics]
    writer.writerow(["point", *keys, "status", "front", *names, "reason"])
    for i, point in enumerate(points):
        shown = [
            v
            if isinstance(v, (str, int, float)) and not isinstance(v, bool)
            else ""
            if v is None
            else json.dumps(v)
            for v in (point.values.get(key) for key in keys)
        ]
        result = result_of(point)
        writer.writerow(
            [
                point.number,
                *shown,
                result.status,
                int(table.ahead[i]),
                *("" if np.isnan(v) else repr(float(v)) for v in table.figures[i]),
                " ".join(result.reason.split()),
            ]
        )
    return out.getvalue()


def _measured(points: Sequence[DesignPoint]) -> str:
    """Processor seconds of each stage of each point, as they were measured when it was computed."""
    stages = list(dict.fromkeys(s for point in points for s in result_of(point).stages))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["point", *(f"{stage} cpu_s" for stage in stages)])
    for point in points:
        spent = result_of(point).stages
        writer.writerow([point.number, *(f"{spent[s]:.4g}" if s in spent else "" for s in stages)])
    return out.getvalue()


def lines(report: SweepSummary) -> str:
    """What a sweep did, for people: a sentence, and the front as a table."""
    aims = ", ".join(f"{name} {aim}" for name, aim in report.objectives.items())
    text = [
        (
            f"{report.output}: {report.points} points, {report.computed} computed now, "
            f"{report.refused} refused; {len(report.front)} on the front of {aims}"
        )
    ]
    for count, what, said in (
        (report.refused, "refused", report.first_reason),
        (report.with_remarks, "with remarks of the stages", report.first_remark),
    ):
        if count:
            text.append(f"  {count} {what}, the first: {' '.join(said.split())[:200]}")
    if report.front:
        text += _front_lines(report)
    return "\n".join(text)


def _front_lines(report: SweepSummary) -> list[str]:
    """The front as a table: number and objectives, and of the other columns those that fit."""
    first = ["point", *report.objectives]
    heads = [*first, *(name for name in report.front[0] if name not in first)]
    columns, width = [], 0
    for head in heads:
        values = (entry.get(head, "") for entry in report.front[:MOST_SHOWN])
        cells = [head, *(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values)]
        wide = 2 + max(map(len, cells))
        if head in first or width + wide <= WIDTH:
            columns.append([cell.rjust(wide) for cell in cells])
            width += wide
    text = ["".join(row) for row in zip(*columns)]
    hidden = len(heads) - len(columns), len(report.front) - MOST_SHOWN
    more = [counted(n, what) for n, what in zip(hidden, ("column", "row")) if n > 0]
    if more:
        text.append(f"  {' and '.join(more)} more in {Path(report.output).with_suffix('.csv')}")
    return text
