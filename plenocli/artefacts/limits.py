"""How much memory a file and a command may ask for."""

import contextlib
import os
import resource

from plenocli.errors import InputError, NumericsError

BASE, CORE = 384 << 20, 80 << 20
"""What a process takes beside its data, bytes, and for each core: the interpreter, the libraries and the room that they set aside."""
_CODE = 128 << 20
"""Of it: the libraries' own code, which no limit of data counts."""


def default_mem_limit():
    """Half of the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def require_room(path, needed, mem_limit=None):
    """Raise InputError, before anything is read, if the data that a header declares (`needed` bytes) exceed the limit."""
    limit = default_mem_limit() if mem_limit is None else mem_limit
    if needed > limit:
        raise InputError(f"declares {needed / 1e9:.3g} GB of data, above the memory limit of {limit / 1e9:.3g} GB", path,
                         "raise the memory limit if the file is yours")


def base_memory():
    """The stated base, bytes: --mem-limit and this are the most that a process may take."""
    return BASE + CORE * (os.cpu_count() or 1)


def hold(mem_limit):
    """From now on this process gets MemoryError instead of more than `mem_limit` bytes of data and the base; only on Linux."""
    table = "/proc/self/status"
    if os.path.exists(table):
        with open(table) as lines:
            used = next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmData"))
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = used + mem_limit + base_memory() - _CODE
        resource.setrlimit(resource.RLIMIT_DATA, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


@contextlib.contextmanager
def limits_restored():
    """What `hold` sets ends with the block."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def require_memory(needed, mem_limit, what, where=None, fewer="take less of it"):
    """NumericsError, before a long computation, if `what` needs more bytes than the limit; it says how much would do."""
    if mem_limit is not None and needed > mem_limit:
        raise NumericsError(f"{what} needs about {_size(needed)}, more than the limit of {_size(mem_limit)}", where, f"{fewer}, or raise --mem-limit to {_size(1.05 * needed)}")


def _size(count):
    return f"{count / 2**30:.3g}GiB" if count >= 2**30 else f"{count / 2**20:.3g}MiB"
