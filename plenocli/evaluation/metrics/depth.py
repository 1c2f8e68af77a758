"""How far a depth map of one plane is from where the plane stands, in units of what
geometry can tell.

The limit: a plane is told from another by its parallax over the whole pupil, and parallax by no
less than a lenslet's width, a slope of one. See docs/model.md, "Refocusing and depth".
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

SURE = 0.9
"""Confidence from which on a lenslet counts."""

DEFINITIONS = {
    "depth_slope": "slope at which the plane stands, px per px: in units of the geometric limit",
    "depth_slope_found": (
        "median slope over the lenslets that count, those with a confidence of 0.9 or more"
    ),
    "depth_slope_error": "median of |slope - truth| over them, in units of the geometric limit",
    "depth_slope_worst": "the same, 95th percentile",
    "depth_sure_share": "share of the lenslets that count",
    "sharpest_slope_error": (
        "slope of the sharpest plane, by a parabola through it and its neighbours, less the truth"
    ),
    "depth_layer_errors": (
        "of opaque layers, the nearest first: depth_slope_error over the lenslets that show it, no "
        "edge within three lenslets and its blur"
    ),
    "depth_distance_m": "distance of the plane, m",
    "depth_distance_error_m": "median of |distance - truth| over the lenslets that count, m",
    "depth_limit_m": "how far the plane would have to move to be seen one geometric limit away, m",
}

SMOOTHED = 3
"""Lenslets over which depth maps are smoothed, about: so near an edge they mix what is there."""


@dataclass(frozen=True, kw_only=True)
class LayersScore:
    """Figures of a depth map of opaque layers, slopes in units of the geometric limit; NaN where no
    lenslet counts. See DEFINITIONS.
    """

    depth_slope_error: float
    depth_slope_worst: float
    depth_sure_share: float
    depth_layer_errors: list[float]


@dataclass(frozen=True, kw_only=True)
class SlopeScore:
    """Figures of a depth map that need no distances, slopes in units of the geometric limit; NaN
    where no lenslet counts. See DEFINITIONS.
    """

    depth_slope: float
    depth_slope_found: float
    depth_slope_error: float
    depth_slope_worst: float
    depth_sure_share: float
    sharpest_slope_error: float


@dataclass(frozen=True)
class DepthScore:
    """Figures of a depth map against a plane at a known distance, m; see DEFINITIONS."""

    slopes: SlopeScore
    depth_distance_m: float
    depth_distance_error_m: float
    depth_limit_m: float


def score_depth(
    slope: np.ndarray,
    confidence: np.ndarray,
    true_slope: float,
    planes: np.ndarray,
    sharpness: np.ndarray,
) -> SlopeScore:
    """Figures of a depth map of one plane.

    slope, confidence: (row, column).
    true_slope: of the plane, px per px.
    planes: (plane,) slopes tried.
    sharpness: (plane,) of the pictures at these slopes.

    docs/model.md, "Refocusing and depth".
    """
    found = np.asarray(slope)[counted(slope, confidence)]
    error = np.abs(found - true_slope)
    middle, far = np.percentile(error, [50, 95]) if found.size else (np.nan, np.nan)
    return SlopeScore(
        depth_slope=round(float(true_slope), 9) + 0.0,
        depth_slope_found=float(np.median(found)) if found.size else np.nan,
        depth_slope_error=float(middle),
        depth_slope_worst=float(far),
        depth_sure_share=found.size / np.size(slope),
        sharpest_slope_error=float(sharpest(planes, sharpness) - true_slope),
    )


def score_layers(
    slope: np.ndarray, confidence: np.ndarray, opacity: np.ndarray, true_slopes: np.ndarray
) -> LayersScore:
    """Figures of a depth map of opaque layers, away from their edges.

    slope, confidence: (row, column).
    opacity: (layer, row, column) of each over a lenslet, the nearest first.
    true_slopes: (layer,) px per px.

    docs/model.md, "Refocusing and depth".
    """
    from scipy.ndimage import minimum_filter

    # light of a point is spread over as many lenslets as its slope says
    away = 2 * (SMOOTHED + int(np.ceil(np.abs(true_slopes).max() / 2))) + 1
    sure, open_to = counted(slope, confidence), np.ones(opacity.shape[1:])
    errors, judged = [], 0
    for one, true in zip(opacity, true_slopes):
        shown = minimum_filter(one * open_to, away, mode="nearest") > 1 - 1e-6
        errors.append(np.abs(slope[shown & sure] - true))
        judged += int(shown.sum())
        open_to = open_to * (1 - one)
    every = np.concatenate(errors)
    middle, far = np.percentile(every, [50, 95]) if every.size else (np.nan, np.nan)
    return LayersScore(
        depth_slope_error=float(middle),
        depth_slope_worst=float(far),
        depth_sure_share=every.size / judged if judged else np.nan,
        depth_layer_errors=[float(np.median(e)) if e.size else np.nan for e in errors],
    )


def counted(slope: np.ndarray, confidence: np.ndarray) -> np.ndarray:
    """Which lenslets count, bool like slope."""
    return np.isfinite(slope) & (np.asarray(confidence) >= SURE)


def sharpest(planes: ArrayLike, sharpness: ArrayLike) -> float:
    """Slope where the sharpness peaks.

    planes: (plane,) rising slopes.
    sharpness: (plane,).

    Returns the top of the parabola through the sharpest plane and its neighbours, or that plane
    where it is the first or last one.
    """
    slopes, heights = np.asarray(planes), np.asarray(sharpness)
    best = int(np.argmax(heights))
    if not 0 < best < len(slopes) - 1:
        return float(slopes[best])
    near = slice(best - 1, best + 2)
    a, b, _ = np.polyfit(slopes[near] - slopes[best], heights[near], 2)
    return float(slopes[best] - b / (2 * a))
