"""An artefact whose large dataset is written while it is computed: the same bytes as if it had
been held in memory.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from plenocli.files.artefacts.container import HEADER_BYTES, Artefact
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.writing import Frame, _frame, seal
from plenocli.files.atomic import replacement, write_at


class Stream:
    """An open artefact with one raw dataset, `name`, of `shape` and `dtype`,
    that comes in pieces.
    """

    def __init__(
        self, descriptor: int, kind: str, name: str, shape: tuple[int, ...], dtype: Any
    ) -> None:
        self.name, self.shape, self.dtype = name, tuple(shape), np.dtype(dtype)
        self._descriptor, self._entry = descriptor, SCHEMAS[kind].field_for(name)
        # the frame is known only at the end, but raw datasets come first in it
        self._offset = (
            HEADER_BYTES + _frame(SCHEMAS[kind], {}, {name: (self.shape, self.dtype)}, {})[1][name]
        )
        self._missing = int(np.prod(self.shape))
        self._closed = False

    def put(self, index: tuple[int, ...], values: np.ndarray) -> None:
        """Write the part of the dataset at `index`, whole numbers for its leading axes.

        ValueError where the table forbids the values.
        """
        values = np.ascontiguousarray(values, self.dtype)
        rest = self.shape[len(index) :]
        if values.shape != rest:
            raise ValueError(f"'{self.name}' at {index} takes {rest}, not {values.shape}")
        low, high = values.min(), values.max()
        least = self._entry and self._entry.minimum
        if not np.isfinite(low + high) or (least is not None and low < least):
            raise ValueError(f"'{self.name}' at {index} holds values from {low:.6g} to {high:.6g}")
        start = (
            int(np.ravel_multi_index(index, self.shape[: len(index)])) * values.size if index else 0
        )
        write_at(self._descriptor, self._offset + start * self.dtype.itemsize, values)
        self._missing -= values.size

    def close(self, artefact: Artefact) -> None:
        """Add everything else, an Artefact without the streamed dataset, and seal the file.

        ValueError as write_artefact.
        """
        if self._missing:
            raise ValueError(f"'{self.name}' lacks {self._missing} values")
        frame = Frame(artefact, {self.name: (self.shape, self.dtype)})
        if frame.offset(self.name) != self._offset:
            raise ValueError(
                f"the place of '{self.name}' in the file depends on more than its size"
            )
        frame.write(self._descriptor)
        for name, values in frame.raw.items():
            write_at(self._descriptor, frame.offset(name), values)
        seal(self._descriptor, frame.size)
        self._closed = True


@contextlib.contextmanager
def streamed_artefact(
    path: str | os.PathLike,
    kind: str,
    name: str,
    shape: tuple[int, ...],
    dtype: Any,
    *,
    overwrite: bool = False,
) -> Iterator[Stream]:
    """Yield a Stream into an artefact that appears at `path` when the block ends well, after
    `close`; errors as write_artefact.
    """
    with replacement(path, overwrite=overwrite) as (_, descriptor):
        stream = Stream(descriptor, kind, name, shape, dtype)
        yield stream
        if not stream._closed:
            raise ValueError(f"the artefact at {path} was not closed")
