"""The one verified reader of artefacts."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError, PlenoError
from plenocli.base.tiling import EVERYTHING
from plenocli.files.artefacts import schema as tables
from plenocli.files.artefacts.container import (
    HDF5_SIGNATURE,
    HEADER_BYTES,
    MAGIC,
    READ_BYTES,
    Artefact,
)
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.provenance import (
    Provenance,
    first_bytes,
    require_file,
)
from plenocli.files.artefacts.sparse import Behind
from plenocli.files.artefacts.structure import (
    attribute_names,
    no_hdf5,
    read_attribute,
    stays,
    survey,
    window,
)
from plenocli.files.outside import outside

SHARE = 16
"""Of the memory, one part: datasets up to that need not stay in their file."""
_HEADER = re.compile(re.escape(MAGIC) + rb"sha256 ([0-9a-f]{64})\nbytes (\d{1,18})\n\0*\Z")
_LOOK_S = 10
"""Processor time, s, in which HDF5 finds all objects of any file that is sound."""
_SLOWEST = 5 << 20
"""Bytes a second that HDF5 unpacks at least."""


def read_artefact(
    path: str | os.PathLike,
    kind: str | tuple[str, ...] | None = None,
    *,
    skip: Collection[str] = (),
) -> Artefact:
    """Read and verify an artefact.

    path: its file.
    kind: the kind due, or a tuple of kinds, or None for any.
    skip: datasets that are not wanted; their bytes are verified, their values are not looked at.

    Raises InputError for a file that is missing, not an artefact, damaged, of another kind, or
    breaks its table; NumericsError for one that the memory of this process does not hold.
    """
    with opened_artefact(path, kind, skip) as (artefact, _):
        return artefact


def read_edited(path: str | os.PathLike) -> tuple[Artefact, str]:
    """An artefact whose digest may not fit, because it was edited since, and the digest.

    Raises as read_artefact, but for the digest.
    """
    path = Path(path)
    require_file(path)
    header = _HEADER.fullmatch(first_bytes(path, HEADER_BYTES))
    if header is None:
        raise InputError(
            "is no artefact with a digest block", path, "edit it with a library that keeps it"
        )
    with _opened(path) as descriptor:
        return _held(path, descriptor, None, {})[0], header[1].decode()


@dataclass(frozen=True, kw_only=True)
class Stored:
    """A dataset that stays in its file, from which windows are read and checked.

    path: of the file.
    name: of the dataset.
    shape, dtype: as it is stored.
    schema: the table that its values follow.
    """

    path: Path
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    schema: tables.Schema

    def window(self, rows: slice = EVERYTHING, columns: slice = EVERYTHING) -> np.ndarray:
        """Part of the last two axes; errors as `part`."""
        return self.part(*[EVERYTHING] * (len(self.shape) - 2), rows, columns)

    def part(self, *sides: slice) -> np.ndarray:
        """Part of the first axes, slices without a step.

        Raises InputError where it cannot be read or breaks the table, NumericsError where the
        memory of this process does not hold it.
        """
        seconds = _LOOK_S + self.path.stat().st_size // _SLOWEST
        every = [*sides, *[EVERYTHING] * (len(self.shape) - len(sides))]
        ends = [side.indices(n)[:2] for side, n in zip(every, self.shape)]
        count = math.prod(last - first for first, last in ends)
        budget().require_reading(self.path, 2 * count * self.dtype.itemsize)
        part = [index for both in ends for index in both]
        values = outside(window, self.path, self.name, part, seconds=seconds)[self.name]
        problems = tables.value_problems(replace(self.schema, rules=()), {self.name: values})
        if problems:
            raise InputError(
                f"breaks the table of its kind: {'; '.join(problems)}", self.path, "make it again"
            )
        return values


@contextlib.contextmanager
def opened_artefact(
    path: str | os.PathLike,
    kind: str | tuple[str, ...] | None,
    apart: Collection[str],
    *,
    large: Collection[str] = (),
    verify: bool = True,
) -> Iterator[tuple[Artefact, Mapping[str, Stored]]]:
    """As read_artefact, but for large datasets whose values are read bit by bit; these may be read
    after the block, too.

    path, kind: as of read_artefact.
    apart: the datasets that stay in the file, whose bytes are verified before.
    large: others that stay there, if they take more than a SHARE of the memory.
    verify: whether the digest is looked at; not where this run has done so before.

    Yields (the Artefact without them, those of them that there are). Raises as read_artefact.
    """
    path = Path(path)
    size = require_file(path)
    with _opened(path) as descriptor:
        digest = _require_whole(path, os.pread(descriptor, HEADER_BYTES, 0), size)
        if verify and _digest_behind(descriptor) != digest:
            raise _damaged(path)
        try:
            found = _held(path, descriptor, kind, _staying(apart, large))
        except InputError:  # damage is told as such, whether it was looked for or not
            if not verify and _digest_behind(descriptor) != digest:
                raise _damaged(path) from None
            raise
    yield found


def _staying(apart: Collection[str], large: Collection[str] = ()) -> dict[str, int]:
    """`apart` of `stays` for datasets as opened_artefact has them."""
    return dict.fromkeys(large, budget().memory // SHARE) | dict.fromkeys(apart, -1)


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[int]:
    """A descriptor of the file at `path`; errors as read_artefact."""
    with _as_input_error(path):
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            yield descriptor
        finally:
            os.close(descriptor)


def _held(
    path: Path, descriptor: int, kind: str | tuple[str, ...] | None, apart: dict[str, int]
) -> tuple[Artefact, dict[str, Stored]]:
    """What the HDF5 part of an open file holds, as opened_artefact yields it; apart: of `stays`."""
    seconds = _LOOK_S + path.stat().st_size // _SLOWEST
    values = outside(compressed_values, path, apart, seconds=seconds)
    with h5py.File(Behind(descriptor, HEADER_BYTES), "r") as file:
        artefact = _parse(path, file, kind, apart, values)
        found = {
            name: Stored(
                path=path,
                name=name,
                shape=file[name].shape,
                dtype=file[name].dtype,
                schema=SCHEMAS[artefact.kind],
            )
            for name in apart.keys() - artefact.data.keys()
            if name in file
        }
    return artefact, found


@contextlib.contextmanager
def _as_input_error(path: Path) -> Iterator[None]:
    """InputError for the half a dozen types that h5py raises for a file that cannot be read."""
    try:
        yield
    except (PlenoError, MemoryError):
        raise
    except Exception as error:
        raise no_hdf5(path, error) from error


def _damaged(path: Path) -> InputError:
    return InputError(
        "is damaged: its SHA-256 is not the one it was written with", path, "make it again"
    )


def _digest_behind(descriptor: int) -> str:
    """SHA-256 of an open file but for its digest block."""
    digest, at = hashlib.sha256(), HEADER_BYTES
    while part := os.pread(descriptor, READ_BYTES, at):
        digest.update(part)
        at += len(part)
    return digest.hexdigest()


def _require_whole(path: Path, head: bytes, size: int) -> str:
    """The digest that an artefact was written with; InputError where the first bytes of the file,
    or its size, are not those of one.

    head: at least the digest block.
    size: bytes of the file.
    """
    if not head.startswith(MAGIC):
        if HDF5_SIGNATURE in head:
            raise InputError(
                "is an HDF5 file, but not one that plenocli wrote (no digest block)",
                path,
                "give the result of a plenocli stage",
            )
        raise InputError("is not a plenocli artefact", path, "give the result of a plenocli stage")
    header = _HEADER.fullmatch(head[:HEADER_BYTES])
    if header is None or size < HEADER_BYTES:
        raise InputError("has a damaged digest block", path, "make it again")
    if size - HEADER_BYTES != int(header[2]):
        raise InputError(
            f"is truncated or has grown: {size - HEADER_BYTES} bytes where {int(header[2])} were "
            "written",
            path,
            "make it again",
        )
    return header[1].decode()


def compressed_values(path: str, apart: dict[str, int]) -> dict[str, np.ndarray]:
    """Dataset path -> values of those that are stored in pieces, which a damaged index of pieces
    may lead HDF5 astray in; runs outside. An empty dict where what the file declares breaks its
    table, as `_parse` then says: what no table knows may be of any size.

    apart: of `stays`.

    Raises as survey; InputError and MemoryError for what HDF5 cannot read.
    """
    with _as_input_error(Path(path)), h5py.File(path, "r", locking=False) as file:
        declared = survey(path, file, apart)
        kind = None
        if "plenocli_kind" in attribute_names(file):
            kind = read_attribute(path, file, "plenocli_kind")
        schema = SCHEMAS.get(kind) if isinstance(kind, str) else None
        if schema is None or tables.declared_problems(schema, declared):
            return {}
        wanted = [name for name in declared if not stays(name, declared[name], apart)]
        return {name: file[name][()] for name in wanted if file[name].chunks is not None}


def _parse(
    path: Path,
    file: h5py.File,
    kind: str | tuple[str, ...] | None,
    apart: dict[str, int],
    compressed: dict[str, np.ndarray],
) -> Artefact:
    """What an open file holds; `compressed`: the values that were read outside."""
    declared = survey(path, file, apart)
    root = {
        name: read_attribute(path, file, name)
        for name in tables.ROOT_ATTRIBUTES
        if name in attribute_names(file)
    }
    missing = [name for name in tables.ROOT_ATTRIBUTES if name not in root]
    if missing:
        raise InputError(
            f"root attributes are missing: {', '.join(missing)}", path, "make it again"
        )
    schema = _schema_of(path, root, kind)
    problems = tables.declared_problems(schema, declared)
    attrs = _read_attributes(path, file, schema, declared, problems)
    if not problems:
        data = {
            name: compressed[name] if file[name].chunks is not None else file[name][()]
            for name in declared
            if not stays(name, declared[name], apart)
        }
        data = {
            name: values if isinstance(values, np.ndarray) else np.asarray(values)
            for name, values in data.items()
        }
        problems = tables.value_problems(schema, data, declared)
    if problems:
        raise InputError(
            "breaks the table of its kind: " + "; ".join(problems),
            path,
            f"make it again ({root['command']})",
        )
    return Artefact(schema.kind, data, attrs, _provenance(path, root))


def _provenance(path: Path, root: dict[str, Any]) -> Provenance:
    try:
        inputs, accuracy = json.loads(root["inputs"]), json.loads(root["accuracy"])
        seed = None if root["seed"] == "none" else int(root["seed"])
        sound = isinstance(accuracy, dict) and all(
            isinstance(about[name], str) for about in inputs.values() for name in ("name", "sha256")
        )
    except (ValueError, TypeError, KeyError, AttributeError):
        sound = False
    if not sound:
        raise InputError("says nonsense of where it comes from", path, "make it again")
    return Provenance(
        command=root["command"], inputs=inputs, seed=seed, config=root["config"], accuracy=accuracy
    )


def _schema_of(
    path: Path, root: dict[str, Any], kind: str | tuple[str, ...] | None
) -> tables.Schema:
    found, version = root["plenocli_kind"], root["schema_version"]
    wanted = (kind,) if isinstance(kind, str) else kind
    if found not in SCHEMAS:
        raise InputError(
            f"is of the unknown kind '{found}'", path, f"known kinds: {', '.join(SCHEMAS)}"
        )
    if wanted is not None and found not in wanted:
        raise InputError(
            f"is an artefact of kind '{found}' where '{' or '.join(wanted)}' is due",
            path,
            "swap or rename the inputs",
        )
    if version != SCHEMAS[found].version:
        older = isinstance(version, (int, float)) and version < SCHEMAS[found].version
        fix = f"make it again ({root['command']})" if older else "update plenocli"
        raise InputError(
            f"has version {version} of kind '{found}', this program reads {SCHEMAS[found].version}",
            path,
            fix,
        )
    return SCHEMAS[found]


def _read_attributes(path, file, schema, declared, problems):
    """Attributes of the table found in the file; unknown ones are added to `problems`, plotting
    attributes are left out.
    """
    generated = tables.plot_attributes(schema, declared)
    attrs = {}
    for where in generated:
        target = file[where or "/"]
        for name in attribute_names(target):
            if name in generated[where] or (where == "" and name in tables.ROOT_ATTRIBUTES):
                continue
            attr = schema.attr_for(where, name)
            if attr is None:
                problems.append(f"attribute '{name}' of '/{where}' is unknown")
                continue
            value = read_attribute(path, target, name)
            attrs.setdefault(where, {})[name] = json.loads(value) if attr.type == "json" else value
    problems.extend(tables.attribute_problems(schema, attrs))
    return attrs
