"""OpenEXR in and out through OpenImageIO. Channels are always found by name,
because EXR sorts them.

What we write is sealed (`files.seal`), because EXR has no checksum of its own. The clock is kept
out: the same channels give the same bytes.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli import __version__
from plenocli.base.budget import budget
from plenocli.base.errors import InputError, OutputError
from plenocli.base.memory import size_text
from plenocli.base.text import printable, utf8
from plenocli.base.tiling import EVERYTHING, Plane, bands
from plenocli.files.artefacts.provenance import first_bytes
from plenocli.files.atomic import check_output, replacement
from plenocli.files.images.in_bands import rows_of
from plenocli.files.outside import outside
from plenocli.files.seal import SEAL, put_seal, require_seal

Name = str | os.PathLike[str]
SEALED = "plenocli:seal"
_CLOCK = re.compile(r"\d{4}(:\d\d){2} \d\d(:\d\d){2}")
_EXR_MAGIC = b"\x76\x2f\x31\x01"
_COMPRESSIONS = ("none", "zip", "zips", "rle", "piz", "zstd")  # those that lose nothing
_BLOCK = 32
"""Lines that any of them packs together, at most."""


def write_exr(
    path: Name,
    channels: Mapping[str, np.ndarray | Plane],
    attrs: Mapping[str, str] | None = None,
    *,
    overwrite: bool = False,
    compression: str = "zip",
) -> None:
    """Write an EXR, some lines at a time. Same input, same bytes.

    Everything is read back and compared before the file takes its place.
    channels: name -> (row, column), all of one shape, stored as float32.
    attrs: name -> text.
    compression: one that loses nothing.

    Raises ValueError (a bug of the caller: shapes, names), UsageError, OutputError.
    """
    image, attrs = _checked(channels, attrs or {}, compression)
    check_output(path, overwrite=overwrite)
    spec = _spec(image, attrs, compression)
    spec.attribute(SEALED, SEAL)
    with replacement(path, overwrite=overwrite) as (partial, descriptor):
        import OpenImageIO as oiio

        output = oiio.ImageOutput.create("exr")
        with oiio_name(partial) as name:
            opened = output is not None and output.open(name, spec)
        if output is None or not opened:
            raise OutputError(
                f"OpenEXR cannot write it ({oiio_error(output)})",
                path,
                "check the folder and the space left",
            )
        written = all(
            output.write_scanlines(rows.start, rows.stop, 0, image.lines(rows))
            for rows in image.in_bands
        )
        closed = output.close()
        if not (written and closed):
            raise OutputError(
                f"OpenEXR could not write all of it ({oiio_error(output)})",
                path,
                "free some space; nothing was changed",
            )
        _verify(path, partial, image, attrs, compression)
        put_seal(descriptor)


def read_exr(
    path: Name, *, most: int | None = None
) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Channels and text attributes of an EXR file.

    most: bytes of pixels above which the file is refused, whatever memory there is.

    Returns name -> (row, column) float32, and name -> text.
    Raises InputError for a file that is missing, damaged, above `most`, deep, in several parts, or
    holds integer channels.
    """
    require_seal(path)
    channels, attrs = outside(_channels, path, most)
    return channels, attrs


def _channels(path: str, most: int | None) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """As read_exr; runs outside."""
    with _opened(path) as source:
        spec = source.spec()
        _check_header(path, source, spec, most)
        pixels = source.read_image("float")
        if pixels is None:
            raise InputError(f"is damaged: {oiio_error(source)}", path, "make or copy it again")
        attrs = _texts(spec)
        pixels = np.asarray(pixels, dtype=np.float32).reshape(
            spec.height, spec.width, spec.nchannels
        )
        # damaged text may come as lone surrogates
        "".join([*spec.channelnames, *attrs, *attrs.values()]).encode()
        channels = {
            name: np.ascontiguousarray(pixels[..., i]) for i, name in enumerate(spec.channelnames)
        }
    return channels, attrs


@dataclass(frozen=True, kw_only=True)
class Header:
    """What an EXR says before its pixels.

    names: of the channels.
    attrs: name -> text.
    shape: (rows, columns).
    by_lines: whether lines follow each other, and can be read without the others.
    """

    names: list[str]
    attrs: dict[str, str]
    shape: tuple[int, int]
    by_lines: bool


def read_header(path: Name) -> Header:
    """The header alone, of a file of ours verified.

    Raises InputError as read_exr.
    """
    require_seal(path)
    found = outside(_header, path)
    return Header(**found | {"shape": tuple(found["shape"])})


def _header(path: str) -> dict[str, Any]:
    """As read_header; runs outside."""
    with _opened(path) as source:
        spec = source.spec()
        _check_kind(path, source, spec)
        names, attrs = list(spec.channelnames), _texts(spec)
        "".join([*names, *attrs, *attrs.values()]).encode()
        shape = [spec.height, spec.width]
        return {"names": names, "attrs": attrs, "shape": shape, "by_lines": not spec.tile_width}


def stored_channel(path: Name, header: Header, name: str) -> Plane:
    """A channel whose values stay in the file, by the Header of one `by_lines`; windows of it raise
    InputError.
    """

    def window(rows: slice, columns: slice) -> np.ndarray:
        first, last, _ = rows.indices(header.shape[0])
        budget().require_reading(path, 2 * 4 * (last - first) * header.shape[1])
        values: np.ndarray = outside(_lines, path, name, first, last)
        return values[:, columns]

    return Plane(header.shape, window)


def _lines(path: str, name: str, first: int, last: int) -> np.ndarray:
    """Lines `first` to `last` of a channel (row, column); runs outside."""
    with _opened(path) as source:
        spec = source.spec()
        at = spec.channelnames.index(name)
        lines = source.read_scanlines(spec.y + first, spec.y + last, 0, at, at + 1, "float")
        if lines is None:
            raise InputError(f"is damaged: {oiio_error(source)}", path, "make or copy it again")
        return np.asarray(lines, np.float32).reshape(last - first, spec.width)


def channel_names(path: Name) -> list[str]:
    """Names of the channels, from the header alone.

    Raises InputError.
    """
    names: list[str] = outside(_names, path)
    return names


def _names(path: str) -> list[str]:
    """As channel_names; runs outside."""
    with _opened(path) as source:
        return list(source.spec().channelnames)


# --- writing --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Image:
    """What is written.

    planes: of the channels (row, column), by their names in order.
    """

    planes: dict[str, Plane]

    @property
    def names(self) -> list[str]:
        return list(self.planes)

    @property
    def shape(self) -> tuple[int, ...]:
        return next(iter(self.planes.values())).shape

    @property
    def in_bands(self) -> list[slice]:
        """Rows of bands of whole blocks of lines, whatever the compression."""
        most = rows_of(4 * self.shape[1] * len(self.planes))
        return bands(self.shape[0], max(_BLOCK, most // _BLOCK * _BLOCK))

    def lines(self, rows: slice) -> np.ndarray:
        """Of all channels, (row, column, channel) float32."""
        out = np.empty((rows.stop - rows.start, self.shape[1], len(self.planes)), np.float32)
        for number, plane in enumerate(self.planes.values()):
            out[..., number] = plane.read(rows, EVERYTHING)
        return out


def _checked(
    channels: Mapping[str, np.ndarray | Plane], attrs: Mapping[str, str], compression: str
) -> tuple[_Image, dict[str, str]]:
    planes = {name: Plane.of(channels[name]) for name in sorted(channels)}
    shapes = {plane.shape for plane in planes.values()}
    if not planes or len(shapes) != 1 or any(len(s) != 2 or 0 in s for s in shapes):
        raise ValueError(
            f"EXR channels must be two-dimensional, not empty and of one shape, not {shapes}"
        )
    # EXR keeps 255 bytes of a name; OpenImageIO renames empty and repeated ones without a word
    if any(not name or len(name.encode()) > 255 or "\0" in name for name in planes) or len(
        {n.lower() for n in planes}
    ) != len(planes):
        raise ValueError(f"EXR channel names must be distinct and not empty: {list(planes)}")
    if any(not isinstance(v, str) or not n for n, v in attrs.items()):
        raise ValueError(
            "EXR attributes must be text: OpenImageIO drops other types without a word"
        )
    if compression not in _COMPRESSIONS:
        raise ValueError(f"EXR compression {compression!r} is none of {_COMPRESSIONS}")
    return _Image(planes), {name: utf8(value).decode() for name, value in attrs.items()}


def _spec(image: _Image, attrs: Mapping[str, str], compression: str) -> Any:
    import OpenImageIO as oiio

    rows, columns = image.shape
    spec = oiio.ImageSpec(columns, rows, len(image.names), "float")
    spec.channelnames = image.names
    for name, value in attrs.items():
        spec.attribute(name, value)
    spec.attribute("compression", compression)
    if not _CLOCK.fullmatch(attrs.get("DateTime", "")):
        spec.attribute("DateTime", "2000:01:01 00:00:00")  # left out, OpenImageIO writes the clock
    spec.attribute("Software", f"plenocli {__version__}")
    return spec


def _verify(
    path: Name,
    partial: Path,
    image: _Image,
    attrs: dict[str, str],
    compression: str,
) -> None:
    """Compare the file with what went in: OpenImageIO drops what it cannot store, and misses a
    disk that gets full, without an error.
    """
    import OpenImageIO as oiio

    with oiio_name(partial) as name:
        source = oiio.ImageInput.open(name)
    if source is None:
        raise OutputError(
            f"cannot be read back ({oiio_error(None)})",
            path,
            "free some space; nothing was changed",
        )
    spec = source.spec()
    back, stored = {a.name: a.value for a in spec.extra_attribs}, list(spec.channelnames)
    wrong = [
        name
        for name, value in (attrs | {"compression": compression}).items()
        if back.get(name) != value
    ]
    if sorted(stored) != image.names or wrong or spec.format.basetype != oiio.FLOAT:
        raise OutputError(
            f"EXR does not keep {wrong or 'the channel names'}", path, "use other names"
        )
    order, same = [stored.index(name) for name in image.names], True
    for rows in image.in_bands:
        found = source.read_scanlines(rows.start, rows.stop, 0, 0, len(order), "float")
        lines = image.lines(rows)
        same = (
            same and found is not None and _is_same(found.reshape(lines.shape)[..., order], lines)
        )
    trouble = oiio_error(source)
    source.close()
    if trouble or not same:
        raise OutputError(
            f"does not hold what was written ({trouble or 'other values'})",
            path,
            "free some space; nothing was changed",
        )


def _is_same(one: np.ndarray, other: np.ndarray) -> bool:
    """Bit by bit, NaN too."""
    return np.array_equal(one.view(np.uint32), other.view(np.uint32))


# --- reading --------------------------------------------------------------------------------------


@contextlib.contextmanager
def _opened(path: Name) -> Iterator[Any]:
    """An open ImageInput of the EXR at `path`, closed afterwards; the type is taken from the
    content, not from the name.
    """
    import OpenImageIO as oiio

    path = Path(path)
    if first_bytes(path, len(_EXR_MAGIC)) != _EXR_MAGIC:
        raise InputError("is not an EXR file", path, "give an .exr")
    try:
        with oiio_name(path) as name:
            source = oiio.ImageInput.open(name)
    except UnicodeError:
        source = None
    if source is None or source.format_name() != "openexr":
        raise InputError(f"is no readable EXR: {oiio_error(source)}", path, "make or copy it again")
    try:
        yield source
    except UnicodeError as error:
        raise InputError(
            "is damaged: an attribute or channel name is not text", path, "make or copy it again"
        ) from error
    finally:
        source.close()
        oiio_error(source)  # an error never fetched is printed when the process ends


def _texts(spec: Any) -> dict[str, str]:
    return {a.name: a.value for a in spec.extra_attribs if isinstance(a.value, str)}


def _check_header(path: Name, source: Any, spec: Any, most: int | None) -> None:
    _check_kind(path, source, spec)
    declared = spec.width * spec.height * spec.nchannels * 4
    require_at_most(path, declared, most)
    budget().require_declared(path, declared, declared)


def _check_kind(path: Name, source: Any, spec: Any) -> None:
    import OpenImageIO as oiio

    if spec.deep:
        raise InputError("is a deep EXR", path, "flatten it first")
    formats = spec.channelformats or (spec.format,) * spec.nchannels
    if any(f.basetype not in (oiio.FLOAT, oiio.HALF) for f in formats):
        raise InputError(
            "holds integer channels, which have no unit", path, "keep only half and float channels"
        )
    if source.seek_subimage(1, 0):
        raise InputError("holds several parts", path, "split it into one file a part")
    oiio_error(source)
    source.seek_subimage(0, 0)


def require_at_most(path: Name, declared: int, most: int | None) -> None:
    """InputError where a file declares more bytes of values than `most`, unless that is None."""
    if most is not None and declared > most:
        raise InputError(
            f"declares {size_text(declared)} of data, more than {size_text(most)}",
            path,
            "give a grid of at most 1024 x 1024 values",
        )


@contextlib.contextmanager
def oiio_name(path: Name) -> Iterator[str]:
    """A name by which OpenImageIO, which knows UTF-8 only, can open a file that is there."""
    name = os.fsdecode(path)
    if name.isascii() or printable(name) == name:
        yield name
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        yield f"/proc/self/fd/{descriptor}"
    finally:
        os.close(descriptor)


def oiio_error(handle: Any) -> str:
    """The pending message of an OpenImageIO object (or of the library, for None), its first
    line; fetching clears it.
    """
    import OpenImageIO as oiio

    try:
        own = handle.geterror() if handle is not None else ""
        return (own or oiio.geterror()).strip().partition("\n")[0]
    except UnicodeDecodeError:  # the message quotes a name that is not text
        return "a name in its header is not text"
