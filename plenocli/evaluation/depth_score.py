"""A refocused capture against the plane that it shows."""

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics.depth import DepthScore, counted, score_depth
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
    planes, depth, distances = known_depth(field)
    known = np.isfinite(planes)
    if known.sum() < 2:
        raise InputError(
            "holds fewer than two planes at known distances", fix="refocus more of them"
        )
    # slopes are linear in 1/distance
    gradient, rest = np.polyfit(1 / planes[known], field.slopes[known], 1)
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
