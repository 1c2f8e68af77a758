"""Two calibrations side by side: a predicted response and a measured one, or two measured ones."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by


@dataclass(frozen=True, kw_only=True)
class ComparedResponse:
    """The response F of a calibration.

    path: its file.
    matrix: F (lenslet_row, lenslet_column, pixel, band), or (pixel, band) where all share one.
    wavelengths: (band,) m.
    window: (rows, columns) of pixels.
    valid: (lenslet_row, lenslet_column) bool, lenslets of the grid that count.
    """

    path: Path
    matrix: np.ndarray
    wavelengths: np.ndarray
    window: tuple[int, ...]
    valid: np.ndarray


@dataclass(frozen=True)
class ResponsePair:
    """Two responses (lenslet, pixel, band) over the lenslets and bands of both, the bands' centres
    (band,) m and the (rows, columns) of their pixels.
    """

    first: np.ndarray
    second: np.ndarray
    wavelengths: np.ndarray
    window: tuple[int, ...]


def paired_responses(first: ComparedResponse, second: ComparedResponse) -> ResponsePair:
    """Two responses over the lenslets and bands of both.

    Where one of them is shared by all lenslets, it stands beside every lenslet of the other that
    has neighbours on all sides (the others lack light).

    Raises InputError where windows, bands or grids differ.
    """
    if first.window != second.window:
        raise InputError(
            f"has windows of {by(first.window)} px, {second.path} of {by(second.window)}",
            first.path,
            "compare calibrations of one camera",
        )
    near = [
        (i, j)
        for i, w in enumerate(first.wavelengths)
        for j, v in enumerate(second.wavelengths)
        if abs(w - v) < 0.05e-9
    ]
    if not near:
        raise InputError(
            "has no band of the other calibration",
            first.path,
            "predict the bands that were measured: --wavelength",
        )
    ours, theirs = (list(part) for part in zip(*near))
    a, b = first.matrix[..., ours], second.matrix[..., theirs]
    if a.ndim == 4 and b.ndim == 4:
        if a.shape != b.shape:
            raise InputError(
                f"has {by(a.shape[:2])} lenslets, {second.path} {by(b.shape[:2])}",
                first.path,
                "predict on the measured grid: simulate-response --grid",
            )
        valid = first.valid & second.valid
        a, b = a[valid], b[valid]
    elif a.ndim == 4:
        a = a[_inner(first.valid)]
    elif b.ndim == 4:
        b = b[_inner(second.valid)]
    a, b = (part.reshape(-1, *part.shape[-2:]) for part in (a, b))
    shape = (max(len(a), len(b)), *a.shape[1:])
    a, b = (np.broadcast_to(part, shape).astype(float) for part in (a, b))
    return ResponsePair(a, b, first.wavelengths[ours], first.window)


def _inner(valid: np.ndarray) -> np.ndarray:
    """Valid lenslets with neighbours on all sides, or all valid ones where none has."""
    inner = np.zeros_like(valid)
    inner[1:-1, 1:-1] = valid[1:-1, 1:-1]
    return inner if inner.any() else valid
