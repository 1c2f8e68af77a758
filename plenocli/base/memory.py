"""How much memory a process may take: the limit of the command line, that of the shell or a
queue, and what to say where it is too little.
"""

from __future__ import annotations

import contextlib
import errno
import math
import mmap
import os
import resource
from collections.abc import Iterator

BASE, CORE = 384 << 20, 80 << 20
"""What a process takes beside its data, bytes, and for each core: the interpreter, the libraries
and the room that they set aside.
"""
_CODE = 128 << 20
"""Of it: the libraries' own code, which no limit of data counts."""
ROOM = 256 << 20
"""Bytes without which no command starts: HDF5, OpenBLAS and LLVM end the process
where they get none.
"""
_SIGNS = (
    "memory allocation failed",
    "start new thread",
    "failed to map segment",
    "bad_alloc",
    "out of memory",
)


def base_memory() -> int:
    """The stated base, bytes: --mem-limit and this are the most that a process may take."""
    return BASE + CORE * (os.cpu_count() or 1)


def hold(memory: int) -> None:
    """From now on this process gets MemoryError instead of more than it is granted; only on Linux.

    memory: bytes of data, beside base_memory().
    """
    table = "/proc/self/status"
    if os.path.exists(table):
        with open(table) as lines:
            used = next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData"))
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = used + memory + base_memory() - _CODE
        resource.setrlimit(
            resource.RLIMIT_DATA,
            (most if hard == resource.RLIM_INFINITY else min(most, hard), hard),
        )


@contextlib.contextmanager
def limits_restored() -> Iterator[None]:
    """What `hold` sets ends with the block."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def can_have(count: int) -> bool:
    """Whether the system would give so many bytes; no page of them is touched."""
    try:
        mmap.mmap(-1, count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS).close()
    except OSError:
        return False
    return True


def require_start() -> None:
    """MemoryError where the limits of the shell or of a queue leave less than ROOM."""
    if not can_have(ROOM):
        raise MemoryError(f"less than {size_text(ROOM)} can be had")


def is_lack_of_memory(error: BaseException) -> bool:
    """Whether an error means that there is no memory: of ours, of a library, of a thread or process
    that cannot start, or one that came of such an error, as where a library takes it for
    another and goes on.
    """
    return _lack_behind(error) is not None


def _lack_behind(error: BaseException | None) -> BaseException | None:
    while error is not None:
        if (
            isinstance(error, MemoryError)
            or getattr(error, "errno", None) in (errno.ENOMEM, errno.EAGAIN)
            or any(sign in str(error).lower() for sign in _SIGNS)
        ):
            return error
        error = error.__cause__ or error.__context__
    return None


def lack_of_memory(error: BaseException) -> str:
    """The message for a person of an error that is_lack_of_memory."""
    said = str(_lack_behind(error) or "")
    return (
        f"not enough memory{said and f' ({said})'}; use fewer points, lenslets or wavelengths, "
        "another --mem-limit, or raise the limit that the shell or the queue sets (ulimit -v)"
    )


def size_text(count: float) -> str:
    """Bytes as options take them, rounded up to three digits: 34.8MiB."""
    unit, power = next(
        (u, p)
        for u, p in (("GiB", 30), ("MiB", 20), ("KiB", 10), ("B", 0))
        if count >= 2**p or not p
    )
    value = count / 2**power
    step = 10.0 ** (math.floor(math.log10(max(value, 1))) - 2)
    return f"{math.ceil(value / step) * step:.6g}{unit}"
