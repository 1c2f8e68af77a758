"""A white image made ready for the search of its lenslet grid, and how it repeats."""

from __future__ import annotations

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.text import by
from plenocli.forward.sensor.frames import REACH, dead_pixels, shifted_neighbours
from plenocli.inverse.grid import lattice
from plenocli.inverse.grid.lattice import Periodicity

STRONG = 0.6
"""Correlation, less than that of spots that repeat all over an image, 0.7 to 0.8; thin lines have
0.3 to 0.6.
"""
FRAME_TOLERANCE = 0.4
"""px by which a cell's edge may seem to lie outside the frame: sensors end where the array does."""
FIX = (
    "give a white image (even light through the main lens) of a lenslet array "
    "in focus on the sensor"
)


def prepare(
    white: np.ndarray, cfa: str = "mono", dark: np.ndarray | float | None = None
) -> np.ndarray:
    """Float image with dark removed, the mosaic's colours equalised, dead and hot pixels replaced,
    and the background at zero; arguments as find_grid's.

    Raises as find_grid for an image that cannot hold a grid.
    """
    white = np.asarray(white)
    if white.ndim != 2 or min(white.shape) < 24:
        raise InputError(
            "a white image must be a single plane of at least 24 x 24 px, this "
            f"has {by(white.shape)}"
        )
    image = white.astype(np.float32)
    if dark is not None:
        image -= np.asarray(dark, np.float32)
    if not np.isfinite(image).all():
        raise InputError("the white image holds values that are not finite")
    most = float(max(image.max(), -image.min()))
    if most > REACH:
        raise InputError(
            f"the white image, or what is taken off it, holds {most:.2g}: no sensor counts so far",
            fix="give it, and the dark image, as the sensor counts",
        )
    if np.ptp(image) <= 0:
        raise NumericsError(
            f"no lenslet lattice in the image: every pixel has the value {float(white.flat[0]):g}",
            fix=FIX,
        )
    step = 1
    if cfa != "mono":
        step = 2
        means = np.array([[image[i::2, j::2].mean() for j in (0, 1)] for i in (0, 1)])
        if (means <= 0).any():
            raise NumericsError(
                "a colour of the mosaic saw no light in the white image",
                fix="use a broad-band white source",
            )
        for i in (0, 1):
            for j in (0, 1):
                image[i::2, j::2] *= np.float32(means.mean() / means[i, j])
    image = _replace_dead(image, step)
    sample = image[:: max(1, image.shape[0] // 1000), :: max(1, image.shape[1] // 1000)]
    return image - np.float32(np.percentile(sample, 0.5))


def _replace_dead(image: np.ndarray, step: int) -> np.ndarray:
    bad = dead_pixels(image, step)
    if not bad.any():
        return image
    out = image.copy()
    out[bad] = (sum(n[bad].astype(np.float64) for n in shifted_neighbours(image, step)) / 4).astype(
        np.float32
    )
    return out


def period_of(image: np.ndarray, crop: int) -> Periodicity:
    """How a white image repeats in its brightest part. Where it does so weakly, dark surroundings
    of the array may hide thin lines: then in what is lit alone, or in the middle of that.
    """
    found = [lattice.find_basis(brightest_crop(image, crop))]
    if found[0].strength < STRONG:
        parts = (_lit_part(image, share) for share in (1.0, 0.7))
        found += [lattice.find_basis(brightest_crop(part, crop)) for part in parts]
    best = max(one.strength for one in found)
    return next(one for one in found if one.strength >= 0.9 * best)


def _lit_part(image: np.ndarray, share: float) -> np.ndarray:
    """The rows and columns that have at least half of the light of the brightest ones, `share` of
    them in the middle.
    """
    sides = []
    for axis in (0, 1):
        light = image.mean(axis=1 - axis)
        lit = np.flatnonzero(light > 0.5 * np.quantile(light, 0.95))
        first, last = (lit[0], lit[-1] + 1) if len(lit) else (0, len(light))
        cut = int((1 - share) / 2 * (last - first))
        sides.append(slice(first + cut, last - cut))
    return image[tuple(sides)]


def brightest_crop(image: np.ndarray, most: int) -> np.ndarray:
    """Up to `most` px a side around the centroid of the light."""
    clipped = np.clip(image[::4, ::4], 0, None).astype(float)
    total = clipped.sum()
    low = []
    for axis in (0, 1):
        size = min(most, image.shape[axis])
        profile = clipped.sum(axis=1 - axis)
        centre = (
            4 * (profile * np.arange(len(profile))).sum() / total
            if total > 0
            else image.shape[axis] / 2
        )
        low.append(int(np.clip(centre - size / 2, 0, image.shape[axis] - size)))
    return image[low[0] : low[0] + most, low[1] : low[1] + most]


def in_frame(position: np.ndarray, shape: tuple[int, ...], margin: float) -> np.ndarray:
    """(N,) bool, whether `margin` px around places (N, 2) px lie in a frame of so many pixels."""
    low = margin - 0.5 - FRAME_TOLERANCE
    return np.all((position >= low) & (position <= np.array(shape) - 1 - low), axis=-1)
