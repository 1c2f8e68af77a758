"""What a camera description names by file: the transmittance of its pupil and its wavefront
error, as square grids.
"""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by
from plenocli.files.artefacts.provenance import first_bytes, require_file
from plenocli.files.artefacts.structure import read_attribute, survey
from plenocli.files.images.exr import read_exr, require_at_most
from plenocli.files.images.pictures import file_type, read_stored
from plenocli.files.outside import outside

MAX_BYTES = 64 << 20
"""No map of at most 1024 x 1024 values is longer."""
_HDF5 = b"\x89HDF\r\n\x1a\n"


def read_transmittance(path: str | os.PathLike[str]) -> np.ndarray:
    """Intensity transmittance from a grey PNG or the one channel of an EXR.

    PNG: stored numbers over the largest (255 or 65535), not decoded as sRGB; EXR: as stored. An RGB
    picture passes if its three channels are equal; alpha is ignored.

    Returns (row, column) float64.
    Raises InputError.
    """
    _require_small(path)
    kind = file_type(path)
    if kind == "exr":
        return _one_channel(path)
    if kind != "png":
        raise InputError("is neither PNG nor EXR", path, "give the transmittance as .png or .exr")
    stored, bits = _grey(path, "a transmittance")
    return stored.astype(float) / (2 ** max(bits, 8) - 1)


def read_drawing(path: str | os.PathLike[str]) -> list[str]:
    """Places of filters from a grey PNG, as `drawing` of a FilterArray
    (plenocli.forward.camera.sections.filter_array): its levels above 0, from dark to bright, are
    the filters in their order; 0 is none.

    Returns a text for each row.
    Raises InputError.
    """
    from plenocli.forward.camera.sections.filter_array import FILTER_SIGNS

    _require_small(path)
    if file_type(path) != "png":
        raise InputError("is no PNG", path, "give the drawing of the filters as a grey .png")
    stored = _grey(path, "a drawing of filters")[0]
    levels = np.union1d(stored, [0])
    if len(levels) > len(FILTER_SIGNS):
        raise InputError(
            f"holds {len(levels) - 1} levels of grey; there are at most {len(FILTER_SIGNS) - 1} "
            "filters",
            path,
            "draw every filter in one level, without smoothed edges",
        )
    numbers = np.searchsorted(levels, stored)
    return ["".join(FILTER_SIGNS[n] for n in row) for row in numbers.tolist()]


def _grey(path: str | os.PathLike[str], what: str) -> tuple[np.ndarray, int]:
    """Stored numbers (row, column) of a PNG without colour, and their bits; alpha is ignored."""
    stored, names, bits = read_stored(path, "png", most=MAX_BYTES)
    colours = stored[..., [i for i, name in enumerate(names) if name.upper() not in ("A", "ALPHA")]]
    if np.any(colours != colours[..., :1]):
        raise InputError(f"is a colour picture; {what} has one channel", path, "convert it to grey")
    return colours[..., 0], bits


def read_wavefront(path: str | os.PathLike[str]) -> np.ndarray:
    """Wavefront error from the dataset "wavefront" of an HDF5 file or the one channel of an EXR.

    A dataset may say its unit in the attribute "units", which must be m, as text of fixed length:
    HDF5 may read a damaged one of variable length for ever.

    Returns (row, column) float64, m.
    Raises InputError.
    """
    _require_small(path)
    if first_bytes(path, len(_HDF5)) == _HDF5:
        return np.asarray(outside(_from_hdf5, path))
    if file_type(path) == "exr":
        return _one_channel(path)
    raise InputError(
        "is neither HDF5 nor EXR",
        path,
        "give the wavefront as .h5 with the dataset wavefront, or as .exr, in metres",
    )


def _require_small(path: str | os.PathLike[str]) -> None:
    size = require_file(path)
    if size > MAX_BYTES:
        raise InputError(
            f"is {size / 1e6:.0f} MB, more than {MAX_BYTES >> 20} MiB",
            path,
            "give a grid of at most 1024 x 1024 values",
        )


def _one_channel(path: str | os.PathLike[str]) -> np.ndarray:
    channels, _ = read_exr(path, most=MAX_BYTES)
    if len(channels) != 1 and "Y" not in channels:
        raise InputError(
            f"has the channels {', '.join(list(channels)[:8])}",
            path,
            "give one channel, or one named Y",
        )
    return np.asarray(channels.get("Y", next(iter(channels.values()))), float)


def _from_hdf5(path: str) -> np.ndarray:
    """The values of /wavefront; runs outside."""
    content = Path(path).read_bytes()
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fapl_core(max(len(content), 1), False)
    access.set_file_image(content)
    try:
        with h5py.File(h5py.h5f.open(b"wavefront", h5py.h5f.ACC_RDONLY, access)) as file:
            declared = survey(path, file)
            if "wavefront" not in declared:
                raise InputError(
                    f"has no dataset wavefront, only {', '.join(list(declared)[:8]) or 'none'}",
                    path,
                    "store W in metres as /wavefront",
                )
            shape, dtype = declared["wavefront"]
            if dtype.kind not in "iuf" or len(shape) != 2:
                raise InputError(
                    f"holds {by(shape)} values of the type {dtype} in /wavefront",
                    path,
                    "store a square grid of floats",
                )
            require_at_most(path, 8 * int(shape[0]) * int(shape[1]), MAX_BYTES)
            dataset = file["wavefront"]
            units = read_attribute(path, dataset, "units") if "units" in dataset.attrs else "m"
            if units != "m":
                raise InputError(
                    f"gives /wavefront in {units!r}", path, 'store metres, units = "m"'
                )
            return dataset[()].astype(float)
    except InputError:
        raise
    except (OSError, KeyError, ValueError, RuntimeError, UnicodeError) as error:
        raise InputError(f"is damaged: {error}", path, "make or copy it again") from error
