"""Stacks as TIFF: OME-TIFF with sizes for Fiji and its kin, and volumes of any program."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli import __version__
from plenocli.base.budget import budget
from plenocli.base.errors import InputError, PlenoError
from plenocli.base.tiling import InParts, by_plane
from plenocli.files.atomic import replacement
from plenocli.files.outside import outside
from plenocli.files.seal import SEAL, put_seal, require_seal

if TYPE_CHECKING:
    from tifffile import TiffFile

_METRES = {"nm": 1e-9, "µm": 1e-6, "um": 1e-6, "micron": 1e-6, "mm": 1e-3, "m": 1.0}
"""Names of units in OME-XML and ImageJ's description."""


@dataclass(frozen=True, kw_only=True)
class TiffVolume:
    """A stack of pictures.

    value: (plane, row, column).
    step: m between planes; spacing: m between rows and columns; None where the file says nothing.
    """

    value: np.ndarray
    step: float | None
    spacing: tuple[float, float] | None


@dataclass(frozen=True, kw_only=True)
class Series:
    """One image of an OME-TIFF, a stack of pictures of one size.

    name: of the image.
    shape: (planes, channels, rows, columns).
    pictures: gives each (row, column), channel by channel of one plane after the other.
    channels: their names.
    spacing: m between rows and columns; None where nobody says.
    positions: (plane,) m along the axis, in order; None where nobody says.
    along: what the planes go along: "Z" through space, "T" otherwise.
    """

    name: str
    shape: tuple[int, ...]
    pictures: Callable[[], Iterable[np.ndarray]]
    channels: list[str]
    spacing: tuple[float, float] | None = None
    positions: np.ndarray | None = None
    along: str = "Z"

    def metadata(self) -> dict[str, Any]:
        """What OME-XML says of it, in micrometres."""
        found: dict[str, Any] = {
            "axes": f"{self.along}CYX",
            "Name": self.name,
            "Channel": {"Name": self.channels},
        }
        if self.spacing is not None:
            for axis, size in zip("YX", self.spacing):
                found |= {f"PhysicalSize{axis}": size * 1e6, f"PhysicalSize{axis}Unit": "µm"}
        if self.positions is not None and np.isfinite(self.positions).all():
            count = len(self.channels)
            if len(self.positions) > 1:
                step = float(np.mean(np.abs(np.diff(self.positions))))
                found |= {"PhysicalSizeZ": step * 1e6, "PhysicalSizeZUnit": "µm"}
            where = np.repeat(self.positions * 1e6, count).tolist()
            found["Plane"] = {"PositionZ": where, "PositionZUnit": ["µm"] * len(where)}
        return found


def write_ome_tiff(
    path: str | os.PathLike, series: Sequence[Series], *, overwrite: bool = False
) -> None:
    """Write an OME-TIFF of float32: the same images give the same bytes.

    Raises UsageError where the file exists, OutputError where it cannot be written.
    """
    import tifffile

    digest = hashlib.sha256()
    for one in series:
        for picture in _single(one):
            digest.update(picture.data)
    # else it has the clock and the machine in it
    name = uuid.uuid5(uuid.NAMESPACE_OID, digest.hexdigest()).urn
    with replacement(path, overwrite=overwrite) as (partial, descriptor):
        with open(partial, "r+b") as opened, tifffile.TiffWriter(opened, ome=True) as file:
            for one in series:
                file.write(
                    _single(one),
                    shape=one.shape,
                    dtype=np.float32,
                    photometric="minisblack",
                    metadata=one.metadata() | {"UUID": name, "Creator": f"plenocli {__version__}"},
                    # named apart from the seal too: damage to one name leaves the other
                    software=f"written by plenocli {__version__}, {SEAL}",
                )
        put_seal(descriptor)


def _single(series: Series) -> Iterator[np.ndarray]:
    """Its pictures as they are stored."""
    for picture in series.pictures():
        yield np.ascontiguousarray(picture, dtype=np.float32)


def write_volume_tiff(
    path: str | os.PathLike,
    value: np.ndarray | InParts,
    sigma: np.ndarray | InParts | None,
    depth: np.ndarray,
    spacing: tuple[float, float],
    *,
    overwrite: bool = False,
) -> None:
    """Write a volume as OME-TIFF: channel "volume", and "sigma" where there is one.

    value, sigma: (plane, row, column).
    depth: (plane,) m; spacing: (rows, columns) m.

    Raises UsageError where the file exists, OutputError where it cannot be written.
    """
    both = [value] if sigma is None else [value, sigma]

    def pictures() -> Iterator[np.ndarray]:
        for plane in zip(*(by_plane(part) for part in both)):
            yield from plane

    one = Series(
        name="volume",
        shape=(len(depth), len(both), *value.shape[-2:]),
        pictures=pictures,
        channels=["volume", "sigma"][: len(both)],
        spacing=spacing,
        positions=np.asarray(depth, float),
    )
    write_ome_tiff(path, [one], overwrite=overwrite)


def read_tiff_volume(path: str | os.PathLike) -> TiffVolume:
    """The first channel of a TIFF stack, with what its OME-XML or ImageJ description says of sizes.

    Raises InputError where the file cannot be read, is no stack, or one of ours that was altered.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError("is no file", path, "give a TIFF stack")
    require_seal(path)
    value, axes, step, spacing = outside(_decoded, path)
    for axis in (a for a in axes if a not in "ZIQYX"):
        value, axes = np.take(value, 0, axes.index(axis)), axes.replace(axis, "", 1)
    if value.ndim == 2:
        value = value[None]
    if value.ndim != 3 or not axes.endswith("YX") or value.dtype.kind not in "biuf":
        raise InputError(
            f"has the axes {axes or 'none'}, which are no stack of grey pictures",
            path,
            "save one channel and one time as a stack",
        )
    value = value.astype(np.float32)
    if not np.isfinite(value).all():
        raise InputError("holds values that are NaN or infinite", path, "mend them")
    return TiffVolume(value=value, step=step, spacing=spacing and tuple(spacing))


def _decoded(path: str) -> tuple[np.ndarray, str, float | None, tuple[float, float] | None]:
    """(values, axes, m between planes, m between rows and columns) of a TIFF; runs outside."""
    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            series = file.series[0]
            size = int(np.prod(series.shape, dtype=object)) * 8
            budget().require_declared(path, size, size)
            return series.asarray(), series.axes, *_sizes(file)
    except (PlenoError, MemoryError):
        raise
    except Exception as error:  # tifffile raises many types for a damaged file
        raise InputError(
            f"cannot be read as TIFF ({type(error).__name__}: {error})", path, "give a TIFF stack"
        ) from None


def _sizes(file: TiffFile) -> tuple[float | None, tuple[float, float] | None]:
    """(m between planes, m between rows and columns) as far as the file says them."""
    if file.ome_metadata:
        import tifffile

        image = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]
        pixels = (image[0] if isinstance(image, list) else image)["Pixels"]
        found = [
            float(pixels[f"PhysicalSize{axis}"])
            * _METRES.get(pixels.get(f"PhysicalSize{axis}Unit", "µm"), 1e-6)
            if f"PhysicalSize{axis}" in pixels
            else None
            for axis in "ZYX"
        ]
    elif file.imagej_metadata:
        about = file.imagej_metadata
        unit = _METRES.get(str(about.get("unit", "")).replace("\\u00B5", "µ"))
        tags = file.pages.first.tags
        found = [about["spacing"] * unit if unit and "spacing" in about else None]
        for name in ("YResolution", "XResolution"):
            many, over = tags[name].value if name in tags else (0, 1)
            found.append(unit * over / many if unit and many else None)
    else:
        return None, None
    step, rows, columns = found
    return step, None if rows is None or columns is None else (rows, columns)
