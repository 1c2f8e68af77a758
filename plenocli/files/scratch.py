"""Pictures that are made in bands of rows and may not fit the memory: in a nameless file until they
are written.
"""

from __future__ import annotations

import contextlib
import math
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Any

import numpy as np

from plenocli.base.errors import OutputError
from plenocli.base.tiling import BAND, InParts, bands
from plenocli.files.atomic import write_at

DTYPE = np.dtype(np.float32)


@dataclass(frozen=True, kw_only=True)
class ScratchRows(InParts):
    """InParts into which rows of the last two axes are put first, in any order, by an index that
    ends with a slice of rows. Errors as Scratch.

    scratch: where they are.
    begin: byte of its file.
    """

    scratch: Scratch
    begin: int

    def __setitem__(self, index: Any, values: np.ndarray) -> None:
        *lead, rows = index if isinstance(index, tuple) else (index,)
        numbers = np.arange(math.prod(self.shape[:-2])).reshape(self.shape[:-2])[tuple(lead)]
        planes = np.ascontiguousarray(values, DTYPE).reshape(numbers.size, -1, self.shape[-1])
        for number, plane in zip(numbers.ravel(), planes):
            first = (int(number) * self.shape[-2] + rows.start) * self.shape[-1]
            with self.scratch.told():
                write_at(self.scratch.file.fileno(), self.begin + first * DTYPE.itemsize, plane)


class Scratch:
    """Room for pictures of float32, (..., row, column), by their shapes.

    where: the result, in whose folder the file is.

    Raises OutputError where that cannot be made or written.
    """

    def __init__(self, where: Path) -> None:
        self.where, self._size = where, 0
        with self.told():
            self.file: IO[bytes] = tempfile.TemporaryFile(dir=where.parent)
        weakref.finalize(self, self.file.close)

    def __call__(self, shape: tuple[int, ...]) -> ScratchRows:
        begin = self._size
        self._size += math.prod(shape) * DTYPE.itemsize
        parts = partial(self._read, shape, begin)
        return ScratchRows(shape=shape, dtype=DTYPE, parts=parts, scratch=self, begin=begin)

    def _read(self, shape: tuple[int, ...], begin: int) -> Iterator[np.ndarray]:
        self.file.seek(begin)
        for _ in range(math.prod(shape[:-2])):
            for rows in bands(shape[-2], BAND // shape[-1]):
                count = (rows.stop - rows.start) * shape[-1]
                with self.told():
                    values = np.frombuffer(self.file.read(count * DTYPE.itemsize), DTYPE)
                yield values.reshape(-1, shape[-1])

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
