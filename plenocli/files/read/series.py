"""Captures of one camera at one setting, checked against each other."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from plenocli.files.images.mosaic import read_capture
from plenocli.forward.sensor.capture import Capture
from plenocli.inverse.calibration.measure import require_alike


def read_series(
    paths: Iterable[str | Path], like: Capture | None = None, cfa: str | None = None
) -> list[Capture]:
    """Read several captures of one kind (.h5, .exr, RAW, DNG, PNG, TIFF).

    like: one whose size, colour filter array and units they must share (default: the first).
    cfa: what a PNG or TIFF cannot say; other files must agree with it (None: they say it, images
        are mono).

    Raises InputError for one that cannot be read or differs.
    """
    out: list[Capture] = []
    for path in paths:
        out.append(read_capture(path, cfa=cfa))
        require_alike(out[-1], like or out[0])
    return out


def true_centres(path: str | Path) -> np.ndarray | None:
    """Superpixel centres (lenslet_row, lenslet_column, 2), px, that a simulated capture (.h5)
    knows of itself, or None.
    """
    if Path(path).suffix != ".h5":
        return None
    grid = read_capture(path).grid
    return grid.centre if grid else None
