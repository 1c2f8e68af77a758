"""The one writer and the one verified reader of artefacts.

A file is a 512-byte user block (magic, SHA-256 and length of the rest), then an ordinary HDF5 file
that any viewer opens. HDF5 never touches the disk, because it may crash the process when one is
full: its frame is built in memory, with room for the large datasets, and frame and values are
written by us (`stream` writes them as they come). Reading goes the other way: digest of all bytes,
structure, declared sizes, and only then values.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from plenocli import __version__
from plenocli.base.budget import budget
from plenocli.base.errors import InputError, PlenoError
from plenocli.base.text import utf8
from plenocli.base.tiling import EVERYTHING, InParts
from plenocli.files.artefacts import schema as tables
from plenocli.files.artefacts.chunks import FILTERS, write_chunks
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.provenance import (
    Provenance,
    first_bytes,
    require_file,
)
from plenocli.files.artefacts.sparse import Behind, SparseFile
from plenocli.files.artefacts.structure import (
    EMPTY_AXIS,
    attribute_names,
    no_hdf5,
    read_attribute,
    survey,
    window,
)
from plenocli.files.atomic import replacement, reserve, write_at
from plenocli.files.outside import outside

MAGIC = b"plenocli artefact 1\n"
HEADER_BYTES = 512
HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_HEADER = re.compile(re.escape(MAGIC) + rb"sha256 ([0-9a-f]{64})\nbytes (\d{1,18})\n\0*\Z")
_CHUNK_BYTES = 1 << 20
_READ_BYTES = 1 << 18
_LOOK_S, _SLOWEST = 10, 5 << 20
"""Processor time, s, in which HDF5 finds all objects of any file that is sound, and bytes a second
that it unpacks at least.
"""
_LONG_TEXT = 60_000  # an attribute in the oldest HDF5 layout ends at 64 KiB


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


def write_artefact(path: str | os.PathLike, artefact: Artefact, *, overwrite: bool = False) -> None:
    """Put an artefact into a file, whole or not at all; same input, same bytes.

    path: file to write.
    artefact: what follows the table of its kind.
    overwrite: whether the file may exist.

    Raises ValueError listing every broken rule of the table (a bug of the caller), UsageError where
    the file exists, OutputError where it cannot be written.
    """
    large = any(isinstance(values, InParts) for values in artefact.data.values())
    frame = None if large else Frame(artefact)
    with replacement(path, overwrite=overwrite) as (_, descriptor):
        frame = frame or Frame(artefact, descriptor=descriptor)
        frame.write(descriptor)
        for name, values in frame.raw.items():
            write_at(descriptor, frame.offset(name), values)
        seal(descriptor, frame.size)


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
        return _held(path, descriptor, None, ())[0], header[1].decode()


# --- writing --------------------------------------------------------------------------------------


class Frame:
    """The HDF5 file of an artefact without the values of its raw datasets (those that the table
    does not compress).

    raw: dataset path -> values to write;
    size: bytes of the HDF5 file.
    `streamed`: dataset path -> (shape, dtype) of raw datasets that come by themselves.
    `descriptor`: of the file that is to be, which takes InParts as they come.
    ValueError listing every broken rule of the table.
    """

    def __init__(
        self,
        artefact: Artefact,
        streamed: tables.Declared | None = None,
        *,
        descriptor: int | None = None,
    ) -> None:
        schema, data, declared, attrs = _checked(artefact, streamed or {})
        stored = _stored_attributes(schema, artefact, declared, attrs)
        apart = [path for path, (shape, dtype) in declared.items() if is_raw(schema, path, shape)]
        self.raw = {path: data.pop(path) for path in apart if path in data}
        self._file, self._offsets = _frame(
            schema, data, {path: declared[path] for path in sorted(apart)}, stored, descriptor
        )
        if self._file.failed is not None:
            raise self._file.failed
        self._taken = {
            path: (start, int(np.prod(declared[path][0])) * np.dtype(declared[path][1]).itemsize)
            for path, start in self._offsets.items()
        }
        self.size = self._file.size

    def offset(self, name: str) -> int:
        """Where the values of a raw dataset begin in the finished file, bytes."""
        return HEADER_BYTES + self._offsets[name]

    def write(self, descriptor: int) -> None:
        """Put the frame into an open file, around the values of the raw datasets, which
        may be there already.
        """
        reserve(descriptor, HEADER_BYTES + self.size)
        for offset, content in self._file.extents():
            for first, last in self._around(offset, offset + len(content)):
                write_at(descriptor, HEADER_BYTES + first, content[first - offset : last - offset])

    def _around(self, first: int, last: int) -> Iterator[tuple[int, int]]:
        """The parts of a range that no raw dataset takes."""
        for start, size in sorted(self._taken.values()):
            if start < last and start + size > first:
                if start > first:
                    yield first, start
                first = start + size
        if first < last:
            yield first, last


def is_raw(schema: tables.Schema, path: str, shape: tuple[int, ...]) -> bool:
    """Whether a dataset is stored as one run of numbers: what the table does not
    compress, and is not empty.
    """
    entry = schema.field_for(path)
    return entry is not None and not entry.compress and len(shape) > 0 and 0 not in shape


def seal(descriptor: int, size: int) -> None:
    """Write the digest block of the HDF5 file of `size` bytes that follows it in the open file."""
    digest = hashlib.sha256()
    for start in range(0, size, _READ_BYTES):
        wanted = min(_READ_BYTES, size - start)
        while wanted:
            part = os.pread(descriptor, wanted, HEADER_BYTES + start)
            if not part:
                raise OSError(errno.EIO, "the file was cut short while it was written")
            digest.update(part)
            start, wanted = start + len(part), wanted - len(part)
    header = MAGIC + f"sha256 {digest.hexdigest()}\nbytes {size}\n".encode()
    write_at(descriptor, 0, header.ljust(HEADER_BYTES, b"\0"))


def _checked(artefact, streamed):
    """(schema, arrays, declared shapes, attributes) of an artefact; ValueError listing every
    broken rule of its table.
    """
    if artefact.kind not in SCHEMAS:
        raise ValueError(f"no artefact kind '{artefact.kind}' (kinds: {', '.join(SCHEMAS)})")
    schema = SCHEMAS[artefact.kind]
    data = {
        path: value if isinstance(value, InParts) else _plain_array(path, value)
        for path, value in artefact.data.items()
        if value is not None
    }
    attrs = {
        where: {n: v for n, v in named.items() if v is not None}
        for where, named in artefact.attrs.items()
    }
    declared = {path: (values.shape, values.dtype) for path, values in data.items()} | dict(
        streamed
    )
    problems = tables.declared_problems(schema, declared) + tables.attribute_problems(schema, attrs)
    known = {path: v for path, v in data.items() if not isinstance(v, InParts)}
    problems += tables.value_problems(schema, known)
    groups = {
        path.rsplit("/", depth)[0] for path in declared for depth in range(1, path.count("/") + 1)
    }
    problems += [
        f"attributes for '{where}', which has no dataset"
        for where in attrs
        if attrs[where] and where not in groups | set(declared)
    ]
    if problems:
        raise ValueError(f"{artefact.kind} artefact breaks its table: " + "; ".join(problems))
    return schema, data, declared, attrs


def _plain_array(path: str, value: Any) -> np.ndarray:
    """Native byte order, C order; text as fixed-length ASCII."""
    if isinstance(value, str) and path.endswith("/cfa"):
        value = value if len(value) != 4 or value == "mono" else np.array(list(value)).reshape(2, 2)
    values = np.asarray(value)
    if values.dtype.kind == "U":
        values = np.char.encode(values, "ascii")
    return np.ascontiguousarray(values, dtype=values.dtype.newbyteorder("=")).reshape(values.shape)


def _stored_attributes(schema, artefact, declared, attrs):
    """path -> name -> what h5py stores: fixed-length bytes, numpy numbers, lists of bytes."""
    origin = artefact.provenance
    stored = {path: dict(named) for path, named in tables.plot_attributes(schema, declared).items()}
    stored[""] |= {
        "plenocli_kind": schema.kind,
        "schema_version": schema.version,
        "plenocli_version": __version__,
        "command": origin.command,
        "config": origin.config,
        "inputs": _json(origin.inputs),
        "seed": "none" if origin.seed is None else str(int(origin.seed)),
        "accuracy": _json(origin.accuracy),
    }
    for where, named in attrs.items():
        for name, value in named.items():
            stored[where][name] = (
                _json(value) if schema.attr_for(where, name).type == "json" else value
            )
    return {
        path: {name: _storable(value) for name, value in named.items()}
        for path, named in stored.items()
    }


def _json(value: Any) -> str:
    return json.dumps(value, sort_keys=True, ensure_ascii=False, allow_nan=False)


def _storable(value):
    if isinstance(value, str):
        return utf8(value)
    if isinstance(value, list) and value and isinstance(value[0], str):
        return np.array([utf8(v) for v in value])
    values = np.asarray(value)
    return values.astype({"i": "i8", "u": "u8", "f": "f8", "b": "?"}[values.dtype.kind])


def _frame(schema, data, apart, stored, descriptor=None):
    """(SparseFile, raw dataset path -> offset in it).

    Raw datasets come first, so that their place depends on their sizes only.
    """
    longest = max(
        (len(v) for named in stored.values() for v in named.values() if isinstance(v, bytes)),
        default=0,
    )
    layout = "v108" if apart or longest >= _LONG_TEXT else "earliest"
    memory, offsets = SparseFile(descriptor, HEADER_BYTES), {}
    with h5py.File(memory, "w", libver=(layout, "v110"), track_times=False) as file:
        for path, (shape, dtype) in apart.items():
            offsets[path] = _reserve_dataset(file, path, shape, dtype)
        for path in sorted(data):
            if isinstance(data[path], InParts):
                _write_parts(file, schema, path, data[path])
            else:
                _write_array(file, path, data[path])
        for where in sorted(stored):
            target = file[where or "/"]
            for name, value in stored[where].items():
                _put_attribute(target, name, value)
        declared = apart | {path: (values.shape, values.dtype) for path, values in data.items()}
        _name_axes(file, tables.axis_names(schema, declared))
    return memory, offsets


def _write_array(file, path, values):
    storage = _storage(values)
    if "chunks" not in storage:
        file.create_dataset(path, data=values, **storage)
    else:
        made = file.create_dataset(path, shape=values.shape, dtype=values.dtype, **storage)
        write_chunks(made, (0,) * values.ndim, values)


def _write_parts(file, schema, path, values):
    """Write a dataset part by part, whole chunks at a time."""
    shape = values.shape
    made = file.create_dataset(path, shape=shape, dtype=values.dtype, **_storage(values))
    # chunks are parts of axis `axis`, whole beyond it and one index thick before it
    axis = next((k for k, side in enumerate(made.chunks[:-2]) if side > 1), len(shape) - 2)
    inner = math.prod(shape[axis + 1 : -1])
    rows, step, at, held = shape[axis] * inner, made.chunks[axis] * inner, 0, []
    fields = replace(schema, rules=())

    def put(block):
        before, row = divmod(at, rows)
        corner = *np.unravel_index(before, shape[:axis]), row // inner
        block = block.reshape((1,) * axis + (-1,) + shape[axis + 1 :])
        write_chunks(made, corner + (0,) * (len(shape) - axis - 1), block)

    for part in values.parts():
        part = np.ascontiguousarray(part, values.dtype)
        problems = tables.value_problems(fields, {path: part})
        if problems:
            raise ValueError("; ".join(problems))
        held.append(part)
        waiting = sum(map(len, held))
        end = at + waiting
        ready = waiting if end % rows == 0 else end % rows // step * step - at % rows
        if ready > 0:
            block = held[0] if len(held) == 1 else np.concatenate(held)
            put(block[:ready])
            at, held = at + ready, [block[ready:]] if ready < waiting else []
    if at != np.prod(shape[:-1]):
        raise ValueError(f"'{path}' lacks rows")


def _name_axes(file, names):
    """Attach HDF5 dimension scales, by which xarray, MATLAB and silx name the axes.

    An axis without values of its own gets a dataset that holds none, as netCDF-4 keeps such axes.
    """
    for path in sorted(names):
        group = path.rpartition("/")[0]
        for axis, (name, size) in enumerate(zip(names[path], file[path].shape)):
            where = f"{group}/{name}"
            if where not in file:
                file.create_dataset(where, shape=(size,), dtype="i1", track_times=False)
                file[where].make_scale(f"{EMPTY_AXIS}{size:10d}")
            elif not file[where].is_scale:
                file[where].make_scale(name)
            if where != path:
                file[path].dims[axis].attach_scale(file[where])


def _reserve_dataset(file, path, shape, dtype):
    """Make a dataset in one run, its room allocated and never filled; returns its offset."""
    group, _, name = path.rpartition("/")
    options = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    options.set_layout(h5py.h5d.CONTIGUOUS)
    options.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
    options.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
    options.set_obj_track_times(False)
    parent = file.require_group(group) if group else file
    made = h5py.h5d.create(
        parent.id,
        name.encode(),
        h5py.h5t.py_create(np.dtype(dtype), logical=True),
        h5py.h5s.create_simple(tuple(shape)),
        options,
    )
    return made.get_offset()


def _put_attribute(target, name, value):
    if isinstance(value, bytes):
        # h5py would store a null-terminated ASCII type; utf-8 of exactly this length keeps every
        # character of a config
        kind = h5py.string_dtype("utf-8", max(len(value), 1))
        target.attrs.create(name, np.array(value, dtype=kind), dtype=kind)
    else:
        target.attrs.create(name, value)


def _storage(values: np.ndarray | InParts) -> dict[str, Any]:
    """Storage options: 1 MiB chunks with a checksum each, gzip."""
    if len(values.shape) == 0 or 0 in values.shape:
        return {"track_times": False}
    chunks: list[int] = []
    room = max(_CHUNK_BYTES // np.dtype(values.dtype).itemsize, 1)
    for size in reversed(values.shape):
        chunks.insert(0, max(min(size, room), 1))
        room //= chunks[0]
    return {"chunks": tuple(chunks), "track_times": False, **FILTERS}


# --- reading --------------------------------------------------------------------------------------


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
        """Part of the last two axes.

        Raises InputError where it cannot be read or breaks the table, NumericsError where the
        memory of this process does not hold it.
        """
        seconds = _LOOK_S + self.path.stat().st_size // _SLOWEST
        sides = [rows.indices(self.shape[-2])[:2], columns.indices(self.shape[-1])[:2]]
        count = math.prod([*self.shape[:-2], *(last - first for first, last in sides)])
        budget().require_reading(self.path, 2 * count * self.dtype.itemsize)
        part = [*sides[0], *sides[1]]
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
    verify: bool = True,
) -> Iterator[tuple[Artefact, Mapping[str, Stored]]]:
    """As read_artefact, but for large datasets whose values are read bit by bit; these may be read
    after the block, too.

    path, kind: as of read_artefact.
    apart: the datasets that stay in the file, whose bytes are verified before.
    verify: whether the digest is looked at; not where this run has done so before.

    Yields (the Artefact without them, those of them that there are). Raises as read_artefact.
    """
    path = Path(path)
    size = require_file(path)
    with _opened(path) as descriptor:
        digest = _require_whole(path, os.pread(descriptor, HEADER_BYTES, 0), size)
        if verify and _digest_behind(descriptor) != digest:
            raise _damaged(path)
        found = _held(path, descriptor, kind, apart)
    yield found


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
    path: Path, descriptor: int, kind: str | tuple[str, ...] | None, apart: Collection[str]
) -> tuple[Artefact, dict[str, Stored]]:
    """What the HDF5 part of an open file holds, as opened_artefact yields it."""
    seconds = _LOOK_S + path.stat().st_size // _SLOWEST
    values = outside(compressed_values, path, sorted(apart), seconds=seconds)
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
            for name in apart
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
    while part := os.pread(descriptor, _READ_BYTES, at):
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


def compressed_values(path: str, skip: list[str]) -> dict[str, np.ndarray]:
    """Dataset path -> values of those that are stored in pieces, which a damaged index of pieces
    may lead HDF5 astray in; runs outside. An empty dict where what the file declares breaks its
    table, as `_parse` then says: what no table knows may be of any size.

    skip: datasets that are not wanted.

    Raises as survey; InputError and MemoryError for what HDF5 cannot read.
    """
    with _as_input_error(Path(path)), h5py.File(path, "r", locking=False) as file:
        declared = survey(path, file, skip)
        kind = None
        if "plenocli_kind" in attribute_names(file):
            kind = read_attribute(path, file, "plenocli_kind")
        schema = SCHEMAS.get(kind) if isinstance(kind, str) else None
        if schema is None or tables.declared_problems(schema, declared):
            return {}
        wanted = [name for name in declared if name not in skip]
        return {name: file[name][()] for name in wanted if file[name].chunks is not None}


def _parse(
    path: Path,
    file: h5py.File,
    kind: str | tuple[str, ...] | None,
    skip: Collection[str],
    compressed: dict[str, np.ndarray],
) -> Artefact:
    """What an open file holds; `compressed`: the values that were read outside."""
    declared = survey(path, file, skip)
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
            if name not in skip
        }
        data = {
            name: values if isinstance(values, np.ndarray) else np.asarray(values)
            for name, values in data.items()
        }
        problems = tables.value_problems(schema, data)
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
