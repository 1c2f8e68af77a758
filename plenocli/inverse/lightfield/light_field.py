"""A capture as a light field: planes, depth and views from its superpixels' samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.inverse.lightfield import refocus as focus
from plenocli.inverse.lightfield.depth import all_in_focus, depth, depth_in_reach
from plenocli.inverse.lightfield.optics import MicroscopeOptics, Optics
from plenocli.inverse.lightfield.planes import Colours, DepthMap, LightField
from plenocli.inverse.lightfield.samples import Samples

RANGE = 3.0
"""Slopes from -RANGE to RANGE are searched first where no distances are given: a lenslet's width of
parallax across the pupil is one.
"""
WIDER = 4
"""Times its first width to which a range that grows is reckoned with, for memory."""


def usual_slopes(planes: int = 13) -> np.ndarray:
    """(plane,) slopes from -RANGE to RANGE, px per px."""
    return np.linspace(-RANGE, RANGE, planes)


def refocused(
    samples: Samples,
    shape: tuple[int, int],
    slopes: np.ndarray,
    *,
    views: int = 3,
    optics: Optics | MicroscopeOptics | None = None,
    grow: bool = False,
) -> LightField:
    """Planes, depth map and views of the samples of a capture.

    shape: (rows, columns) of a picture, in lenslet pitches.
    slopes: (plane,) px per px, rising; a depth map needs at least three.
    views: along each side, 0 for none.
    optics: turns slopes into distances.
    grow: widens evenly spaced slopes, three or more, until what has texture is within them.

    docs/model.md, "Refocusing and depth".
    """
    found = None
    if len(slopes) >= 3 and grow:
        found, slopes = depth_in_reach(samples, slopes.tolist(), shape)
    elif len(slopes) >= 3:
        found = depth(samples, slopes.tolist(), shape)
    if found is not None and optics is not None:
        found = in_metres(found, optics)
    channels = len(samples.parts())
    points = tuple(focus.STEP * n for n in shape)
    grey = np.empty((len(slopes), *points), np.float32)
    coloured = np.empty((len(slopes), channels if samples.channels else 0, *points), np.float32)
    sharpness = np.empty(len(slopes))
    for number, slope in enumerate(slopes):
        picture = focus.in_colour(samples, slope, shape)
        mean = known_mean(picture, 0)
        grey[number], coloured[number] = mean, picture[: coloured.shape[1]]
        sharpness[number] = focus.sharpness(mean)
    sharp = None if found is None else all_in_focus(samples, found.slope, shape)
    seen = focus.views_in_colour(samples, views, shape) if views else None
    return LightField(
        pictures=grey,
        slopes=slopes,
        sharpness=sharpness,
        distances=None if optics is None else optics.distance(slopes),
        spacing=None if optics is None else optics.spacing,
        microscope=isinstance(optics, MicroscopeOptics),
        depth=found,
        sharp=None if sharp is None else known_mean(sharp, 0),
        views=None if seen is None else known_mean(seen, 2),
        colours=None
        if samples.channels is None
        else Colours(channels=samples.channels, pictures=coloured, sharp=sharp, views=seen),
    )


def in_metres(depth: DepthMap, optics: Optics | MicroscopeOptics) -> DepthMap:
    """The depth map with distances and their standard deviation."""
    sigma = depth.sigma
    around = (
        None
        if sigma is None
        else np.abs(optics.distance(depth.slope + sigma) - optics.distance(depth.slope - sigma)) / 2
    )
    return replace(depth, distance=optics.distance(depth.slope), distance_sigma=around)


def known_mean(values: np.ndarray, axis: int) -> np.ndarray:
    """Mean over the channels along `axis` that are known; NaN where none is."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return np.where(known, values, 0.0).sum(axis) / np.where(
            known.any(axis), known.sum(axis), np.nan
        )
