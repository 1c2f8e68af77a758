"""A folder of captures of a ColorChecker under narrow-band light, as colorchecker reads it.

Anywhere below the folder: captures whose names hold their band and exposure time as in
chart_550nm_25ms.tif, dark frames as dark_25ms.tif, a label map with "label" in its name (a picture
with 0 for nothing, 1 to 24 for the patches row by row), and the spectrometer's table (.csv):
wavelengths in nm in the first column, one column a patch by its name on the chart, one a
filter such as "550 nm".
"""

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.chart_score import ChartCaptures, Shot

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture

PICTURES = (".tif", ".tiff", ".png")
MOST_FILES = 10_000
_BAND = re.compile(r"(?<![\d.])(\d{3,4})nm(?![a-z])", re.I)
_TIME = re.compile(r"(?<![\d.])(\d+(?:\.\d+)?)(us|ms|s)(?![a-z])", re.I)
_UNIT = {"us": 1e-6, "ms": 1e-3, "s": 1.0}
_FILTER = re.compile(r"\s*(\d{3,4})\s*nm\s*")


@dataclass(frozen=True, kw_only=True)
class ChartFiles:
    """Every file used: captures, dark frames, the label map and the spectrometer's table."""

    captures: Sequence[Path]
    darks: Sequence[Path]
    labels: Path
    spectra: Path

    def paths(self) -> list[Path]:
        """All of them."""
        return [*self.captures, *self.darks, self.labels, self.spectra]

    def by_role(self) -> dict[str, Any]:
        """As describe_inputs takes them."""
        return {
            "capture": list(self.captures),
            "dark": list(self.darks),
            "labels": self.labels,
            "spectra": self.spectra,
        }


@dataclass(frozen=True)
class ChartFolder:
    """What a folder holds of a chart, and the files it came from."""

    data: ChartCaptures
    files: ChartFiles


@dataclass(frozen=True)
class _Table:
    """wavelengths (n,) m; patches (24, n) reflectance; filters: label (m) -> (n,) transmission."""

    wavelengths: np.ndarray
    patches: np.ndarray
    filters: dict[float, np.ndarray]


def read_chart_folder(
    folder: Path | str,
    *,
    cfa: str,
    labels: Path | str | None = None,
    spectra: Path | str | None = None,
) -> ChartFolder:
    """The captures of a chart in a folder, with what is known of it.

    cfa: of the captures, "mono" or four letters.
    labels, spectra: files instead of the ones in the folder.

    Raises InputError, saying what is missing.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError("is no folder", folder, "name the folder with the captures of the chart")
    found = [
        path for path, _ in zip(sorted(folder.rglob("*")), range(MOST_FILES)) if path.is_file()
    ]
    pictures = [
        path
        for path in found
        if path.suffix.lower() in PICTURES
        and "label" not in path.name.lower()
        and _TIME.search(path.name)
    ]
    dark_paths = [path for path in pictures if "dark" in path.name.lower()]
    shots = [path for path in pictures if _BAND.search(path.name) and path not in dark_paths]
    if not shots:
        raise InputError(
            "holds no capture whose name says band and exposure time, such as chart_550nm_25ms.tif",
            folder,
            "name the captures so",
        )
    captures: dict[float, list[Shot]] = {}
    white = np.inf
    shape: tuple[int, ...] | None = None
    for path in shots:
        capture, shape = _read(path, cfa, shape)
        white = capture.levels.white
        band = int(_matched(_BAND, path.name)[1]) * 1e-9
        captures.setdefault(band, []).append(Shot(_seconds(path), capture.mosaic))
    kept, darks = [], []
    for path in dark_paths:
        capture, _ = _read(path, cfa, None)
        if capture.shape == shape:
            kept.append(path)
            darks.append(Shot(_seconds(path), capture.mosaic))
    assert shape is not None  # there are shots
    label_path, label_map = _labels(labels, found, shape, folder)
    table_path, table = _spectra(spectra, found, folder)
    data = ChartCaptures(
        captures=dict(sorted(captures.items())),
        darks=darks,
        white=white,
        cfa=cfa,
        labels=label_map,
        wavelengths=table.wavelengths,
        patches=table.patches,
        filters=table.filters,
    )
    files = ChartFiles(captures=shots, darks=kept, labels=label_path, spectra=table_path)
    return ChartFolder(data, files)


def _matched(pattern: re.Pattern[str], name: str) -> re.Match[str]:
    """The match in a name that was chosen for having one."""
    match = pattern.search(name)
    assert match is not None
    return match


def _seconds(path: Path) -> float:
    value, unit = _matched(_TIME, path.name).groups()
    return float(value) * _UNIT[unit.lower()]


def _read(path: Path, cfa: str, shape: tuple[int, ...] | None) -> tuple["Capture", tuple[int, ...]]:
    from plenocli.files.images.mosaic import read_capture

    capture = read_capture(path, cfa=cfa)
    if shape is not None and capture.shape != shape:
        raise InputError(
            f"is {capture.shape[0]} x {capture.shape[1]} px, other captures "
            f"{shape[0]} x {shape[1]}",
            path,
            "give captures of one camera",
        )
    return capture, capture.shape


def _labels(
    path: Path | str | None, found: Sequence[Path], shape: tuple[int, ...], folder: Path
) -> tuple[Path, np.ndarray]:
    """(path, map): the one asked for, or the map of this size whose patches are
    each in one piece.
    """
    likely = [
        p
        for p in found
        if "label" in p.name.lower() and p.suffix.lower() in (".png", ".tif", ".tiff")
    ]
    return _first(
        path,
        likely,
        lambda one: _label_map(one, shape),
        "label map of the chart",
        folder,
        "give one with --labels: 0 nothing, 1 to 24 the patches row by row",
    )


def _first(
    path: Path | str | None,
    likely: Sequence[Path],
    read: Callable[[Path], Any],
    what: str,
    folder: Path,
    fix: str,
) -> tuple[Path, Any]:
    """(path, read(path)) of the file asked for, or of the first of the `likely` ones that can be
    read; InputError where there is none.
    """
    faults = []
    for one in [Path(path)] if path else likely:
        try:
            return one, read(one)
        except InputError as error:
            faults.append(error)
    if path:
        raise faults[0]
    said = f": {faults[0].what} ({Path(faults[0].where or '').name})" if faults else ""
    raise InputError(f"holds no {what}{said}", folder, fix)


def _label_map(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    from scipy.ndimage import label

    from plenocli.files.images.mosaic import read_capture

    values = np.asarray(read_capture(path).mosaic)
    if values.shape != shape:
        raise InputError(
            f"is {values.shape[0]} x {values.shape[1]} px, the captures {shape[0]} x {shape[1]}",
            path,
            "draw it on a capture",
        )
    labels = np.rint(values).astype(int)
    if set(np.unique(labels)) != set(range(25)):
        raise InputError(
            "does not hold the labels 0 to 24", path, "label every patch, and nothing else"
        )
    for k in range(1, 25):
        pieces = np.bincount(label(labels == k)[0].ravel())[1:]
        if pieces.max() < 0.99 * pieces.sum():
            raise InputError(
                f"shows patch {k} in several pieces", path, "draw every patch in one piece"
            )
    return labels


def _spectra(path: Path | str | None, found: Sequence[Path], folder: Path) -> tuple[Path, _Table]:
    """(path, table) of the first table that has all patches."""
    likely = [p for p in found if p.suffix.lower() == ".csv"]
    return _first(
        path,
        likely,
        _table,
        "table of the patches' spectra",
        folder,
        "give one with --spectra: wavelength in nm, then a column a patch",
    )


def _table(path: Path) -> _Table:
    from plenocli.forward.scene.tables import colorchecker

    try:
        with open(path, newline="", encoding="utf-8-sig") as file:
            header, *rows = list(csv.reader(file))
        values = np.array([[float(cell) for cell in row] for row in rows if row])
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(
            f"is no table of numbers ({error})", path, "give a .csv with a header line"
        ) from error
    header = [name.strip() for name in header]
    names = colorchecker()[0]
    missing = [name for name in names if name not in header]
    if (
        missing
        or values.ndim != 2
        or values.shape[1] != len(header)
        or not np.isfinite(values).all()
    ):
        raise InputError(
            f"has no column {missing[0]!r}"
            if missing
            else "has rows of different length, or values that are not finite",
            path,
            "name the columns after the patches: dark skin, light skin, ...",
        )
    wavelengths = values[:, 0] * 1e-9
    if (
        len(wavelengths) < 2
        or not (np.diff(wavelengths) > 0).all()
        or wavelengths[0] < 100e-9
        or wavelengths[-1] > 20e-6
    ):
        raise InputError(
            "does not begin with ascending wavelengths in nm", path, "put them in the first column"
        )
    columns = {name: values[:, i] for i, name in enumerate(header)}
    filters = {
        int(match[1]) * 1e-9: columns[name]
        for name in header[1:]
        if (match := _FILTER.fullmatch(name))
    }
    return _Table(wavelengths, np.array([columns[name] for name in names]), filters)
