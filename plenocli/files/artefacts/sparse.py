"""A file in memory that keeps only what was written: the frame of an HDF5 file whose large
datasets go to the disk by themselves.
"""

import io
import os

PAGE = 1 << 12


class SparseFile(io.RawIOBase):
    """A seekable file of any size; pages never written read as zeros and cost nothing."""

    def __init__(self):
        self.pages, self.size, self._place = {}, 0, 0

    def readable(self):
        return True

    writable = seekable = readable

    def tell(self):
        return self._place

    def seek(self, offset, whence=os.SEEK_SET):
        self._place = (
            offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: self.size}[whence]
        )
        return self._place

    def truncate(self, size=None):
        self.size = self._place if size is None else size
        return self.size

    def write(self, data):
        view = memoryview(data).cast("B")
        for page, inside, part in self._parts(len(view)):
            self.pages.setdefault(page, bytearray(PAGE))[inside : inside + len(view[part])] = view[
                part
            ]
        self._place += len(view)
        self.size = max(self.size, self._place)
        return len(view)

    def readinto(self, buffer):
        view = memoryview(buffer).cast("B")
        view = view[: max(0, min(len(view), self.size - self._place))]
        for page, inside, part in self._parts(len(view)):
            length = len(view[part])
            view[part] = (
                self.pages[page][inside : inside + length] if page in self.pages else bytes(length)
            )
        self._place += len(view)
        return len(view)

    def _parts(self, length):
        """(page, place in it, slice of the data) of `length` bytes from the current place."""
        done = 0
        while done < length:
            page, inside = divmod(self._place + done, PAGE)
            step = min(PAGE - inside, length - done)
            yield page, inside, slice(done, done + step)
            done += step

    def extents(self):
        """(offset, bytes) of all that was written, ascending, cut at the size."""
        for page in sorted(self.pages):
            yield page * PAGE, memoryview(self.pages[page])[: max(0, self.size - page * PAGE)]
