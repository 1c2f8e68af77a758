"""The seal of every file that we write and read back, other than artefacts, which have their own: a
text in it, whatever its format, that ends with the SHA-256 of all its bytes, its own digits taken
as zeros. Nothing of such a file, values or notes, can be altered unseen.
"""

from __future__ import annotations

import hashlib
import os
import re
from itertools import islice
from pathlib import Path
from typing import Any

from plenocli.base.errors import InputError
from plenocli.files.artefacts.provenance import first_bytes, reading
from plenocli.files.atomic import replacement, write_at

SEAL = "plenocli sha256 " + 64 * "0"
"""What a file holds near its start before it is sealed."""
_OURS = b"plenocli"
_SEALS = re.compile(rb"plenocli sha256 ([0-9a-f]{64})")
_HEAD_BYTES = 4 << 20
_PIECE_BYTES = 1 << 22


def publish_sealed(path: str | os.PathLike, pieces: list[Any], *, overwrite: bool = False) -> None:
    """Put bytes-like pieces, the first of which holds SEAL, into a file with its seal; errors as
    publish.
    """
    with replacement(path, overwrite=overwrite) as (_, descriptor):
        start = 0
        for piece in pieces:
            write_at(descriptor, start, piece)
            start += len(piece)
        put_seal(descriptor)


def put_seal(descriptor: int) -> None:
    """Seal the whole file that is open, which holds SEAL near its start; ValueError if not."""
    place = os.pread(descriptor, _HEAD_BYTES, 0).find(SEAL.encode())
    if place < 0:
        raise ValueError("the file holds no place for its seal")
    digits = place + len(SEAL) - 64
    write_at(descriptor, digits, _digest(descriptor, digits))


def require_seal(path: str | os.PathLike) -> bool:
    """Whether a file is one of ours, as it was written; False for a file that says nothing of us.

    Raises InputError where it is missing, or names us but its seal is broken or gone.
    """
    head = first_bytes(path, _HEAD_BYTES)
    if _OURS not in head:
        return False
    with reading(path), open(path, "rb") as stream:
        # the name of an input may look like a seal, too
        found = islice(_SEALS.finditer(head), 8)
        if any(_digest(stream.fileno(), s.start(1)) == s[1] for s in found):
            return True
    raise InputError(
        "is damaged, was edited, or is of an older plenocli: it is not sealed as it stands",
        Path(path),
        "make it again",
    )


def resealed(content: bytes) -> bytes:
    """The bytes of an edited file of ours, other than an artefact, with a seal that fits them.

    Raises ValueError where its place for one is gone.
    """
    found = _SEALS.search(content[:_HEAD_BYTES])
    if found is None:
        raise ValueError("the file holds no place for its seal")
    before, after = content[: found.start(1)], content[found.end(1) :]
    digits = hashlib.sha256(before + b"0" * 64 + after).hexdigest().encode()
    return before + digits + after


def _digest(descriptor: int, digits: int) -> bytes:
    """SHA-256, hex, of an open file whose 64 bytes at `digits` count as zeros."""
    digest, start = hashlib.sha256(), 0
    while piece := bytearray(os.pread(descriptor, _PIECE_BYTES, start)):
        low, high = max(digits - start, 0), min(digits + 64 - start, len(piece))
        if low < high:
            piece[low:high] = b"0" * (high - low)
        digest.update(piece)
        start += len(piece)
    return digest.hexdigest().encode()
