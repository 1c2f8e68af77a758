"""A file in memory that keeps only what was written: the frame of an HDF5 file whose large
datasets go to the disk by themselves.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from typing import Any

PAGE = 1 << 12


class SparseFile(io.RawIOBase):
    """A seekable file of any size; pages never written read as zeros and cost nothing."""

    def __init__(self) -> None:
        self.pages: dict[int, bytearray] = {}
        self.size, self._place = 0, 0

    def readable(self) -> bool:
        return True

    writable = seekable = readable

    def tell(self) -> int:
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        self._place = (
            offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.size}[whence]
        )
        return self._place

    def truncate(self, size: int | None = None) -> int:
        self.size = self._place if size is None else size
        return self.size

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        for page, inside, part in self._parts(len(view)):
            self.pages.setdefault(page, bytearray(PAGE))[inside : inside + len(view[part])] = view[
                part
            ]
        self._place += len(view)
        self.size = max(self.size, self._place)
        return len(view)

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        view = view[: max(0, min(len(view), self.size - self._place))]
        for page, inside, part in self._parts(len(view)):
            length = len(view[part])
            view[part] = (
                self.pages[page][inside : inside + length] if page in self.pages else bytes(length)
            )
        self._place += len(view)
        return len(view)

    def _parts(self, length: int) -> Iterator[tuple[int, int, slice]]:
        """(page, place in it, slice of the data) of `length` bytes from the current place."""
        done = 0
        while done < length:
            page, inside = divmod(self._place + done, PAGE)
            step = min(PAGE - inside, length - done)
            yield page, inside, slice(done, done + step)
            done += step

    def extents(self) -> Iterator[tuple[int, memoryview]]:
        """(offset, bytes) of all that was written, ascending, cut at the size."""
        for page in sorted(self.pages):
            yield page * PAGE, memoryview(self.pages[page])[: max(0, self.size - page * PAGE)]
