"""Look at every object of an HDF5 file before reading a single value: what is refused, and what
the rest declares.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any, TypeAlias

import h5py
import numpy as np
from h5py import h5d, h5ds, h5l, h5t, h5z

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.memory import can_have

Name: TypeAlias = str | os.PathLike[str]
Values: TypeAlias = tuple[tuple[int, ...], np.dtype]
_FIX = (
    "make it with plenocli; files from elsewhere may hold plain numbers, and text of fixed length "
    "(numpy.bytes_), only"
)
_FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
_LINKS = {h5l.TYPE_SOFT: "a soft", h5l.TYPE_EXTERNAL: "an external"}
EMPTY_AXIS = "This is a netCDF dimension but not a netCDF variable. "
"""How the name of a dimension scale begins that holds no values."""
_AXIS_ATTRIBUTES = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST"}
"""What HDF5 keeps of dimension scales; nothing here follows the references in them."""
_ATTRIBUTE_BYTES = 8 << 20
_MAX_OBJECTS = 10_000
_MAX_DEPTH = 8


def survey(
    path: Name, file: h5py.File, apart: Mapping[str, int] | None = None
) -> dict[str, Values]:
    """Walk `file` (an open h5py.File) and return dataset path -> (shape, dtype).

    Refuses, with InputError naming `path` and the object: soft, external and user-defined links, an
    object linked twice, external or virtual storage, unknown filters, any type but plain integers,
    floats, true/false and fixed-length text, and what does not fit the
    memory of this process, as Budget.require_declared, but for the datasets that stay `apart` in
    their file. Reads no dataset.
    """
    declared: dict[str, Values] = {}
    seen: set[int] = set()
    total = 0
    stack = [
        ("", file.id if isinstance(file.id, h5py.h5g.GroupID) else h5py.h5g.open(file.id, b"/"), 0)
    ]
    while stack:
        name, group, depth = stack.pop()
        _check_attributes(path, group, f"/{name}")
        if name and not len(group):
            raise InputError(f"'/{name}' is a group without data", path, _FIX)
        for link in sorted(group):
            child = f"{name}/{_text(path, link)}".lstrip("/")
            _check_link(path, group, link, child)
            info = h5py.h5o.get_info(group, link)
            if info.addr in seen or len(seen) > _MAX_OBJECTS or depth > _MAX_DEPTH:
                raise InputError(
                    f"'/{child}' is linked twice, or the file nests too deep", path, _FIX
                )
            seen.add(info.addr)
            if info.type == h5py.h5o.TYPE_GROUP:
                stack.append((child, h5py.h5g.open(group, link), depth + 1))
            elif info.type == h5py.h5o.TYPE_DATASET:
                dataset = h5d.open(group, link)
                _check_attributes(path, dataset, f"/{child}")
                shape, dtype = _declaration(path, dataset, child)
                if _is_empty_axis(dataset):
                    continue
                declared[child] = shape, dtype
                if not stays(child, declared[child], apart or {}):
                    total += _bytes_of(declared[child])
            else:
                raise InputError(f"'/{child}' is neither a group nor a dataset", path, _FIX)
            budget().require_declared(path, total, total, f" up to '/{child}'")
    return dict(sorted(declared.items()))


def _bytes_of(declared: Values) -> int:
    """What a dataset's values take."""
    shape, dtype = declared
    return math.prod(int(n) for n in shape) * dtype.itemsize


def stays(name: str, declared: Values, apart: Mapping[str, int]) -> bool:
    """Whether a dataset stays in its file; apart: more bytes than which keep one there."""
    return name in apart and _bytes_of(declared) > apart[name]


def window(path: str, name: str, part: list[int]) -> dict[str, np.ndarray]:
    """A part of a dataset, first and last but one index on each of its axes, by its name; runs
    outside, as `reading.compressed_values`.
    """
    try:
        with h5py.File(path, "r", locking=False) as file:
            return {name: file[name][tuple(map(slice, part[::2], part[1::2]))]}
    except Exception as error:
        raise no_hdf5(path, error) from error


def no_hdf5(path: Name, error: Exception) -> Exception:
    """The error for what HDF5 says of a whole file: it does not say when it got no memory."""
    if not can_have(os.path.getsize(path) + (1 << 20)):
        return MemoryError(str(error))
    if isinstance(error, OSError) and error.errno:
        return InputError(f"cannot be read ({error.strerror})", path, "check the disk")
    return InputError(
        f"cannot be parsed as HDF5 ({type(error).__name__}: {error})", path, "make it again"
    )


def _text(path: Name, name: bytes) -> str:
    try:
        return name.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"holds an object whose name '{name.decode('utf-8', 'replace')}' is not UTF-8",
            path,
            _FIX,
        ) from error


def _check_link(path: Name, group: Any, link: bytes, child: str) -> None:
    kind = group.links.get_info(link).type
    if kind != h5l.TYPE_HARD:
        raise InputError(f"'/{child}' is {_LINKS.get(kind, 'a user-defined')} link", path, _FIX)


def _declaration(path: Name, dataset: Any, name: str) -> tuple[tuple[int, ...], np.dtype]:
    properties = dataset.get_create_plist()
    if properties.get_external_count() > 0:
        raise InputError(f"'/{name}' keeps its data in another file (external storage)", path, _FIX)
    if properties.get_layout() == h5d.VIRTUAL:
        raise InputError(f"'/{name}' is a virtual dataset, which reads other files", path, _FIX)
    for position in range(properties.get_nfilters()):
        if properties.get_filter(position)[0] not in _FILTERS:
            raise InputError(
                f"'/{name}' uses the filter {properties.get_filter(position)[0]}, not gzip, "
                "shuffle or fletcher32",
                path,
                _FIX,
            )
    _check_type(path, dataset.get_type(), f"/{name}")
    if dataset.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        raise InputError(f"'/{name}' holds no data (null dataspace)", path, _FIX)
    return tuple(dataset.shape), np.dtype(dataset.dtype)


def _check_type(path: Name, kind: Any, where: str) -> None:
    allowed = (
        kind.get_class() in (h5t.INTEGER, h5t.FLOAT)
        or (kind.get_class() == h5t.STRING and not kind.is_variable_str())
        or (kind.get_class() == h5t.ENUM and kind.dtype == np.dtype(bool))
    )
    if not allowed:
        raise InputError(
            f"'{where}' holds objects, references, compounds or text of variable length", path, _FIX
        )


def _check_attributes(path: Name, target: Any, where: str) -> None:
    for position in range(h5py.h5a.get_num_attrs(target)):
        attribute = h5py.h5a.open(target, index=position)
        label = f"{where}@{_text(path, attribute.name)}"
        if not _is_axis_list(attribute):
            _check_type(path, attribute.get_type(), label)
        count = attribute.get_space().get_simple_extent_npoints()
        if count * attribute.get_type().get_size() > _ATTRIBUTE_BYTES:
            raise InputError(f"'{label}' is larger than {_ATTRIBUTE_BYTES >> 20} MiB", path, _FIX)


def _is_axis_list(attribute):
    """Whether an attribute holds the references of dimension scales, of just the type that HDF5
    gives them.
    """
    kind = attribute.get_type()
    if attribute.name == b"DIMENSION_LIST":
        return kind.get_class() == h5t.VLEN and kind.get_super().get_class() == h5t.REFERENCE
    if attribute.name == b"REFERENCE_LIST" and kind.get_class() == h5t.COMPOUND:
        members = [kind.get_member_class(n) for n in range(kind.get_nmembers())]
        return members == [h5t.REFERENCE, h5t.INTEGER]
    return False


def _is_empty_axis(dataset):
    """Whether a dataset only gives an axis its name; its values are never read."""
    if not (h5ds.is_scale(dataset) and dataset.get_space().get_simple_extent_ndims() == 1):
        return False
    return h5ds.get_scale_name(dataset).startswith(EMPTY_AXIS.encode())


def attribute_names(target: Any) -> list[str]:
    """Names of the attributes of an h5py group or dataset but those of dimension scales, sorted."""
    return sorted(set(target.attrs) - _AXIS_ATTRIBUTES)


def read_attribute(path: Name, target: Any, name: str) -> Any:
    """One attribute as text, list of texts, Python number, bool or numpy array."""
    value = target.attrs[name]
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value[()]
    if isinstance(value, bytes):
        try:
            return value.decode("utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"attribute '{name}' is not UTF-8 text", path, _FIX) from error
    if isinstance(value, np.generic):
        return value.item()
    return value
