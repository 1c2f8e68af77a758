"""The front of a sweep as a picture: every point in the plane of two objectives, the best
joined, a third one as colour.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.designs import DesignTable
from plenocli.report.drawing import COLOURS, LEVEL_MAP, Figures, colour_bar, drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LABELS = {
    "psnr_db": "PSNR (dB)",
    "psnr_inner_db": "PSNR without the border (dB)",
    "ssim": "SSIM",
    "rmse": "root mean square error",
    "six_patch_rmse": "error over six patches",
    "spectral_angle_deg": "spectral angle (degrees)",
    "delta_e_2000": "colour difference ΔE 2000",
    "snr_predicted_mean_db": "predicted SNR (dB)",
    "matrix_seconds": "time for the matrix (s)",
    "matrix_bytes": "size of the matrix (bytes)",
    "sensor_pixels": "pixels of the sensor",
    "lenslets": "lenslets",
    "object_points": "object points",
    "lenslet_field_m": "lenslet's field on the object (m)",
}
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
    } | {
        m.name: (LABELS.get(m.name, m.name), table.figures[:, i])
        for i, m in enumerate(table.metrics)
    }
    return {name: _handy(*column) for name, column in found.items()}


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
    axes.set_ylabel(label(y))
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
