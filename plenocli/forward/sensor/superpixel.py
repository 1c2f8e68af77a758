"""Superpixels: one window of whole pixels a lenslet, cut out of the mosaic as it is (no
resampling, no demosaicing).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from plenocli.base.tiling import EVERYTHING, Plane


class CutByWindow(Protocol):
    """What gives its pixels by windows, such as plenocli.forward.sensor.readout.Readout."""

    def cut(self, origin: np.ndarray, window: tuple[int, ...]) -> np.ndarray:
        """Pixels (lenslet, h*w) of windows (h, w) whose first pixels are `origin` (lenslet, 2)."""
        ...


def windows(centres: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Windows of whole pixels centred nearest to given places.

    Pixel centres are at integers: an even window is centred half a pixel after its middle pixel's
    corner, so a centre at 25.5 with 52 rows starts at row 0. On a lattice of whole-pixel pitch all
    centres sit at the same place within a pixel; there all windows take the same rounding, lest
    noise decide it for each.
    centres: (lenslet_row, lenslet_column, 2) px.
    shape: (rows, columns) of a window, px.

    Returns the first pixels (lenslet_row, lenslet_column, 2) int; sites without a centre (NaN)
    start at a large negative number.
    """
    centres = np.asarray(centres, float)
    corner = centres - (np.asarray(shape) - 1) / 2
    for axis in (0, 1):
        turns = np.exp(2j * np.pi * corner[..., axis][np.isfinite(corner[..., axis])])
        if turns.size and np.abs(turns.mean()) > 0.95:
            corner[..., axis] -= np.angle(turns.mean()) / (2 * np.pi)
    first = np.rint(corner)
    return np.where(np.isfinite(first), first, -(2**30)).astype(int)


def inside(origin: np.ndarray, window: tuple[int, ...], shape: tuple[int, ...]) -> np.ndarray:
    """Which windows (..) with first pixels `origin` (.., 2) lie wholly in a mosaic of `shape`."""
    return ((origin >= 0) & (origin + np.asarray(window) <= np.asarray(shape))).all(axis=-1)


def extract(
    mosaic: np.ndarray | CutByWindow, origin: np.ndarray, window: tuple[int, ...]
) -> np.ndarray:
    """Pixels of every window, row by row.

    mosaic: (row, column).
    origin: (lenslet_row, lenslet_column, 2) first pixels, int.
    window: (rows, columns) px.

    Returns (lenslet_row, lenslet_column, pixel), NaN where a window is not wholly in the mosaic;
    float arrays keep their type, others become float64.
    """
    if not isinstance(mosaic, np.ndarray):
        return mosaic.cut(origin.reshape(-1, 2), window).reshape(*origin.shape[:-1], -1)
    kind = mosaic.dtype if mosaic.dtype.kind == "f" else float
    good = inside(origin, window, mosaic.shape)
    out = np.full((*origin.shape[:-1], window[0] * window[1]), np.nan, kind)
    if good.any():
        view = np.lib.stride_tricks.sliding_window_view(mosaic, window)
        out[good] = view[tuple(origin[good].T)].reshape(-1, window[0] * window[1])
    return out


def extract_rows(image: Plane, origin: np.ndarray, window: tuple[int, int]) -> np.ndarray:
    """As `extract`, of an image of which no more rows are read than are needed."""
    there = inside(origin, window, image.shape)
    rows = origin[there, 0]
    first, last = (int(rows.min()), int(rows.max())) if rows.size else (0, 0)
    seen = image.read(slice(first, last + window[0]), EVERYTHING)
    own = np.where(there[..., None], origin - (first, 0), -1)
    return extract(seen, own, window)
