"""The one writer of artefacts."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from plenocli import __version__
from plenocli.base.text import utf8
from plenocli.base.tiling import InParts
from plenocli.files.artefacts import schema as tables
from plenocli.files.artefacts.chunks import AT_ONCE, FILTERS, write_chunks
from plenocli.files.artefacts.container import HEADER_BYTES, MAGIC, READ_BYTES, Artefact, is_raw
from plenocli.files.artefacts.kinds import SCHEMAS
from plenocli.files.artefacts.sparse import SparseFile
from plenocli.files.artefacts.structure import EMPTY_AXIS
from plenocli.files.atomic import replacement, reserve, write_at

_CHUNK_BYTES = 1 << 20
_LONG_TEXT = 60_000  # an attribute in the oldest HDF5 layout ends at 64 KiB


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


def seal(descriptor: int, size: int) -> None:
    """Write the digest block of the HDF5 file of `size` bytes that follows it in the open file."""
    digest = hashlib.sha256()
    for start in range(0, size, READ_BYTES):
        wanted = min(READ_BYTES, size - start)
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
    problems += tables.value_problems(schema, known, declared)
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
        write_chunks(made, [((0,) * values.ndim, values)])


def _write_parts(file, schema, path, values):
    """Write a dataset part by part, whole chunks at a time."""
    made = file.create_dataset(path, shape=values.shape, dtype=values.dtype, **_storage(values))
    write_chunks(made, _blocks(replace(schema, rules=()), path, values, made.chunks))


def _blocks(schema, path, values, chunks):
    """The parts of a dataset put together to blocks of whole chunks, as write_chunks takes them;
    ValueError where the table forbids values.
    """
    shape = values.shape
    # chunks are parts of axis `axis`, whole beyond it and one index thick before it
    axis = next((k for k, side in enumerate(chunks[:-2]) if side > 1), len(shape) - 2)
    inner = math.prod(shape[axis + 1 : -1])
    rows, step, at, held = shape[axis] * inner, chunks[axis] * inner, 0, []
    for part in values.parts():
        part = np.ascontiguousarray(part, values.dtype)
        problems = tables.value_problems(schema, {path: part})
        if problems:
            raise ValueError("; ".join(problems))
        held.append(part)
        waiting = sum(map(len, held))
        end = at + waiting
        ready = waiting if end % rows == 0 else end % rows // step * step - at % rows
        if ready >= AT_ONCE * step or (ready > 0 and end % rows == 0):
            block = held[0] if len(held) == 1 else np.concatenate(held)
            before, row = divmod(at, rows)
            corner = *np.unravel_index(before, shape[:axis]), row // inner
            placed = block[:ready].reshape((1,) * axis + (-1,) + shape[axis + 1 :])
            yield corner + (0,) * (len(shape) - axis - 1), placed
            at, held = at + ready, [block[ready:]] if ready < waiting else []
    if at != np.prod(shape[:-1]):
        raise ValueError(f"'{path}' lacks rows")


def _name_axes(file, names):
    """Attach HDF5 dimension scales, by which xarray, MATLAB and silx name the axes.

    An axis without values of its own gets a dataset that holds none, as netCDF-4 keeps such axes.
    """
    for path in sorted(names):
        group, named = path.rpartition("/")[0], file[path]
        for axis, (name, size) in enumerate(zip(names[path], named.shape)):
            where = f"{group}/{name}"
            scale = file.get(where)
            if scale is None:
                scale = file.create_dataset(where, shape=(size,), dtype="i1", track_times=False)
                scale.make_scale(f"{EMPTY_AXIS}{size:10d}")
            elif not scale.is_scale:
                scale.make_scale(name)
            if where != path:
                named.dims[axis].attach_scale(scale)


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
