"""A refocused capture against the plane that it shows."""

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by
from plenocli.evaluation.metrics.depth import (
    DepthScore,
    LayersScore,
    counted,
    score_depth,
    score_layers,
)
from plenocli.inverse.lightfield.planes import DepthMap, LightField


def known_depth(field: LightField) -> tuple[np.ndarray, DepthMap, np.ndarray]:
    """What says at which distances planes and depth map stand.

    Returns (distances of the planes (plane,) m, depth map, its distances (row, column) m).
    Raises InputError where the field does not say.
    """
    depth, planes = field.depth, field.distances
    if depth is None:
        raise InputError("holds no depth map", fix="refocus three planes or more with --camera")
    if depth.distance is None or planes is None:
        raise InputError("holds no distances", fix="refocus three planes or more with --camera")
    return planes, depth, depth.distance


def score_lightfield(field: LightField, distance: float) -> DepthScore:
    """Figures of the depth map of a plane.

    field: planes of refocus, with distances.
    distance: of the plane that was taken, in front of the main lens, m.

    Raises InputError where fewer than two planes stand at known distances.
    docs/model.md, "Refocusing and depth".
    """
    _, depth, distances = known_depth(field)
    gradient, rest = _slope_law(field)
    sure = counted(depth.slope, depth.confidence)
    off = np.abs(distances[sure] - distance)
    slopes = score_depth(
        depth.slope, depth.confidence, gradient / distance + rest, field.slopes, field.sharpness
    )
    return DepthScore(
        slopes,
        depth_distance_m=distance,
        depth_distance_error_m=float(np.nanmedian(off)) if np.isfinite(off).any() else np.nan,
        depth_limit_m=float(distance**2 / abs(gradient)),
    )


def score_layered(field: LightField, opacity: np.ndarray, distances: np.ndarray) -> LayersScore:
    """Figures of the depth map of opaque layers.

    field: planes of refocus, with distances.
    opacity: (layer, row, column) on any whole number of points a lenslet, the nearest layer first.
    distances: (layer,) in front of the main lens, m.

    Raises InputError where the layers are not before the lenslets of the field, or fewer than two
    planes stand at known distances.
    """
    _, depth, _ = known_depth(field)
    gradient, rest = _slope_law(field)
    rows, columns = depth.slope.shape
    several = opacity.shape[1] // rows, opacity.shape[2] // columns
    if opacity.shape[1:] != (rows * several[0], columns * several[1]) or not all(several):
        raise InputError(
            f"has {rows} x {columns} lenslets, the layers {by(opacity.shape[1:])} points",
            fix="name the truth that capture-sim --scene-out wrote beside this capture",
        )
    blocks = opacity.reshape(len(opacity), rows, several[0], columns, several[1]).mean((2, 4))
    return score_layers(depth.slope, depth.confidence, blocks, gradient / distances + rest)


def _slope_law(field: LightField) -> tuple[float, float]:
    """(m, 1): slopes are linear in 1/distance."""
    assert field.distances is not None
    known = np.isfinite(field.distances)
    if known.sum() < 2:
        raise InputError(
            "holds fewer than two planes at known distances", fix="refocus more of them"
        )
    gradient, rest = np.polyfit(1 / field.distances[known], field.slopes[known], 1)
    return float(gradient), float(rest)
