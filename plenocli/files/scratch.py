"""Pictures that are made or read bit by bit and may not fit the memory: in a nameless file as long
as they are worked on, or in one on a bench, where a later run finds them.
"""

from __future__ import annotations

import contextlib
import errno
import math
import os
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from plenocli.base.errors import OutputError
from plenocli.base.tiling import BAND, EVERYTHING, InParts, bands
from plenocli.files.atomic import write_at
from plenocli.files.bench import Bench

DTYPE = np.dtype(np.float32)
_STAYS = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC


@dataclass(frozen=True, kw_only=True)
class ScratchRows(InParts):
    """InParts of which rows of the last two axes are put and looked at first, in any order, by an
    index that ends with a slice of rows, or of rows and of columns; zero where nothing was put, in
    a file on a bench by no run before either. Errors as Scratch.

    scratch: where they are.
    begin: byte of its file.
    """

    scratch: Scratch
    begin: int

    def __setitem__(self, index: Any, values: np.ndarray) -> None:
        shape, runs = self._runs(index)
        whole = np.broadcast_to(np.asarray(values, self.dtype), shape)
        lines = np.ascontiguousarray(whole).reshape(len(runs), -1)
        for first, line in zip(runs, lines):
            with self.scratch.told():
                write_at(self.scratch.file.fileno(), first, line)

    def __getitem__(self, index: Any) -> np.ndarray:
        shape, runs = self._runs(index)
        values = np.empty(shape, self.dtype)
        for first, line in zip(runs, values.reshape(len(runs), -1)):
            self.scratch.read_into(line, first)
        return values

    def _runs(self, index: Any) -> tuple[tuple[int, ...], list[int]]:
        """The shape of what an index means, and the byte where each run of it begins in the file,
        all of one length: rows that are whole lie one after the other.
        """
        sides = [*index] if isinstance(index, tuple) else [index]
        if len(sides) < len(self.shape):
            sides.append(EVERYTHING)
        *lead, rows, columns = sides
        height, width = self.shape[-2:]
        planes = np.arange(math.prod(self.shape[:-2])).reshape(self.shape[:-2])[tuple(lead)]
        (top, bottom, _), (left, right, _) = rows.indices(height), columns.indices(width)
        starts = np.arange(top, bottom) if right - left < width else np.arange(top, bottom)[:1]
        lines = np.add.outer(planes.ravel() * height, starts).ravel() * width + left
        shape = *planes.shape, bottom - top, right - left
        return shape, (self.begin + lines * self.dtype.itemsize).tolist()


class Scratch:
    """Room for pictures (..., row, column) by their shapes, of float32 or another dtype.

    where: the result, in whose folder the file is.
    bench: where the file has a name and stays, so that a later run that asks for the same shapes
        finds there what was put.

    Raises OutputError where that cannot be made or written.
    """

    def __init__(self, where: Path, bench: Bench | None = None) -> None:
        self.where, self._bench, self._size = where, bench, 0

    @cached_property
    def file(self) -> IO[bytes]:
        """Opened once there are pictures, so that a run that fails before leaves nothing."""
        if self._bench is not None:
            self._bench.make()
        with self.told():
            file = (
                tempfile.TemporaryFile(dir=self.where.parent)
                if self._bench is None
                else open(os.open(self._bench.path("pictures"), _STAYS, 0o600), "r+b")
            )
        weakref.finalize(self, file.close)
        return file

    def __call__(self, shape: tuple[int, ...], dtype: np.dtype = DTYPE) -> ScratchRows:
        begin = self._size
        self._size += math.prod(shape) * dtype.itemsize
        with self.told():
            if os.fstat(self.file.fileno()).st_size < self._size:
                os.ftruncate(self.file.fileno(), self._size)
        parts = partial(self._read, shape, dtype, begin)
        return ScratchRows(shape=shape, dtype=dtype, parts=parts, scratch=self, begin=begin)

    def _read(self, shape: tuple[int, ...], dtype: np.dtype, begin: int) -> Iterator[np.ndarray]:
        for _ in range(math.prod(shape[:-2])):
            for rows in bands(shape[-2], BAND // shape[-1]):
                values = np.empty((rows.stop - rows.start, shape[-1]), dtype)
                self.read_into(values, begin)
                begin += values.nbytes
                yield values

    def read_into(self, values: np.ndarray, begin: int) -> None:
        """Fill an array, C-ordered, with what is in the file from a byte on."""
        view = values.data.cast("B")
        with self.told():
            while view:
                done = os.preadv(self.file.fileno(), [view], begin)
                if not done:
                    raise OSError(errno.EIO, "it was cut short")
                view, begin = view[done:], begin + done

    @contextlib.contextmanager
    def told(self) -> Iterator[None]:
        """OSError within the block becomes the OutputError."""
        try:
            yield
        except OSError as error:
            raise OutputError(
                f"its pictures cannot be kept beside it ({error.strerror})",
                self.where,
                "free some space or choose another folder",
            ) from error
