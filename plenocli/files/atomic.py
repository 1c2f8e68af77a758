"""Results appear whole or not at all: temporary file beside the target, fsync, rename,
fsync of the folder.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from plenocli.base.errors import OutputError, UsageError, remedy


def check_output(
    path: str | os.PathLike,
    *,
    overwrite: bool = False,
    inputs: Iterable[str | os.PathLike | None] = (),
    suffixes: tuple[str, ...] = (),
) -> None:
    """Refuse an output path that cannot work, before any long computation.

    path: file to be written.
    overwrite: whether it may exist.
    inputs: files that are read, which it may not replace.
    suffixes: allowed ones; any where there are none.

    Raises UsageError if the file exists and `overwrite` is not set, or its suffix is none of
    `suffixes` (where given); OutputError if `path` is a folder or not an ordinary file, its name is
    impossible, its folder is missing or read-only, or it is one of `inputs`.
    """
    path = Path(path)
    folder = path.parent
    try:
        os.lstat(partial_path(path))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise OutputError(
            f"is no possible file name ({error.strerror})", path, "choose another name"
        ) from None
    if path.is_dir():
        raise OutputError("is a folder", path, "name a file for the result")
    if suffixes and path.suffix not in suffixes:
        raise UsageError(
            (
                f"the result is written as {' or '.join(suffixes)}, not "
                f"{path.suffix or 'without a suffix'}"
            ),
            path,
            "change the suffix of OUT",
        )
    if not folder.is_dir():
        raise OutputError(f"the folder {folder} does not exist", path, "make it first")
    if path.exists():
        for other in inputs:
            if other is not None and os.path.exists(other) and os.path.samefile(path, other):
                raise OutputError(
                    "is also an input of this command", path, "give the result another name"
                )
        if not path.is_file():
            raise OutputError("is not an ordinary file", path, "name a file for the result")
        if not overwrite:
            raise UsageError("exists already", path, "pass --overwrite or choose another name")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"the folder {folder} is read-only", path, "choose another folder")


def partial_path(path: str | os.PathLike) -> Path:
    """The temporary name used while `path` is written; always the same, so that the next run
    sweeps what a killed one left.
    """
    path = Path(path)
    return path.with_name(f".{path.name}.partial")


def publish(path: str | os.PathLike, data: Any, *, overwrite: bool = False) -> None:
    """Put bytes into a file so that a reader sees all of them or the file as it was.

    path: file to write.
    data: bytes, or a list of bytes-like pieces.
    overwrite: whether the file may exist.

    Raises UsageError if the file exists and `overwrite` is not set, OutputError if it cannot be
    written; the target is then untouched and nothing is left beside it.
    """
    pieces = [data] if isinstance(data, (bytes, bytearray, memoryview)) else data
    with replacement(path, overwrite=overwrite) as (_, descriptor):
        for piece in pieces:
            _write_all(descriptor, memoryview(piece).cast("B"))


@contextlib.contextmanager
def replacement(path: str | os.PathLike, *, overwrite: bool = False) -> Iterator[tuple[Path, int]]:
    """Yield (temporary path, open descriptor) of an empty file that takes the place of `path` when
    the block ends well.

    For libraries that write by name; they must write into the file that is there.
    Errors as `publish`.
    """
    path = Path(path)
    check_output(path, overwrite=overwrite)
    partial = partial_path(path)
    try:
        descriptor = _open_partial(partial)
    except OSError as error:
        raise OutputError(f"cannot be written ({error.strerror})", path, remedy(error)) from error
    try:
        yield partial, descriptor
        os.fsync(descriptor)
        if not overwrite and path.exists():
            raise UsageError(
                "appeared while the result was computed",
                path,
                "pass --overwrite or choose another name",
            )
        os.replace(partial, path)
        _sync_folder(path.parent)
    except OSError as error:
        raise OutputError(
            f"cannot be written ({error.strerror})",
            path,
            "free some space or choose another folder; what was there before is untouched",
        ) from error
    finally:
        if _is_same_file(descriptor, partial):
            partial.unlink(missing_ok=True)
        os.close(descriptor)


def _open_partial(partial: Path) -> int:
    """Open and lock the temporary file, empty.

    The lock keeps two runs with one target from mixing their bytes.
    """
    while True:
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise OutputError(
                    "another run is writing this file", partial, "wait for it, or stop it"
                ) from error
            # else the other run renamed it between our open and our lock
            if _is_same_file(descriptor, partial):
                _empty(descriptor, partial)
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)


def _empty(descriptor: int, partial: Path) -> None:
    try:
        os.ftruncate(descriptor, 0)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def _is_same_file(descriptor: int, path: Path) -> bool:
    try:
        there = os.lstat(path)
    except OSError:
        return False
    here = os.fstat(descriptor)
    return (here.st_dev, here.st_ino) == (there.st_dev, there.st_ino)


def _write_all(descriptor: int, view: memoryview) -> None:
    while view:
        view = view[os.write(descriptor, view[: 1 << 24]) :]


def write_at(descriptor: int, offset: int, data: Any) -> None:
    """Write all of `data` (bytes-like or a C-ordered array) at `offset` of an open file; short
    writes are continued.
    """
    view = memoryview(data)
    view = view.cast("B") if view.nbytes else view[:0]
    while view:
        done = os.pwrite(descriptor, view[: 1 << 24], offset)
        view, offset = view[done:], offset + done


def reserve(descriptor: int, size: int) -> None:
    """Make an open file `size` bytes long, with room for them on the disk where the file
    system can promise it.
    """
    os.ftruncate(descriptor, size)
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno not in (
            errno.EOPNOTSUPP,
            errno.EINVAL,
            errno.ENOSYS,
            errno.EBADF,
            errno.ENODEV,
        ):
            raise


def _sync_folder(folder: Path) -> None:
    """Make the rename survive a power cut.

    Some network file systems refuse this; the file is then whole all the same.
    """
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
