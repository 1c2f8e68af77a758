"""A sweep in pictures: every point in the plane of two objectives, the best joined, a third one as
colour; and quality over the seconds that were measured.
"""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.designs import DesignTable, Parameter
from plenocli.files.results.measured_seconds import inversion_seconds
from plenocli.report.drawing import COLOURS, LEVEL_MAP, Figures, colour_bar, drawing
from plenocli.report.tables import label_and_unit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "matrix_seconds": "time for the matrix (s)",
    "matrix_bytes": "size of the matrix (bytes)",
    "sensor_pixels": "pixels of the sensor",
    "lenslet_field_m": "lenslet's field on the object (m)",
}
"""Of what designs say themselves, beside those of plenocli.report.tables."""
QUALITY = ("psnr_db", "ssim", "six_patch_rmse", "spectral_angle_deg", "depth_slope_error")
"""Figures that are drawn over the seconds, where a table has them."""
MARKERS = "osD^vP*X<>"
MOST_ROWS = 200
COSTS = (
    "Every point, the best first. Seconds of the processor were measured when the point was "
    "computed and differ from run to run and from machine to machine; all other figures do not."
)
_LOG_SPAN = 30.0
"""Ratio of the ends of an axis from which on it is logarithmic."""
_PREFIXES = (("nm", 1e-9), ("µm", 1e-6), ("mm", 1e-3), ("m", 1.0))


@dataclass(frozen=True)
class _Column:
    """What stands on an axis: its label, and values (point,) in the unit that it names."""

    label: str
    values: np.ndarray


def front_picture(table: DesignTable) -> bytes:
    """The first objective over each of the others (two at most), the best points joined, or
    coloured by the objective that no axis shows.

    Returns PNG.
    Raises InputError where no objective has values.
    """
    columns = _columns(table)
    names = [
        name
        for name in table.objectives
        if name in columns and np.isfinite(columns[name].values).any()
    ]
    if not names:
        raise InputError(
            "the sweep has no point with the figures of its front",
            fix="inspect says why its points were refused",
        )
    across: list[str | None] = [*names[1:3]] or [None]
    with drawing(4.0 * len(across) + 0.6, 3.6) as made:
        for axes, x in zip(np.atleast_1d(made.figure.subplots(1, len(across))), across):
            colour = next((name for name in names[1:] if name != x), None)
            _panel(axes, columns, x, names[0], colour, table.ahead, table.objectives)
        handles = axes.get_legend_handles_labels()
        made.figure.legend(*handles, loc="outside upper left", ncols=2)
    return made.png


def _columns(table: DesignTable) -> dict[str, _Column]:
    """Every figure and every key that is a number, by name; lengths in a handy unit."""
    found = {
        p.key: (f"{p.key} ({p.unit})" if p.unit else p.key, table.values[:, i])
        for i, p in enumerate(table.parameters)
        if p.choices is None
    } | {m.name: (_label(m.name), table.figures[:, i]) for i, m in enumerate(table.metrics)}
    return {name: _handy(*column) for name, column in found.items()}


def _label(name: str) -> str:
    """What people read for a figure, with its unit."""
    label, unit = label_and_unit(name)
    return LABELS.get(name) or (f"{label} ({unit})" if unit else label)


def _handy(label: str, values: np.ndarray) -> _Column:
    known = values[np.isfinite(values)]
    if not label.endswith("(m)") or not known.size:
        return _Column(label, values)
    unit, scale = next((p for p in _PREFIXES if np.abs(known).max() < 999.5 * p[1]), _PREFIXES[-1])
    return _Column(f"{label[:-3]}({unit})", values / scale)


def _panel(
    axes: "Axes",
    columns: Mapping[str, _Column],
    x: str | None,
    y: str,
    colour: str | None,
    ahead: np.ndarray,
    objectives: Mapping[str, str],
) -> None:
    """One pair of axes: the figure y over x (the number of the point where there is none)."""

    def label(name: str) -> str:
        return f"{columns[name].label}, {'more' if objectives[name] == 'max' else 'less'} is better"

    values = columns[y].values
    across = np.arange(len(values), dtype=float) if x is None else columns[x].values
    known = np.isfinite(across) & np.isfinite(values)
    order = np.flatnonzero(known & ahead)[np.argsort(across[known & ahead], kind="stable")]
    axes.scatter(
        across[known & ~ahead],
        values[known & ~ahead],
        s=12,
        color="#bbbbbb",
        linewidth=0,
        label="beaten by another design",
    )
    if colour is None:
        axes.plot(
            across[order],
            values[order],
            "o-",
            color=COLOURS[0],
            markersize=5,
            linewidth=1,
            label="the front: beaten by none",
        )
    else:
        shades = axes.scatter(
            across[order],
            values[order],
            s=30,
            c=columns[colour].values[order],
            cmap=LEVEL_MAP,
            edgecolor="#222222",
            linewidth=0.6,
            label="the front: beaten by none",
        )
        colour_bar(axes, shades, label(colour))
    for limits, scale in ((across[known], axes.set_xscale), (values[known], axes.set_yscale)):
        if (
            limits.min(initial=np.inf) > 0
            and limits.max(initial=0) / limits.min() > _LOG_SPAN
            and (x is not None or limits is not across)
        ):
            scale("log")
    axes.set_xlabel("point" if x is None else label(x))
    axes.set_ylabel("\n".join(textwrap.wrap(label(y), 40)))
    axes.grid(True)


def front_rows(table: DesignTable) -> tuple[list[str], list[list[str]]]:
    """The designs on the front as text, best first in the first objective.

    Returns (header, rows): number, what varies, objectives.
    """
    columns = _columns(table)
    words = {
        p.key: [p.choices[int(i)] if np.isfinite(i) else "" for i in table.values[:, k]]
        for k, p in enumerate(table.parameters)
        if p.choices is not None
    }
    keys = [p.key for p in table.parameters]
    aims = [(name, aim) for name, aim in table.objectives.items() if name in columns]
    shown = [*keys, *(name for name, _ in aims if name not in keys)]
    first, aim = columns[aims[0][0]].values, aims[0][1]
    order = sorted(
        np.flatnonzero(table.ahead), key=lambda i: -first[i] if aim == "max" else first[i]
    )
    rows = [
        [
            str(i),
            *(
                str(words[name][i]) if name in words else f"{columns[name].values[i]:.6g}"
                for name in shown
            ),
        ]
        for i in order
    ]
    return ["design", *(name if name in words else columns[name].label for name in shown)], rows


def front_figures(table: DesignTable) -> Figures:
    """[(PNG, caption)] of a sweep, for `show` and the report."""
    aims = " and ".join(f"{name} ({aim})" for name, aim in table.objectives.items())
    return [
        (
            front_picture(table),
            (
                f"{len(table.status)} designs, {int((table.status != 0).sum())} of them refused; "
                f"{int(table.ahead.sum())} that no other beats in {aims}."
            ),
        )
    ]


def cost_figures(table: DesignTable, measured: Mapping[str, np.ndarray]) -> Figures:
    """[(PNG, caption)] figures of quality over the seconds from the camera's description and a
    capture to the result, coloured by what varies first and marked by what varies second.

    measured: stage -> seconds (point,).
    """
    seconds = inversion_seconds(measured)
    names = [name for name in QUALITY if _known(table, name, seconds).any()]
    if not names:
        return []
    keys = [p for p in table.parameters if len(set(_words(table, p))) > 1]
    colours = _words(table, keys[0]) if keys else [""] * len(seconds)
    marks = _words(table, keys[1]) if len(keys) > 1 else [""] * len(seconds)
    with drawing(4.0 * len(names) + 1.4, 3.8) as made:
        for axes, name in zip(np.atleast_1d(made.figure.subplots(1, len(names))), names):
            figure, shown = _column(table, name), _known(table, name, seconds)
            for i, mark in enumerate(dict.fromkeys(marks)):
                for j, colour in enumerate(dict.fromkeys(colours)):
                    of = shown & np.array(
                        [m == mark and c == colour for m, c in zip(marks, colours)]
                    )
                    axes.scatter(
                        seconds[of],
                        figure[of],
                        s=22,
                        marker=MARKERS[i % len(MARKERS)],
                        color=COLOURS[j % len(COLOURS)],
                        linewidth=0,
                        alpha=0.8,
                        label=" ".join(filter(None, (colour, mark))),
                    )
            axes.set_xscale("log")
            axes.set_xlabel("CPU seconds, measured")
            axes.set_ylabel(_label(name))
            axes.grid(True)
        handles, labels = axes.get_legend_handles_labels()
        drawn = [k for k, h in enumerate(handles) if len(h.get_offsets())]
        made.figure.legend(
            [handles[k] for k in drawn], [labels[k] for k in drawn], loc="outside right upper"
        )
    by = " and ".join(p.key for p in keys[:2])
    caption = "What quality costs: seconds from the camera and a capture to the result"
    return [(made.png, f"{caption}{f', by {by}' if by else ''}.")]


def cost_rows(
    table: DesignTable, measured: Mapping[str, np.ndarray]
) -> tuple[list[str], list[list[str]]]:
    """All points as text, best first in the first objective, with stated and measured costs.

    Returns (header, rows).
    """
    aims = list(table.objectives.items())
    first = _column(table, aims[0][0]) * (-1 if aims[0][1] == "max" else 1)
    order = np.argsort(np.where(np.isfinite(first), first, np.inf), kind="stable")[:MOST_ROWS]
    stated = [n for n in (*QUALITY, "matrix_seconds", "matrix_bytes") if _has(table, n)]
    words = [_words(table, p) for p in table.parameters]
    total = inversion_seconds(measured)
    rows = [
        [
            str(i),
            *(column[i] for column in words),
            *(_shown(_column(table, name)[i]) for name in stated),
            *(_shown(spent[i]) for spent in measured.values()),
            _shown(total[i]),
        ]
        for i in map(int, order)
    ]
    heads = [_label(name) for name in stated]
    spent = [f"{stage.removesuffix(' cpu_s')} (CPU s, measured)" for stage in measured]
    keys = [p.key for p in table.parameters]
    return ["design", *keys, *heads, *spent, "to the result (CPU s, measured)"], rows


def _column(table: DesignTable, name: str) -> np.ndarray:
    found = table.column(name)
    return np.full(len(table.status), np.nan) if found is None else found


def _has(table: DesignTable, name: str) -> bool:
    return bool(np.isfinite(_column(table, name)).any())


def _known(table: DesignTable, name: str, seconds: np.ndarray) -> np.ndarray:
    return np.isfinite(_column(table, name)) & np.isfinite(seconds) & (seconds > 0)


def _words(table: DesignTable, parameter: Parameter) -> list[str]:
    """The values of a parameter as text, "" where there is none."""
    values = table.values[:, [p.key for p in table.parameters].index(parameter.key)]
    if parameter.choices is None:
        return [f"{v:.6g}" if np.isfinite(v) else "" for v in values]
    return [str(parameter.choices[int(v)]) if np.isfinite(v) else "" for v in values]


def _shown(value: float) -> str:
    return f"{value:.4g}" if np.isfinite(value) else ""
