"""What quality costs: the points of a sweep over the seconds that were measured for each."""

from collections.abc import Mapping

import numpy as np

from plenocli.evaluation.designs import DesignTable, Parameter
from plenocli.files.results.measured_seconds import inversion_seconds
from plenocli.report.drawing import COLOURS, Figures, drawing
from plenocli.report.front import LABELS

QUALITY = {
    "psnr_db": "PSNR (dB)",
    "ssim": "SSIM",
    "six_patch_rmse": "spectral RMSE, six patches",
    "spectral_angle_deg": "spectral angle (degrees)",
    "depth_slope_error": "depth error (geometric limits)",
}
"""Figures that are drawn over the seconds, where a table has them."""
MARKERS = "osD^vP*X<>"
MOST_ROWS = 200
COSTS = (
    "Every point, the best first. Seconds of the processor were measured when the point was "
    "computed and differ from run to run and from machine to machine; all other figures do not."
)


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
            axes.set_ylabel(QUALITY[name])
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
    heads = [QUALITY.get(name, LABELS.get(name, name)) for name in stated]
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
