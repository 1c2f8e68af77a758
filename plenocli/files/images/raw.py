"""Camera RAW and DNG: the mosaic as stored, with the levels of each position, never demosaiced.

LibRaw runs outside (`files.outside`); what it returns must be plausible before anyone computes with
it.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError, PlenoError
from plenocli.base.tiling import Plane, Room, bands
from plenocli.files.artefacts.provenance import require_file
from plenocli.files.images.dng import read_notes
from plenocli.files.images.in_bands import put_together, rows_of, whole_bands
from plenocli.files.outside import outside, outside_in_parts
from plenocli.files.seal import require_seal
from plenocli.forward.sensor.cfa import ColourProfile

DECODER_COPIES = 2
"""Of a mosaic that LibRaw, its colours and a band of rows take (measured)."""
_FIX = "give an intact camera RAW or DNG with a colour filter mosaic"
_CLOCK = re.compile(r"([12]\d{3}):(\d\d):(\d\d) (\d\d:\d\d:\d\d)")
_REASONS = {
    "LibRawFileUnsupportedError": (
        "is not a RAW file that LibRaw knows, or too damaged to be recognised"
    ),
    "LibRawIOError": "ends before its image does, or is damaged",
    "LibRawDataError": "holds corrupt image data",
    "LibRawTooBigError": "declares an image that is too big; the file is damaged",
    "LibRawUnspecifiedError": "cannot be unpacked",
}


@dataclass(frozen=True, kw_only=True)
class RawFile:
    """What a camera's RAW or a DNG holds.

    values: (row, column) uint16 without masked borders, DN; a Plane where it has room in a file.
    cfa: "mono" or four letters, row by row.
    black: (2, 2) by position, DN.
    white: DN.
    exposure_s: s, None where unknown.
    gain: DN per electron, None where unknown.
    profile: what its colours are; None of a mono sensor, or where nobody says.
    details: what else the file says, by its names.
    """

    values: np.ndarray | Plane
    cfa: str
    black: np.ndarray
    white: float
    exposure_s: float | None
    gain: float | None
    profile: ColourProfile | None
    details: dict[str, Any]


def read_raw(path: str | Path, room: Room | None = None) -> RawFile:
    """Read a RAW file or DNG.

    room: for its mosaic, where that is large beside the memory; LibRaw itself holds all of it.

    Raises InputError, saying why, for a file that LibRaw cannot read, that holds no mosaic, or
    whose mosaic is implausible; NumericsError where the memory of this process does not hold it;
    OutputError where there is no room.
    """
    path = Path(path)
    size = require_file(path)
    budget().require_reading(path, size)
    ours = require_seal(path)
    parts = outside_in_parts(_decoded, path, room is None)
    found = next(parts)
    cfa, shape = _letters(path, found), tuple(found["shape"])
    if len(shape) != 2 or 0 in shape:
        raise InputError("came back incomplete from LibRaw", path, _FIX)
    black = (
        np.array(found["black"])[np.clip(np.array(found.get("indices", [[0, 0], [0, 0]])), 0, 3)]
        if cfa != "mono"
        else np.full((2, 2), found["black"][0])
    )
    notes = _own_notes(path) if ours else {}
    if notes:
        black, found["white"] = (
            np.broadcast_to(np.asarray(notes["black"]), (2, 2)).astype(float),
            notes["white"],
        )
    counts = np.zeros((2, 2, 1 << 16), np.int64)
    values = put_together(_counted(whole_bands(path, parts, shape), counts), shape, room)
    if not notes:
        _check_plausible(path, counts, black, found["white"])
    details = {
        key: found[key]
        for key in ("full_shape", "camera_white", "iso", "f_number", "focal_length_m")
        if found.get(key)
    }
    details |= {key: found["exif"][key] for key in ("make", "model") if key in found["exif"]}
    details |= {key: value for key, value in notes.items() if key != "seal"} | {
        "verified": bool(notes)
    }
    return RawFile(
        values=values,
        cfa=cfa,
        black=black,
        white=float(found["white"]),
        exposure_s=notes.get("exposure_s") or _exposure(found),
        gain=1 / notes["gain_e_per_dn"] if notes.get("gain_e_per_dn") else None,
        profile=None if cfa == "mono" else _profile(found),
        details=details,
    )


def _counted(parts: Iterable[np.ndarray], counts: np.ndarray) -> Iterator[np.ndarray]:
    """The same bands of rows, of uint16; `counts` (2, 2, value) then has how many pixels of each
    position report each value.
    """
    top = 0
    for part in parts:
        for i, j in np.ndindex(2, 2):
            here = part[(i - top) % 2 :: 2, j::2]
            counts[i, j] += np.bincount(here.ravel(), minlength=counts.shape[2])
        top += len(part)
        yield part


def _profile(found: dict[str, Any]) -> ColourProfile | None:
    """The camera's colours by the matrix that the file, or LibRaw of its maker, tells; white is
    that of the shot.
    """
    gains = np.array(found["gains"], float)
    told = (gains > 0).all() and np.isfinite(gains).all() and np.ptp(gains) > 0
    neutral = gains.min() / gains if told else None
    from_xyz, to_rgb = np.array(found["from_xyz"]), np.array(found["to_rgb"])
    if from_xyz.any():
        return ColourProfile.of_matrix(from_xyz, neutral)
    if to_rgb.any() and np.isfinite(to_rgb).all():
        return ColourProfile(to_rgb=to_rgb, neutral=neutral)
    return None


def _decoded(path: str, held: bool) -> Iterator[Any]:
    """What LibRaw and the EXIF tags say of a file, then its mosaic in bands of rows; runs outside.

    held: whether all bands will be in memory together.
    """
    import rawpy

    name = path
    try:
        path.encode()
    except UnicodeEncodeError:  # LibRaw is given UTF-8 only
        name = f"/proc/self/fd/{os.open(path, os.O_RDONLY)}"
    try:
        with rawpy.imread(name) as raw:
            declared = 2 * raw.sizes.raw_width * raw.sizes.raw_height
            needed = (DECODER_COPIES + held) * declared
            why = ": LibRaw holds the whole mosaic"
            budget().require_declared(path, declared, needed, why=why)
            yield {**_said(path, raw), "exif": _exif(path)}
            visible = raw.raw_image_visible
            for rows in bands(visible.shape[0], rows_of(2 * visible.shape[1])):
                yield visible[rows].astype("<u2")  # LibRaw frees the mosaic when it is closed
    except rawpy.LibRawError as error:
        raise InputError(_reason(error, path), path, _FIX) from None


def _said(path: str, raw: Any) -> dict[str, Any]:
    """Shape, levels and colours of a file that LibRaw has open."""
    import rawpy

    if raw.raw_type != rawpy.RawType.Flat:
        raise InputError(
            f"holds {raw.raw_image.shape[-1]} values a pixel, not a colour filter mosaic: "
            "it is demosaiced, a scan or a stack",
            path,
            _FIX,
        )
    colours, camera_white = raw.raw_colors_visible, raw.camera_white_level_per_channel
    found = {
        "shape": list(raw.raw_image_visible.shape),
        "full_shape": list(raw.raw_image.shape),
        "description": raw.color_desc.decode("latin-1"),
        "colour_count": int(raw.num_colors),
        "black": [float(v) for v in raw.black_level_per_channel],
        "white": float(raw.white_level),
        "camera_white": None if camera_white is None else [float(v) for v in camera_white],
        # XYZ to camera, or camera over white to sRGB; zeros where LibRaw knows none
        "from_xyz": raw.rgb_xyz_matrix[:3].tolist(),
        "to_rgb": raw.color_matrix[:, :3].tolist(),
        "gains": [float(v) for v in raw.camera_whitebalance[:3]],
        "exposure_s": float(raw.other.shutter_speed),
        "iso": float(raw.other.iso_speed),
        "f_number": float(raw.other.aperture),
        "focal_length_m": float(raw.other.focal_length) / 1000,
    }
    if colours.shape[0] >= 2 and colours.shape[1] >= 2:
        indices = colours[:2, :2].astype(int)
        corner = colours[:48, :48]  # LibRaw's patterns repeat every 16 pixels at most
        repeats = all((corner[i::2, j::2] == indices[i, j]).all() for i in (0, 1) for j in (0, 1))
        found |= {"indices": indices.tolist(), "repeats": repeats}
    return found


def captured_at(path: str | Path) -> str | None:
    """When a camera took a RAW, DNG or TIFF by its own clock, "2026-11-24T07:30:00"; None where the
    file does not say it.
    """
    if Path(path).suffix.lower() in (".h5", ".exr", ".png"):
        return None
    try:
        when = outside(_exif, path).get("captured")
    except PlenoError:  # a courtesy
        return None
    return None if when is None else str(when)


def _exif(path: str) -> dict[str, Any]:
    """Make, model, exposure and time from the EXIF tags, as far as they can be read."""
    import exifread

    logging.disable(logging.CRITICAL)
    try:
        with open(path, "rb") as stream:
            tags = exifread.process_file(stream, details=False)
    except Exception:  # a courtesy: whatever breaks in the tags, the mosaic stands on its own
        return {}
    found: dict[str, Any] = {}
    for key, name in (("Image Make", "make"), ("Image Model", "model")):
        if key in tags:
            found[name] = str(tags[key]).strip("\0 ")
    for key in ("EXIF ExposureTime", "Image ExposureTime"):
        try:
            found.setdefault("exposure_s", float(tags[key].values[0]))
        except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError, AttributeError):
            continue
    for key in ("EXIF DateTimeOriginal", "Image DateTime"):
        if clock := _CLOCK.match(str(tags.get(key, ""))):
            found.setdefault("captured", "{}-{}-{}T{}".format(*clock.groups()))
    return found


def _reason(error: Exception, path: str) -> str:
    """A sentence for the user from what LibRaw said."""
    text = error.args[0] if error.args else ""
    text = text.decode("latin-1") if isinstance(text, bytes) else str(text)
    known = _REASONS.get(type(error).__name__)
    if known is None:
        return f"{text} ({type(error).__name__})"
    return f"{known} ({os.path.getsize(path)} bytes; LibRaw: {text})"


def _letters(path: Path, found: dict[str, Any]) -> str:
    """ "mono" or four letters, row by row, from LibRaw's colour indices."""
    if found["colour_count"] == 1:
        return "mono"
    if "indices" not in found or not found["repeats"]:
        raise InputError(
            "has a colour filter array that does not repeat every 2x2 pixels (such as X-Trans)",
            path,
            _FIX,
        )
    names = found["description"]
    indices = [i for row in found["indices"] for i in row]
    letters = "".join(names[i] if i < len(names) else "?" for i in indices)
    if set(letters) - set("RGB") or len(set(letters)) == 1:
        raise InputError(
            f"has no red, green and blue filter mosaic (LibRaw sees '{letters}')", path, _FIX
        )
    return letters


def _own_notes(path: Path) -> dict[str, Any]:
    """What `write_dng` left in a file of ours."""
    notes = read_notes(path)
    black: Any = notes.get("black")
    numbers = [
        notes.get("white"),
        *np.ravel(black),
        *(notes[k] for k in ("exposure_s", "gain_e_per_dn", "band_m") if notes.get(k) is not None),
    ]
    if np.size(black) not in (1, 4) or any(
        isinstance(v, bool) or not isinstance(v, (int, float)) for v in numbers
    ):
        raise InputError(
            "is damaged or was edited: its XMP notes hold no levels", path, "make it again"
        )
    return notes


def _exposure(found: dict[str, Any]) -> float | None:
    """Exposure time, s, or None: the exact fraction of the EXIF tag where it agrees with
    LibRaw's single precision.
    """
    exact, rounded = found["exif"].get("exposure_s"), found["exposure_s"]
    return exact if exact and (not rounded or abs(exact / rounded - 1) < 1e-3) else rounded or None


def _check_plausible(path: Path, counts: np.ndarray, black: np.ndarray, white: float) -> None:
    """Refuse a mosaic that opens without error and yet cannot be a photograph: LibRaw fills what
    it could not read with zeros.

    counts: (2, 2, value) pixels of each position with each value.
    """
    value, every = np.arange(counts.shape[2]), counts.sum(axis=(0, 1))
    size = int(every.sum())
    zeros = float(every[0] / size)
    if zeros >= 0.99:
        raise InputError(
            f"is {zeros:.1%} zeros although LibRaw reports no error: the image data "
            "are missing or cut off",
            path,
            _FIX,
        )
    if not white > black.max():
        raise InputError(
            f"has a white level of {white:g} DN, not above its black level of {black.max():g} DN",
            path,
            _FIX,
        )
    over = float(every[value > white].sum() / size)
    if over > 0.01:
        raise InputError(
            f"contradicts its metadata: {over:.1%} of the pixels are above its white "
            f"level of {white:g} DN",
            path,
            _FIX,
        )
    least = black - 0.02 * (white - black)
    below = np.where(value < least[..., None], counts, 0).sum(axis=2)
    share = float((below / np.maximum(counts.sum(axis=2), 1)).max())
    if share > 0.5:
        raise InputError(
            f"contradicts its metadata: {share:.0%} of the pixels at one position lie far "
            f"below its black level of {black.max():g} DN",
            path,
            _FIX,
        )
    if size > 1 and every.max() == size:
        raise InputError(f"is one single value, {every.argmax()}, everywhere", path, _FIX)
