"""A plane of pixels or object points as blocks, one a lenslet, and back; lenslets tile the plane
from its first corner. And planes that are worked on in bands of rows or in tiles, and never all in
memory.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np


def to_blocks(plane: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A plane as the blocks that tile it.

    plane: (row, column), both whole numbers of blocks, or several, (band, row, column).
    shape: (rows, columns) of a block.

    Returns (lenslet_row, lenslet_column, sample), samples numbered row by row, those of one band
    after those of the other.
    """
    if plane.ndim == 3:
        return np.concatenate([to_blocks(one, shape) for one in plane], axis=2)
    rows, columns = plane.shape[0] // shape[0], plane.shape[1] // shape[1]
    return (
        plane.reshape(rows, shape[0], columns, shape[1])
        .swapaxes(1, 2)
        .reshape(rows, columns, shape[0] * shape[1])
    )


def to_plane(blocks: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The plane of blocks, the inverse of `to_blocks`.

    blocks: (lenslet_row, lenslet_column, sample), or two axes (rows, columns) for the samples.
    shape: (rows, columns) of a block.

    Returns (row, column); more samples than a block holds are several bands, and give
    (band, row, column).
    """
    rows, columns = blocks.shape[:2]
    if blocks.ndim == 3 and blocks.shape[2] > shape[0] * shape[1]:
        return np.stack(
            [
                to_plane(band, shape)
                for band in np.split(blocks, blocks.shape[2] // (shape[0] * shape[1]), axis=2)
            ]
        )
    return (
        blocks.reshape(rows, columns, *shape)
        .swapaxes(1, 2)
        .reshape(rows * shape[0], columns * shape[1])
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
        return np.concatenate(list(self.parts())).reshape(self.shape).astype(self.dtype, copy=False)


def bands(count: int, most: int) -> list[slice]:
    """Rows 0 to `count` in bands of `most` (at least one), the last of what is left."""
    most = max(1, most)
    return [slice(start, min(start + most, count)) for start in range(0, count, most)]


def mirrored(rows: slice, reach: int, count: int) -> np.ndarray:
    """Numbers of the rows of a band and of `reach` more on either side of it; beyond the first and
    the last of `count` rows they go back, each of these twice.
    """
    return np.pad(np.arange(count), reach, mode="symmetric")[rows.start : rows.stop + 2 * reach]


_Value = TypeVar("_Value")


@dataclass
class Whole:
    """What holds for all tiles of a whole, in the order in which it is asked for: known before, or
    worked out on a piece that stands for the whole.

    found: name -> values.
    """

    found: dict[str, list[Any]] = field(default_factory=dict)

    @contextlib.contextmanager
    def worked_out(self) -> Iterator[None]:
        """While the block lasts, `common` works out what is not known, and keeps it here."""
        known = {name: list(values) for name, values in self.found.items()}
        with _during(_Run(known, self.found)):
            yield

    @contextlib.contextmanager
    def taken_over(self) -> Iterator[None]:
        """While the block lasts, `common` gives what is kept here."""
        with _during(_Run(self.found)):
            yield

    @contextlib.contextmanager
    def compared(self, others: dict[str, list[Any]]) -> Iterator[None]:
        """The same; what the piece has by itself of what is put together is kept in `others`."""
        with _during(_Run(self.found, others)):
            yield

    def together(self, others: Sequence[dict[str, list[Any]]]) -> Whole:
        """With what `common` puts together of `others`, in place of the one piece's own."""
        found = {name: list(values) for name, values in self.found.items()}
        for name, values in found.items():
            for place in range(len(values)):
                beside = [o[name][place] for o in others if len(o.get(name, ())) > place]
                if beside:
                    values[place] = _joined(beside)
        return Whole(found)


def _joined(values: Sequence[Any]) -> Any:
    """The mean of numbers; arrays of several axes one after the other, along a last one."""
    if np.ndim(values[0]) < 2:
        return np.mean(values, axis=0)
    return np.concatenate([value.reshape(len(value), -1) for value in values], axis=1)


@dataclass
class _Run:
    """One piece that is worked on: what is known of the whole, where what it has by itself is kept,
    and how many values of each name were asked for.
    """

    known: dict[str, list[Any]]
    kept: dict[str, list[Any]] | None = None
    asked: dict[str, int] = field(default_factory=dict)

    def value(self, name: str, work: Callable[[], _Value], together: bool) -> _Value:
        place = self.asked.get(name, 0)
        self.asked[name] = place + 1
        known = self.known.get(name, [])
        # a piece may ask more often than that which stands for the whole did
        told: Any = known[min(place, len(known) - 1)] if known else None
        if known and (self.kept is None or not together):
            return told
        with _during(None):
            made = work()
        if self.kept is not None:
            self.kept.setdefault(name, []).append(made)
        return told if known else made


_run: ContextVar[_Run | None] = ContextVar("whole", default=None)


@contextlib.contextmanager
def _during(run: _Run | None) -> Iterator[None]:
    token = _run.set(run)
    try:
        yield
    finally:
        _run.reset(token)


def common(name: str, work: Callable[[], _Value], *, together: bool = False) -> _Value:
    """What `work` gives; of a tile, what it gave on the piece that stands for the whole.

    name: of the value. Where it is asked for several times, the order counts.
    together: whether several pieces stand for the whole better than one: the means of numbers
        (any,), or samples (kind, ..) of all of them.
    """
    run = _run.get()
    return work() if run is None else run.value(name, work, together)


def is_piece() -> bool:
    """Whether what is worked on is a piece of a whole."""
    return _run.get() is not None
