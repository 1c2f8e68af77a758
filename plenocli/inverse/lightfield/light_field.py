"""A capture as a light field: planes, depth and views from its superpixels' samples."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.tiling import BAND, EVERYTHING, FORGETFUL, Keeper, Room, around, bands, shared
from plenocli.inverse.lightfield.depth import (
    depth,
    depth_in_reach,
    filled,
    plane_bytes,
    plane_name,
    together,
    together_bytes,
)
from plenocli.inverse.lightfield.optics import MicroscopeOptics, Optics
from plenocli.inverse.lightfield.planes import Colours, DepthMap, LightField
from plenocli.inverse.lightfield.refocus import STEP, Parts, pictures, views_in_bands
from plenocli.inverse.lightfield.samples import AT_ONCE, TEMPORARY_BYTES, SampleBands

RANGE = 3.0
"""Slopes from -RANGE to RANGE are searched first where no distances are given: a lenslet's width of
parallax across the pupil is one.
"""
WIDER = 2
"""Times its first width to which a range that grows is reckoned with, for memory."""
MAP_BYTES, WAITING, WAITING_BYTES = 64, 4, 4 << 20
"""Memory for each lenslet of the maps of depth; how many bands wait for others, at most, and memory
for each (measured).
"""


def in_memory(shape: tuple[int, ...]) -> np.ndarray:
    """Room for pictures in memory."""
    return np.empty(shape, np.float32)


def usual_slopes(planes: int = 13) -> np.ndarray:
    """(plane,) slopes from -RANGE to RANGE, px per px."""
    return np.linspace(-RANGE, RANGE, planes)


def refocused(
    source: SampleBands,
    slopes: np.ndarray,
    *,
    views: int = 3,
    optics: Optics | MicroscopeOptics | None = None,
    grow: bool = False,
    room: Room = in_memory,
    keeper: Keeper = FORGETFUL,
) -> LightField:
    """Planes, depth map and views of the samples of a capture.

    slopes: (plane,) px per px, rising; a depth map needs at least three.
    views: along each side, 0 for none.
    optics: turns slopes into distances.
    grow: widens evenly spaced slopes, three or more, until what has texture is within them.
    room: what gives arrays for pictures by their shape; rows of their last two axes are put into
        them, one band after the other.
    keeper: of what is finished, all but pictures; what it tells of these counts where `room` still
        has them, from an earlier run.

    Raises NumericsError where memory does not suffice, InputError where no pixel is lit.
    docs/model.md, "Refocusing and depth".
    """
    held = room is in_memory
    _require(source, slopes, views, held, WIDER if grow else 1)
    found = None
    if len(slopes) >= 3 and grow:
        found, slopes = depth_in_reach(source, slopes.tolist(), keeper=keeper)
        _require(source, slopes, views, held)
    elif len(slopes) >= 3:
        found = depth(source, slopes.tolist(), keeper=keeper)
    if found is not None and optics is not None:
        found = in_metres(found, optics)
    grey, coloured, sharpness = _planes(source, slopes, room, keeper)
    own = None if found is None else filled(found.slope)
    sharp, tinted = (None, None) if own is None else _in_focus(source, own, room)
    seen, through = _views(source, views, room) if views else (None, None)
    return LightField(
        pictures=grey,
        slopes=slopes,
        sharpness=sharpness,
        distances=None if optics is None else optics.distance(slopes),
        spacing=None if optics is None else optics.spacing,
        microscope=isinstance(optics, MicroscopeOptics),
        depth=found,
        sharp=sharp,
        views=seen,
        colours=None
        if source.channels is None
        else Colours(channels=source.channels, pictures=coloured, sharp=tinted, views=through),
    )


def _require(
    source: SampleBands, slopes: np.ndarray, views: int, held: bool, wider: int = 1
) -> None:
    """NumericsError where there is not the memory to refocus; held: whether it holds all pictures;
    wider: times as many planes that may be tried, see WIDER; the others as of `refocused`.
    """
    lenslets, colours = source.shape[0] * source.shape[1], source.count
    reach = math.ceil(float(np.abs(slopes).max()) * math.sqrt(0.5) * STEP) + 1
    plane = plane_bytes(source, reach, STEP)
    needed = source.held + min(lenslets * source.pitch**2, AT_ONCE) * TEMPORARY_BYTES
    needed += min(len(slopes) * plane, max(together_bytes(), plane))
    needed += WAITING_BYTES * min(len(source.rows) - 1, WAITING)
    needed += lenslets * max(MAP_BYTES, 4 * wider * len(slopes)) * (len(slopes) >= 3)
    fewer = "cut the capture"
    if held:
        values = (len(slopes) + 1) * STEP**2 + views**2
        needed += 4 * lenslets * values * (1 if source.channels is None else 1 + colours)
        fewer = "take fewer planes"
    budget().require(needed, "refocusing", source.where, fewer)


def _room(
    source: SampleBands, room: Room, step: int, lead: tuple[int, ...] = ()
) -> tuple[Any, Any]:
    """Room for pictures in grey, and in colour where there are channels."""
    points = step * source.shape[0], step * source.shape[1]
    grey = room((*lead, *points))
    return grey, None if source.channels is None else room((*lead, source.count, *points))


def _planes(
    source: SampleBands, slopes: np.ndarray, room: Room, keeper: Keeper
) -> tuple[Any, Any, np.ndarray]:
    """(pictures, the same in colour or None, sharpness) of all planes."""
    grey, coloured = _room(source, room, STEP, (len(slopes),))
    square, count = np.zeros((2, len(slopes)))
    names, todo = [plane_name("plane", slope) for slope in slopes], []
    for number, name in enumerate(names):
        before = keeper.get(name)
        if before is None or before[0][2] != _checksum(grey, coloured, number):
            todo.append(number)
        else:
            square[number], count[number] = before[0][:2]
    for numbers in together(source, slopes, todo, STEP):
        streams = shared(source, len(numbers))
        planes = [_plane(*both, source) for both in zip(streams, slopes[numbers])]
        for rows, parts in zip(source.points(STEP), zip(*planes)):
            for number, (mean, colours, steep) in zip(numbers, parts):
                grey[number, rows] = mean
                if coloured is not None:
                    coloured[number, :, rows] = colours
                square[number] += np.nansum(steep)
                count[number] += np.count_nonzero(np.isfinite(steep))
        for number in numbers:
            told = square[number], count[number], _checksum(grey, coloured, number)
            keeper.put(names[number], [np.array(told)])
    with np.errstate(invalid="ignore"):
        return grey, coloured, square / count


def _checksum(grey: Any, coloured: Any, number: int) -> int:
    """Of the pictures of a plane, as they are in their room."""
    total = 0
    for plane in (grey, coloured):
        if plane is not None:
            lead = number, *[EVERYTHING] * (len(plane.shape) - 3)
            for rows in bands(plane.shape[-2], BAND // plane.shape[-1]):
                total = zlib.crc32(np.ascontiguousarray(plane[(*lead, rows)]).data, total)
    return total


def _plane(
    bands_of: Parts, slope: float, source: SampleBands
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """The mean of a plane's pictures, these (channel, row, column), and the squared gradient of the
    mean, of each band of the source.
    """
    streams = shared(bands_of, source.count)
    seen = (pictures(stream, source, number, slope) for number, stream in enumerate(streams))
    parts = (np.stack(channels) for channels in zip(*seen))
    for own, part in around(parts, source.points(STEP), 1):
        mean = known_mean(part, 0)
        down, right = np.gradient(mean)
        yield mean[own], part[:, own], (down**2 + right**2)[own]


def _in_focus(source: SampleBands, slope: np.ndarray, room: Room) -> tuple[Any, Any]:
    """The picture in which every lenslet is refocused by its own slope, of a map (row, column), in
    grey, and in colour or None.
    """
    grey, coloured = _room(source, room, STEP)
    seen = [
        pictures(stream, source, number, slope)
        for number, stream in enumerate(shared(source, source.count))
    ]
    for rows, parts in zip(source.points(STEP), zip(*seen)):
        grey[rows] = known_mean(np.stack(parts), 0)
        if coloured is not None:
            coloured[:, rows] = np.stack(parts)
    return grey, coloured


def _views(source: SampleBands, count: int, room: Room) -> tuple[Any, Any]:
    """The views, one value a pitch, in grey, and in colour or None."""
    grey, coloured = _room(source, room, 1, (count, count))
    for rows, seen in zip(source.rows, views_in_bands(source, count)):
        grey[:, :, rows] = known_mean(seen, 2)
        if coloured is not None:
            coloured[:, :, :, rows] = seen
    return grey, coloured


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
