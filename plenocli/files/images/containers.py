"""Captures in containers of others: pages of a TIFF, Lytro's LFP and LFR, and microscopes' CZI and
ND2 (with the extra `[bio]`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError, PlenoError
from plenocli.base.progress import note
from plenocli.base.text import by
from plenocli.base.tiling import Plane, Room, bands
from plenocli.files.images.in_bands import put_together, rows_of, sound, whole_bands
from plenocli.files.outside import outside_in_parts
from plenocli.forward.sensor.cfa import ColourProfile

if TYPE_CHECKING:
    from tifffile import TiffFile, TiffPageSeries

LYTRO = b"\x89LFP\r\n\x1a\n"
BIO = (".czi", ".nd2")
"""Suffixes that the extra `[bio]` reads."""
_AVERAGED = "IQ"
"""Axes of a TIFF's pages of which nobody says what they go along: exposures of one thing."""


@dataclass(frozen=True, kw_only=True)
class Contained:
    """A mosaic from a container.

    values: (row, column), in memory or in a file.
    cfa: "mono" or four letters.
    black: (2, 2) by position; white: the level of saturation; units of the values.
    exposure_s: s, None where unknown.
    profile: what its colours are, or None.
    details: what else is known, by its names.
    """

    values: np.ndarray | Plane
    cfa: str = "mono"
    black: np.ndarray
    white: float
    exposure_s: float | None = None
    profile: ColourProfile | None = None
    details: dict[str, Any]


@dataclass(frozen=True)
class Pages:
    """Mean (row, column) of the pages of a TIFF, and the level of saturation of their type."""

    values: np.ndarray | Plane
    white: float


def read_pages(path: Path, room: Room | None) -> Pages | None:
    """The mosaic (row, column) of a TIFF with several pages or further axes; None of a plain one.

    Pages of which nobody says what they go along are exposures of one thing, and averaged; a note
    says so.
    room: as of plenocli.files.images.in_bands.put_together.

    Raises InputError where pages are times, planes or channels.
    """
    parts = outside_in_parts(_pages, path, room is None)
    found = next(parts, None)
    if found is None:
        return None
    _require_one(path, found["axes"], found["shape"])
    count, picture = found["pages"], tuple(found["picture"])
    bands_of = sound(path, whole_bands(path, parts, picture, count))
    values = put_together(bands_of, picture, room, count)
    if count > 1:
        note(f"{path.name}: its {count} pages are averaged; frames of a movie go to files")
    return Pages(values, found["white"] or np.inf)


def _require_one(path: Path, axes: str, shape: list[int]) -> None:
    """InputError where axes other than rows, columns and exposures have more than one place."""
    names = {"T": "times", "Z": "planes", "C": "channels", "S": "colours", "M": "tiles"}
    many = [
        f"{size} {names.get(axis, 'places along ' + axis)}"
        for axis, size in zip(axes, shape)
        if size > 1 and axis not in "YX" + _AVERAGED
    ]
    if many:
        raise InputError(
            f"holds {' and '.join(many)}, a capture is one exposure",
            path,
            "save each as a file of its own (ImageJ: File, Save As, Image Sequence)",
        )


def _pages(path: str, held: bool) -> Iterator[Any]:
    """What a TIFF has beside one plain page, and bands of rows of its pages, one after the other;
    nothing of others; runs outside.

    held: whether their mean will be in memory.
    """
    import tifffile

    pages = 1
    try:
        with tifffile.TiffFile(path) as file:
            first = file.series[0]
            axes, shape, every = first.axes, [int(n) for n in first.shape], [first]
            alike = [s for s in file.series if s.shape == first.shape and s.dtype == first.dtype]
            if axes == "YX" and len(alike) > 1 and not file.is_ome:
                axes, shape, every = "IYX", [len(alike), *shape], alike
            counted = {a: n for a, n in zip(axes, shape) if n > 1}
            if not set(counted) - set("YXS"):
                return
            picture = [counted.get("Y", 1), counted.get("X", 1)]
            size = math.prod(picture) * first.dtype.itemsize
            pages = math.prod([n for a, n in counted.items() if a in _AVERAGED])
            budget().require_declared(path, pages * size, 2 * size + 8 * held * math.prod(picture))
            white = float(np.iinfo(first.dtype).max) if first.dtype.kind == "u" else None
            yield {"axes": axes, "shape": shape, "picture": picture, "pages": pages, "white": white}
            for one in every:
                for values in _by_page(file, one):
                    for whole in values.reshape(-1, *picture):
                        for rows in bands(picture[0], rows_of(whole[0].nbytes)):
                            yield whole[rows]
    except (PlenoError, MemoryError):
        raise
    except Exception as error:  # tifffile raises many types for a damaged file
        if pages == 1:
            return  # the usual reader says more
        raise InputError(
            f"holds {pages} pages that cannot all be read ({error})", path, "make or copy it again"
        ) from None


def _by_page(file: TiffFile, series: TiffPageSeries) -> Iterator[np.ndarray]:
    """Values of the pages of a series, of one at a time."""
    if series.dataoffset is None:
        for page in series.pages:
            if page is None:
                raise ValueError("one is not there")
            yield page.asarray(maxworkers=1)
        return
    # one after the other, and some programs describe only the first
    count, of = math.prod(series.shape[-2:]), series.dtype.newbyteorder(file.byteorder)
    for number in range(math.prod(series.shape[:-2])):
        start = series.dataoffset + number * count * of.itemsize
        yield file.filehandle.read_array(of, count, start).astype(series.dtype, copy=False)


def read_lytro(path: Path, room: Room | None) -> Contained:
    """The mosaic in a Lytro's container: .lfp of the first camera, .lfr of the Illum.

    room: as of plenocli.files.images.in_bands.put_together.

    Raises InputError for what is none, and for containers without a mosaic, such as developed
    pictures.
    """
    parts = outside_in_parts(_lytro, path, room is None)
    found = next(parts)
    image = found["about"]["image"]
    raw = image.get("rawDetails", image)
    levels, corner = raw.get("pixelFormat", {}), raw.get("mosaic", {}).get("upperLeftPixel", "gr")
    # the tile is r, gr over gb, b
    kinds = {"r": "RGGB", "gr": "GRBG", "gb": "GBRG", "b": "BGGR"}
    if corner not in kinds:
        raise InputError(f"begins with a pixel {corner!r}", path, "give one of r, gr, gb or b")
    turned = list(kinds).index(corner)
    tile = np.roll([["r", "gr"], ["gb", "b"]], (-(turned // 2), -(turned % 2)), axis=(0, 1))
    black, top = levels.get("black", {}), float(2 ** found["bits"] - 1)
    size = tuple(found["size"])
    return Contained(
        values=put_together(whole_bands(path, parts, size), size, room),
        cfa=kinds[corner],
        black=np.array([[float(black.get(name, 0.0)) for name in row] for row in tile]),
        white=float(levels.get("white", {}).get("gr", top)),
        exposure_s=found["about"]
        .get("devices", {})
        .get("shutter", {})
        .get("pixelExposureDuration"),
        profile=_lytro_profile(image.get("color", {})),
        details={
            name: str(value)
            for name, value in found["about"].get("camera", {}).items()
            if name in ("make", "model")
        },
    )


def _lytro_profile(colour: dict[str, Any]) -> ColourProfile | None:
    matrix = colour.get("ccmRgbToSrgbArray", colour.get("ccm"))
    if matrix is None or len(matrix) != 9:
        return None
    gains = colour.get("whiteBalanceGain", {})
    gain = np.array([float(gains.get(name, 0.0)) for name in ("r", "gr", "b")])
    return ColourProfile(
        to_rgb=np.array(matrix, float).reshape(3, 3),
        neutral=gain.min() / gain if (gain > 0).all() else None,
    )


def _lytro(path: str, held: bool) -> Iterator[Any]:
    """Size, bits of a value and metadata of a Lytro's container, and bands of rows of its mosaic;
    runs outside.

    held: whether that will be in memory.
    """
    try:
        parts = _chunks(Path(path).read_bytes())
        contents = json.loads(bytes(parts[b"LFM"]))
        frames = contents["frames"] if "frames" in contents else contents["picture"]["frameArray"]
        named = frames[0]["frame"]
        about = json.loads(bytes(parts[named["metadataRef"].encode()]))
        image = about["image"]
        raw = image.get("rawDetails", image)
        rows, columns = int(image["height"]), int(image["width"])
        bits = int(raw["pixelPacking"]["bitsPerPixel"])
        packed, size = parts[named["imageRef"].encode()], 2 * rows * columns
        if bits not in (10, 12) or len(packed) < rows * columns * bits // 8:
            raise ValueError(
                f"{len(packed)} bytes are not {rows} x {columns} values of {bits} bits"
            )
        budget().require_declared(path, size, size * held + Path(path).stat().st_size)
        yield {"size": [rows, columns], "bits": bits, "about": about}
        # whole groups of values
        for band in bands(rows, max(4, rows_of(12 * columns) // 4 * 4)):
            begin, end = (row * columns * bits // 8 for row in (band.start, band.stop))
            yield _unpacked(packed[begin:end], bits).reshape(-1, columns)
    except (PlenoError, MemoryError):
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise InputError(
            f"holds no capture of a Lytro, or is damaged ({type(error).__name__}: {error})",
            path,
            "give the .lfp or .lfr as the camera wrote it",
        ) from None


def _chunks(data: bytes) -> dict[bytes, memoryview]:
    """Contents of a container by their names; that of the table of contents by b"LFM".

    Each has a head of 16 bytes that ends in its size, a name of 45 in 80, and zeros behind it.
    """
    found: dict[bytes, memoryview] = {}
    place, whole = 16, memoryview(data)
    while (place := data.find(b"\x89LF", place)) >= 0 and place + 96 <= len(data):
        size = int.from_bytes(data[place + 12 : place + 16], "big")
        content = whole[place + 96 : place + 96 + size]
        if len(content) < size:
            raise ValueError(f"ends {size - len(content)} bytes early")
        name = data[place + 16 : place + 61]
        found[b"LFM" if data[place + 1 : place + 4] == b"LFM" else name] = content
        place += 96 + size if size else 16
    return found


def _unpacked(packed: memoryview, bits: int) -> np.ndarray:
    """(value,) uint16 of values of 12 bits, two in three bytes, or of 10, the upper eight of four
    before the lowest pairs of all.
    """
    group = np.frombuffer(packed, np.uint8).reshape(-1, 3 if bits == 12 else 5)
    parts = group.astype(np.uint16).T
    if bits == 12:
        values = np.stack([parts[0] << 4 | parts[1] >> 4, (parts[1] & 15) << 8 | parts[2]], axis=1)
    else:
        low = [(parts[4] >> shift) & 3 for shift in (0, 2, 4, 6)]
        values = np.stack([high << 2 | pair for high, pair in zip(parts, low)], axis=1)
    return values.ravel()


def read_bio(path: Path, room: Room | None) -> np.ndarray | Plane:
    """The one picture (row, column) of a CZI or ND2 file, by bioio, which holds it.

    room: as of plenocli.files.images.in_bands.put_together.

    Raises InputError where bioio is missing, cannot read it, or finds several pictures.
    """
    from plenocli.base.text import how_to_install

    try:
        from bioio import BioImage
    except ImportError:
        raise InputError(
            f"is {path.suffix[1:].upper()}, which needs bioio", path, how_to_install("bio")
        ) from None
    try:
        image = BioImage(path)
        axes, shape = image.dims.order, [int(n) for n in image.shape]
    except Exception as error:  # its readers raise many types
        raise InputError(
            f"cannot be read by bioio ({type(error).__name__}: {error})", path, "export a TIFF"
        ) from None
    _require_one(path, axes, shape)
    rows, columns = (shape[axes.index(axis)] for axis in "YX")
    if rows < 2 or columns < 2:
        raise InputError(f"holds {by((rows, columns))} pixels", path, "give a capture")
    budget().require_declared(path, 8 * rows * columns, 8 * rows * columns)
    whole = np.asarray(image.data).reshape(rows, columns)
    return put_together([whole], (rows, columns), room)
