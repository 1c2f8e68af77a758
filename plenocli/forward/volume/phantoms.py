"""Specimens that are made, not seen: what volumes are judged by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from plenocli.base.random_streams import stream

FILLED = 0.75
"""Share of the volume's sides that phantoms keep to."""
EDGE = 0.2
"""Width of a surface's fall from 1 to 0, in images of a lenslet."""


@dataclass(frozen=True, kw_only=True)
class Region:
    """What a phantom has room in, m.

    half: half sides (depth, rows, columns) of the volume about its middle.
    middle: depth of its middle.
    unit: size of a lenslet's image.
    """

    half: tuple[float, float, float]
    middle: float
    unit: float


Sampler = Callable[[float, np.ndarray, np.ndarray], np.ndarray]
"""(depth, rows (row,), columns (column,)), m -> (row, column) light of a voxel there."""


def phantom(name: str, region: Region, seed: int = 0) -> Sampler:
    """A phantom of PHANTOMS.

    region: in which it lies.
    seed: of its places.

    Raises KeyError for an unknown name.
    """
    return PHANTOMS[name](region, stream(seed, "phantom"))


def _places(region: Region, rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 3) depth, row, column."""
    places = rng.uniform(-1, 1, (count, 3)) * FILLED * np.array(region.half)
    return places + [region.middle, 0, 0]


def _beads(region: Region, rng: np.random.Generator) -> Sampler:
    """Balls as wide as a lenslet's image."""
    places = _places(region, rng, 40)
    return _sum_of([(_ball(place, 0.5 * region.unit, region.unit), place) for place in places])


def _shells(region: Region, rng: np.random.Generator) -> Sampler:
    """Hollow spheres, as vesicles are."""
    most = 0.5 * min(region.half)
    radii = rng.uniform(0.5, 1.0, 6) * max(most, region.unit)
    places = _places(region, rng, 6)
    return _sum_of(
        [(_shell(place, radius, region.unit), place) for place, radius in zip(places, radii)]
    )


def _filaments(region: Region, rng: np.random.Generator) -> Sampler:
    """Curved lines half as wide as a lenslet's image."""
    steps = np.linspace(-1, 1, 60)[:, None]
    lines = []
    for _ in range(8):
        ends = _places(region, rng, 3)
        lines.append(ends[0] + (ends[1] - ends[0]) * steps + (ends[2] - ends[0]) * steps**2 / 2)
    radius, edge = 0.4 * region.unit, EDGE * region.unit

    def at(depth: float, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        nearest = np.full((len(rows), len(columns)), np.inf)
        for line in lines:
            for a, b in zip(line[:-1], line[1:]):
                np.minimum(nearest, _to_segment(depth, rows, columns, a, b), out=nearest)
        return _fall(np.sqrt(nearest) - radius, edge)

    return at


def _target(region: Region, rng: np.random.Generator) -> Sampler:
    """Bars across, finer from left to right, in every third of the depth."""
    third = 2 * region.half[0] * FILLED / 3
    periods = region.unit * np.array([8, 4, 2, 1])

    def at(depth: float, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        plane = (depth - region.middle) / third if third > 0 else 0.0
        inside = abs(plane - round(plane)) < 0.2 and abs(plane) < 1.5
        if not inside:
            return np.zeros((len(rows), len(columns)))
        width = 2 * FILLED * region.half[2]
        part = np.floor((columns + width / 2) / width * len(periods)).astype(int)
        known = (part >= 0) & (part < len(periods))
        period = periods[np.clip(part, 0, len(periods) - 1)]
        bars = 0.5 + 0.5 * np.cos(2 * np.pi * rows[:, None] / period)
        high = np.abs(rows) < FILLED * region.half[1]
        return bars * known * high[:, None]

    return at


def _slide(region: Region, rng: np.random.Generator) -> Sampler:
    """An even layer in the middle of the depth, as fluorescent slides have it for white images."""

    def at(depth: float, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        inside = abs(depth - region.middle) < max(region.unit / 2, region.half[0] / 20)
        return np.full((len(rows), len(columns)), float(inside))

    return at


PHANTOMS: dict[str, Callable[[Region, np.random.Generator], Sampler]] = {
    "beads": _beads,
    "shells": _shells,
    "filaments": _filaments,
    "target": _target,
    "slide": _slide,
}


def _fall(outside: np.ndarray, edge: float) -> np.ndarray:
    """1 inside a surface, 0 outside, over the width `edge`; outside: distance from it, m."""
    return 0.5 - 0.5 * np.tanh(2 * outside / edge)


def _ball(place: np.ndarray, radius: float, unit: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda distance: _fall(distance - radius, EDGE * unit)


def _shell(place: np.ndarray, radius: float, unit: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda distance: _fall(np.abs(distance - radius) - 0.3 * unit, EDGE * unit)


def _sum_of(
    bodies: list[tuple[Callable[[np.ndarray], np.ndarray], np.ndarray]],
) -> Sampler:
    """Bodies whose light depends on the distance from their places alone."""

    def at(depth: float, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        total = np.zeros((len(rows), len(columns)))
        for light, place in bodies:
            square = (depth - place[0]) ** 2 + (rows[:, None] - place[1]) ** 2
            total += light(np.sqrt(square + (columns - place[2]) ** 2))
        return total

    return at


def _to_segment(
    depth: float, rows: np.ndarray, columns: np.ndarray, a: np.ndarray, b: np.ndarray
) -> np.ndarray:
    """Squared distance (row, column) of places in a plane from the line between a and b."""
    along = b - a
    z, y, x = depth - a[0], rows[:, None] - a[1], columns - a[2]
    share = (z * along[0] + y * along[1] + x * along[2]) / float(along @ along)
    share = np.clip(share, 0, 1)
    return (z - share * along[0]) ** 2 + (y - share * along[1]) ** 2 + (x - share * along[2]) ** 2
