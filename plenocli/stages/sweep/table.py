"""What comes of a sweep: one table with a row a point, as artefact and CSV, and the front of
those that none beats.
"""

import csv
import io
import json
import shutil

import numpy as np

from plenocli.base.errors import ConfigError, InputError, NumericsError
from plenocli.base.progress import note
from plenocli.base.text import plain
from plenocli.stages.sweep.point import DESIGN

FRONTS = {
    "spatial": {"psnr_db": "max", "sensor_pixels": "min"},
    "spectral": {"six_patch_rmse": "min", "lenslet_field_m": "min"},
}
"""What counts as better where the file does not say."""


def _definitions():
    from plenocli.evaluation.metrics import classify, quality, snr, spectral

    return {
        name: text
        for module in (quality, spectral, snr, classify)
        for name, text in module.DEFINITIONS.items()
    } | DESIGN


def objectives_of(space, rows):
    """Metric or numeric key -> "max" or "min"; ConfigError for a name that no point can have."""
    import difflib

    from plenocli.files.config.sweep_file import number

    wanted = space.sweep.front or FRONTS[space.chain]
    numeric = [
        key
        for key in space.sweep.varied
        if rows and all(number(row.point.get(key)) is not None for row in rows)
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


def _columns(space, rows):
    """(parameters, metrics, values (point, parameter), figures (point, metric)): dicts that
    describe the columns, NaN where there is nothing.
    """
    from plenocli.files.config.sweep_file import number, unit

    parameters, values = [], []
    for key in space.sweep.varied:
        given = [row.point.get(key) for row in rows]
        numbers = [None if value is None else number(value) for value in given]
        if all(value is None or n is not None for value, n in zip(given, numbers)):
            parameters.append(
                {"key": key, "unit": next((unit(v) for v in given if v is not None), "")}
            )
            values.append([np.nan if n is None else n for n in numbers])
        else:
            choices = list({json.dumps(v): v for v in given if v is not None}.values())
            parameters.append({"key": key, "unit": "", "choices": choices})
            values.append(
                [
                    np.nan
                    if v is None
                    else next(i for i, c in enumerate(choices) if c == v and type(c) is type(v))
                    for v in given
                ]
            )
    names = dict.fromkeys(name for row in rows for name in row.result["metrics"])
    order = [
        *(name for name in names if name not in DESIGN),
        *(name for name in DESIGN if name in names),
    ]
    known = _definitions()
    figures = [
        [np.nan if (v := row.result["metrics"].get(name)) is None else v for name in order]
        for row in rows
    ]
    return (
        parameters,
        [{"name": name, "meaning": known.get(name, "")} for name in order],
        np.array(values, float).reshape(len(values), len(rows)).T,
        np.array(figures, float).reshape(len(rows), len(order)),
    )


def finish(space, rows, objectives, store, computed, command):
    """Write table, CSV and picture; returns the summary.

    The error of the first point is raised where no point worked.
    """
    from plenocli.evaluation.metrics.pareto import front
    from plenocli.files.artefacts.container import Artefact, write_artefact
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import publish

    parameters, metrics, values, figures = _columns(space, rows)
    names = [m["name"] for m in metrics]
    keys = [p["key"] for p in parameters]
    merit = [
        figures[:, names.index(n)]
        if n in names
        else values[:, keys.index(n)]
        if n in keys
        else np.full(len(rows), np.nan)
        for n in objectives
    ]
    status = np.array([row.result["status"] for row in rows])
    ahead = front(
        np.where(status[:, None] == 0, np.array(merit).T, np.nan),
        [1 if way == "max" else -1 for way in objectives.values()],
    )
    reasons = {str(row.number): row.result["reason"] for row in rows if row.result["status"]}
    remarks = {str(row.number): row.result["notes"] for row in rows if row.result["notes"]}
    attrs = {
        "chain": space.chain,
        "parameters": parameters,
        "metrics": metrics,
        "objectives": list(objectives.items()),
        "reasons": reasons,
        "notes": remarks,
        "description": plain(space.sweep.model_dump(by_alias=True, exclude_none=True)),
    }
    data = {
        "sweep/parameter": values,
        "sweep/metric": figures if names else None,
        "sweep/status": status.astype(np.int32),
        "sweep/front": ahead,
        "sweep/key": np.array([row.key for row in rows], dtype="S64"),
    }
    inputs = {"sweep": space.path, "camera": space.camera_path, "file": sorted(space.files) or None}
    provenance = Provenance(command, describe_inputs(inputs), space.seed, _base_text(space))
    publish(
        store.output.with_suffix(".csv"),
        _csv(rows, keys, names, figures, ahead).encode(),
        overwrite=store.again,
    )
    artefact = Artefact("sweep", data, {"sweep": attrs}, provenance)
    if store.plot is not None and not ahead.any():
        note("no point has all figures of the front: there is nothing to draw")
    elif store.plot is not None:
        from plenocli.files.results.design_tables import designs_of
        from plenocli.report.front import front_picture

        publish(store.plot, front_picture(designs_of(artefact)), overwrite=store.again)
    write_artefact(store.output, artefact, overwrite=store.overwrite)
    shutil.rmtree(store.folder / "matrices", ignore_errors=True)
    if not (status == 0).any():
        worst = max((row for row in rows), key=lambda row: row.result["status"])
        raise _CLASSES[worst.result["status"]](
            f"none of {len(rows)} points could be computed; the first: {rows[0].result['reason']}",
            space.path,
            f"{store.output} holds all reasons",
        )
    best = sorted(
        np.flatnonzero(ahead),
        key=lambda i: tuple(
            -m[i] if way == "max" else m[i] for m, way in zip(merit, objectives.values())
        ),
    )
    shown = [
        {
            "point": rows[i].number,
            **{name: float(m[i]) for name, m in zip(objectives, merit) if name not in keys},
            **rows[i].point,
        }
        for i in best
    ]
    return {
        "output": str(store.output),
        "points": len(rows),
        "computed": computed,
        "refused": len(reasons),
        "with_remarks": len(remarks),
        "first_reason": next(iter(reasons.values()), ""),
        "first_remark": next(iter(remarks.values()), [""])[0],
        "objectives": objectives,
        "front": shown,
        "cpu_seconds": sum(row.result["seconds"] for row in rows),
    } | ({"plot": str(store.plot)} if store.plot is not None and ahead.any() else {})


_CLASSES = {error.exit_code: error for error in (ConfigError, InputError, NumericsError)}


def _base_text(space):
    """The camera that all points start from, as resolved TOML; as it stands where it is no
    camera before something is put in.
    """
    from plenocli.files.config.camera_file import parse_camera, to_toml

    text = space.camera_path.read_text(encoding="utf-8")
    try:
        return to_toml(parse_camera(text, space.camera_path))
    except ConfigError:
        return text


def _csv(rows, keys, names, figures, ahead):
    """The table as text: values as they stand in the sweep file, figures to the last digit,
    nothing for what is not there.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["point", *keys, "status", "front", *names, "reason"])
    for i, row in enumerate(rows):
        shown = [
            v
            if isinstance(v, (str, int, float)) and not isinstance(v, bool)
            else ""
            if v is None
            else json.dumps(v)
            for v in (row.point.get(key) for key in keys)
        ]
        writer.writerow(
            [
                row.number,
                *shown,
                row.result["status"],
                int(ahead[i]),
                *("" if np.isnan(v) else repr(float(v)) for v in figures[i]),
                " ".join(row.result["reason"].split()),
            ]
        )
    return out.getvalue()


def lines(report):
    """What run_sweep did, for people: a sentence, and the front as a table, at most
    twenty rows of it.
    """
    aims = ", ".join(f"{name} {way}" for name, way in report["objectives"].items())
    text = [
        (
            f"{report['output']}: {report['points']} points, {report['computed']} computed now, "
            f"{report['refused']} refused; {len(report['front'])} on the front of {aims}"
        )
    ]
    for count, what, said in (
        (report["refused"], "refused", report["first_reason"]),
        (report["with_remarks"], "with remarks of the stages", report["first_remark"]),
    ):
        if count:
            text.append(f"  {count} {what}, the first: {' '.join(said.split())[:200]}")
    if report["front"]:
        heads = list(report["front"][0])
        cells = [heads] + [
            [
                f"{v:.6g}" if isinstance(v, float) else str(v)
                for v in (entry.get(h, "") for h in heads)
            ]
            for entry in report["front"][:20]
        ]
        widths = [max(len(row[i]) for row in cells) for i in range(len(heads))]
        text += ["  " + "  ".join(c.rjust(w) for c, w in zip(row, widths)) for row in cells]
        if len(report["front"]) > 20:
            text.append(f"  and {len(report['front']) - 20} more")
    return "\n".join(text)
