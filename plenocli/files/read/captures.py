"""Captures that a command line names, and captures from files as superpixels in the units of the
system matrix.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from plenocli.base.budget import budget, spread
from plenocli.base.errors import InputError
from plenocli.base.progress import collected_notes
from plenocli.base.tiling import bands
from plenocli.files.artefacts.provenance import require_file
from plenocli.files.images.in_bands import SHARE
from plenocli.files.images.mosaic import StoredCapture, capture_in_file, stored_capture
from plenocli.files.read.calibrations import read_white
from plenocli.files.scratch import Scratch
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.superpixels import (
    along_the_grid,
    require_tiled,
    superpixels,
)
from plenocli.inverse.picture.tiles import EVERY, Area, Source

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture

T = TypeVar("T")

PART = 1 << 24
"""Bytes of rows that are read at a time."""
KEPT_SHARE = 1 / 64
"""Share of the memory that the last rows of a capture may take."""
SUFFIXES = tuple(
    ".h5 .exr .dng .png .tif .tiff .3fr .arw .cr2 .cr3 .crw .erf .fff .iiq .kdc .mef .mos .mrw "
    ".nef .nrw .orf .pef .raf .raw .rw2 .rwl .srw .x3f .lfp .lfr .czi .nd2".split()
)
"""Of the files in a folder that are taken for captures; JPEGs and notes lie beside them."""


def named_captures(
    names: Iterable[str | Path], others: Iterable[str | Path | None] = ()
) -> list[Path]:
    """The files that a list of captures means, each once, in its order.

    names: files as they are; of a folder the captures directly in it, by name; of a pattern such as
        `shots/*.NEF`, which not every shell resolves, the files that match.
    others: files that are no captures, a calibration beside them for example; None is nobody.

    Raises InputError where a folder holds no captures.
    """
    apart = {Path(other).absolute() for other in others if other is not None}
    found: dict[Path, None] = {}
    for name in map(Path, names):
        found.update(dict.fromkeys(_meant(name, apart)))
    return list(found)


def describe_capture(path: str | Path) -> dict[str, dict[str, str]]:
    """A capture among the inputs of a Provenance: name, digest and when it was taken, if known."""
    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.images.raw import captured_at

    inputs, when = describe_inputs({"capture": path}), captured_at(path)
    return {"capture": inputs["capture"] | ({"captured": when} if when else {})}


def _meant(name: Path, apart: set[Path]) -> list[Path]:
    """What one name of named_captures stands for."""
    try:
        is_folder, is_there = name.is_dir(), name.exists()
    except OSError:  # a name too long, of which its reader says more
        return [name]
    if not is_folder:
        pattern = not is_there and any(mark in name.name for mark in "*?[")
        matches = sorted(name.parent.glob(name.name)) if pattern else []
        return matches or [name]
    inside = [
        path
        for path in sorted(name.iterdir())
        if path.suffix.lower() in SUFFIXES
        and not path.name.startswith(".")
        and path.is_file()
        and path.absolute() not in apart
    ]
    if not inside:
        raise InputError(
            "is a folder without captures", name, "name one with .h5, .exr, .dng, RAW or TIFF files"
        )
    return inside


class _Rows:
    """Rows of a stored capture, of which each thread that waits for them reads a part."""

    def __init__(self, capture: StoredCapture, rows: slice) -> None:
        self.rows, self._capture = rows, capture
        self._values = np.empty((rows.stop - rows.start, capture.shape[1]), capture.dtype)
        most = PART // (capture.shape[1] * capture.dtype.itemsize)
        self._parts = [(part, Future[None]()) for part in bands(len(self._values), most)]
        self._left = deque(self._parts)

    def values(self) -> np.ndarray:
        """Of all columns, not to be written to. Raises InputError."""
        spread([()] * len(self._left), self._read_next)
        for _, done in self._parts:
            done.result()
        found = self._values.view()
        found.flags.writeable = False
        return found

    def _read_next(self) -> None:
        try:
            part, done = self._left.popleft()
        except IndexError:  # another was faster
            return
        rows = slice(self.rows.start + part.start, self.rows.start + part.stop)
        try:
            self._values[part] = self._capture.values(rows)
            done.set_result(None)
        except BaseException as error:
            done.set_exception(error)


class _Windows:
    """Windows of a stored capture. Chunks of its file, if it has any, are as wide as the sensor, so
    that tiles side by side would unpack the same ones: the last rows are kept where they are few.
    """

    def __init__(self, capture: StoredCapture) -> None:
        self.capture = capture
        self._last: _Rows | None = None
        self._turn = Lock()

    def read(self, rows: slice, columns: slice) -> Capture:
        """That of some pixels. Raises InputError."""
        capture = self.capture
        size = (rows.stop - rows.start) * capture.shape[1] * capture.dtype.itemsize
        if size > KEPT_SHARE * budget().memory:
            return capture.window(rows, columns)
        with self._turn:
            if self._last is None or self._last.rows != rows:
                self._last = None  # not two at a time
                self._last = _Rows(capture, rows)
            last = self._last
        return capture.holding(last.values()[:, columns], rows, columns)


class _Stored:
    """Superpixels that stay in the file of a capture, tiled as it says."""

    def __init__(self, windows: _Windows, system: LensletMatrix) -> None:
        whole: Any = windows.capture.mosaic
        require_tiled(replace(windows.capture.about, mosaic=whole), system)
        self.windows, self.system = windows, system
        self.count = (
            windows.capture.shape[0] // system.pixel_shape[0],
            windows.capture.shape[1] // system.pixel_shape[1],
        )
        self._said = False

    def cut(self, rows: slice, columns: slice, own: Area = EVERY) -> Superpixels:
        """As of Source."""
        lenslets = (slice(*part.indices(n)[:2]) for part, n in zip((rows, columns), self.count))
        pixels = (
            slice(part.start * n, part.stop * n)
            for part, n in zip(lenslets, self.system.pixel_shape)
        )
        part = self.windows.read(*pixels)
        # what there is to say of all of it is said once
        said, self._said = self._said, True
        with collected_notes() if said else nullcontext():
            found = superpixels(part, self.system)
        return replace(found, own=own)


def superpixel_source(
    path: str | Path,
    system: LensletMatrix,
    calibration: str | Path | None = None,
    *,
    each_pixel: bool = False,
    beside: Path | None = None,
    verify: bool = True,
) -> Source:
    """Superpixels of a capture, of which parts are asked for.

    path: of the capture.
    system: the system matrix in whose units they are wanted.
    calibration: artefact along whose lenslet grid they are cut out; without it the capture is
        tiled as its file says.
    each_pixel: as for plenocli.inverse.picture.superpixels.superpixels.
    beside: the result, in whose folder a file that cannot be read in parts is decoded to one that
        can, where it is large, and superpixels along a grid are kept; None: they are held.
    verify: as of plenocli.files.artefacts.reading.opened_artefact; a file that was verified before
        is opened once.

    Raises InputError where sizes disagree or the scale is not known.
    """
    path = Path(path)
    if calibration is None:
        opened = partial(_opened, path, beside, verify=verify)
        windows = _remembered((path, beside, _stamp(path)), opened, anew=verify)
        return _Stored(windows, system)
    files = path, Path(calibration)
    key = *files, system, each_pixel, beside, *map(_stamp, files)
    return _remembered(key, partial(_along_the_grid, *files, system, each_pixel, beside))


def room_beside(target: Path | None) -> Scratch | None:
    """Room in the folder of a result, None where there is no such folder, as for another machine.

    Raises OutputError where nothing can be put there.
    """
    return None if target is None or not target.parent.is_dir() else Scratch(target)


def _opened(path: Path, beside: Path | None, *, verify: bool) -> _Windows:
    """Windows of a capture."""
    with stored_capture(path, room=room_beside(beside), verify=verify) as stored:
        return _Windows(stored)


def _along_the_grid(
    path: Path, calibration: Path, system: LensletMatrix, each_pixel: bool, beside: Path | None
) -> Source:
    """Superpixels along the grid of a calibration, which take a while: tiles have them in common.

    Arguments as of superpixel_source.
    """
    room = room_beside(beside)
    capture = capture_in_file(path, room=room)
    numbers = 8 * math.prod(capture.shape)
    is_held = room is None or numbers <= budget().memory // SHARE
    known = read_white(calibration, in_file=True)
    kept: Any = np.empty if is_held else room
    return along_the_grid(
        capture, system, known, where=calibration, each_pixel=each_pixel, room=kept
    )


_turn = Lock()
"""Threads open captures in turn, so that the second finds what the first has made."""
_open: list[tuple[Any, Any]] = []
"""What was opened last, and all that it goes by."""


def _remembered(key: Any, make: Callable[[], T], *, anew: bool = False) -> T:
    """What was made under this key before where that was the last one, else what is made now.

    anew: in any case.
    """
    with _turn:
        if anew or not _open or _open[0][0] != key:
            _open.clear()
            _open.append((key, make()))
        return _open[0][1]


def forget_captures() -> None:
    """Let go what was opened last, and the files that it was decoded to."""
    with _turn:
        _open.clear()


def _stamp(path: str | Path) -> tuple[int, int]:
    """What tells a file from another one of its name. Raises InputError."""
    size = require_file(path)
    return size, Path(path).stat().st_mtime_ns
