"""Pictures that decoders send in bands of rows: put together in memory, or, where they are large
beside it, in a file.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane, Room

DECODED = 1 << 22
"""Bytes of a band of rows that a decoder sends, at most, about."""
SHARE = 16
"""Of the memory, one part: pictures up to that are held."""
FURTHEST = 1e100
"""Of the largest value of a capture from 1, in either direction."""
_FIX = "make or copy it again"


def rows_of(line: int) -> int:
    """Rows of a band that a decoder sends; line: bytes of one."""
    return max(1, min(DECODED, budget().memory // (4 * SHARE)) // line)


def whole_bands(
    path: str | os.PathLike[str], parts: Iterable[Any], shape: tuple[int, ...], count: int = 1
) -> Iterator[np.ndarray]:
    """Bands of rows that a decoder sends; InputError where they are not those of `count` pictures
    of a shape (row, column, ...), one after the other.
    """
    rows = 0
    for part in parts:
        fits = isinstance(part, np.ndarray) and part.shape[1:] == shape[1:]
        fits = fits and 0 < len(part) <= shape[0] - rows % shape[0]
        rows += len(part) if fits else 0
        if not fits or rows > count * shape[0]:
            break
        yield part
    else:
        if rows == count * shape[0]:
            return
    raise InputError("came back incomplete from its decoder", path, _FIX)


def put_together(
    parts: Iterable[np.ndarray],
    shape: tuple[int, ...],
    room: Room | None = None,
    count: int = 1,
) -> np.ndarray | Plane:
    """The picture of all bands of rows, or the mean of `count` pictures, one after the other.

    shape: (row, column), or with channels behind them where it is held.
    room: where it is put if it is more than a SHARE of the memory; None: it is held in any case.

    Raises what parts raise; NumericsError or OutputError where there is no room.
    """
    kept: Any = None
    is_held, row = True, 0
    for part in parts:
        picture, top = divmod(row, shape[0])
        rows, row = slice(top, top + len(part)), row + len(part)
        if count > 1:
            part = _summed(part, kept[rows] if picture else 0, count if picture == count - 1 else 1)
        if kept is None:
            is_held = room is None or math.prod(shape) * part.itemsize <= budget().memory // SHARE
            kept = np.empty(shape, part.dtype) if is_held else _there(room)(shape, part.dtype)
        kept[rows] = part
    return kept if is_held else Plane((shape[0], shape[1]), lambda *window: kept[window])


def _summed(part: np.ndarray, before: Any, over: int) -> np.ndarray:
    """A band added to those before it, as np.mean does it."""
    exact = np.float32 if part.dtype.kind == "f" and part.itemsize < 8 else np.float64
    return np.asarray((before + part.astype(exact)) / exact(over))


def _there(room: Room | None) -> Room:
    assert room is not None
    return room


def sound(path: Path, parts: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The same bands; InputError behind the last for values that no sensor reports."""
    unknown, most = 0, 0.0
    for part in parts:
        known = np.isfinite(part) if part.dtype.kind == "f" else None
        lost = 0 if known is None else int(known.size - known.sum())
        unknown += lost
        if not lost and part.size:
            most = max(most, abs(float(part.max())), abs(float(part.min())))
        yield part
    if unknown:
        raise InputError(f"holds {unknown} values that are NaN or infinite", path, "make it again")
    if most and not 1 / FURTHEST < most < FURTHEST:
        raise InputError(
            f"has values up to {most:.3g}, whose squares no number holds",
            path,
            "divide it by its white level; a unit changes nothing else",
        )


def require_sound(path: Path, parts: Iterable[np.ndarray]) -> None:
    """InputError for values that no sensor reports, in any of some bands."""
    for _ in sound(path, parts):
        pass
