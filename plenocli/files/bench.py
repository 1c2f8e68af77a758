"""What is finished of a result that is not."""

from __future__ import annotations

import glob
import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plenocli import __version__
from plenocli.base.errors import OutputError
from plenocli.files.kept import read_arrays, write_arrays

DIGITS = 16
"""Of the digest in a folder's name."""


@dataclass(frozen=True)
class Bench:
    """A folder of finished tiles of a result, which lies beside it and has a name of all that they
    depend on: a run that was killed goes on from them. It is there once a tile is.

    folder: of the tiles.
    target: the result, for messages.
    prefix: of the names of tiles.
    """

    folder: Path
    target: Path
    prefix: str = ""

    @classmethod
    def beside(cls, target: Path, depends: Any) -> Bench:
        """That of the result `target`; those of other runs towards it go.

        depends: all that tiles depend on, beside the code; its repr counts.
        """
        digest = hashlib.sha256(f"{__version__} {depends!r}".encode()).hexdigest()[:DIGITS]
        folder = target.with_name(f".{target.name}.{digest}.tiles")
        clear(target, but=folder)
        return cls(folder, target)

    def under(self, name: str) -> Bench:
        """That of other tiles in the same folder, which may be called as those here are."""
        return replace(self, prefix=f"{self.prefix}{name}.")

    def path(self, tile: int | str) -> Path:
        """Of a tile's file, by its number or name."""
        name = f"{tile:06d}" if isinstance(tile, int) else tile
        return self.folder / f"{self.prefix}{name}"

    def get(self, tile: int | str) -> tuple[np.ndarray, ...] | None:
        """The arrays of a tile, None of one that is not finished."""
        return read_arrays(self.path(tile))

    def put(self, tile: int | str, arrays: Sequence[np.ndarray]) -> None:
        """Keep a finished tile. Raises OutputError."""
        self.make()
        write_arrays(self.path(tile), tuple(np.ascontiguousarray(a, float) for a in arrays))

    def make(self) -> None:
        """Make its folder, where it is not there yet. Raises OutputError."""
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"the folder of its tiles cannot be made ({error.strerror})", self.target
            ) from error


def clear(target: Path, but: Path | None = None) -> None:
    """Remove the folders of tiles of a result, which is written, or of other runs towards it.

    but: the one that is needed.
    """
    digest = "[0-9a-f]" * DIGITS  # and not *, which results of longer names have
    for folder in target.parent.glob(f".{glob.escape(target.name)}.{digest}.tiles"):
        if folder != but:
            shutil.rmtree(folder, ignore_errors=True)
