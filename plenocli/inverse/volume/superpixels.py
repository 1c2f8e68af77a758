"""The superpixels of a capture as a volume's kernels have them: whole pixels about lenslets."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import by
from plenocli.base.tiling import EVERYTHING, Plane, Room, bands, in_cells, in_lenslets
from plenocli.forward.sensor.capture import SuperpixelGrid
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.forward.sensor.frames import require_in_reach, saturated
from plenocli.forward.sensor.superpixel import extract_rows
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.picture.real_light import (
    DUST,
    UNLIKE,
    above_dark,
    binned,
    in_common,
    pixel_noise,
    rows_around,
    sampled,
)
from plenocli.inverse.volume.measurement import AT_ONCE, Measurement

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.volume.stack import Stack
    from plenocli.inverse.calibration.calibration import Calibration

EDGE = 0.1
"""Of the brightest pixel of white, below which one at the pupil's edge counts for nothing."""
MOST_TURN = 3.0
"""Degrees by which superpixels may be turned."""
LEAST_DUST, MOST_DUST = 0.02, 0.02
"""Of a pixel's light, what dust takes away at the least, and what is left at the least: such pixels
count for nothing anyhow.
"""
DIM = 0.05
"""Of the usual white level, below which a lenslet counts for nothing."""


def measured(
    capture: Capture,
    stack: Stack,
    calibration: Calibration | None = None,
    *,
    where: str | Path | None = None,
    background: float = 0.0,
    channel: str | None = None,
    room: Room = np.empty,
) -> Measurement:
    """Superpixels of a capture, one unit of light the mean level of the white image, or what the
    capture calls one.

    stack: the kernels, which say how many pixels superpixels have, and on what lattice.
    calibration: with grid, white and dark, along which real captures are resampled, several pixels
        of theirs to one of the kernels where these have a whole part of them; where the white
        image shows another light than the kernels have of an even object, pixels are made what they
        would be behind the camera that is described. None: the capture is tiled as it says itself.
    where: the calibration's file, for messages.
    background: light without any specimen, in the same unit.
    channel: letter of the colour filter array whose pixels count, each a sample at its own place;
        a grey capture has none.
    room: for them, of a shape, which takes slices of rows.

    Raises InputError where sizes disagree, lenslets are missing or light is out of reach,
    UsageError for a channel that the capture does not have, or none of those that it has.
    """
    channel = _asked(capture, channel)
    several = stack.lenslets
    shape = stack.pixel_shape[0] // several, stack.pixel_shape[1]
    if calibration is None:
        found = _tiled(capture, shape, stack.lattice, channel)
    else:
        found = _resampled(capture, shape, stack.lattice, calibration, where, channel, room)
        even = in_lenslets(stack.even()[None, None], several).mean(axis=(0, 1))
        white = white_superpixel(calibration, shape, stack.lattice, channel)
        found = found.times(_evening(white.ravel(), even))
    (rows, columns), pixels = found.count, shape[0] * shape[1]
    signal = room((-(-rows // several), columns, several * pixels))
    for cells in bands(signal.shape[0], AT_ONCE // (several * columns * pixels)):
        first, last = cells.start * several, cells.stop * several
        cut = found.cut(slice(first, min(last, rows)))
        # what the last row of cells lacks
        cut = np.pad(cut, ((0, last - first - len(cut)), (0, 0), (0, 0)), constant_values=np.nan)
        require_in_reach(cut, capture.metadata.path)
        signal[cells, :] = in_cells(cut, several)
    return Measurement(
        signal=signal, read_variance=found.read_variance, gain=found.gain, background=background
    )


@dataclass(frozen=True, kw_only=True)
class _Superpixels:
    """Superpixels in units of the volume's light, cut out when they are asked for.

    count: lenslets (rows, columns).
    cut: gives those of some rows, (row, column, pixel), NaN where a pixel counts for nothing.
    read_variance, gain: as of Measurement.
    """

    count: tuple[int, int]
    cut: Callable[[slice], np.ndarray]
    read_variance: float
    gain: float

    def times(self, factor: np.ndarray) -> _Superpixels:
        """The same times a factor (pixel,)."""
        return replace(self, cut=lambda rows: self.cut(rows) * factor)

    def below_nothing(self) -> _Superpixels:
        """The same with one row more, the first, of which nothing is known."""

        def cut(rows: slice) -> np.ndarray:
            own = self.cut(slice(max(rows.start - 1, 0), max(rows.stop - 1, 1)))
            above = int(rows.start == 0)
            whole = np.pad(own, ((above, 0), (0, 0), (0, 0)), constant_values=np.nan)
            return whole[: rows.stop - rows.start]

        rows, columns = self.count
        return replace(self, count=(rows + 1, columns), cut=cut)


def _asked(capture: Capture, channel: str | None) -> str:
    """The letter whose pixels count."""
    letters = sorted(set(cfa_map((2, 2), capture.cfa).flat))
    if channel is None and len(letters) == 1:
        return letters[0]
    if channel is None or channel not in letters:
        names = ", ".join(letters)
        has = "none" if capture.cfa == "mono" else f"those of {capture.cfa}: {names}"
        raise UsageError(
            f"--channel {channel or 'is missing'}: of the sensor's channels {capture.name} has "
            f"{has}; each makes a volume of its own",
            fix="leave --channel out" if capture.cfa == "mono" else f"name one of {names}",
        )
    return channel


def _evening(white: np.ndarray, even: np.ndarray) -> np.ndarray:
    """(pixel,) by what superpixels are multiplied whose white image (pixel,) would be `even`, NaN
    at the pupil's edge.
    """
    known = (even > EDGE * even.max()) & (white > EDGE * white.max())
    factor = np.where(known, even / np.where(known, white, 1.0), np.nan)
    return factor / np.average(factor[known], weights=white[known])


def white_superpixel(
    calibration: Calibration,
    shape: tuple[int, int],
    lattice: str = "square",
    channel: str | None = None,
) -> np.ndarray:
    """Mean superpixel (row, column) of the white image, resampled to `shape`.

    channel: letter of the colour filter array whose pixels count; all by default.

    Raises InputError where the calibration has no white image, or another lattice.
    """
    from scipy.ndimage import uniform_filter

    white = calibration.white
    if white is None or white.flat is None:
        raise InputError(
            "holds no white image", "calibration", "calibrate with one (--white), as measured"
        )
    grid = calibration.grid
    step, flat = _step(calibration, shape, lattice), Plane.of(white.flat)
    corners, pixels = _corners(calibration.sensor.cfa, channel), math.prod(shape)
    light, count = np.zeros((2, *shape))
    for rows in bands(len(grid.valid), AT_ONCE // (pixels * grid.valid.shape[1])):
        own = grid.centres[rows][grid.valid[rows]]
        known = _sampled(flat, own, shape, step, corners)
        light += np.nansum(known, axis=0, dtype=float).reshape(shape)
        count += np.isfinite(known).sum(axis=0).reshape(shape)
    # behind lenslets an even number of pixels apart a colour is seen by the same ones everywhere
    around = [uniform_filter(a.astype(float), 3, mode="nearest") for a in (light, count)]
    around[1] = np.maximum(around[1], 1 / 9)
    return np.where(count > 0, light / np.maximum(count, 1), around[0] / around[1])


def _corners(cfa: str, channel: str | None) -> list[tuple[int, int]]:
    """Where a channel's pixels are in the 2x2 of a colour filter array; nothing where all count."""
    if cfa == "mono" or channel is None:
        return []
    return [(r, c) for r, c in np.argwhere(cfa_map((2, 2), cfa) == channel).tolist()]


def _sampled(
    image: Plane,
    centres: np.ndarray,
    shape: tuple[int, int],
    step: tuple[float, float],
    corners: list[tuple[int, int]],
) -> np.ndarray:
    """As `sampled`, of each corner's pixels alone, and NaN where those of none are the nearest;
    means of as many samples as a step has whole pixels. Of the image no more rows are read than the
    centres need.
    """
    near = rows_around(centres, shape[0] * step[0], image.shape[0])
    seen, centres = image.read(near, EVERYTHING), centres - (near.start, 0)
    bins = _bins(step)
    step = step[0] / bins[0], step[1] / bins[1]
    shape = shape[0] * bins[0], shape[1] * bins[1]
    if not corners:
        return binned(sampled(seen, centres, shape, step), shape, bins)
    values = np.full((*centres.shape[:-1], *shape), np.nan)
    axes = [
        np.rint(centres[..., axis, None] + (np.arange(n) - (n - 1) / 2) * s) % 2
        for axis, (n, s) in enumerate(zip(shape, step))
    ]
    for row, column in corners:
        every = seen[row::2, column::2]
        half = step[0] / 2, step[1] / 2
        part = sampled(every, (centres - (row, column)) / 2, shape, half).reshape(values.shape)
        nearest = (axes[0] == row)[..., :, None] & (axes[1] == column)[..., None, :]
        values = np.where(nearest, part, values)
    return binned(values.reshape(*centres.shape[:-1], -1), shape, bins)


def _bins(step: tuple[float, float]) -> tuple[int, int]:
    """Whole pixels of the sensor (rows, columns) in one of the kernels."""
    return max(1, round(step[0])), max(1, round(step[1]))


def _step(calibration: Calibration, shape: tuple[int, int], lattice: str) -> tuple[float, float]:
    """Pixels of the sensor between those of the kernels (rows, columns).

    Raises InputError for another lattice than that of the kernels.
    """
    grid = calibration.grid
    if grid.lattice != lattice:
        raise InputError(
            f"holds a {grid.lattice} lattice, the kernels are those of a {lattice} one",
            "calibration",
            "describe the camera as it is: lenslet_array.lattice",
        )
    if abs(grid.angle) > MOST_TURN:
        raise InputError(
            f"holds a lattice turned by {grid.angle:.2g} degrees",
            "calibration",
            "turn white image and captures so that rows of lenslets follow those of pixels",
        )
    down, right = (float(p) for p in grid.pitch)
    if lattice == "hexagonal":
        # rows stand as far apart as the lattice has them, evenly or not
        down = abs(float(np.linalg.det(grid.basis))) / right
    return down / shape[0], right / shape[1]


def _tiled(capture: Capture, shape: tuple[int, int], lattice: str, channel: str) -> _Superpixels:
    path = capture.metadata.path
    own, count = (capture.grid.shape, capture.grid.count) if capture.grid else (None, None)
    if own is None or count is None:
        raise InputError(
            "does not say where its lenslets are",
            path,
            "give --calibration (from calibrate) with the white image of this camera",
        )
    if tuple(own) != tuple(shape):
        raise InputError(
            f"has superpixels of {by(own)} pixels, the kernels {by(shape)}",
            path,
            "simulate-pif with the description that the capture was made with",
        )
    unit = capture.metadata.electrons_per_unit or 1.0
    unit *= (capture.levels.gain or 1.0) if capture.units == "DN" else 1.0
    noise, (rows, columns) = capture.noise, count
    # whole pixels side by side
    centre = there(SuperpixelGrid.tiled((rows, columns), shape, lattice).centre)
    origin = np.rint(centre - (np.array(shape) - 1) / 2).astype(int)

    def usable(some: slice, columns: slice) -> np.ndarray:
        seen = capture.window(some, columns)
        corner = some.indices(capture.shape[0])[0] % 2, columns.indices(capture.shape[1])[0] % 2
        signal = seen.signal()
        counts = cfa_map((signal.shape[0], signal.shape[1]), capture.cfa, corner) == channel
        if np.isfinite(seen.levels.white):
            counts &= ~saturated(seen.mosaic, seen.levels.black, seen.levels.white)
        return np.where(counts, signal, np.nan)

    image = Plane(capture.shape, usable)
    return _Superpixels(
        count=(rows, columns),
        cut=lambda some: extract_rows(image, origin[some], shape) / unit,
        read_variance=0.0 if noise is None else noise.without_signal / unit**2,
        gain=0.0 if noise is None else noise.gain / unit,
    )


def _resampled(
    capture: Capture,
    shape: tuple[int, int],
    lattice: str,
    calibration: Calibration,
    where: str | Path | None,
    channel: str,
    room: Room,
) -> _Superpixels:
    grid, white = calibration.grid, calibration.white
    step = _step(calibration, shape, lattice)
    corners, bins = _corners(capture.cfa, channel), _bins(step)
    if max(abs(s / b - 1) for s, b in zip(step, bins)) > 0.1 or (corners and bins != (1, 1)):
        rows, columns = (s * n for s, n in zip(step, shape))
        raise InputError(
            f"has lenslets {rows:.4g} x {columns:.4g} pixels apart, the kernels {by(shape)} pixels "
            "a lenslet",
            where,
            "describe the camera with sensor.pixels_per_lenslet as measured, to the nearest pixel"
            + ("" if corners else ", or a whole part of it"),
        )
    if white is None or white.level is None or white.superpixels is None:
        raise InputError("holds no white image", where, "calibrate with one (--white)")
    light = Plane(capture.shape, partial(_light, capture, calibration))
    level = np.where(grid.valid, white.level, np.nan)
    if corners and white.flat is not None:
        level = level * _share_of_white(Plane.of(white.flat), capture.cfa, channel)
    usual = float(np.nanmedian(level))
    lit = np.isfinite(level) & (level > DIM * usual)
    # lenslets see less towards the corners, which is no property of the specimen
    even = np.where(lit, level / usual, 1.0)[..., None]
    noise = pixel_noise(capture, calibration, _beside_white(light, calibration, lit))
    dust = None
    if not corners and white.flat is not None and lit.any():
        flat = Plane.of(white.flat)
        kept = room((math.prod(shape), *lit.shape))
        dust = _Dust(lambda rows: _sampled(flat, grid.centres[rows], shape, step, []), lit, kept)

    def cut(rows: slice) -> np.ndarray:
        values, own = _sampled(light, grid.centres[rows], shape, step, corners), even[rows]
        good = np.isfinite(values) & lit[rows, :, None]
        if dust is not None:
            # the level, too, is that of what dust let through
            through, shade = dust.on(rows)
            good &= through >= DUST
            values, own = values / through, own / shade
        return np.where(good, values, np.nan) / own / usual

    found = _Superpixels(
        count=lit.shape,
        cut=cut,
        read_variance=noise.without_signal / usual**2 / math.prod(bins),
        gain=noise.gain / usual / math.prod(bins),
    )
    aside = lattice == "hexagonal" and _starts_aside(grid.centres)
    return found.below_nothing() if aside else found


def _light(capture: Capture, calibration: Calibration, rows: slice, columns: slice) -> np.ndarray:
    """Light (row, column) of a part of the sensor, NaN where it is saturated."""
    signal = above_dark(capture, calibration, rows)
    if np.isfinite(capture.levels.white):
        seen = capture.window(rows, EVERYTHING)
        over = saturated(seen.mosaic, seen.levels.black, seen.levels.white)
        signal = np.where(over, np.nan, signal)
    return signal[:, columns]


def _share_of_white(flat: Plane, cfa: str, channel: str) -> float:
    """The mean of white on a channel's pixels over that on all."""
    sums, counts = np.zeros(2), np.zeros(2)
    for rows in flat.in_bands(2):
        values = flat.window(rows)
        own = cfa_map((values.shape[0], values.shape[1]), cfa) == channel
        for number, some in enumerate((values[own], values)):
            sums[number] += np.nansum(some)
            counts[number] += np.isfinite(some).sum()
    mean = sums / counts
    return float(mean[0] / mean[1])


def _beside_white(
    light: Plane, calibration: Calibration, lit: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """As noise_of_parts takes them: whole pixels of the superpixels, those of white, and which of
    them count.
    """
    windows, white = there(calibration.windows), there(there(calibration.white).superpixels)
    pixels = math.prod(windows.shape)
    for rows in bands(len(lit), AT_ONCE // (pixels * lit.shape[1])):
        raw = extract_rows(light, windows.origin[rows], windows.shape)
        seen = np.broadcast_to(white if white.ndim == 1 else white[rows], raw.shape)
        yield raw, seen, np.isfinite(raw) & np.isfinite(seen) & lit[rows, :, None]


class _Dust:
    """What dust lets through of the light of each pixel, as the white image shows it.

    white: gives the superpixels of its rows of lenslets, (row, column, pixel), NaN where a pixel is
        not known.
    lit: (lenslet_row, lenslet_column), which of them count.
    kept: room for them, (pixel, lenslet_row, lenslet_column).
    """

    def __init__(self, white: Callable[[slice], np.ndarray], lit: np.ndarray, kept: Any) -> None:
        self._lit, self._white, pixels = lit, kept, kept.shape[0]
        total = np.zeros(pixels)
        for rows in bands(len(lit), AT_ONCE // (pixels * lit.shape[1])):
            own = white(rows)
            self._white[:, rows] = np.moveaxis(own, 2, 0)
            total += np.nan_to_num(own[lit[rows]]).sum(axis=0, dtype=float)
        self._mean = total / lit.sum()
        self._common = in_common(self._white, lit)

    def on(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """Of some rows of lenslets: the share (row, column, pixel), 1 where there is no dust, and
        that of their brightness, (row, column, 1).
        """
        white, lit = np.moveaxis(self._white[:, rows], 0, 2), self._lit[rows, :, None]
        through = np.ones(white.shape)
        if self._common is not None:
            share = np.where(lit, white, np.nan) / self._common.typical(rows)
            unlike = np.abs(share - 1) > np.maximum(UNLIKE * self._common.spread, LEAST_DUST)
            through = np.where(unlike, np.maximum(share, MOST_DUST), 1.0)
        bright = np.percentile(self._mean * through, 98, axis=2) / np.percentile(self._mean, 98)
        return through, bright[..., None]


def _starts_aside(centres: np.ndarray) -> bool:
    """Whether the first row of a hexagonal lattice is the lower one of its cell, half a pitch to
    the right; centres (lenslet_row, lenslet_column, 2).
    """
    return len(centres) > 1 and bool(np.nanmedian(centres[1, :, 1] - centres[0, :, 1]) < 0)
