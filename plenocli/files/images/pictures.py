"""Photographs and other pictures as linear light."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.tiling import bands
from plenocli.files.artefacts.provenance import first_bytes
from plenocli.files.images.exr import oiio_error, oiio_name, require_at_most
from plenocli.files.images.in_bands import put_together, rows_of, whole_bands
from plenocli.files.outside import outside_in_parts
from plenocli.files.seal import require_seal

_MAGIC = (
    (b"\x89PNG\r\n\x1a\n", "png"),
    (b"\xff\xd8\xff", "jpeg"),
    (b"II*\0", "tiff"),
    (b"MM\0*", "tiff"),
    (b"\x76\x2f\x31\x01", "exr"),
    (b"II+\0", "tiff"),
    (b"MM\0+", "tiff"),
)
_INTERLACED = 28
"""The byte of a PNG that says whether its rows come in several passes."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Linear light.

    values: (row, column, channel) float32.
    is_spectral: whether its channels are bands.
    wavelengths: (channel,) m, of a spectral picture; else None.
    """

    values: np.ndarray
    is_spectral: bool = False
    wavelengths: np.ndarray | None = None


def read_picture(path: str | os.PathLike[str]) -> Picture:
    """Read a photograph (PNG, JPEG, TIFF) or an EXR as linear values with one channel, or R,
    G, B, or one a band.

    8 and 16 bit values are taken as sRGB (IEC 61966-2-1) and decoded to 0..1; float values are
    linear already. Alpha is dropped without touching the colours.

    Raises InputError.
    """
    kind = file_type(path)
    if kind == "exr":
        return _from_exr(path)
    if kind is None:
        raise InputError("is no PNG, JPEG, TIFF or EXR", path, "convert it to one of them")
    if kind == "tiff" and Path(path).suffix.lower() not in (".tif", ".tiff"):
        raise InputError(
            "is a camera's RAW or a DNG, the mosaic of a sensor and no picture",
            path,
            "develop it, or name it .tif if it is a picture",
        )
    stored, names, _ = read_stored(path, kind)
    colours = [i for i, name in enumerate(names) if name.upper() not in ("A", "ALPHA")]
    if len(colours) not in (1, 3):
        raise InputError(
            f"has the channels {', '.join(names)}", path, "give a grey or an RGB picture"
        )
    stored = stored[..., colours]
    if stored.dtype.kind == "f":
        return Picture(values=_finite(path, stored.astype(np.float32)))
    if stored.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f"holds values of the type {stored.dtype}", path, "give 8 or 16 bits, or float"
        )
    table = srgb_to_linear(
        np.arange(np.iinfo(stored.dtype).max + 1) / np.iinfo(stored.dtype).max
    ).astype(np.float32)
    return Picture(values=table[stored])


def read_opacity(path: str | os.PathLike[str]) -> np.ndarray | None:
    """Alpha of a photograph (PNG or TIFF), (row, column) 0..1; None where it has none.

    Raises InputError.
    """
    kind = file_type(path)
    if kind in (None, "exr"):
        return None
    stored, names, _ = read_stored(path, kind)
    alpha = [i for i, name in enumerate(names) if name.upper() in ("A", "ALPHA")]
    if not alpha:
        return None
    full = 1.0 if stored.dtype.kind == "f" else np.iinfo(stored.dtype).max
    return np.clip(stored[..., alpha[0]].astype(np.float32) / np.float32(full), 0, 1)


def srgb_to_linear(encoded: ArrayLike) -> np.ndarray:
    """Linear light of sRGB-encoded values, both 0..1 (IEC 61966-2-1)."""
    encoded = np.asarray(encoded, dtype=np.float64)
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def file_type(path: str | os.PathLike[str]) -> str | None:
    """ "png", "jpeg", "tiff", "exr" or None, by the first bytes.

    Raises InputError for what is no readable file.
    """
    head = first_bytes(path, 8)
    return next((kind for magic, kind in _MAGIC if head.startswith(magic)), None)


@dataclass(frozen=True, kw_only=True)
class StoredHead:
    """What a PNG, JPEG or TIFF says before its values.

    shape: (rows, columns, channels).
    names: of the channels.
    bits: of a value.
    """

    shape: tuple[int, int, int]
    names: list[str]
    bits: int


def read_stored(
    path: str | os.PathLike[str], kind: str, *, most: int | None = None
) -> tuple[np.ndarray, list[str], int]:
    """Values of a PNG, JPEG or TIFF as they are stored.

    kind: as of file_type.
    most: bytes of values above which the file is refused, whatever memory there is.

    Returns (values (row, column, channel), channel names, bits); values of odd bit depths (10, 12,
    14) come back unscaled in uint16.
    Raises InputError, also for a TIFF of ours that was altered; NumericsError where the memory of
    this process does not hold them.
    """
    head, parts = stored_in_parts(path, kind, most=most)
    return np.asarray(put_together(parts, head.shape)), head.names, head.bits


def stored_in_parts(
    path: str | os.PathLike[str], kind: str, *, most: int | None = None, held: bool = True
) -> tuple[StoredHead, Iterator[np.ndarray]]:
    """The head of a PNG, JPEG or TIFF, and its values in bands of rows (row, column, channel), one
    after the other, as they are decoded; as read_stored.

    held: whether all bands will be in memory together.
    """
    if kind == "tiff":
        require_seal(path)
    parts = outside_in_parts(_decoded, path, kind, most, held)
    said = next(parts)
    head = StoredHead(shape=tuple(said["shape"]), names=said["names"], bits=said["bits"])
    return head, whole_bands(path, parts, head.shape)


def _decoded(path: str, kind: str, most: int | None, held: bool) -> Iterator[Any]:
    """The head of stored_in_parts, and bands of rows; runs outside."""
    import OpenImageIO as oiio

    settings = oiio.ImageSpec()
    settings.attribute("oiio:UnassociatedAlpha", 1)  # else colours come multiplied with alpha
    with oiio_name(path) as name:
        source = oiio.ImageInput.open(name, settings)
    if source is None or source.format_name() != kind:
        raise InputError(
            f"is no readable {kind.upper()}: {oiio_error(source)}", path, "make or copy it again"
        )
    try:
        spec = source.spec()
        if spec.depth > 1 or spec.nchannels > 8:
            raise InputError(
                f"has {spec.depth} layers and {spec.nchannels} channels",
                path,
                "give a flat picture",
            )
        size = spec.format.size()
        declared = spec.width * spec.height * spec.nchannels * size
        line = spec.width * spec.nchannels * size
        require_at_most(path, declared, most)
        rows = min(spec.tile_height or rows_of(line), spec.height)
        needed, why = (declared if held else 0) + 4 * rows * line, ""
        if kind == "png" and first_bytes(path, _INTERLACED + 1)[_INTERLACED]:
            needed, why = needed + declared, ": its decoder holds an interlaced PNG whole"
        budget().require_declared(path, declared, needed, why=why)
        container = 8 * size
        bits = spec.get_int_attribute("oiio:BitsPerSample", container)
        whole = spec.format.basetype in (oiio.UINT8, oiio.UINT16, oiio.UINT32)
        shape = [spec.height, spec.width, spec.nchannels]
        told = bits if whole else container
        yield {"shape": shape, "names": list(spec.channelnames), "bits": told}
        for part in bands(spec.height, rows):
            values = _rows(path, source, spec, part)
            # OpenImageIO fills the upper bits; this undoes it exactly
            yield values >> (container - bits) if whole and 8 < bits < container else values
    finally:
        source.close()
        oiio_error(source)


def _rows(path: str, source: Any, spec: Any, rows: slice) -> np.ndarray:
    """Rows of an open picture, of a tiled one those of its tiles."""
    first, last, left = spec.y + rows.start, spec.y + rows.stop, spec.x
    if spec.tile_width:
        right = left + spec.width
        ends = left, right, first, last, spec.z, spec.z + 1
        values = source.read_tiles(*ends, 0, spec.nchannels, spec.format)
    else:
        values = source.read_scanlines(first, last, spec.z, 0, spec.nchannels, spec.format)
    trouble = oiio_error(source)
    if values is None or trouble:
        raise InputError(f"is damaged: {trouble}", path, "make or copy it again")
    return np.asarray(values).reshape(rows.stop - rows.start, spec.width, spec.nchannels)


def _from_exr(path: str | os.PathLike[str]) -> Picture:
    from plenocli.files.images.exr import read_exr
    from plenocli.files.images.spectral_exr import is_spectral, read_spectral_exr

    if is_spectral(path):
        spectral = read_spectral_exr(path)
        return Picture(
            values=_finite(path, np.ascontiguousarray(np.moveaxis(spectral.values, 0, -1))),
            is_spectral=True,
            wavelengths=spectral.wavelengths,
        )
    channels, _ = read_exr(path)
    for names in (("R", "G", "B"), ("Y",), tuple(channels) if len(channels) == 1 else ("Y",)):
        if set(names) <= set(channels):
            planes = np.stack([channels[name] for name in names], axis=-1)
            return Picture(values=_finite(path, planes))
    raise InputError(
        f"has the channels {', '.join(list(channels)[:8])}, neither Y nor R, G, B nor wavelengths",
        path,
        "rename its channels",
    )


def _finite(path: str | os.PathLike[str], values: np.ndarray) -> np.ndarray:
    if not np.isfinite(values).all():
        raise InputError(
            f"holds {int((~np.isfinite(values)).sum())} values that are NaN or infinite",
            path,
            "mend or crop it",
        )
    return values
