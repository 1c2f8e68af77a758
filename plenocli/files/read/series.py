"""Captures of one camera at one setting, checked against each other."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by
from plenocli.files.images.mosaic import read_capture
from plenocli.forward.sensor.capture import Capture


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
        _require_alike(out[-1], like or out[0])
    return out


def check_exposure_times(captures: Sequence[Capture]) -> None:
    """InputError unless all or none of the captures know their exposure time: else their scales
    cannot be compared.
    """
    known = [c for c in captures if c.exposure_s is not None]
    if known and len(known) != len(captures):
        lost = next(c for c in captures if c.exposure_s is None)
        raise InputError(
            f"does not say its exposure time, while {known[0].name} does",
            lost.metadata.path,
            "use files of one kind for all captures",
        )


def true_centres(path: str | Path) -> np.ndarray | None:
    """Superpixel centres (lenslet_row, lenslet_column, 2), px, that a simulated capture (.h5)
    knows of itself, or None.
    """
    if Path(path).suffix != ".h5":
        return None
    grid = read_capture(path).grid
    return grid.centre if grid else None


def _require_alike(capture: Capture, like: Capture) -> None:
    for what, ours, theirs in (
        ("size", by(capture.shape), by(like.shape)),
        ("colour filter array", capture.cfa, like.cfa),
        ("unit", capture.units, like.units),
    ):
        if ours != theirs:
            raise InputError(
                f"has another {what} ({ours}) than {like.name} ({theirs})",
                capture.metadata.path,
                "use captures of one camera at one setting",
            )
