"""Superpixels of a real capture along the grid of a calibration, in units of A x.

Lenslets of a real array lie between pixels, and move by parts of a pixel between white image and
capture; pixels have noise, dust and gains of their own. So every superpixel is sampled about its
lenslet's centre (quintic splines: the image of the pupil is finer than the pixels by several
times), evened by the white image, and each pixel keeps the variance that it has then.
docs/model.md, "Real light".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.text import by
from plenocli.base.tiling import EVERYTHING, Plane, Room, bands
from plenocli.forward.sensor.frames import require_sensor
from plenocli.forward.sensor.noise import Noise
from plenocli.forward.sensor.superpixel import extract_rows
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

AT_ONCE = 1 << 19
"""Pixels of superpixels that are worked on at a time."""
MARGIN = 64
"""Pixels beyond superpixels that are read with them: splines forget what is further away."""
CENTRED = 0.01
"""px: windows that lie so well about their lenslets are taken as they are."""
FARTHEST = 2.0
"""px: more than this between white image and capture is no motion of the array."""
FLAT = 0.25
"""Share of the lenslets, those with the least structure, that tell the motion."""
DARK = 0.02
"""Of the brightest pixel of white, below which a pixel has nothing to tell."""
FEWEST = 16
"""Lenslets whose white image tells what a pixel has in common with others."""
UNLIKE = 6.0
"""Standard deviations from which on a pixel of white is not that of all lenslets: dust."""
MEDIANS = 1 << 21
"""Values whose medians are looked for at a time."""
DUST = 0.5
"""Of the white that all lenslets have, below which a pixel counts for nothing."""
BRIGHT = 0.8
"""Of the brightest pixel of white in a superpixel, where the noise is told from differences."""
NORMAL = 1.4826
"""Standard deviation over median absolute deviation, of a normal distribution."""


class EachPixel:
    """A capture cut out along a calibration's grid, with the variance of every pixel; worked out in
    bands of lenslets, and cut when it is asked for.

    capture, calibration: with windows, white and dark; what of them stays in files is read in
        bands.
    system: the system matrix, with the pixels of the calibration's windows, or with pixels that
        hold a whole number of them.
    where: the calibration's file, for messages.
    room: as of plenocli.inverse.picture.superpixels.along_the_grid.

    Raises InputError where sizes differ.
    """

    def __init__(
        self,
        capture: Capture,
        system: LensletMatrix,
        calibration: Calibration,
        where: str | Path | None,
        room: Room = np.empty,
    ) -> None:
        bins = _bins(there(calibration.windows).shape, system.pixel_shape, where)
        light = _Light(capture, calibration)
        self.count, self.pixels = light.count, math.prod(system.pixel_shape)
        moved, noise = light.settle(), pixel_noise(capture, calibration, light)
        kept = room((self.pixels, *self.count), np.dtype(float))
        for rows in light.bands:
            kept[:, rows] = np.moveaxis(binned(light.white(rows), light.window, bins), 2, 0)
        if np.abs(moved).max() > CENTRED:
            note(
                f"{capture.name}: the lenslets lie {moved[0]:+.2f} rows and {moved[1]:+.2f} "
                "columns from where the white image has them; superpixels are taken there"
            )
        common, even = in_common(kept, light.lit), system.blocks.sum(axis=(0, 2), dtype=float)
        size = self.count[0] * self.count[1], self.pixels
        self._y, self._variance = (room(size, np.dtype(float)) for _ in range(2))
        for rows in light.bands:
            white, dusty = typical_white(np.moveaxis(kept[:, rows], 0, 2), common, rows)
            cut, usable = (binned(a, light.window, bins) for a in light.seen(rows))
            usable = (usable > 0.99) & ~dusty & (even > DARK * even.max()) & (white > 0)
            factor = np.where(usable, even / np.where(usable, white, 1.0), 0.0)
            cut = np.where(usable, cut, 0.0)
            variance = noise.variance(np.maximum(cut, 0.0)) / np.prod(bins) * factor**2
            own = slice(rows.start * self.count[1], rows.stop * self.count[1])
            y = np.where(usable, cut * factor, np.nan)
            self._y[own, :] = y.reshape(-1, self.pixels)
            variance = np.where(usable, variance, np.inf)
            self._variance[own, :] = variance.reshape(-1, self.pixels)

    def cut(
        self, rows: slice, columns: slice, own: tuple[slice, slice] = (EVERYTHING, EVERYTHING)
    ) -> Superpixels:
        """As of plenocli.inverse.picture.tiles.Source: y, NaN where a pixel counts for nothing, and
        its variance, inf there.
        """
        first, last, _ = rows.indices(self.count[0])
        lenslets = slice(first * self.count[1], last * self.count[1])
        y, variance = (
            kept[lenslets, :].reshape(last - first, self.count[1], self.pixels)[:, columns]
            for kept in (self._y, self._variance)
        )
        return Superpixels(y=y, variance=variance, own=own)


class _Light:
    """What the windows of a capture and of the white image hold, in bands of lenslets.

    count: lenslets (rows, columns).
    window: (rows, columns) px.
    bands: rows of lenslets.
    lit: (lenslet_row, lenslet_column), which of them count.
    """

    def __init__(self, capture: Capture, calibration: Calibration) -> None:
        windows = there(calibration.windows)
        self._capture, self._calibration = capture, calibration
        self._origin, self.window = windows.origin, windows.shape
        self._white = there(there(calibration.white).superpixels)
        self.count: tuple[int, int] = calibration.grid.valid.shape
        self.bands = bands(self.count[0], AT_ONCE // (math.prod(self.window) * self.count[1]))
        self.lit = np.zeros(self.count, bool)
        self._signal = Plane(capture.shape, self._above_dark)
        self._places: np.ndarray | None = None
        self._moved = np.zeros(2)

    def _above_dark(self, rows: slice, _: slice) -> np.ndarray:
        """(row, column) of some rows of the sensor, NaN where a pixel counts for nothing."""
        signal, mask = above_dark(self._capture, self._calibration, rows), self._capture.mask
        return signal if mask is None else np.where(mask[rows], np.nan, signal)

    def _of_white(self, rows: slice) -> np.ndarray:
        white = self._white if self._white.ndim == 1 else self._white[rows]
        shape = rows.stop - rows.start, self.count[1], white.shape[-1]
        return np.broadcast_to(white, shape).astype(float)

    def windows(self, rows: slice) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(capture, white, which pixels count) of some rows of lenslets, (lenslet_row,
        lenslet_column, pixel), as they lie on the sensor.
        """
        cut = extract_rows(self._signal, self._origin[rows], self.window)
        white = self._of_white(rows)
        known = np.isfinite(cut), np.isfinite(white)
        lit = known[0].any(axis=2) & known[1].any(axis=2) & self._calibration.grid.valid[rows]
        self.lit[rows] = lit
        usable = known[0] & known[1] & lit[..., None]
        levels = self._capture.levels
        over = levels.white - float(np.max(levels.black))
        return cut, white, usable & (cut < over) if np.isfinite(over) else usable

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return map(self.windows, self.bands)

    def settle(self) -> np.ndarray:
        """Where lenslets lie from where the white image has them, (2,) rows and columns, px; from
        then on they are sampled there, unless windows lie well about them.
        """
        self._moved = moved = motion(self, self.window)
        middle = self._origin + (np.asarray(self.window) - 1) / 2
        aside = np.where(self.lit[..., None], self._calibration.grid.centres - middle, 0.0)
        if np.abs(aside).max(initial=0) > CENTRED or np.abs(moved).max() > CENTRED:
            self._places = np.where(self.lit[..., None], middle + aside, np.nan)
        return moved

    def seen(self, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(superpixels of the capture, which of their pixels count), (lenslet_row, lenslet_column,
        pixel).
        """
        cut, _, usable = self.windows(rows)
        if self._places is None:
            return cut, usable
        places = self._places[rows] + self._moved
        near = rows_around(places, self.window[0], self._signal.shape[0])
        image = self._signal.read(near, EVERYTHING)
        return sampled(image, places - (near.start, 0), self.window), usable

    def white(self, rows: slice) -> np.ndarray:
        """Superpixels of the white image, as `seen`."""
        if self._places is None:
            return self._of_white(rows)
        places, height = self._places[rows], self.window[0]
        near = rows_around(places, height, self._signal.shape[0])
        first, last = self._origin[..., 0], self._origin[..., 0] + height
        touch = (last > near.start) & (first < near.stop) & (first >= 0)
        lines = np.flatnonzero(touch.any(axis=1))
        if not len(lines):
            return np.full((*places.shape[:2], math.prod(self.window)), np.nan)
        some = slice(int(lines[0]), int(lines[-1]) + 1)
        top = int(first[touch].min())
        size = min(int(last[touch].max()), self._signal.shape[0]) - top, self._signal.shape[1]
        origin = np.where(touch[some, :, None], self._origin[some] - (top, 0), -1)
        image = _pasted(self._of_white(some), origin, self.window, size)
        return sampled(image, places - (top, 0), self.window)


def above_dark(capture: Capture, calibration: Calibration, rows: slice = EVERYTHING) -> np.ndarray:
    """Signal (row, column) above the dark level of a calibration, at its exposure.

    rows: of the sensor; of a capture or a dark image in a file no more are read.

    Raises InputError where the two sensors differ.
    """
    dark = there(calibration.dark).mean
    if len(dark.shape) == 2:
        require_sensor(capture.shape, dark.shape, capture.metadata.path)
    reference = calibration.sensor.exposure
    scale = reference / capture.exposure_s if reference and capture.exposure_s else 1.0
    own = Plane.of(dark).read(rows, EVERYTHING) if len(dark.shape) == 2 else dark
    return (Plane.of(capture.mosaic).read(rows, EVERYTHING) - own) * scale


def motion(
    parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]], shape: tuple[int, int]
) -> np.ndarray:
    """Where the lenslets of a capture lie, from where the white image has them.

    An evenly lit superpixel is b white(p - d) + o; d is fitted with b and o to first order in every
    lenslet, and the median over those with the least structure taken.

    parts: as of noise_of_parts.
    shape: (rows, columns) of a superpixel.

    Returns d (2,) rows and columns, px; 0 where it is not above four standard errors.
    """
    rests = np.concatenate([_motions(*part, shape) for part in parts])
    if len(rests) < 8:
        return np.zeros(2)
    calm = rests[np.argsort(rests[:, 0])[: max(8, int(FLAT * len(rests)))], 1:]
    shift = np.median(calm, axis=0)
    error = NORMAL * np.median(np.abs(calm - shift), axis=0) * np.sqrt(np.pi / 2 / len(calm))
    sure = (np.abs(shift) > 4 * error) & (np.abs(shift) < FARTHEST)
    return np.where(sure, shift, 0.0)


def _motions(
    cut: np.ndarray, white: np.ndarray, usable: np.ndarray, shape: tuple[int, int]
) -> np.ndarray:
    """(lenslet, 3) what an even object does not explain of the lenslets that are wholly known, root
    mean square over their brightness, and d.
    """
    found = []
    for y, w, good in zip(*(a.reshape(-1, a.shape[-1]) for a in (cut, white, usable))):
        if not good.all():
            continue
        down, right = np.gradient(w.reshape(shape))
        terms = np.stack([w, -down.ravel(), -right.ravel(), np.ones_like(w)], axis=1)
        fitted = np.linalg.lstsq(terms, y, rcond=None)[0]
        if fitted[0] > DARK:
            rest = np.sqrt(np.mean((y - terms @ fitted) ** 2)) / (fitted[0] * w.max())
            found.append([rest, *(fitted[1:3] / fitted[0])])
    return np.array(found).reshape(-1, 3)


def rows_around(centres: np.ndarray, height: float, count: int) -> slice:
    """Rows of an image of `count` rows that splines need for windows about places, from an even one
    on.

    centres: (.., 2) px, NaN where nothing is wanted.
    height: of a window, px.
    """
    known = centres[..., 0][np.isfinite(centres[..., 0])]
    ends = np.array([known.min(), known.max()] if known.size else [0.0, 0.0])
    reach = MARGIN + height / 2
    top, bottom = np.clip(ends + (-reach, reach), 0, count).astype(int) // 2 * 2 + (0, 2)
    return slice(int(top), min(int(bottom), count))


def sampled(
    image: np.ndarray,
    centres: np.ndarray,
    shape: tuple[int, int],
    step: tuple[float, float] = (1.0, 1.0),
) -> np.ndarray:
    """Windows of an image about places between its pixels, by quintic splines.

    image: (row, column), NaN where a pixel counts for nothing.
    centres: (.., 2) px.
    shape: (rows, columns) of a window.
    step: between its rows and columns, px.

    Returns (.., pixel), NaN near pixels that count for nothing and off the image.
    """
    from scipy.ndimage import binary_dilation, distance_transform_edt, map_coordinates

    lost = ~np.isfinite(image)
    if lost.any():
        nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
        image = image[tuple(nearest)]
    rows, columns = ((np.arange(n) - (n - 1) / 2) * s for n, s in zip(shape, step))
    place = np.empty((2, *centres.shape[:-1], *shape))
    place[0] = centres[..., 0, None, None] + rows[:, None]
    place[1] = centres[..., 1, None, None] + columns
    values = map_coordinates(image, place, order=5, mode="nearest")
    size = np.array(image.shape).reshape(2, *[1] * (place.ndim - 1))
    off = ((place < -1) | (place > size)).any(axis=0)
    if lost.any():
        spoilt = binary_dilation(lost, iterations=1)
        at = np.clip(np.rint(place), 0, size - 1).astype(int)
        off |= spoilt[at[0], at[1]]
    return np.where(off, np.nan, values).reshape(*centres.shape[:-1], -1)


def typical_white(
    white: np.ndarray, common: Common | None, rows: slice = EVERYTHING
) -> tuple[np.ndarray, np.ndarray]:
    """The white image with less noise: what all lenslets have in common, times the brightness of
    each; where a pixel differs from that beyond the noise, its own.

    white: (lenslet_row, lenslet_column, pixel) of some rows of lenslets, NaN where it is not known.
    common: of `in_common`.

    Returns it, and which pixels lie under dust.
    """
    own = np.where(np.isfinite(white), white, 0.0)
    if common is None:
        return own, np.zeros(white.shape, bool)
    typical = common.typical(rows)
    with np.errstate(invalid="ignore"):
        kept = np.abs(own - typical) <= UNLIKE * common.spread * typical
        return np.where(kept, typical, own), own < DUST * typical


@dataclass(frozen=True, kw_only=True)
class Common:
    """A white image without dust.

    pixel: (pixel,) what lenslets have in common, NaN where too few tell.
    level: (lenslet_row, lenslet_column, 1) brightness of each, NaN where it does not tell.
    spread: (pixel,) standard deviation of each pixel's share of it.
    """

    pixel: np.ndarray
    level: np.ndarray
    spread: np.ndarray

    def typical(self, rows: slice = EVERYTHING) -> np.ndarray:
        """(lenslet_row, lenslet_column, pixel) what it would be behind some rows of lenslets."""
        return self.level[rows] * self.pixel


def in_common(white: Any, lit: np.ndarray) -> Common | None:
    """The white image without dust: what lenslets have in common times the brightness of each, both
    medians, of which dust on few lenslets and on less than half of one moves neither.

    white: (pixel, lenslet_row, lenslet_column), NaN where it is not known; may stay in a file, of
        which slices are looked at.
    lit: (lenslet_row, lenslet_column), which of them count.

    Returns None where too few lenslets are lit.
    """
    pixels = white.shape[0]
    groups = bands(pixels, MEDIANS // lit.size)
    common, spread = np.full((2, pixels), np.nan)

    def known(some: slice) -> np.ndarray:
        return np.where(lit, white[some, :], np.nan).reshape(-1, lit.size)

    for some in groups:
        values = known(some)
        told = np.isfinite(values).sum(axis=1) >= FEWEST
        if told.any():
            common[some][told] = np.nanmedian(values[told], axis=1)
    counts = common > 0
    if not counts.any():
        return None
    common[~counts] = np.nan
    level = np.full((*lit.shape, 1), np.nan)
    for rows in bands(lit.shape[0], MEDIANS // (pixels * lit.shape[1])):
        seen = np.where(lit[rows], white[:, rows], np.nan)[counts] / common[counts, None, None]
        tells = np.isfinite(seen).any(axis=0)
        level[rows][tells, 0] = np.nanmedian(seen[:, tells], axis=0)
    for some in groups:
        own = counts[some]
        if own.any():
            share = known(some)[own] / common[some][own, None] / level.ravel() - 1
            spread[some][own] = NORMAL * np.nanmedian(np.abs(share), axis=1)
    return Common(pixel=common, level=level, spread=spread)


def _bins(
    window: tuple[int, int], pixels: tuple[int, int], where: str | Path | None
) -> tuple[int, int]:
    """Pixels (rows, columns) of the sensor in one of the matrix."""
    bins = window[0] // pixels[0], window[1] // pixels[1]
    if (bins[0] * pixels[0], bins[1] * pixels[1]) != tuple(window) or 0 in bins:
        raise InputError(
            (
                f"holds windows of {by(window)} pixels, the system matrix {by(pixels)}, which is "
                "no whole part of them"
            ),
            where,
            "simulate-pif with pixels_per_lenslet as measured, or a whole part of it",
        )
    return bins


def _pasted(
    superpixels: np.ndarray, origin: np.ndarray, shape: tuple[int, int], sensor: tuple[int, ...]
) -> np.ndarray:
    """An image (row, column) of superpixels where they lie; between them the nearest pixel."""
    from scipy.ndimage import distance_transform_edt

    image = np.full(sensor, np.nan)
    for window, (row, column) in zip(
        superpixels.reshape(-1, *shape), origin.reshape(-1, 2).tolist()
    ):
        if np.isfinite(window).any() and row >= 0 and column >= 0:
            image[row : row + shape[0], column : column + shape[1]] = window
    nearest = distance_transform_edt(
        ~np.isfinite(image), return_distances=False, return_indices=True
    )
    return image[tuple(nearest)]


def binned(values: np.ndarray, shape: tuple[int, int], bins: tuple[int, int]) -> np.ndarray:
    """(.., pixel) averaged over bins (rows, columns) of pixels."""
    rows, columns = shape[0] // bins[0], shape[1] // bins[1]
    parts = values.reshape(*values.shape[:-1], rows, bins[0], columns, bins[1])
    return parts.mean(axis=(-3, -1)).reshape(*values.shape[:-1], -1)


def pixel_noise(
    capture: Capture,
    calibration: Calibration,
    parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> Noise:
    """Of a pixel: as the capture tells, as the calibration does, else from the capture itself.

    parts: as of noise_of_parts.
    """
    if capture.noise is not None and capture.noise.without_signal > 0:
        return capture.noise
    sensor = calibration.sensor
    if sensor.gain is not None:
        return Noise(gain=sensor.gain, read_variance=sensor.read_variance)
    return noise_of_parts(capture, calibration, parts)


def noise_of_parts(
    capture: Capture,
    calibration: Calibration,
    parts: Iterable[tuple[np.ndarray, np.ndarray, np.ndarray]],
) -> Noise:
    """Of a pixel, from the capture itself.

    parts: (capture, white, which pixels count), (lenslet_row, lenslet_column, pixel), of some rows
        of lenslets after the other.
    """
    shape, apart = there(calibration.windows).shape, 1 if capture.cfa == "mono" else 2
    shares, peak = [], 0.0
    for cut, white, usable in parts:
        shares.append(_unlike_neighbours(cut, white, usable, shape, apart))
        peak = max(peak, float(np.max(np.abs(white), where=np.isfinite(white), initial=0.0)))
    # a sensor without noise is none
    least = max(calibration.sensor.read_variance, (1e-6 * peak) ** 2)
    return Noise(gain=_photon_transfer(np.concatenate(shares)), read_variance=least)


def _unlike_neighbours(
    cut: np.ndarray,
    white: np.ndarray,
    usable: np.ndarray,
    shape: tuple[int, int],
    apart: int,
) -> np.ndarray:
    """(n,) mixed second differences, which what lenslets show has little of, over the root of the
    level, one of each bright pixel whose neighbours are so.

    cut, white, usable: (lenslet_row, lenslet_column, pixel).
    shape: (rows, columns) of a superpixel, px.
    apart: pixels from one to the next of the same colour.
    """
    peak = np.nanmax(np.where(usable, white, 0.0), axis=2, keepdims=True)
    bright = np.where(usable & (white > BRIGHT * peak), cut, np.nan).reshape(-1, *shape)
    both, n = 2 * apart, apart
    second = bright[:, both:] - 2 * bright[:, n:-n] + bright[:, :-both]
    mixed = (second[:, :, both:] - 2 * second[:, :, n:-n] + second[:, :, :-both]) / 6
    level = bright[:, n:-n, n:-n]
    good = np.isfinite(mixed) & (level > 0)
    return (np.abs(mixed[good]) / np.sqrt(level[good])).astype(np.float32)


def _photon_transfer(shares: np.ndarray) -> float:
    """Variance for one unit of signal, of what _unlike_neighbours gives."""
    return 0.0 if len(shares) < 100 else float((NORMAL * np.median(shares)) ** 2)
