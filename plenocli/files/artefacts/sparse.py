"""A file in memory that keeps only what was written: the frame of an HDF5 file whose large
datasets go to the disk by themselves, or whose large writes do.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from typing import Any

from plenocli.files.atomic import write_at

PAGE = 1 << 12
LARGE = 1 << 16
"""Bytes that are written at once from which on they go to the disk, where there is one."""


class SparseFile(io.RawIOBase):
    """A seekable file of any size; pages never written read as zeros and cost nothing."""

    def __init__(self, descriptor: int | None = None, base: int = 0) -> None:
        """descriptor: of an open file that takes what is written LARGE bytes and more at a time,
        from its byte `base` on; None: everything stays in memory.

        What goes wrong with that file is kept in `failed`: HDF5 does not survive an error.
        """
        self.pages: dict[int, bytearray] = {}
        self.size, self._place = 0, 0
        self._descriptor, self._base = descriptor, base
        self._on_disk: list[range] = []
        self.failed: OSError | None = None

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
        head, large = 0, 0
        if self._descriptor is not None and len(view) >= LARGE:
            head = -self._place % PAGE
            large = (len(view) - head) // PAGE * PAGE
        self._keep(view[:head])
        self._spill(view[head : head + large])
        self._keep(view[head + large :])
        self.size = max(self.size, self._place)
        return len(view)

    def _keep(self, view: memoryview) -> None:
        for page, inside, part in self._parts(len(view)):
            if page not in self.pages:
                self.pages[page] = self._from_disk(page)
            self.pages[page][inside : inside + len(view[part])] = view[part]
        self._place += len(view)

    def _spill(self, view: memoryview) -> None:
        """Write whole pages to the disk, from the current place on."""
        if not view or self._descriptor is None:
            return
        pages = range(self._place // PAGE, (self._place + len(view)) // PAGE)
        for page in pages:
            self.pages.pop(page, None)
        try:
            write_at(self._descriptor, self._base + self._place, view)
        except OSError as error:
            self.failed = self.failed or error
        if self._on_disk and self._on_disk[-1].stop == pages.start:
            self._on_disk[-1] = range(self._on_disk[-1].start, pages.stop)
        else:
            self._on_disk.append(pages)
        self._place += len(view)

    def _from_disk(self, page: int) -> bytearray:
        """A page that is not in memory."""
        if self._descriptor is None or not any(page in pages for pages in self._on_disk):
            return bytearray(PAGE)
        try:
            found = os.pread(self._descriptor, PAGE, self._base + page * PAGE)
        except OSError as error:
            self.failed, found = self.failed or error, b""
        return bytearray(found.ljust(PAGE, b"\0"))

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        view = view[: max(0, min(len(view), self.size - self._place))]
        for page, inside, part in self._parts(len(view)):
            held = self.pages.get(page) or self._from_disk(page)
            view[part] = held[inside : inside + len(view[part])]
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


class Behind(io.RawIOBase):
    """A file that is read from its byte `base` on, through a descriptor that is open."""

    def __init__(self, descriptor: int, base: int) -> None:
        self._descriptor, self._base, self._place = descriptor, base, 0
        self._size = os.fstat(descriptor).st_size - base

    def readable(self) -> bool:
        return True

    seekable = readable

    def tell(self) -> int:
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        origin = {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self._size}[whence]
        self._place = origin + offset
        return self._place

    def readinto(self, buffer: Any) -> int:
        view, start = memoryview(buffer).cast("B"), self._place
        # HDF5 does not look how much came, and a call brings 2 GiB at most
        while view and (done := os.preadv(self._descriptor, [view], self._base + self._place)):
            self._place, view = self._place + done, view[done:]
        return self._place - start
