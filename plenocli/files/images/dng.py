"""DNG out: the mosaic of a simulated sensor as a file that every RAW reader opens (Adobe DNG
specification 1.4).

Uncompressed 16-bit container, one strip, little-endian, nothing but tags that follow from the
arguments: same input, same bytes. What the tags cannot say (gain, band, seed, seal)
travels as JSON in the XMP packet.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from html import escape, unescape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plenocli import __version__
from plenocli.base.errors import OutputError
from plenocli.base.text import utf8
from plenocli.files.seal import SEAL, publish_sealed
from plenocli.forward.sensor.cfa import ColourProfile

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_FORMAT = {_BYTE: "B", _SHORT: "H", _LONG: "I"}
_CFA_PHOTOMETRIC, _LINEAR_RAW = 32803, 34892
_COLOUR_CODE = {"R": 0, "G": 1, "B": 2}
# XYZ to linear sRGB, D65 (IEC 61966-2-1), of a sensor without a profile of its own
_COLOUR_MATRIX = (3.2406, -1.5372, -0.4986, -0.9689, 1.8758, 0.0415, 0.0557, -0.2040, 1.0570)
_OPEN, _CLOSE = "<plenocli:capture>", "</plenocli:capture>"
_Tag = tuple[int, int, Sequence[int] | bytes]
"""Number, type and values of a tag."""
_Packed = tuple[int, int, int, bytes]
"""Number, type, count and bytes of a tag."""
SMALLEST = 22  # LibRaw takes anything smaller for no RAW file


def write_dng(
    path: str | os.PathLike[str],
    mosaic: np.ndarray,
    *,
    cfa: str,
    black: ArrayLike,
    white: float,
    exposure_s: float | None = None,
    iso: float | None = None,
    xmp_json: Mapping[str, Any] | str | None = None,
    profile: ColourProfile | None = None,
    overwrite: bool = False,
) -> None:
    """Write a sensor mosaic as DNG; `rawpy` reads the same numbers back.

    mosaic: (row, column) unsigned integers below 65536.
    cfa: "mono" or four letters, row by row.
    black: DN, one number or 2x2 by position.
    white: saturation level, DN.
    exposure_s: s.
    iso: speed, for the EXIF tag.
    xmp_json: JSON-able dict or JSON text kept in the XMP packet (attributes of a capture artefact
        by their names, "provenance"); black, white and the seal are added to it.
    profile: what the colours are.

    Raises ValueError (a bug of the caller), UsageError, OutputError.
    """
    values = np.asarray(mosaic)
    _check(path, values, cfa, white)
    pixels = np.ascontiguousarray(values, dtype="<u2").tobytes()
    levels = np.asarray(black, dtype=float)
    notes = json.loads(xmp_json) if isinstance(xmp_json, str) else dict(xmp_json or {})
    # in full: RAW readers round and merge them
    notes |= {"black": levels.tolist(), "white": float(white)}
    notes["seal"] = SEAL
    head = _headers(
        values.shape, cfa, levels, int(round(white)), exposure_s, iso, notes, len(pixels), profile
    )
    publish_sealed(path, [head, pixels], overwrite=overwrite)


def _check(path: str | os.PathLike[str], values: np.ndarray, cfa: str, white: float) -> None:
    """ValueError or OutputError for what a DNG cannot hold."""
    if (
        values.ndim != 2
        or values.size == 0
        or values.dtype.kind not in "iu"
        or values.min() < 0
        or values.max() > 65535
    ):
        raise ValueError(
            f"a DNG mosaic is a table of whole numbers 0..65535, not {values.dtype} {values.shape}"
        )
    if min(values.shape) < SMALLEST:
        raise OutputError(
            f"{values.shape[0]} x {values.shape[1]} pixels are too few for a DNG: RAW readers "
            f"refuse less than {SMALLEST} x {SMALLEST}",
            path,
            "write .h5 instead",
        )
    if cfa != "mono" and (len(cfa) != 4 or set(cfa) - set("RGB")):
        raise ValueError(f"no colour filter array {cfa!r}")
    if not 0 < white <= 65535:
        raise ValueError(f"white level {white} is not within 1..65535")


def _headers(
    shape: tuple[int, ...],
    cfa: str,
    black: np.ndarray,
    white: int,
    exposure_s: float | None,
    iso: float | None,
    notes: dict[str, Any],
    size: int,
    profile: ColourProfile | None,
) -> bytes:
    """Everything before the pixels.

    Laid out twice: the first pass finds the lengths, the second fills in the offsets.
    """
    exif: list[_Packed] = [(36864, _UNDEFINED, 4, b"0230")]
    if exposure_s:
        exif.append((33434, _RATIONAL, 1, _rationals([exposure_s])))
    if iso:
        exif.append((34855, _SHORT, 1, struct.pack("<H", int(iso))))
    start, pixels = 0, 0
    for _ in range(2):
        main = _directory(_tags(shape, cfa, black, white, notes, size, pixels, start, profile), 8)
        start = 8 + len(main)
        pixels = -(-(start + len(_directory(exif, start))) // 16) * 16
    head = b"II*\0" + struct.pack("<I", 8) + main + _directory(exif, start)
    return head.ljust(pixels, b"\0")


def _tags(
    shape: tuple[int, ...],
    cfa: str,
    black: np.ndarray,
    white: int,
    notes: dict[str, Any],
    size: int,
    pixels: int,
    exif: int,
    profile: ColourProfile | None,
) -> list[_Packed]:
    """Tags of the picture, whose pixels and EXIF directory are at these places of the file."""
    rows, columns = shape
    tags: list[_Tag] = [
        (254, _LONG, [0]),
        (256, _LONG, [columns]),
        (257, _LONG, [rows]),
        (258, _SHORT, [16]),
        (259, _SHORT, [1]),
        (262, _SHORT, [_LINEAR_RAW if cfa == "mono" else _CFA_PHOTOMETRIC]),
        (271, _ASCII, b"plenocli\0"),
        (272, _ASCII, b"simulated plenoptic camera\0"),
        (273, _LONG, [pixels]),
        (274, _SHORT, [1]),
        (277, _SHORT, [1]),
        (278, _LONG, [rows]),
        (279, _LONG, [size]),
        (284, _SHORT, [1]),
        (305, _ASCII, f"plenocli {__version__}\0".encode()),
        (700, _BYTE, _packet(notes)),
        (34665, _LONG, [exif]),
        (50706, _BYTE, [1, 4, 0, 0]),
        (50707, _BYTE, [1, 1, 0, 0]),
        (50708, _ASCII, b"plenocli simulated plenoptic camera\0"),
        (50717, _LONG, [white]),
        *_black_tags(black),
    ]
    if cfa != "mono":
        matrix = _COLOUR_MATRIX if profile is None else profile.from_xyz().ravel()
        neutral = [1.0] * 3 if profile is None or profile.neutral is None else profile.neutral
        tags += [
            (33421, _SHORT, [2, 2]),
            (33422, _BYTE, [_COLOUR_CODE[letter] for letter in cfa]),
            (50710, _BYTE, [0, 1, 2]),
            (50711, _SHORT, [1]),
            (50721, _SRATIONAL, [round(v * 10_000) for v in matrix]),
            (50728, _RATIONAL, _rationals(neutral)),
            (50778, _SHORT, [21]),
        ]
    return [_packed(*tag) for tag in sorted(tags, key=lambda tag: tag[0])]


def _black_tags(black: np.ndarray) -> list[_Tag]:
    """BlackLevelRepeatDim and BlackLevel, row by row; whole numbers as such,
    others as fractions.
    """
    levels = black.ravel() if black.shape == (2, 2) else np.array([float(black)])
    whole = all(float(v).is_integer() and 0 <= v < 65536 for v in levels)
    side = 2 if levels.size == 4 else 1
    return [
        (50713, _SHORT, [side, side]),
        (50714, _SHORT, [int(v) for v in levels])
        if whole
        else (50714, _RATIONAL, _rationals(levels)),
    ]


def _packed(number: int, kind: int, values: Sequence[int] | bytes) -> _Packed:
    """(tag, type, count, bytes)."""
    if kind in _FORMAT and not isinstance(values, bytes):
        return number, kind, len(values), struct.pack(f"<{len(values)}{_FORMAT[kind]}", *values)
    if kind == _SRATIONAL:
        return number, kind, len(values), b"".join(struct.pack("<ii", v, 10_000) for v in values)
    return number, kind, len(values) // 8 if kind == _RATIONAL else len(values), bytes(values)


def _rationals(values: Iterable[float]) -> bytes:
    parts = [
        Fraction(float(v)).limit_denominator(10**6)
        if v >= 1e-3
        else Fraction(round(float(v) * 1e9), 10**9)
        for v in values
    ]
    return b"".join(struct.pack("<II", min(p.numerator, 2**32 - 1), p.denominator) for p in parts)


def _directory(tags: list[_Packed], offset: int) -> bytes:
    """One image file directory at `offset`, with the values that do not fit into its
    entries behind it.
    """
    entries, extra = b"", b""
    behind = offset + 2 + 12 * len(tags) + 4
    for number, kind, count, data in sorted(tags):
        if len(data) <= 4:
            field = data.ljust(4, b"\0")
        else:
            field = struct.pack("<I", behind + len(extra))
            extra += data + b"\0" * (len(data) % 2)
        entries += struct.pack("<HHI", number, kind, count) + field
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + extra


def _packet(notes: dict[str, Any]) -> bytes:
    text = json.dumps(notes, sort_keys=True, ensure_ascii=False, allow_nan=False)
    return utf8(
        '<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta '
        'xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        f'xmlns:plenocli="https://plenocli.invalid/ns/1/">{_OPEN}'
        f"{escape(text, quote=False)}{_CLOSE}</"
        'rdf:Description></rdf:RDF></x:xmpmeta><?xpacket end="r"?>'
    )


def read_notes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON that `write_dng` left in the XMP packet; {} where there is none.

    Looks at the first 4 MiB only.
    """
    with open(path, "rb") as stream:
        head = stream.read(4 << 20)
    start = head.find(_OPEN.encode())
    end = head.find(_CLOSE.encode(), start)
    if not head.startswith(b"II*\0") or start < 0 or end < 0:
        return {}
    try:
        notes = json.loads(unescape(head[start + len(_OPEN) : end].decode("utf-8")))
    except ValueError:
        return {}
    return notes if isinstance(notes, dict) else {}
