"""Pictures of a refocused capture: planes, how sharp each is, depth and its confidence, views
through the pupil.
"""

import numpy as np

from plenocli.report.drawing import COLOURS, LEVEL_MAP, drawing, show_map, show_picture

MOST = 9
"""Planes drawn, evenly from all."""


def lightfield_figures(artefact):
    """[(PNG, caption)] of a light-field artefact."""
    data = artefact.data
    figures = [
        (_planes(data), "Planes of the capture, nearest last."),
        (_sharpness(data), "Sharpness of each plane."),
    ]
    if "depth/slope" in data:
        figures.append((_depth(data), "Where the views agree best, and how clearly."))
    if "views/value" in data:
        figures.append((_views(data["views/value"]), "The scene through parts of the pupil."))
    return figures


def _label(data, plane):
    distance = data.get("refocus/distance")
    slope = f"slope {data['refocus/slope'][plane]:.3g}"
    return (
        slope
        if distance is None or np.isnan(distance[plane])
        else f"{distance[plane] * 1e3:.4g} mm, {slope}"
    )


def _top(values):
    return max(float(np.nanpercentile(values, 99.5)), 1e-30)


def _planes(data):
    pictures = data["refocus/value"]
    chosen = np.unique(
        np.linspace(0, len(pictures) - 1, min(len(pictures), MOST)).round().astype(int)
    )
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    height, width = pictures.shape[1:]
    with drawing(3.1 * columns, (3.1 * height / width + 0.25) * rows) as made:
        panels = made.figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(chosen) :]:
            axes.set_visible(False)
        for axes, plane in zip(panels, chosen):
            show_picture(axes, pictures[plane] / _top(pictures), _label(data, plane))
    return made.png


def _sharpness(data):
    with drawing(5.6, 2.4) as made:
        axes = made.figure.subplots()
        distance = data.get("refocus/distance")
        known = distance is not None and np.isfinite(distance).all()
        axes.plot(
            1e3 * distance if known else data["refocus/slope"],
            data["refocus/sharpness"],
            "o-",
            color=COLOURS[0],
        )
        axes.set(
            xlabel="distance [mm]" if known else "slope of the plane [px/px]",
            ylabel="mean square gradient",
            ylim=(0, None),
        )
    return made.png


def _depth(data):
    distance = data.get("depth/distance")
    known = distance is not None and np.isfinite(distance).any()
    values, bar = (
        (1e3 * distance, "distance [mm]") if known else (data["depth/slope"], "slope [px/px]")
    )
    sure = data["depth/confidence"]
    with drawing(8.6, 3.4) as made:
        left, right = made.figure.subplots(1, 2)
        low, high = np.nanpercentile(values, [2, 98])
        left.set_facecolor("#dddddd")
        show_map(
            left,
            np.ma.masked_invalid(values),
            "depth (faint where not sure)",
            bar,
            cmap=LEVEL_MAP,
            vmin=low,
            vmax=high if high > low else low + 1e-9,
            alpha=np.clip(2 * sure, 0.1, 1),
        )
        show_map(right, sure, "confidence", "", cmap=LEVEL_MAP, vmin=0, vmax=1)
    return made.png


def _views(values):
    rows, columns, height, width = values.shape
    with drawing(1.9 * columns, 1.9 * rows * height / width + 0.1) as made:
        for axes, picture in zip(
            made.figure.subplots(rows, columns, squeeze=False).ravel(),
            values.reshape(-1, height, width),
        ):
            show_picture(axes, picture / _top(values))
    return made.png
