"""Camera RAW and DNG: the mosaic as stored, with the levels of each position, never demosaiced.

LibRaw runs in a child process with limits (`raw_child`); what it returns must be plausible before
anyone computes with it.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.files.artefacts.provenance import require_file
from plenocli.files.images.dng import read_notes
from plenocli.files.seal import require_seal

CHILD = Path(__file__).with_name("raw_child.py")
TIMEOUT_S = 120
_CPU_S = 90
_BASE_BYTES = 3 << 29  # what Python, numpy and LibRaw map before they read anything
_FIX = "give an intact camera RAW or DNG with a colour filter mosaic"
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

    values: (row, column) uint16 without masked borders, DN.
    cfa: "mono" or four letters, row by row.
    black: (2, 2) by position, DN.
    white: DN.
    exposure_s: s, None where unknown.
    gain: DN per electron, None where unknown.
    details: what else the file says, by its names.
    """

    values: np.ndarray
    cfa: str
    black: np.ndarray
    white: float
    exposure_s: float | None
    gain: float | None
    details: dict[str, Any]


def read_raw(path: str | Path, *, timeout_s: float = TIMEOUT_S) -> RawFile:
    """Read a RAW file or DNG; LibRaw may take `timeout_s`.

    Raises InputError, saying why, for a file that LibRaw cannot read, that holds no mosaic, or
    whose mosaic is implausible.
    """
    path = Path(path)
    size = require_file(path)
    budget().require_reading(path, size)
    ours = require_seal(path)
    found, pixels = _from_child(path, timeout_s)
    if "declared" in found:
        budget().require_declared(path, found["declared"], found["needed"])
    if "refused" in found:
        raise InputError(_reason(found, size), path, _FIX)
    values = np.frombuffer(pixels, dtype="<u2")
    shape = tuple(found["shape"])
    if len(shape) != 2 or values.size != shape[0] * shape[1] or values.size == 0:
        raise InputError("came back incomplete from LibRaw", path, _FIX)
    values = values.reshape(shape).copy()
    cfa = _letters(path, found)
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
    else:
        _check_plausible(path, values, black, found["white"])
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
        details=details,
    )


def _from_child(path: Path, timeout_s: float) -> tuple[dict[str, Any], bytes]:
    """(description, mosaic bytes) from the child process; a crash there becomes
    an InputError here.
    """
    command = [
        sys.executable,
        "-P",
        str(CHILD),
        str(path.resolve()),
        str(budget().memory),
        str(_BASE_BYTES),
        str(_CPU_S),
    ]
    # threads map memory
    single = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            timeout=timeout_s,
            stdin=subprocess.DEVNULL,
            env={**os.environ, **single},
        )
    except subprocess.TimeoutExpired as error:
        raise InputError(f"LibRaw did not finish within {timeout_s:g} s", path, _FIX) from error
    except OSError as error:
        raise InputError(
            f"cannot be read: no process could be started for LibRaw ({error.strerror})",
            path,
            "close other programs, and try again",
        ) from error
    line, newline, pixels = done.stdout.partition(b"\n")
    if done.returncode != 0 or not newline:
        if done.returncode < 0:
            raise InputError(
                f"made LibRaw crash or hit its limits (signal {-done.returncode})", path, _FIX
            )
        detail = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise InputError(
            f"could not be read by the RAW process ({detail[-1] if detail else 'no answer'})",
            path,
            _FIX,
        )
    try:
        return dict(json.loads(line)), pixels
    except (TypeError, ValueError) as error:
        raise InputError("came back garbled from LibRaw", path, _FIX) from error


def _reason(found: dict[str, Any], size: int) -> str:
    """A sentence for the user from what LibRaw said."""
    known = _REASONS.get(found.get("error", ""))
    if known is None:
        return found["refused"] + (f" ({found['error']})" if "error" in found else "")
    return f"{known} ({size} bytes; LibRaw: {found['refused']})"


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


def _check_plausible(path: Path, values: np.ndarray, black: np.ndarray, white: float) -> None:
    """Refuse a mosaic that opens without error and yet cannot be a photograph: LibRaw fills what
    it could not read with zeros.
    """
    zeros = float(np.mean(values == 0))
    if zeros >= 0.99:
        raise InputError(
            (
                f"is {zeros:.1%} zeros although LibRaw reports no error: the image data "
                "are missing or cut off"
            ),
            path,
            _FIX,
        )
    if not white > black.max():
        raise InputError(
            f"has a white level of {white:g} DN, not above its black level of {black.max():g} DN",
            path,
            _FIX,
        )
    over = float(np.mean(values > white))
    if over > 0.01:
        raise InputError(
            (
                f"contradicts its metadata: {over:.1%} of the pixels are above its white "
                f"level of {white:g} DN"
            ),
            path,
            _FIX,
        )
    below = [
        float(np.mean(values[i::2, j::2] < black[i, j] - 0.02 * (white - black[i, j])))
        for i in (0, 1)
        for j in (0, 1)
    ]
    if max(below) > 0.5:
        raise InputError(
            (
                f"contradicts its metadata: {max(below):.0%} of the pixels at one position lie far "
                f"below its black level of {black.max():g} DN"
            ),
            path,
            _FIX,
        )
    if values.size > 1 and values.min() == values.max():
        raise InputError(f"is one single value, {values.min()}, everywhere", path, _FIX)
