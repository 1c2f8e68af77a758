"""A plane of pixels or object points as blocks, one a lenslet, and back; lenslets tile the plane
from its first corner. And planes that are worked on in bands of rows or in tiles, and never all in
memory.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.budget import spread
from plenocli.base.device import namespace

T = TypeVar("T")
BAND, LEAST = 1 << 18, 16
"""Points of a band of a Plane, about, and its rows at least."""


def to_blocks(plane: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A plane as the blocks that tile it.

    plane: (row, column), both whole numbers of blocks, or several, (band, row, column).
    shape: (rows, columns) of a block.

    Returns (lenslet_row, lenslet_column, sample), samples numbered row by row, those of one band
    after those of the other.
    """
    xp = namespace(plane)
    if plane.ndim == 3:
        bands = (to_blocks(plane[k, ...], shape) for k in range(plane.shape[0]))
        return xp.concat(list(bands), axis=2)
    rows, columns = plane.shape[0] // shape[0], plane.shape[1] // shape[1]
    parts = xp.reshape(plane, (rows, shape[0], columns, shape[1]))
    return xp.reshape(xp.permute_dims(parts, (0, 2, 1, 3)), (rows, columns, shape[0] * shape[1]))


def to_plane(blocks: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The plane of blocks, the inverse of `to_blocks`.

    blocks: (lenslet_row, lenslet_column, sample), or two axes (rows, columns) for the samples.
    shape: (rows, columns) of a block.

    Returns (row, column); more samples than a block holds are several bands, and give
    (band, row, column).
    """
    xp, (rows, columns), size = namespace(blocks), blocks.shape[:2], shape[0] * shape[1]
    if blocks.ndim == 3 and blocks.shape[2] > size:
        bands = range(0, blocks.shape[2], size)
        return xp.stack([to_plane(blocks[:, :, at : at + size], shape) for at in bands])
    parts = xp.permute_dims(xp.reshape(blocks, (rows, columns, *shape)), (0, 2, 1, 3))
    return xp.reshape(parts, (rows * shape[0], columns * shape[1]))


def in_lenslets(cells: np.ndarray, several: int) -> np.ndarray:
    """(row, column, sample) of cells as those of their `several` lenslets, one below the other."""
    rows, columns, _ = cells.shape
    parts = cells.reshape(rows, columns, several, -1).swapaxes(1, 2)
    return parts.reshape(rows * several, columns, -1)


def in_cells(lenslets: np.ndarray, several: int) -> np.ndarray:
    """The inverse of `in_lenslets`; what the last row of cells lacks is zero."""
    if several == 1:
        return lenslets
    rows, columns, samples = lenslets.shape
    whole = np.pad(lenslets, ((0, -rows % several), (0, 0), (0, 0)))
    return (
        whole.reshape(-1, several, columns, samples)
        .swapaxes(1, 2)
        .reshape(-1, columns, several * samples)
    )


@dataclass(frozen=True, kw_only=True)
class InParts:
    """An array that comes in bands of rows while it is written or read.

    shape, dtype: of all of it.
    parts: gives rows of its last two axes that follow each other, (row, column), of one plane after
        the other; a part does not reach into the next plane.
    """

    shape: tuple[int, ...]
    dtype: Any
    parts: Callable[[], Iterable[np.ndarray]]

    def whole(self) -> np.ndarray:
        """All of it, in memory."""
        out = np.empty(self.shape, self.dtype)
        self.put_into(out)
        return out

    def put_into(self, out: np.ndarray) -> None:
        """All of it into an array of its shape, of which planes are views."""
        planes, at, height = out.reshape(-1, *self.shape[-2:]), 0, self.shape[-2]
        for part in self.parts():
            plane, row = divmod(at, height)
            planes[plane, row : row + len(part)] = part
            at += len(part)
        if at != len(planes) * height:
            raise ValueError(f"{at} rows are not those of {self.shape}")


def by_plane(values: np.ndarray | InParts) -> Iterator[np.ndarray]:
    """Its planes, (row, column) each, one after the other."""
    height, width = values.shape[-2:]
    if not isinstance(values, InParts):
        yield from values.reshape(-1, height, width)
        return
    plane, top = np.empty((height, width), values.dtype), 0
    for part in values.parts():
        plane[top : top + len(part)] = part
        top += len(part)
        if top == height:
            yield plane
            plane, top = np.empty((height, width), values.dtype), 0


EVERYTHING = slice(None)

Room = Callable[..., Any]
"""What gives room for values of a shape, and of a dtype if one is named, put and looked at by
slices: np.empty, or a file beside a result (plenocli.files.scratch.Scratch).
"""


class Keeper(Protocol):
    """What keeps the arrays of finished tiles by their names, for a run that comes after one that
    was killed.
    """

    def get(self, tile: str) -> Sequence[np.ndarray] | None:
        """The arrays of a tile, None of one that is not finished."""
        ...

    def put(self, tile: str, arrays: Sequence[np.ndarray]) -> None:
        """Keep a finished tile, as float64."""
        ...

    def under(self, name: str) -> Keeper:
        """That of other tiles, which may be called as those here are."""
        ...


class _Forgetful:
    """A Keeper that keeps nothing."""

    def get(self, tile: str) -> None:
        """None."""

    def put(self, tile: str, arrays: Sequence[np.ndarray]) -> None:
        """Forget it."""

    def under(self, name: str) -> _Forgetful:
        """The same."""
        return self


FORGETFUL: Keeper = _Forgetful()
"""Keeps nothing."""


def kept(
    keeper: Keeper, tile: str, make: Callable[[], Sequence[np.ndarray]]
) -> Sequence[np.ndarray]:
    """The arrays of a tile: as an earlier run left them, else as they are made, which is left."""
    found = keeper.get(tile)
    if found is None:
        found = make()
        keeper.put(tile, found)
    return found


@dataclass(frozen=True)
class Plane:
    """A picture that is read in windows, because it may not fit the memory.

    shape: of all of it, (..., row, column).
    read: gives a window by its rows and columns, slices without a step.
    """

    shape: tuple[int, ...]
    read: Callable[[slice, slice], np.ndarray]

    @classmethod
    def of(cls, values: ArrayLike | Plane) -> Plane:
        """That of an array; a Plane is one already."""
        if isinstance(values, Plane):
            return values
        array = np.asarray(values)
        return cls(array.shape, lambda rows, columns: array[..., rows, columns])

    def window(self, rows: slice = EVERYTHING, columns: slice = EVERYTHING) -> np.ndarray:
        """A part of the last two axes, float64."""
        return np.asarray(self.read(rows, columns), dtype=np.float64)

    def through(self, change: Callable[[np.ndarray], np.ndarray]) -> Plane:
        """The plane of what `change`, which works point by point, makes of windows."""
        return Plane(self.shape, lambda rows, columns: change(self.window(rows, columns)))

    def in_bands(self, multiple: int = 1) -> list[slice]:
        """Rows of bands that are worked on one after the other.

        multiple: whole numbers of so many rows; the last band may have less.
        """
        points = math.prod(self.shape) // max(self.shape[-2], 1)
        most = max(BAND // max(points, 1), LEAST) // multiple * multiple
        found = bands(self.shape[-2], max(most, multiple))
        if len(found) > 1 and found[-1].stop - found[-1].start < LEAST:
            found[-2:] = [slice(found[-2].start, found[-1].stop)]
        return found


def bands(count: int, most: int) -> list[slice]:
    """Rows 0 to `count` in bands of `most` (at least one), the last of what is left."""
    most = max(1, most)
    return [slice(start, min(start + most, count)) for start in range(0, count, most)]


def even_bands(count: int, most: int) -> list[slice]:
    """As few bands as `bands` gives, as long as each other."""
    return bands(count, -(-count // max(1, len(bands(count, most)))))


def spread_bands(count: int, most: int, work: Callable[[slice], object]) -> None:
    """work(rows) for `even_bands` of 0 to `count`, on as many threads as the budget has."""
    spread([(rows,) for rows in even_bands(count, most)], work)


def windows(blocks: Iterable[np.ndarray], wanted: Iterable[slice]) -> Iterator[np.ndarray]:
    """Rows of what comes in blocks of rows, (..., row, column), each block after the one before.

    blocks: asked for as they are needed; no more rows are held than that takes.
    wanted: rows, of which neither end goes back and none is left out between two.
    """
    coming, held, top = iter(blocks), None, 0
    for rows in wanted:
        parts: list[np.ndarray] = [] if held is None else [held[..., max(rows.start - top, 0) :, :]]
        top = rows.start if held is not None else top
        while top + sum(part.shape[-2] for part in parts) < rows.stop:
            parts.append(next(coming))
        held = parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-2)
        yield held[..., rows.start - top : rows.stop - top, :]


def around(
    blocks: Iterable[np.ndarray], own: Sequence[slice], reach: int
) -> Iterator[tuple[slice, np.ndarray]]:
    """Bands of what comes in blocks of rows, as `windows`, with `reach` rows more on either side as
    far as there are any; and which rows of these are the band's own.

    own: rows of each band; they follow each other from the first row to the last.
    """
    wide = [widened(rows, reach, own[-1].stop) for rows in own]
    for rows, more, part in zip(own, wide, windows(blocks, wide)):
        yield slice(rows.start - more.start, rows.stop - more.start), part


def shared(items: Iterable[T], count: int) -> list[Iterator[T]]:
    """The same items for each of `count` who ask for them in turn. As itertools.tee, which keeps
    dozens that nobody waits for any more; here only those are held that some have not had.
    """
    coming, waiting = iter(items), [deque[T]() for _ in range(count)]

    def own(mine: deque[T]) -> Iterator[T]:
        while True:
            if not mine:
                item = list(islice(coming, 1))
                for other in waiting:
                    other.extend(item)
                if not item:
                    return
                item.clear()
            yield mine.popleft()

    return [own(mine) for mine in waiting]


def widened(rows: slice, reach: int, count: int) -> slice:
    """Rows and `reach` more on either side, as far as there are `count` of them."""
    return slice(max(rows.start - reach, 0), min(rows.stop + reach, count))


def mirrored(rows: slice, reach: int, count: int) -> np.ndarray:
    """Numbers of the rows of a band and of `reach` more on either side of it; beyond the first and
    the last of `count` rows they go back, each of these twice.
    """
    return np.pad(np.arange(count), reach, mode="symmetric")[rows.start : rows.stop + 2 * reach]
