"""Superpixels: one window of whole pixels a lenslet, cut out of the mosaic as it is (no
resampling, no demosaicing).
"""

import numpy as np


def windows(centres, shape):
    """First pixel (R, C, 2) int of windows of `shape` (rows, columns) px centred nearest to
    `centres` (R, C, 2).

    Pixel centres are at integers: an even window is centred half a pixel after its middle pixel's
    corner, so a centre at 25.5 with 52 rows starts at row 0. On a lattice of whole-pixel pitch all
    centres sit at the same place within a pixel; there all windows take the same rounding, lest
    noise decide it for each. Sites without a centre (NaN) start at a large negative number.
    """
    centres = np.asarray(centres, float)
    corner = centres - (np.asarray(shape) - 1) / 2
    for axis in (0, 1):
        turns = np.exp(2j * np.pi * corner[..., axis][np.isfinite(corner[..., axis])])
        if turns.size and np.abs(turns.mean()) > 0.95:
            corner[..., axis] -= np.angle(turns.mean()) / (2 * np.pi)
    first = np.rint(corner)
    return np.where(np.isfinite(first), first, -(2**30)).astype(int)


def inside(origin, window, shape):
    """Which windows (R, C) lie wholly in a mosaic of `shape`."""
    return ((origin >= 0) & (origin + np.asarray(window) <= np.asarray(shape))).all(axis=-1)


def extract(mosaic, origin, window):
    """Pixels (R, C, h*w) of every window, row by row; NaN where a window is not
    wholly in the mosaic.

    mosaic (rows, columns), or a plenocli.forward.sensor.readout.Readout; origin (R, C, 2) int;
    window (h, w). Float arrays keep their type, others become float64.
    """
    if hasattr(mosaic, "cut"):
        return mosaic.cut(origin.reshape(-1, 2), window).reshape(*origin.shape[:-1], -1)
    mosaic = np.asarray(mosaic)
    kind = mosaic.dtype if mosaic.dtype.kind == "f" else float
    good = inside(origin, window, mosaic.shape)
    out = np.full((*origin.shape[:-1], window[0] * window[1]), np.nan, kind)
    if good.any():
        view = np.lib.stride_tricks.sliding_window_view(mosaic, window)
        out[good] = view[tuple(origin[good].T)].reshape(-1, window[0] * window[1])
    return out
