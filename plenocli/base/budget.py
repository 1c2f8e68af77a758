"""How much memory a file may ask for."""

import os

from plenocli.base.errors import InputError
from plenocli.base.memory import size_text


def default_mem_limit():
    """Half of the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def require_room(path, needed, mem_limit=None):
    """Raise InputError, before anything is read, if the data that a header declares (`needed`
    bytes) exceed the limit.
    """
    limit = default_mem_limit() if mem_limit is None else mem_limit
    if needed > limit:
        raise InputError(
            f"declares {size_text(needed)} of data, above the memory limit of {size_text(limit)}",
            path,
            f"raise --mem-limit to {size_text(1.05 * needed)} if the file is yours",
        )
