"""Captures that a command line names, and captures from files as superpixels in the units of the
system matrix.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from plenocli.base.errors import InputError
from plenocli.files.images.mosaic import read_capture
from plenocli.files.read.calibrations import read_calibration
from plenocli.inverse.calibration.calibration import Calibration
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.superpixels import superpixels

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


def read_superpixels(
    path: str | Path,
    system: LensletMatrix,
    calibration: str | Path | None = None,
    *,
    each_pixel: bool = False,
) -> Superpixels:
    """Superpixels of a capture.

    path: of the capture.
    system: the system matrix in whose units they are wanted.
    calibration: artefact along whose lenslet grid they are cut out; without it the capture is
        tiled as its file says.
    each_pixel: as for plenocli.inverse.picture.superpixels.superpixels.

    Raises InputError where sizes disagree or the scale is not known.
    """
    capture = read_capture(path)
    if calibration is None or capture.cfa != "mono":
        return superpixels(capture, system)
    return superpixels(
        capture, system, read_white(calibration), where=calibration, each_pixel=each_pixel
    )


def read_white(path: str | Path) -> Calibration:
    """What a calibration artefact knows of lenslets, white and dark."""
    return read_calibration(path, needs=("windows", "white", "dark"), response=False)
