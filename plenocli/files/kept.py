"""What takes long to work out and is the same every time, kept from one run to the next.

It lies in the folder that PLENOCLI_CACHE names (`off`: nowhere), else in plenocli under
XDG_CACHE_HOME or ~/.cache; at most LARGEST bytes, what was not used for longest goes first. Names
are digests of all that values depend on. A file that is damaged, has another's name or another
owner, or a folder that cannot be written, only means that values are worked out as if nothing were
kept.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from plenocli import __version__
from plenocli.base.budget import linear_algebra
from plenocli.base.errors import PlenoError
from plenocli.files.atomic import publish

LARGEST = 2 << 30
"""Bytes that are kept."""
_SUFFIX = ".kept"


def folder() -> Path | None:
    """Where values are kept, None for nowhere."""
    named = os.environ.get("PLENOCLI_CACHE", "")
    if named:
        return None if named == "off" else Path(named)
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(home) / "plenocli" if os.path.isabs(home) else None


def kept(
    name: str, inputs: list[np.ndarray], make: Callable[[], tuple[np.ndarray, ...]]
) -> tuple[np.ndarray, ...]:
    """The float64 arrays of `make`, from an earlier run where that kept them.

    name: of the computation.
    inputs: all that it depends on, beside the code and the linear algebra of this process.
    make: works the arrays out.

    Returns them in C order, the same bytes either way.
    """
    path = _place(name, inputs)
    if path is None:
        return tuple(map(np.ascontiguousarray, make()))
    found = read_arrays(path)
    if found is None:
        found = tuple(map(np.ascontiguousarray, make()))
        _write(path, found)
    return found


def is_kept(name: str, inputs: list[np.ndarray]) -> bool:
    """Whether an earlier run kept what `kept` would make."""
    path = _place(name, inputs)
    return path is not None and path.exists()


def _place(name: str, inputs: list[np.ndarray]) -> Path | None:
    place = folder()
    return None if place is None else place / (_digest(name, inputs) + _SUFFIX)


def write_arrays(path: Path, arrays: tuple[np.ndarray, ...]) -> None:
    """Put float64 arrays, in C order, into a file, whole or not at all. Raises OutputError."""
    head = json.dumps([_sum(path, arrays), [values.shape for values in arrays]]) + "\n"
    publish(path, [head.encode(), *arrays], overwrite=True, for_good=False)


def _digest(name: str, inputs: list[np.ndarray]) -> str:
    loaded = [library for library in linear_algebra().info() if library["user_api"] == "blas"]
    own = [library for library in loaded if "numpy" in library["filepath"]] or loaded
    machine = [{**library, "filepath": ""} for library in own]
    digest = hashlib.sha256(
        json.dumps([name, __version__, np.__version__, machine], sort_keys=True).encode()
    )
    for values in inputs:
        digest.update(f"{values.dtype.str} {values.shape}\n".encode())
        digest.update(np.ascontiguousarray(values).data)
    return digest.hexdigest()


def _sum(path: Path, arrays: tuple[np.ndarray, ...]) -> int:
    """What damage would change: ten times as fast as a digest."""
    from isal import isal_zlib

    total = isal_zlib.crc32(path.name.encode())
    for values in arrays:
        total = isal_zlib.crc32(values.data, total)
    return total


def read_arrays(path: Path) -> tuple[np.ndarray, ...] | None:
    """The float64 arrays that `write_arrays` put into a file, None where it is missing,
    damaged, under another name or somebody else's.
    """
    try:
        with open(path, "rb") as file:
            total, shapes = json.loads(file.readline(4096))
            size, about = sum(8 * int(np.prod(s)) for s in shapes), os.fstat(file.fileno())
            if about.st_size != file.tell() + size or about.st_uid != os.geteuid():
                return None
            arrays = tuple(
                np.fromfile(file, np.float64, int(np.prod(shape))).reshape(shape)
                for shape in shapes
            )
        if _sum(path, arrays) != total:
            return None
    except (OSError, ValueError, TypeError):
        return None
    with contextlib.suppress(OSError):
        os.utime(path)
    return arrays


def _write(path: Path, arrays: tuple[np.ndarray, ...]) -> None:
    """Keep arrays, and make room for them, where that is possible."""
    size = sum(values.nbytes for values in arrays)
    if size > LARGEST:
        return
    with contextlib.suppress(OSError, PlenoError):
        path.parent.mkdir(parents=True, exist_ok=True)
        held = [(f.stat().st_mtime, f.stat().st_size, f) for f in path.parent.glob(f"*{_SUFFIX}")]
        room = LARGEST - size
        for _, bytes_of, file in sorted(held, reverse=True):
            room -= bytes_of
            if room < 0:
                file.unlink(missing_ok=True)
        write_arrays(path, arrays)
