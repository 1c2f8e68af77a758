"""Results appear whole or not at all: temporary file beside the target, fsync, rename,
fsync of the folder; the several results of one command together (`together`).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plenocli.base.errors import OutputError, UsageError, remedy


def check_output(
    path: str | os.PathLike,
    *,
    overwrite: bool = False,
    inputs: Iterable[str | os.PathLike | None] = (),
    others: Iterable[str | os.PathLike | None] = (),
    suffixes: tuple[str, ...] = (),
) -> None:
    """Refuse an output path that cannot work, before any long computation.

    path: file to be written; of a link, what it leads to is written.
    overwrite: whether it may exist.
    inputs: files that are read, which it may not replace.
    others: files that the same command writes too.
    suffixes: allowed ones; any where there are none.

    Raises UsageError if the file exists and `overwrite` is not set, it is one of `others`, or its
    suffix is none of `suffixes` (where given); OutputError if `path` is a folder or not an ordinary
    file, its name is impossible, its folder is missing or read-only, or it is one of `inputs`.
    """
    settle(path)
    path, target = Path(path), _target(path)
    folder = target.parent
    try:
        os.lstat(partial_path(target))
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise OutputError(
            f"is no possible file name ({error.strerror})", path, "choose another name"
        ) from None
    if target.is_symlink():
        raise OutputError("is a link that leads nowhere", path, "remove it or name a file")
    if target.is_dir():
        raise OutputError("is a folder", path, "name a file for the result")
    if suffixes and path.suffix not in suffixes:
        raise UsageError(
            f"the result is written as {' or '.join(suffixes)}, not "
            f"{path.suffix or 'without a suffix'}",
            path,
            "change the suffix of OUT",
        )
    if not folder.is_dir():
        raise OutputError(f"the folder {folder} does not exist", path, "make it first")
    if any(_is_one_file(target, other) for other in others):
        raise UsageError(
            "is another output of this command too", path, "give each result a name of its own"
        )
    if target.exists():
        if any(_is_one_file(target, other) for other in inputs):
            raise OutputError(
                "is also an input of this command", path, "give the result another name"
            )
        if not target.is_file():
            raise OutputError("is not an ordinary file", path, "name a file for the result")
        if not overwrite:
            raise UsageError("exists already", path, "pass --overwrite or choose another name")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"the folder {folder} is read-only", path, "choose another folder")


def _target(path: str | os.PathLike) -> Path:
    """The file that is written: where a link leads."""
    return Path(os.path.realpath(path) if os.path.islink(path) else path)


def _is_one_file(path: Path, other: str | os.PathLike | None) -> bool:
    """Whether two names, of files that need not exist, are those of one file."""
    if other is None:
        return False
    if os.path.realpath(path) == os.path.realpath(other):
        return True
    return path.exists() and os.path.exists(other) and os.path.samefile(path, other)


def partial_path(path: str | os.PathLike) -> Path:
    """The temporary name used while `path` is written; always the same, so that the next run
    sweeps what a killed one left.
    """
    path = Path(path)
    return path.with_name(f".{path.name}.partial")


def publish(
    path: str | os.PathLike, data: Any, *, overwrite: bool = False, for_good: bool = True
) -> None:
    """Put bytes into a file so that a reader sees all of them or the file as it was.

    path: file to write.
    data: bytes, or a list of bytes-like pieces.
    overwrite: whether the file may exist.
    for_good: as of `replacement`.

    Raises UsageError if the file exists and `overwrite` is not set, OutputError if it cannot be
    written; the target is then untouched and nothing is left beside it.
    """
    pieces = [data] if isinstance(data, (bytes, bytearray, memoryview)) else data
    with replacement(path, overwrite=overwrite, for_good=for_good) as (_, descriptor):
        for piece in pieces:
            _write_all(descriptor, memoryview(piece).cast("B"))


@dataclass(frozen=True, kw_only=True)
class _Staged:
    """A file that is written but does not stand under its name yet.

    path: as the user named it.
    target: where it will stand, links followed.
    partial, descriptor: where it is, open and locked.
    overwrite: whether the target may exist.
    for_good: as of `replacement`.
    """

    path: Path
    target: Path
    partial: Path
    descriptor: int
    overwrite: bool
    for_good: bool

    def discard(self) -> None:
        """Let go of the temporary file; it is removed where it has not taken its place."""
        if _is_same_file(self.descriptor, self.partial):
            self.partial.unlink(missing_ok=True)
        os.close(self.descriptor)


_transaction: ContextVar[list[_Staged] | None] = ContextVar("transaction", default=None)


@contextlib.contextmanager
def together() -> Iterator[list[_Staged]]:
    """All files that are written within the block appear when it ends well; of a failure, of one
    of them or between them, every file stays as it was and nothing is left.

    A block within another is part of that. Files of several names cannot appear at one instant:
    where a process is killed, or the power goes, just while they take their places, the next one
    that reads or writes any of them lets the others follow (`settle`).

    Raises UsageError where a file appeared meanwhile, OutputError where one cannot take its place.
    """
    outer = _transaction.get()
    if outer is not None:
        yield outer
        return
    staged: list[_Staged] = []
    token = _transaction.set(staged)
    try:
        yield staged
        _commit(staged)
    finally:
        _transaction.reset(token)
        for file in staged:
            file.discard()


@contextlib.contextmanager
def replacement(
    path: str | os.PathLike, *, overwrite: bool = False, for_good: bool = True
) -> Iterator[tuple[Path, int]]:
    """Yield (temporary path, open descriptor) of an empty file that takes the place of `path` when
    the block ends well, and with it the block of `together` around it.

    For libraries that write by name; they must write into the file that is there.
    for_good: whether it must survive a power cut, for which a disk takes its time; not where a
        reader knows what is damaged, and can do without.
    Errors as `publish`. A file that is replaced passes its owner and permissions on.
    """
    check_output(path, overwrite=overwrite)
    with together() as staged:
        file = _stage(Path(path), overwrite, for_good)
        staged.append(file)
        try:
            with _told(file.path):
                yield file.partial, file.descriptor
                _keep_rights(file)
                if for_good:
                    os.fsync(file.descriptor)
        except BaseException:
            staged.remove(file)
            file.discard()
            raise


def staged_path(path: str | os.PathLike) -> Path:
    """Where the bytes of a file are that the open block of `together` has written: they do not
    stand under its name yet. Any other path stays as it is.
    """
    target = _target(path)
    known = (file.partial for file in _transaction.get() or () if file.target == target)
    return next(known, Path(path))


@contextlib.contextmanager
def _told(
    path: Path,
    what: str = "cannot be written",
    fix: str = "free some space or choose another folder; what was there before is untouched",
) -> Iterator[None]:
    """OSError within the block becomes the OutputError for a file."""
    try:
        yield
    except OSError as error:
        raise OutputError(f"{what} ({error.strerror})", path, fix) from error


_CUT_OFF = "is one of several results that were cut off halfway, and cannot follow the others"
_FOLLOWS = "make its folder writable: all results follow when plenocli next looks at one of them"


def _stage(path: Path, overwrite: bool, for_good: bool) -> _Staged:
    target = _target(path)
    partial = partial_path(target)
    try:
        # what replaces a file is no more open than that while it is written
        descriptor = _open_partial(partial, 0o600 if target.exists() else 0o666)
    except OSError as error:
        raise OutputError(f"cannot be written ({error.strerror})", path, remedy(error)) from error
    return _Staged(
        path=path,
        target=target,
        partial=partial,
        descriptor=descriptor,
        overwrite=overwrite,
        for_good=for_good,
    )


def _keep_rights(file: _Staged) -> None:
    """Give a file the owner and the permissions of the one that it replaces."""
    try:
        before = os.stat(file.target)
    except FileNotFoundError:
        return
    with contextlib.suppress(PermissionError):
        os.fchown(file.descriptor, before.st_uid, before.st_gid)
    os.fchmod(file.descriptor, stat.S_IMODE(before.st_mode))


def _commit(staged: list[_Staged]) -> None:
    """Let all files take their places, or none."""
    for file in staged:
        if not file.overwrite and file.target.exists():
            raise UsageError(
                "appeared while the result was computed",
                file.path,
                "pass --overwrite or choose another name",
            )
    several = staged if len(staged) > 1 else []  # a single file needs no way back
    with _announced(several) as announcements:
        try:
            for file in several:
                with _told(file.path):
                    _before(file.target).unlink(missing_ok=True)
            for file in staged:
                with _told(file.path):
                    if several and file.target.exists():
                        _named_too(file.target, _before(file.target))
                    os.replace(file.partial, file.target)
        except BaseException:
            _take_back(several, announcements)
            raise
        for file in several:
            with contextlib.suppress(OSError):
                _before(file.target).unlink(missing_ok=True)
        _sync_folders(file.target for file in staged if file.for_good)


def _take_back(staged: list[_Staged], announcements: list[Path]) -> None:
    """Undo what `_commit` did, as far as it came. What is new stands by under its temporary names
    until all is undone: where this is cut off, or fails too, `settle` lets all follow.
    """
    try:
        for file in staged:
            with _told(file.path, "can neither take nor leave its place", _FOLLOWS):
                _put_back(file)
        _sync_folders(file.target for file in staged)
    except BaseException:
        announcements.clear()
        for file in staged:
            os.close(file.descriptor)
        staged.clear()
        raise


def _announcement(target: Path) -> Path:
    """Where it says which files take their places together with this one."""
    return target.with_name(f".{target.name}.together")


@contextlib.contextmanager
def _announced(several: Sequence[_Staged]) -> Iterator[list[Path]]:
    """Beside each of several files it says, for good, what all of them are, until the block ends
    well: their names as seen from there, sizes and times.
    """
    places = [Path(os.path.realpath(f.target.parent), f.target.name) for f in several]
    announcements = [_announcement(place) for place in places]
    how = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    with contextlib.ExitStack() as held:
        try:
            for file, announcement in zip(several, announcements):
                names = [os.path.relpath(place, announcement.parent) for place in places]
                told = [[name, *_about(f.descriptor)] for name, f in zip(names, several)]
                with _told(file.path):
                    made = os.open(announcement, how, 0o600)
                    held.callback(os.close, made)
                    fcntl.flock(made, fcntl.LOCK_EX)
                    os.ftruncate(made, 0)
                    write_at(made, 0, json.dumps(told).encode())
                    os.fsync(made)
            _sync_folders(places)
            yield announcements
        finally:
            for announcement in announcements:
                with contextlib.suppress(OSError):
                    announcement.unlink(missing_ok=True)


def settle(path: str | os.PathLike) -> None:
    """Where the several results of one command, of which the file at `path` is one, were cut off
    while they took their places, let the rest follow; else nothing, at the cost of one look.

    They follow only where it says the same beside all of them: who can write in one folder decides
    nothing in another. Where it does not, none has moved yet, or all have.
    """
    with contextlib.suppress(OSError, ValueError, TypeError, RecursionError):
        announcement = _announcement(_target(path))
        if not os.path.lexists(announcement):
            return
        descriptor = os.open(announcement, _LOOK)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)  # until a command that is about it has ended
            if not _is_same_file(descriptor, announcement):
                return
            told = json.loads(os.pread(descriptor, 1 << 20, 0))
            folder = os.path.realpath(announcement.parent)
            targets = [Path(os.path.normpath(os.path.join(folder, name))) for name, *_ in told]
            if not all(target.parent.is_dir() for target in targets):
                return  # a disk that is not there now
            if not all(_says(target, told) for target in targets):
                announcement.unlink()
                return
            for target, (_, *about) in zip(targets, told):
                with _told(target, _CUT_OFF, _FOLLOWS), contextlib.suppress(FileNotFoundError):
                    if _about(partial_path(target)) == about:
                        os.replace(partial_path(target), target)
            _sync_folders(targets)
            for name in (_before, _announcement):
                for target in targets:
                    name(target).unlink(missing_ok=True)
        finally:
            os.close(descriptor)


_LOOK = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


def _says(target: Path, told: list[list[Any]]) -> bool:
    """Whether it says of the same files beside one of them."""
    try:
        descriptor = os.open(_announcement(target), _LOOK)
    except FileNotFoundError:
        return False
    with open(descriptor, "rb") as file:
        found = json.loads(file.read(1 << 20) or b"[]")
    return [[Path(name).name, *rest] for name, *rest in found] == [
        [Path(name).name, *rest] for name, *rest in told
    ]


def _about(file: Path | int) -> list[int]:
    """What tells a finished temporary file from one that is written anew."""
    found = os.stat(file, follow_symlinks=isinstance(file, int))
    return [found.st_size, found.st_mtime_ns]


def _before(target: Path) -> Path:
    """A second name of the old file, by which it can be put back."""
    return target.with_name(f".{target.name}.before")


def _named_too(path: Path, name: Path) -> None:
    try:
        os.link(path, name)
    except OSError:  # a file system without hard links
        os.rename(path, name)


def _put_back(file: _Staged) -> None:
    before, moved = _before(file.target), _is_same_file(file.descriptor, file.target)
    if before.exists():
        if moved:
            _named_too(file.target, file.partial)
        os.rename(before, file.target)
        before.unlink(missing_ok=True)  # two names of one file are not renamed
    elif moved:
        os.rename(file.target, file.partial)


def _open_partial(partial: Path, mode: int = 0o666) -> int:
    """Open and lock the temporary file, empty; `mode` of a new one, less the umask.

    The lock keeps two runs with one target from mixing their bytes.
    """
    while True:
        descriptor = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, mode)
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


def _sync_folders(files: Iterable[Path]) -> None:
    for folder in dict.fromkeys(file.parent for file in files):
        sync_folder(folder)


def sync_folder(folder: Path) -> None:
    """Make the rename survive a power cut.

    Some network file systems refuse this; the file is then whole all the same.
    """
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
