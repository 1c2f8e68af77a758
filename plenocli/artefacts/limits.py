"""How much memory a file may ask for."""

import os

from plenocli.errors import InputError


def default_mem_limit():
    """Half of the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def require_room(path, needed, mem_limit=None):
    """Raise InputError, before anything is read, if the data that a header declares (`needed` bytes) exceed the limit."""
    limit = default_mem_limit() if mem_limit is None else mem_limit
    if needed > limit:
        raise InputError(f"declares {needed / 1e9:.3g} GB of data, above the memory limit of {limit / 1e9:.3g} GB", path,
                         "raise the memory limit if the file is yours")
