"""Captures from files as superpixels in the units of the system matrix."""

from __future__ import annotations

from pathlib import Path

from plenocli.files.images.mosaic import read_capture
from plenocli.files.read.calibrations import read_calibration
from plenocli.inverse.calibration.calibration import Calibration
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.superpixels import superpixels


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
