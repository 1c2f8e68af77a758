"""What is finished of a result that is not."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli import __version__
from plenocli.base.errors import OutputError
from plenocli.files.kept import read_arrays, write_arrays


@dataclass(frozen=True)
class Bench:
    """A folder of finished tiles of a result, which lies beside it and has a name of all that they
    depend on: a run that was killed goes on from them.
    """

    folder: Path

    @classmethod
    def beside(cls, target: Path, depends: Any) -> Bench:
        """That of the result `target`; those of other runs towards it go.

        depends: all that tiles depend on, beside the code; its repr counts.

        Raises OutputError where it cannot be made.
        """
        digest = hashlib.sha256(f"{__version__} {depends!r}".encode()).hexdigest()[:16]
        folder = target.with_name(f".{target.name}.{digest}.tiles")
        for other in target.parent.glob(f".{target.name}.*.tiles"):
            if other != folder:
                shutil.rmtree(other, ignore_errors=True)
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"the folder of its tiles cannot be made ({error.strerror})", target
            ) from error
        return cls(folder)

    def path(self, number: int) -> Path:
        """Of a tile's file."""
        return self.folder / f"{number:06d}"

    def get(self, number: int) -> tuple[np.ndarray, ...] | None:
        """The arrays of a tile, None of one that is not finished."""
        return read_arrays(self.path(number))

    def put(self, number: int, arrays: Sequence[np.ndarray]) -> None:
        """Keep a finished tile."""
        write_arrays(self.path(number), tuple(np.ascontiguousarray(a, float) for a in arrays))

    def remove(self) -> None:
        """Its tiles are no longer needed."""
        shutil.rmtree(self.folder, ignore_errors=True)
