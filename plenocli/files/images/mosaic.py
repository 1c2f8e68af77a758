"""A sensor's mosaic from whatever file holds one: capture artefact, EXR, camera
RAW, DNG, PNG or TIFF.
"""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.files.artefacts.provenance import first_bytes
from plenocli.files.images.exr import read_exr, write_exr
from plenocli.files.images.pictures import file_type, read_stored
from plenocli.files.images.raw import read_raw

CAPTURE = "plenocli:capture"  # EXR attribute: JSON of what a capture artefact has as attributes
_CFA = re.compile(r"mono|[RGB]{4}")


@dataclass
class Mosaic:
    """values: (row, column) as stored.
    cfa: "mono" or four letters, row by row.
    black: (2, 2) by position, and white: in the units of the values ("DN",
        "electron" or "relative");
    white is inf where nothing saturates.
    gain: DN/e or None.
    exposure_s: s or None.
    band_m: centre of the narrow band that lit the scene, m, or None.
    source: "raw", "dng", "image", "capture" or "exr".
    meta: whatever else the file says; a simulated capture's attributes by their names,
        whatever the file.
    """

    values: np.ndarray
    cfa: str = "mono"
    black: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    white: float = np.inf
    gain: float | None = None
    exposure_s: float | None = None
    units: str = "DN"
    band_m: float | None = None
    source: str = "image"
    meta: dict = field(default_factory=dict)


def read_mosaic(path, *, cfa=None):
    """Read the mosaic at `path`, never demosaiced.

    cfa: colour filter array of a PNG or TIFF, which cannot say it (default mono); for other files
        it must agree with theirs.
    Raises InputError, saying why.
    """
    path = Path(path)
    kind = file_type(path)
    if kind == "exr":
        found = _from_exr(path)
    elif kind == "png" or (kind == "tiff" and path.suffix.lower() in (".tif", ".tiff")):
        found = _from_image(path, kind)
        found.cfa = cfa or "mono"
    elif kind == "jpeg":
        raise InputError(
            "is a JPEG: its values were demosaiced, bent and compressed",
            path,
            "give the RAW, a PNG or a TIFF of the sensor",
        )
    elif is_hdf5(path):
        found = _from_capture(path)
    else:
        found = Mosaic(
            **read_raw(path),
            source="dng" if kind == "tiff" and path.suffix.lower() == ".dng" else "raw",
        )
    if cfa is not None and found.cfa != cfa:
        raise InputError(
            f"has the colour filter array {found.cfa}, not {cfa}",
            path,
            "leave the option out; the file knows it",
        )
    if found.values.dtype.kind == "f" and not np.isfinite(found.values).all():
        raise InputError(
            f"holds {int((~np.isfinite(found.values)).sum())} values that are NaN or infinite",
            path,
            "make it again",
        )
    return found


def write_capture_exr(path, mosaic, description, *, attrs=None, overwrite=False):
    """Write a simulated capture as EXR: channel Y and `description`, the attributes of a capture
    artefact and "cfa", as JSON.

    float32 keeps whole numbers up to 2^24 exactly.
    attrs: more text attributes.
    Raises ValueError, UsageError, OutputError.
    """
    text = json.dumps(description, sort_keys=True, allow_nan=False, ensure_ascii=False)
    write_exr(
        path, {"Y": np.asarray(mosaic)}, {CAPTURE: text, **(attrs or {})}, overwrite=overwrite
    )


def is_hdf5(path):
    """Whether the file at `path` is an artefact or another HDF5 file, by its first bytes.

    Raises InputError.
    """
    from plenocli.files.artefacts.container import HDF5_SIGNATURE, MAGIC

    head = first_bytes(path, 1024)
    return head.startswith(MAGIC) or HDF5_SIGNATURE in head


def _from_capture(path):
    from plenocli.files.artefacts.container import cfa_text, read_artefact

    artefact = read_artefact(path, "capture")
    attrs = dict(artefact.attrs.get("capture", {}))
    found = _described(
        path,
        artefact.data["capture/mosaic"],
        {**attrs, "cfa": cfa_text(artefact.data["capture/cfa"])},
        "capture",
    )
    found.meta["accuracy"], found.meta["inputs"] = (
        artefact.provenance.accuracy,
        artefact.provenance.inputs,
    )
    return found


def _from_exr(path):
    channels, attrs = read_exr(path)
    if set(channels) != {"Y"} and len(channels) != 1:
        raise InputError(
            f"has {len(channels)} channels ({', '.join(list(channels)[:6])}), a mosaic has one",
            path,
            "give a capture",
        )
    try:
        description = dict(json.loads(attrs.get(CAPTURE, "{}")))
    except (TypeError, ValueError) as error:
        raise InputError(f"has a broken attribute {CAPTURE}", path, "make it again") from error
    return _described(path, next(iter(channels.values())), description, "exr")


def _described(path, values, description, source):
    """Mosaic from the attributes of a capture, given by an artefact or an EXR."""
    try:
        black = np.broadcast_to(
            np.asarray(description.get("black", 0.0), dtype=float), (2, 2)
        ).copy()
        white = float(description.get("white", np.inf))
        gain = description.get("gain_e_per_dn")
        found = Mosaic(
            values,
            str(description.get("cfa", "mono")),
            black,
            white,
            1 / float(gain) if gain else None,
            description.get("exposure_s"),
            str(description.get("units", "relative" if source == "exr" else "DN")),
            description.get("band_m"),
            source,
            description,
        )
    except (TypeError, ValueError) as error:
        raise InputError(
            f"describes its capture in a way that makes no sense ({error})", path, "make it again"
        ) from error
    if not _CFA.fullmatch(found.cfa):
        raise InputError(f"names the colour filter array '{found.cfa}'", path, "make it again")
    return found


def _from_image(path, kind):
    values, names, bits = read_stored(path, kind)
    keep = [i for i, name in enumerate(names) if name.upper() not in ("A", "ALPHA")]
    values, meta = values[..., keep], {"bits": bits, "verified": False}
    if values.dtype.kind not in "uf":
        raise InputError(f"holds {values.dtype} values", path, "give unsigned integers or float")
    if values.shape[-1] > 1:
        if (values == values[..., :1]).all():
            meta["note"] = f"{values.shape[-1]} identical channels, one taken"
        else:
            raise InputError(
                (
                    f"is a picture with {values.shape[-1]} different channels, not a mosaic "
                    "with one value a pixel"
                ),
                path,
                "give the sensor's mosaic before demosaicing",
            )
    return Mosaic(np.ascontiguousarray(values[..., 0]), white=_top(values, bits), meta=meta)


def _top(values, bits):
    return float(2**bits - 1) if values.dtype.kind == "u" else np.inf
