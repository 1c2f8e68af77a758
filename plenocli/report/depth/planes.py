"""Pictures of a refocused capture: planes, how sharp each is, depth and its confidence, views
through the pupil.
"""

import numpy as np

from plenocli.inverse.lightfield.planes import DepthMap, LightField
from plenocli.report.drawing import COLOURS, LEVEL_MAP, Figures, drawing, show_map, show_picture

MOST = 9
"""Planes drawn, evenly from all."""


def lightfield_figures(field: LightField) -> Figures:
    """[(PNG, caption)] of what refocus made of a capture."""
    figures = [
        (_planes(field), "Planes of the capture, nearest last."),
        (_sharpness(field), "Sharpness of each plane."),
    ]
    if field.depth is not None:
        figures.append((_depth(field.depth), "Where the views agree best, and how clearly."))
    if field.sharp is not None:
        figures.append((_sharp(field.sharp), "Everything in focus, by the depth map."))
    if field.views is not None:
        figures.append((_views(field.views), "The scene through parts of the pupil."))
    return figures


def _label(field: LightField, plane: int) -> str:
    slope = f"slope {field.slopes[plane]:.3g}"
    if field.distances is None or np.isnan(field.distances[plane]):
        return slope
    return f"{field.distances[plane] * 1e3:.4g} mm, {slope}"


def _top(values: np.ndarray) -> float:
    return max(float(np.nanpercentile(values, 99.5)), 1e-30)


def _planes(field: LightField) -> bytes:
    pictures = field.pictures
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
            show_picture(axes, pictures[plane] / _top(pictures), _label(field, plane))
    return made.png


def _sharpness(field: LightField) -> bytes:
    with drawing(5.6, 2.4) as made:
        axes = made.figure.subplots()
        distances = field.distances
        known = distances is not None and np.isfinite(distances).all()
        axes.plot(
            1e3 * distances if distances is not None and known else field.slopes,
            field.sharpness,
            "o-",
            color=COLOURS[0],
        )
        axes.set(
            xlabel="distance [mm]" if known else "slope of the plane [px/px]",
            ylabel="mean square gradient",
            ylim=(0, None),
        )
    return made.png


def _depth(depth: DepthMap) -> bytes:
    values, bar = depth.slope, "slope [px/px]"
    if depth.distance is not None and np.isfinite(depth.distance).any():
        values, bar = 1e3 * depth.distance, "distance [mm]"
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [2, 98]) if known.size else (0.0, 1.0)
    with drawing(8.6, 3.4) as made:
        left, right = made.figure.subplots(1, 2)
        left.set_facecolor("#dddddd")
        show_map(
            left,
            np.ma.masked_invalid(values),
            "depth (faint where not sure)",
            bar,
            cmap=LEVEL_MAP,
            vmin=low,
            vmax=high if high > low else low + 1e-9,
            alpha=np.clip(2 * depth.confidence, 0.1, 1),
        )
        show_map(right, depth.confidence, "confidence", "", cmap=LEVEL_MAP, vmin=0, vmax=1)
    return made.png


def _sharp(picture: np.ndarray) -> bytes:
    with drawing(5.6, 5.6 * picture.shape[0] / picture.shape[1] + 0.1) as made:
        show_picture(made.figure.subplots(), picture / _top(picture))
    return made.png


def _views(values: np.ndarray) -> bytes:
    rows, columns, height, width = values.shape
    with drawing(1.9 * columns, 1.9 * rows * height / width + 0.1) as made:
        for axes, picture in zip(
            made.figure.subplots(rows, columns, squeeze=False).ravel(),
            values.reshape(-1, height, width),
        ):
            show_picture(axes, picture / _top(values))
    return made.png
