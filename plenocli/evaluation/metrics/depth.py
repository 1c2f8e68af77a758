"""How far a depth map of one plane is from where the plane stands, in units of what
geometry can tell.

The limit: a plane is told from another by its parallax over the whole pupil, and parallax by no
less than a lenslet's width, a slope of one. See docs/model.md, "Refocusing and depth".
"""

import numpy as np

SURE = 0.4
"""Confidence from which on a lenslet counts."""

DEFINITIONS = {
    "depth_slope": "slope at which the plane stands, px per px: in units of the geometric limit",
    "depth_slope_found": (
        "median slope over the lenslets that count, those with a confidence of 0.4 or more"
    ),
    "depth_slope_error": "median of |slope - truth| over them, in units of the geometric limit",
    "depth_slope_worst": "the same, 95th percentile",
    "depth_sure_share": "share of the lenslets that count",
    "sharpest_slope_error": (
        "slope of the sharpest plane, by a parabola through it and its neighbours, less the truth"
    ),
    "depth_distance_m": "distance of the plane, m",
    "depth_distance_error_m": "median of |distance - truth| over the lenslets that count, m",
    "depth_limit_m": "how far the plane would have to move to be seen one geometric limit away, m",
}


def score_depth(slope, confidence, true_slope, planes, sharpness):
    """Figures of a depth map, a dict of those of DEFINITIONS that need no distances.

    slope, confidence (row, column);
    true_slope: of the plane;
    planes, sharpness (plane,): slopes tried, and how sharp each picture is.
    """
    found = np.asarray(slope)[counted(slope, confidence)]
    error = np.abs(found - true_slope)
    middle, far = np.percentile(error, [50, 95]) if found.size else (np.nan, np.nan)
    return {
        "depth_slope": round(float(true_slope), 9) + 0.0,
        "depth_slope_found": float(np.median(found)) if found.size else np.nan,
        "depth_slope_error": float(middle),
        "depth_slope_worst": float(far),
        "depth_sure_share": found.size / np.size(slope),
        "sharpest_slope_error": float(sharpest(planes, sharpness) - true_slope),
    }


def counted(slope, confidence):
    """Which lenslets count."""
    return np.isfinite(slope) & (np.asarray(confidence) >= SURE)


def sharpest(planes, sharpness):
    """Slope where the sharpness peaks: on a parabola through the sharpest plane and its
    neighbours, or that plane at an end.
    """
    best = int(np.argmax(sharpness))
    if not 0 < best < len(planes) - 1:
        return float(planes[best])
    near = slice(best - 1, best + 2)
    a, b, _ = np.polyfit(np.asarray(planes)[near] - planes[best], sharpness[near], 2)
    return float(planes[best] - b / (2 * a))
