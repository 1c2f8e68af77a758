"""Pictures of a refocused capture: planes, how sharp each is, depth and its confidence, views
through the pupil.
"""

import numpy as np

from plenocli.inverse.lightfield.planes import Colours, DepthMap, LightField
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
        colours = field.colours
        sharp = _seen(field.colours, field.sharp, None if colours is None else colours.sharp)
        figures.append((_sharp(sharp), "Everything in focus, by the depth map."))
    if field.views is not None:
        figures.append((_views(field), "The scene through parts of the pupil."))
    return figures


def _seen(colours: Colours | None, grey: np.ndarray, channels: np.ndarray | None) -> np.ndarray:
    """A picture (row, column), or (row, column, 3) of its channels where there are some; what is
    unknown of a channel counts as none.
    """
    if colours is None or channels is None:
        return grey
    return np.moveaxis(colours.rgb(np.nan_to_num(channels)), 0, -1)


def _label(field: LightField, plane: int) -> str:
    slope = f"slope {field.slopes[plane]:.3g}"
    if field.distances is None or np.isnan(field.distances[plane]):
        return slope
    return f"{field.distances[plane] * 1e3:.4g} mm, {slope}"


def _top(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.percentile(known, 99.5)), 1e-30) if known.size else 1.0


def _planes(field: LightField) -> bytes:
    pictures, colours = field.pictures, field.colours
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
            own = None if colours is None else colours.pictures[plane]
            shown = _seen(colours, pictures[plane], own)
            show_picture(axes, shown / _top(pictures), _label(field, plane))
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


def _views(field: LightField) -> bytes:
    values, colours = field.views, field.colours
    assert values is not None
    rows, columns, height, width = values.shape
    own = None if colours is None else colours.views
    shown = [
        _seen(colours, values[at], None if own is None else own[at])
        for at in np.ndindex(rows, columns)
    ]
    with drawing(1.9 * columns, 1.9 * rows * height / width + 0.1) as made:
        for axes, picture in zip(
            made.figure.subplots(rows, columns, squeeze=False).ravel(),
            shown,
        ):
            show_picture(axes, picture / _top(values))
    return made.png
