"""Artefacts: one writer (`writing`), one verified reader (`reading`).

A file is a 512-byte user block (magic, SHA-256 and length of the rest), then an ordinary HDF5 file
that any viewer opens. HDF5 never touches the disk, because it may crash the process when one is
full: its frame is built in memory, with room for the large datasets, and frame and values are
written by us (`stream` writes them as they come). Reading goes the other way: digest of all bytes,
structure, declared sizes, and only then values.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from plenocli.files.artefacts import schema as tables
from plenocli.files.artefacts.provenance import Provenance

MAGIC = b"plenocli artefact 1\n"
HEADER_BYTES = 512
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
READ_BYTES = 1 << 18
"""That are read at a time."""


@dataclass
class Artefact:
    """What a file holds.

    kind: the table that it follows.
    data: dataset path ("pif/A") -> array, or InParts to be written.
    attrs: group or dataset path -> name -> number, list, text, bool or JSON-able value.
    provenance: where it came from.

    A colour filter array may be given as text ("mono", "RGGB"); it comes back as an
    array: see `cfa_text`.
    """

    kind: str
    data: dict[str, Any]
    attrs: dict[str, dict[str, Any]] = field(default_factory=dict)
    provenance: Provenance = field(default_factory=lambda: Provenance(command=""))


def cfa_text(value: Any) -> str:
    """ "mono" or four letters from the dataset capture/cfa (0-d or 2x2 array of bytes or
    str, or already text).
    """
    values = np.asarray(value)
    return "".join(
        v.decode("ascii") if isinstance(v, bytes) else str(v) for v in values.ravel().tolist()
    )


def is_raw(schema: tables.Schema, path: str, shape: tuple[int, ...]) -> bool:
    """Whether a dataset is stored as one run of numbers: what the table does not
    compress, and is not empty.
    """
    entry = schema.field_for(path)
    return entry is not None and not entry.compress and len(shape) > 0 and 0 not in shape
