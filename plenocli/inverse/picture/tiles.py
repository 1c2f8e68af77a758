"""A capture that is estimated tile by tile: squares of lenslets, each with as many around it as its
method looks at. What is common to a capture - its unit, its noise, whether the matrix is believed,
weights, how contrasts are spread - is worked out once, on the square that is most like the whole,
and taken over by every tile.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from plenocli.base.tiling import even_bands, spread_bands
from plenocli.inverse.picture.estimate import BRIGHTNESS
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels, Whole
from plenocli.inverse.picture.methods.method import Method, Sees
from plenocli.inverse.picture.nuisances.defects import DefectsFound
from plenocli.inverse.picture.nuisances.saturation import SaturationFound
from plenocli.inverse.picture.nuisances.veil import VeilFound
from plenocli.inverse.picture.reconstruction import Entry, Reconstruction

AT_ONCE = 1 << 22
"""Numbers of a tile: of its pixels and points, and FURTHER a lenslet that the methods take."""
FURTHER = 1000
BESIDE = 3
"""Squares along an axis over which what is common to a capture is averaged."""
LIKE = np.linspace(0.05, 0.95, 19)
"""Quantiles of brightness and detail by which a square is compared with the whole."""

NUISANCES = (DefectsFound, SaturationFound, VeilFound)
"""What is told of a whole once its tiles are put together."""
Area = tuple[slice, slice]
"""Lenslets, rows and columns."""
EVERY = (slice(None), slice(None))


class Source(Protocol):
    """Superpixels of which parts are asked for."""

    @property
    def count(self) -> tuple[int, int]:
        """Lenslets (rows, columns)."""
        ...

    def cut(self, rows: slice, columns: slice, own: Area = EVERY) -> Superpixels:
        """Those of some lenslets, of which `own` count. Raises InputError."""
        ...


@dataclass(frozen=True)
class Tile:
    """Lenslets that are estimated together.

    own: those whose objects are wanted.
    around: those that are looked at.
    """

    own: Area
    around: Area

    @property
    def within(self) -> Area:
        """Where its own lenslets are found among those that are looked at."""
        rows, columns = (
            slice(own.start - near.start, own.stop - near.start)
            for own, near in zip(self.own, self.around)
        )
        return rows, columns

    @property
    def shape(self) -> tuple[int, int]:
        """Its own lenslets (rows, columns)."""
        rows, columns = (part.stop - part.start for part in self.own)
        return rows, columns


def side_of(system: LensletMatrix) -> int:
    """Lenslets along the side of a tile. It depends on the matrix alone: results depend on it."""
    pixels, points = system.own.shape
    return math.isqrt(AT_ONCE // (pixels + points + FURTHER))


def tiles_of(estimators: Estimators, method: Method, count: tuple[int, int]) -> list[Tile]:
    """The tiles of a capture of `count` lenslets (rows, columns), row by row; one where it is no
    larger than a tile.
    """
    side = side_of(estimators.system)
    every = (slice(0, count[0]), slice(0, count[1]))
    if count[0] * count[1] <= side**2:
        return [Tile(every, every)]
    margin = _margin(estimators, method)

    def around(part: slice, length: int) -> slice:
        return slice(max(0, part.start - margin), min(length, part.stop + margin))

    return [
        Tile((rows, columns), (around(rows, count[0]), around(columns, count[1])))
        for rows in even_bands(count[0], side)
        for columns in even_bands(count[1], side)
    ]


def largest_tile(estimators: Estimators, method: Method) -> int:
    """Lenslets that are looked at for the largest tile that there may be."""
    return (side_of(estimators.system) + 2 * _margin(estimators, method)) ** 2


def _margin(estimators: Estimators, method: Method) -> int:
    """Lenslets around a tile that its own depend on."""
    if method.sees is Sees.LENSLET_AS_IS:
        return method.lenslets_around
    reach = int(np.abs(estimators.system.offsets).max(initial=0))
    near = 2 + reach if estimators.overlap == 3 or reach else 0
    if method.sees is Sees.PICTURE:
        near = max(near, 2) + -(-method.points_around // min(estimators.system.object_shape))
    return near


def survey(system: LensletMatrix, source: Source, tile: int) -> tuple[Whole, Tile]:
    """(what is known of a whole capture: the unit of its brightness, the square of `tile` lenslets
    on a side that is most like it).
    """
    count = source.count
    levels, detail, power = np.zeros(count), np.zeros(count), np.zeros(count)

    def look(rows: slice) -> None:
        # row by row: what is worked on stays in the cache
        for row, y in enumerate(source.cut(rows, slice(0, count[1])).y, start=rows.start):
            y = np.where(np.isfinite(y), y, 0)
            found = system.levels(y)
            levels[row], power[row] = found.mean(axis=1), np.mean(found**2, axis=1)
            y -= found @ system.even.T
            detail[row] = np.sqrt(np.mean(np.square(y, out=y), axis=1))

    spread_bands(count[0], tile**2 // count[1], look)
    unit = math.sqrt(float(power.mean())) / BRIGHTNESS
    return Whole({"unit": {None: unit if unit > 0 else 1.0}}), _typical(levels, detail, tile)


def _typical(levels: np.ndarray, detail: np.ndarray, side: int) -> Tile:
    """The square whose lenslets are as bright and as rich in detail as all.

    levels, detail: (lenslet_row, lenslet_column).
    """
    rows, columns = (min(side, n) for n in levels.shape)
    of_all = [np.quantile(one, LIKE) for one in (levels, detail)]
    widths = [max(float(np.ptp(one)), np.finfo(float).tiny) for one in of_all]

    def unlike(area: Area) -> float:
        return sum(
            float(np.mean(np.abs(np.quantile(one[area], LIKE) - known))) / wide
            for one, known, wide in zip((levels, detail), of_all, widths)
        )

    areas = [
        (slice(row, row + rows), slice(column, column + columns))
        for row in _steps(levels.shape[0] - rows, rows)
        for column in _steps(levels.shape[1] - columns, columns)
    ]
    best = min(areas, key=unlike)
    return Tile(best, best)


def spread_over(count: tuple[int, int], side: int) -> list[Tile]:
    """Squares all over a capture which are as many lenslets as a tile, together."""
    length = side // BESIDE
    places = [np.linspace(0, n - length, BESIDE).round().astype(int).tolist() for n in count]
    areas = [(slice(r, r + length), slice(c, c + length)) for r in places[0] for c in places[1]]
    return [Tile(area, area) for area in areas]


def _steps(most: int, side: int) -> list[int]:
    """Places from 0 to `most`, a quarter of a side apart or less."""
    return np.unique(np.linspace(0, most, -(-4 * most // side) + 1).round().astype(int)).tolist()


def counts(trace: Sequence[Entry]) -> np.ndarray:
    """What of a tile's trace adds up over a whole: defects dark, bright and known, clipped pixels,
    lenslets that have some, and what these were raised by, over their level, summed over pixels.
    """
    found = np.zeros(6)
    for entry in trace:
        if isinstance(entry, DefectsFound):
            found[:3] = entry.dark, entry.bright, entry.known
        elif isinstance(entry, SaturationFound):
            found[3:] = entry.pixels, entry.lenslets, (entry.raised or 0.0) * entry.pixels
    return found


def joined(
    sample: Reconstruction, counted: np.ndarray, size: int, *, declared: bool
) -> tuple[Entry, ...]:
    """The trace of a whole: that of the piece which stands for it, its counts those of all tiles.

    sample: of that piece.
    counted: (6,) sum of `counts`.
    size: pixels of all superpixels.
    declared: whether the capture says where its sensor saturates.
    """
    dark, bright, known, pixels, lenslets = (int(n) for n in counted[:5])
    rest = [e for e in sample.trace if not isinstance(e, (DefectsFound, SaturationFound))]
    looked = any(isinstance(entry, DefectsFound) for entry in sample.trace)
    found: list[Entry] = []
    if looked or dark + bright + known:
        found.append(DefectsFound(dark=dark, bright=bright, known=known, pixels=size))
    if pixels:
        found.append(
            SaturationFound(
                pixels=pixels,
                lenslets=lenslets,
                share=pixels / size,
                declared=declared,
                raised=float(counted[5]) / pixels if looked else None,
            )
        )
    return (*found, *rest)
