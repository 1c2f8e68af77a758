"""The front of a sweep as a picture: every point in the plane of two objectives, the best
joined, a third one as colour.
"""

import numpy as np

from plenocli.base.errors import InputError
from plenocli.report.drawing import COLOURS, LEVEL_MAP, colour_bar, drawing

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


def front_picture(artefact):
    """PNG of a sweep artefact: the first objective over each of the others (two at most), the best
    points joined, or coloured by the objective that no axis shows. InputError where no
    objective has values.
    """
    attrs = artefact.attrs["sweep"]
    columns = _columns(artefact)
    objectives = dict(attrs["objectives"])
    names = [name for name in objectives if name in columns and np.isfinite(columns[name][1]).any()]
    if not names:
        raise InputError(
            "the sweep has no point with the figures of its front",
            fix="inspect says why its points were refused",
        )
    ahead = artefact.data["sweep/front"].astype(bool)
    across = names[1:3] or [None]
    with drawing(4.0 * len(across) + 0.6, 3.6) as made:
        for axes, x in zip(np.atleast_1d(made.figure.subplots(1, len(across))), across):
            colour = next((name for name in names[1:] if name != x), None)
            _panel(axes, columns, x, names[0], colour, ahead, objectives)
        handles = axes.get_legend_handles_labels()
        made.figure.legend(*handles, loc="outside upper left", ncols=2)
    return made.png


def _columns(artefact):
    """Name -> (label, (point,) values) of every figure and of every key that is a number;
    lengths in a handy unit.
    """
    attrs = artefact.attrs["sweep"]
    found = {
        p["key"]: (
            f"{p['key']} ({p['unit']})" if p["unit"] else p["key"],
            artefact.data["sweep/parameter"][:, i],
        )
        for i, p in enumerate(attrs["parameters"])
        if "choices" not in p
    }
    if "sweep/metric" in artefact.data:
        found |= {
            m["name"]: (LABELS.get(m["name"], m["name"]), artefact.data["sweep/metric"][:, i])
            for i, m in enumerate(attrs["metrics"])
        }
    return {name: _handy(*column) for name, column in found.items()}


def _handy(label, values):
    known = values[np.isfinite(values)]
    if not label.endswith("(m)") or not known.size:
        return label, values
    unit, scale = next((p for p in _PREFIXES if np.abs(known).max() < 999.5 * p[1]), _PREFIXES[-1])
    return f"{label[:-3]}({unit})", values / scale


def _panel(axes, columns, x, y, colour, ahead, objectives):
    def label(name):
        return f"{columns[name][0]}, {'more' if objectives[name] == 'max' else 'less'} is better"

    values = columns[y][1]
    across = np.arange(len(values), dtype=float) if x is None else columns[x][1]
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
            c=columns[colour][1][order],
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


def front_rows(artefact):
    """(header, rows) of the designs on the front: their number, what varies, the objectives; as
    text, best first in the first objective.
    """
    attrs = artefact.attrs["sweep"]
    columns, data = _columns(artefact), artefact.data
    words = {
        p["key"]: [
            p["choices"][int(i)] if np.isfinite(i) else "" for i in data["sweep/parameter"][:, k]
        ]
        for k, p in enumerate(attrs["parameters"])
        if "choices" in p
    }
    keys = [p["key"] for p in attrs["parameters"]]
    aims = [(name, way) for name, way in attrs["objectives"] if name in columns]
    shown = [*keys, *(name for name, _ in aims if name not in keys)]
    order = sorted(
        np.flatnonzero(data["sweep/front"]),
        key=lambda i: (
            -columns[aims[0][0]][1][i] if aims[0][1] == "max" else columns[aims[0][0]][1][i]
        ),
    )
    rows = [
        [
            str(i),
            *(
                str(words[name][i]) if name in words else f"{columns[name][1][i]:.6g}"
                for name in shown
            ),
        ]
        for i in order
    ]
    return ["design", *(name if name in words else columns[name][0] for name in shown)], rows


def front_figures(artefact):
    """[(PNG, caption)] of a sweep, for `show` and the report."""
    attrs = artefact.attrs["sweep"]
    status = artefact.data["sweep/status"]
    aims = " and ".join(f"{name} ({way})" for name, way in attrs["objectives"])
    return [
        (
            front_picture(artefact),
            (
                f"{len(status)} designs, {int((status != 0).sum())} of them refused; "
                f"{int(artefact.data['sweep/front'].sum())} that no other beats in {aims}."
            ),
        )
    ]
