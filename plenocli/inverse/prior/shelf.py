"""Training pictures that are kept: in memory as long as there is room, then in a temporary file."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

IN_MEMORY = 1 << 30
"""Bytes of pictures that are held in memory; more go to a temporary file that is mapped, so that
thousands of pictures stream.
"""


class Shelf:
    """Keeps float32 arrays: in memory up to `limit` bytes (IN_MEMORY), the rest in a nameless
    temporary file.
    """

    def __init__(self, limit: int | None = None) -> None:
        self.limit, self.held = IN_MEMORY if limit is None else limit, 0
        self.file: BinaryIO | None = None

    def keep(self, values: np.ndarray) -> np.ndarray:
        """The array as float32, wherever it now lies."""
        values = np.asarray(values, np.float32)
        self.held += values.nbytes
        if self.held <= self.limit:
            return values
        if self.file is None:
            import tempfile
            import weakref

            self.file = tempfile.TemporaryFile()
            weakref.finalize(self, self.file.close)  # the mapped arrays keep what they need
        begin = self.file.seek(0, 2)
        self.file.write(np.ascontiguousarray(values).data)
        self.file.flush()
        return np.memmap(self.file, np.float32, "r", begin, values.shape)
