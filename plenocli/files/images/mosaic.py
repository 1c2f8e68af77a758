"""Captures in and out: a sensor's mosaic from whatever file holds one (capture artefact, EXR,
camera RAW, DNG, PNG or TIFF), and simulated ones as artefact, EXR or DNG.
"""

from __future__ import annotations

import contextlib
import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.tiling import EVERYTHING, InParts, Plane, Room
from plenocli.files.artefacts.provenance import Provenance, first_bytes, provenance_texts
from plenocli.files.images.containers import BIO, LYTRO, Contained, read_bio, read_lytro, read_pages
from plenocli.files.images.dng import write_dng
from plenocli.files.images.exr import Header, read_exr, read_header, stored_channel, write_exr
from plenocli.files.images.in_bands import SHARE, put_together, require_sound, sound
from plenocli.files.images.pictures import file_type, stored_in_parts
from plenocli.files.images.raw import RawFile, read_raw
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels, SuperpixelGrid
from plenocli.forward.sensor.cfa import ColourProfile
from plenocli.forward.sensor.noise import Noise

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.reading import Stored

CAPTURE = "plenocli:capture"  # EXR attribute: JSON of what a capture artefact has as attributes
MOSAIC = "capture/mosaic"
_CFA = re.compile(r"mono|[RGB]{4}")
NAMED = {
    ".h5": "HDF5",
    ".png": "PNG",
    ".jpg": "JPEG",
    ".jpeg": "JPEG",
    ".tif": "TIFF",
    ".tiff": "TIFF",
    ".exr": "OpenEXR",
}
"""Suffix -> what LibRaw need not be asked about."""


# --- reading --------------------------------------------------------------------------------------


def read_capture(path: str | Path, *, cfa: str | None = None) -> Capture:
    """Read the capture at `path`, never demosaiced.

    path: .h5, .exr, RAW, DNG, PNG, TIFF or a Lytro's .lfp or .lfr, known by its first bytes; .czi
        or .nd2 (extra `[bio]`).
    cfa: colour filter array of a PNG or TIFF, which cannot say it (default mono); for other files
        it must agree with theirs.

    Raises InputError, saying why.
    """
    return _read(Path(path), cfa, None)


def _read(path: Path, cfa: str | None, room: Room | None) -> Capture:
    """As read_capture; room: for a mosaic that is large beside the memory, then a Plane."""
    kind = file_type(path)
    if kind == "exr":
        found = _from_exr(path, room)
    elif kind == "png" or (kind == "tiff" and path.suffix.lower() in (".tif", ".tiff")):
        found = _from_image(path, kind, cfa or "mono", room)
    elif kind == "jpeg":
        raise InputError(
            "is a JPEG: its values were demosaiced, bent and compressed",
            path,
            "give the RAW, a PNG or a TIFF of the sensor",
        )
    elif is_hdf5(path):
        found = _from_artefact(path)
    elif first_bytes(path, len(LYTRO)) == LYTRO:
        found = _contained(path, read_lytro(path, room))
    elif path.suffix.lower() in BIO:
        found = _of_values(path, read_bio(path, room), cfa or "mono")
    elif kind in (None, "tiff") and path.suffix.lower() in NAMED:
        is_tiff = kind == "tiff"  # RAW files are TIFFs, too, and only their names say so
        raise InputError(
            f"begins as no {NAMED[path.suffix.lower()]} file does"
            + (", but as a TIFF" if is_tiff else ""),
            path,
            f"{'name it .tif' if is_tiff else 'make or copy it again'}; a RAW file keeps its own "
            "suffix",
        )
    else:
        is_dng = kind == "tiff" and path.suffix.lower() == ".dng"
        found = _from_raw(path, "dng" if is_dng else "raw", read_raw(path, room))
    if cfa is not None:
        _require_array(path, found, cfa)
    if isinstance(found.mosaic, np.ndarray):
        require_sound(path, [found.mosaic])
    return found


def _require_array(path: str | Path, found: Capture, cfa: str) -> None:
    if found.cfa != cfa:
        raise InputError(
            f"has the colour filter array {found.cfa}, not {cfa}",
            path,
            "leave the option out; the file knows it",
        )


@dataclass(frozen=True)
class StoredCapture:
    """A capture whose mosaic stays in a file.

    about: the capture, its mosaic without values.
    mosaic: in its file, or decoded.
    """

    about: Capture
    mosaic: Stored | Plane

    @property
    def path(self) -> Path:
        """Of the capture."""
        assert self.about.metadata.path is not None
        return self.about.metadata.path

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the sensor."""
        rows, columns = self.mosaic.shape
        return rows, columns

    @property
    def dtype(self) -> np.dtype:
        """Of a value."""
        return self.about.mosaic.dtype

    def values(self, rows: slice, columns: slice = EVERYTHING) -> np.ndarray:
        """A part of the mosaic as it is stored. Raises InputError."""
        mosaic = self.mosaic
        return (
            mosaic.read(rows, columns)
            if isinstance(mosaic, Plane)
            else mosaic.window(rows, columns)
        )

    def window(self, rows: slice, columns: slice) -> Capture:
        """The capture of a part of the sensor. Raises InputError."""
        return self.holding(self.values(rows, columns), rows, columns)

    def holding(self, values: np.ndarray, rows: slice, columns: slice) -> Capture:
        """The capture of a part of the sensor whose values were read. Raises InputError."""
        require_sound(self.path, [values])
        first = (part.indices(side)[0] for part, side in zip((rows, columns), self.shape))
        return replace(self.about, mosaic=values, levels=self.about.levels.from_pixel(*first))


def capture_in_file(
    path: str | Path, *, cfa: str | None = None, small: bool = True, room: Room | None = None
) -> Capture:
    """As read_capture, but that a mosaic that is not small stays in a file, a Plane.

    small: whether an artefact's that is small beside the memory is held.
    room: for what is decoded of other files; None: that is held in any case.

    Raises OutputError where there is no room.
    """
    from plenocli.files.artefacts.reading import opened_artefact

    path = Path(path)
    if not is_hdf5(path):
        return _read(path, cfa, room)
    apart = ("capture/scene",) if small else ("capture/scene", MOSAIC)
    with opened_artefact(path, "capture", apart, large=(MOSAIC,)) as (found, stored):
        mosaic: Any = found.data.get(MOSAIC)
        if mosaic is None:
            whole = _stored(path, found, stored[MOSAIC])
            mosaic = Plane(whole.shape, lambda rows, columns: whole.window(rows, columns).mosaic)
        else:
            require_sound(path, [mosaic])
        capture = _capture_of(path, found, mosaic)
        if cfa is not None:
            _require_array(path, capture, cfa)
        return capture


@contextlib.contextmanager
def stored_capture(
    path: str | Path, *, room: Room | None = None, verify: bool = True
) -> Iterator[StoredCapture]:
    """The capture at `path`, whose mosaic stays in a file: always that of an artefact, of another
    file one that is large beside the memory.

    room: as of capture_in_file.
    verify: as of opened_artefact.

    Raises as capture_in_file.
    """
    from plenocli.files.artefacts.reading import opened_artefact

    path = Path(path)
    if not is_hdf5(path):
        found = _read(path, None, room)
        mosaic = Plane.of(found.mosaic)
        few = mosaic.read(slice(0, 1), slice(0, 1))
        yield StoredCapture(replace(found, mosaic=few[:0, :0]), mosaic)
        return
    apart = (MOSAIC, "capture/scene")
    with opened_artefact(path, "capture", apart, verify=verify) as (artefact, stored):
        yield _stored(path, artefact, stored[MOSAIC])


def _stored(path: Path, artefact: Artefact, mosaic: Stored) -> StoredCapture:
    return StoredCapture(_capture_of(path, artefact, np.empty((0, 0), mosaic.dtype)), mosaic)


def is_hdf5(path: str | Path) -> bool:
    """Whether the file at `path` is an artefact or another HDF5 file, by its first bytes.

    Raises InputError.
    """
    from plenocli.files.artefacts.container import HDF5_SIGNATURE, MAGIC

    head = first_bytes(path, 1024)
    return head.startswith(MAGIC) or HDF5_SIGNATURE in head


def _from_artefact(path: Path) -> Capture:
    from plenocli.files.artefacts.reading import read_artefact

    artefact = read_artefact(path, "capture")
    return _capture_of(path, artefact, artefact.data[MOSAIC])


def _capture_of(path: Path, artefact: Artefact, mosaic: np.ndarray) -> Capture:
    from plenocli.files.artefacts.container import cfa_text

    said = {**artefact.attrs.get("capture", {}), "cfa": cfa_text(artefact.data["capture/cfa"])}
    found = _described(path, mosaic, said, "capture")
    origin = artefact.provenance
    metadata = replace(
        found.metadata, accuracy=origin.accuracy, matrix=origin.inputs.get("pif", {}).get("sha256")
    )
    grid = replace(
        found.grid or SuperpixelGrid(), centre=artefact.data.get("capture/lenslet_centre")
    )
    return replace(found, metadata=metadata, grid=grid)


def _from_exr(path: Path, room: Room | None) -> Capture:
    header = None if room is None else read_header(path)
    channels: dict[str, np.ndarray] = {}
    size = 0 if header is None else 4 * math.prod(header.shape)
    if header is None or not header.by_lines or size <= budget().memory // SHARE:
        header, (channels, attrs) = None, read_exr(path)
        names = list(channels)
    else:
        names, attrs = header.names, header.attrs
    if len(names) != 1:
        raise InputError(
            f"has {len(names)} channels ({', '.join(names[:6])}), a mosaic has one",
            path,
            "give a capture",
        )
    try:
        said = dict(json.loads(attrs.get(CAPTURE, "{}")))
    except (TypeError, ValueError) as error:
        raise InputError(f"has a broken attribute {CAPTURE}", path, "make it again") from error
    stays: Any = None if header is None else _sound_lines(path, header)
    return _described(path, channels[names[0]] if stays is None else stays, said, "exr")


def _sound_lines(path: Path, header: Header) -> Plane:
    """The one channel of an EXR, whose windows raise InputError as require_sound."""
    lines = stored_channel(path, header, header.names[0])

    def read(rows: slice, columns: slice) -> np.ndarray:
        values = lines.read(rows, columns)
        require_sound(path, [values])
        return values

    return Plane(lines.shape, read)


def _described(path: Path, values: np.ndarray, said: dict[str, Any], source: str) -> Capture:
    """A capture from its attributes, as an artefact or an EXR names them."""
    with _sensible(path):
        black = np.broadcast_to(np.asarray(said.get("black", 0.0), dtype=float), (2, 2)).copy()
        per_dn = said.get("gain_e_per_dn")
        gain = 1 / float(per_dn) if per_dn else None
        found = Capture(
            mosaic=values,
            units=str(said.get("units", "relative" if source == "exr" else "DN")),
            cfa=str(said.get("cfa", "mono")),
            levels=Levels(black=black, white=float(said.get("white", np.inf)), gain=gain),
            exposure_s=said.get("exposure_s"),
            profile=_profile(said),
            **_told(path, source, said, gain),
        )
    if not _CFA.fullmatch(found.cfa):
        raise InputError(f"names the colour filter array '{found.cfa}'", path, "make it again")
    return found


@contextlib.contextmanager
def _sensible(path: Path) -> Iterator[None]:
    """InputError for the errors that numbers make which are none."""
    try:
        yield
    except (TypeError, ValueError) as error:
        raise InputError(
            f"describes its capture in a way that makes no sense ({error})", path, "make it again"
        ) from error


def _told(path: Path, source: str, said: dict[str, Any], gain: float | None) -> dict[str, Any]:
    """Noise, grid and metadata of a capture from what its file says; TypeError or ValueError
    where that makes no sense.
    """
    sigma, notes = said.get("noise_sigma"), said.get("notes")
    noise, origin = None, None
    if sigma is not None:
        noise, origin = Noise.of_sigma(sigma), "white noise of the simulation"
    elif gain is not None:
        noise, origin = Noise(gain=gain), "file"
    electrons = said.get("electrons_per_unit") or (
        notes.get("electrons_per_unit") if isinstance(notes, dict) else None
    )
    maker = " ".join(str(said.get(name)) for name in ("make", "model") if said.get(name))
    metadata = CaptureMetadata(
        source=source,
        path=path,
        camera=maker or said.get("camera"),
        noise_from=origin,
        target=said.get("target"),
        illuminant=said.get("illuminant"),
        band_m=said.get("band_m"),
        electrons_per_unit=float(electrons) if electrons else None,
        snr_db=said.get("snr_db"),
        scene_shape=_whole(said.get("scene_shape")),
        details=said,
    )
    grid = SuperpixelGrid(
        shape=_whole(said.get("superpixel_shape")), count=_whole(said.get("lenslet_count"))
    )
    return {"noise": noise, "metadata": metadata, "grid": grid}


def _profile(said: dict[str, Any]) -> ColourProfile | None:
    if said.get("to_rgb") is None:
        return None
    neutral = said.get("neutral")
    return ColourProfile(
        to_rgb=np.asarray(said["to_rgb"], float).reshape(3, 3),
        neutral=None if neutral is None else np.asarray(neutral, float).reshape(3),
    )


def _whole(numbers: Any) -> tuple[int, ...] | None:
    return None if numbers is None else tuple(int(n) for n in np.ravel(numbers))


def _from_raw(path: Path, source: str, found: RawFile) -> Capture:
    with _sensible(path):
        told = _told(path, source, found.details, found.gain)
    mosaic: Any = found.values
    return Capture(
        mosaic=mosaic,
        cfa=found.cfa,
        levels=Levels(black=found.black, white=found.white, gain=found.gain),
        exposure_s=found.exposure_s,
        profile=found.profile,
        **told,
    )


def _contained(path: Path, found: Contained) -> Capture:
    with _sensible(path):
        told = _told(path, "raw", found.details, None)
    mosaic: Any = found.values
    return Capture(
        mosaic=mosaic,
        cfa=found.cfa,
        levels=Levels(black=found.black, white=found.white),
        exposure_s=found.exposure_s,
        profile=found.profile,
        **told,
    )


def _of_values(path: Path, values: Any, cfa: str, white: float | None = None) -> Capture:
    """A mosaic, in memory or in a file, of which a file says nothing but its numbers."""
    of = Plane.of(values).read(slice(0, 1), slice(0, 1)).dtype
    if of.kind not in "uf":
        raise InputError(f"holds {of} values", path, "give unsigned integers or float")
    if white is None:
        white = float(np.iinfo(of).max) if of.kind == "u" else np.inf
    metadata = CaptureMetadata(source="image", path=path, details={"verified": False})
    return Capture(mosaic=values, cfa=cfa, levels=Levels(white=white), metadata=metadata)


def _from_image(path: Path, kind: str, cfa: str, room: Room | None) -> Capture:
    pages = read_pages(path, room) if kind == "tiff" else None
    if pages is not None:
        return _of_values(path, pages.values, cfa, pages.white)
    head, parts = stored_in_parts(path, kind, held=room is None)
    details: dict[str, Any] = {"bits": head.bits, "verified": False}
    keep = [i for i, name in enumerate(head.names) if name.upper() not in ("A", "ALPHA")]
    if len(keep) > 1:
        details["note"] = f"{len(keep)} identical channels, one taken"
    values: Any = put_together(sound(path, _one_channel(path, parts, keep)), head.shape[:2], room)
    is_whole = Plane.of(values).read(slice(0, 1), slice(0, 1)).dtype.kind == "u"
    return Capture(
        mosaic=values,
        cfa=cfa,
        levels=Levels(white=float(2**head.bits - 1) if is_whole else np.inf),
        metadata=CaptureMetadata(source="image", path=path, details=details),
    )


def _one_channel(path: Path, parts: Iterable[np.ndarray], keep: list[int]) -> Iterator[np.ndarray]:
    """The first of the channels to keep, of bands (row, column, channel); InputError behind the
    last where they are not all the same, or no numbers of a sensor.
    """
    same = True
    for part in parts:
        if part.dtype.kind not in "uf":
            raise InputError(f"holds {part.dtype} values", path, "give unsigned integers or float")
        values = part[..., keep]
        same = same and (len(keep) == 1 or bool((values == values[..., :1]).all()))
        yield np.ascontiguousarray(values[..., 0])
    if not same:
        raise InputError(
            f"is a picture with {len(keep)} different channels, not a mosaic "
            "with one value a pixel",
            path,
            "give the sensor's mosaic before demosaicing",
        )


# --- writing --------------------------------------------------------------------------------------


def write_capture(
    path: str | Path,
    capture: Capture,
    provenance: Provenance,
    *,
    scene: np.ndarray | InParts | None = None,
    wavelengths: np.ndarray | None = None,
    degree: np.ndarray | None = None,
    overwrite: bool = False,
) -> None:
    """Write a simulated capture as .h5, .exr or .dng.

    An EXR keeps float32, whole numbers up to 2^24 exactly; a DNG whole numbers below 65536.
    path: its suffix says what is written.
    capture: what the sensor reports; only an .h5 takes a mosaic InParts.
    provenance: where it came from.
    scene: (band, scene_row, scene_column) the object as sampled, which an .h5 keeps.
    wavelengths: (band,) of the scene, m.
    degree: (scene_row, scene_column), of its polarisation.
    overwrite: replace a file that is there.

    Raises ValueError (a bug of the caller), UsageError, OutputError.
    """
    path = Path(path)
    said = _attributes(capture)
    if path.suffix == ".h5":
        from plenocli.files.artefacts.container import Artefact
        from plenocli.files.artefacts.writing import write_artefact

        data = {
            "mosaic": capture.mosaic,
            "cfa": capture.cfa,
            "lenslet_centre": capture.grid.centre if capture.grid else None,
            "scene": scene,
            "wavelength": wavelengths,
            "polarisation": degree,
        }
        data = {f"capture/{name}": v for name, v in data.items() if v is not None}
        artefact = Artefact("capture", data, {"capture": said}, provenance)
        write_artefact(path, artefact, overwrite=overwrite)
    elif path.suffix == ".exr":
        # JSON knows no infinity
        finite = {name: value for name, value in said.items() if value != float("inf")}
        text = json.dumps(
            finite | {"cfa": capture.cfa}, sort_keys=True, allow_nan=False, ensure_ascii=False
        )
        attrs = {CAPTURE: text, **provenance_texts(provenance)}
        write_exr(path, {"Y": np.asarray(capture.mosaic)}, attrs, overwrite=overwrite)
    else:
        write_dng(
            path,
            capture.mosaic,
            cfa=capture.cfa,
            black=said["black"],
            white=capture.levels.white,
            exposure_s=capture.exposure_s,
            xmp_json=said | {"provenance": asdict(provenance)},
            profile=capture.profile,
            overwrite=overwrite,
        )


def _attributes(capture: Capture) -> dict[str, Any]:
    """The attributes of a capture artefact by their names; what is not known is left out."""
    levels, metadata, grid = capture.levels, capture.metadata, capture.grid or SuperpixelGrid()
    black = levels.black
    said = {
        "units": capture.units,
        "black": float(black.flat[0]) if np.ptp(black) == 0 else black.tolist(),
        "white": float(levels.white),
        "snr_db": metadata.snr_db,
        "noise_sigma": capture.white_noise.sigma if capture.white_noise else None,
        "gain_e_per_dn": 1 / levels.gain if levels.gain else None,
        "exposure_s": capture.exposure_s,
        "electrons_per_unit": metadata.electrons_per_unit,
        "lenslet_count": _listed(grid.count),
        "superpixel_shape": _listed(grid.shape),
        "scene_shape": _listed(metadata.scene_shape),
        "target": metadata.target,
        "illuminant": metadata.illuminant,
        "band_m": metadata.band_m,
    }
    if capture.profile is not None:
        said["to_rgb"] = capture.profile.to_rgb.ravel().tolist()
        neutral = capture.profile.neutral
        said["neutral"] = None if neutral is None else neutral.tolist()
    return {name: value for name, value in said.items() if value is not None}


def _listed(numbers: tuple[int, ...] | None) -> list[int] | None:
    return None if numbers is None else list(numbers)
