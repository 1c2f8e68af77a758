"""A capture as light, cut out superpixel by superpixel: dark taken off, exposure divided out,
saturation masked.

A whole mosaic in single precision would pass through memory several times; windows of some lenslets
stay in the cache.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plenocli.base.tiling import EVERYTHING, Plane
from plenocli.forward.sensor.frames import SATURATION, Dark, require_in_reach
from plenocli.forward.sensor.superpixel import inside

BAND = 1 << 21
"""Pixels that are read at a time of a sensor that stays in its file."""


@dataclass(frozen=True, kw_only=True)
class Readout:
    """A capture that gives its light by windows; `readout - number` has a larger offset.

    values: (row, column) as the sensor reports them; a Plane where they stay in their file.
    dark: what it reports without light.
    exposure_s: s, None where unknown.
    black: (2, 2) by position.
    white: level from which on, or nearly, pixels are saturated; inf where none is.
    scale: to the light of the calibration's exposure.
    offset: taken off after that.
    ready: windows of the dark image that were cut before.
    brightest: white, in units of the light; None: all is taken as it is.
    path: of the capture, for messages.
    """

    values: np.ndarray | Plane
    dark: Dark
    exposure_s: float | None
    black: np.ndarray
    white: float
    scale: float = 1.0
    offset: float = 0.0
    ready: DarkWindows | None = None
    brightest: float | None = None
    path: str | Path | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns)."""
        return self.values.shape

    def __sub__(self, offset: float) -> Readout:
        return replace(self, offset=self.offset + float(offset))

    def cut(self, origin: np.ndarray, window: tuple[int, ...]) -> np.ndarray:
        """Light of windows.

        origin: (lenslet, 2) first pixels.
        window: (rows, columns) px.

        Returns (lenslet, pixel) float32; NaN where a pixel is saturated, and everywhere in windows
        that are not wholly on the sensor.
        Raises InputError for light beyond reach.
        """
        return self.cutter(origin, window)(slice(None))

    def cutter(
        self, origin: np.ndarray, window: tuple[int, ...]
    ) -> Callable[[np.ndarray | slice], np.ndarray]:
        """Function of an index or slice into `origin` that cuts those windows."""
        if isinstance(self.values, Plane) or isinstance(self.dark.mean, Plane):
            return lambda part: self._from_bands(origin[part], window)
        whole = inside(origin, window, self.shape)
        if whole.all():
            return _Cutter(self, origin, window)
        inner = _Cutter(self, np.where(whole[:, None], origin, 0), window)

        def cut(part: np.ndarray | slice) -> np.ndarray:
            light = inner(part)
            light[~whole[part]] = np.nan
            return light

        return cut

    def _from_bands(self, origin: np.ndarray, window: tuple[int, ...]) -> np.ndarray:
        """As `cut`, from bands of rows that are read one after the other."""
        light = np.full((len(origin), math.prod(window)), np.nan, np.float32)
        whole = np.flatnonzero(inside(origin, window, self.shape))
        order = whole[np.argsort(origin[whole, 0], kind="stable")]
        rows, at = origin[order, 0], 0
        most = max(window[0], BAND // self.shape[1])
        while at < len(order):
            first = int(rows[at]) // 2 * 2  # colours and levels go by the parity of rows
            end = max(at + 1, int(np.searchsorted(rows, first + most - window[0], "right")))
            band = slice(first, int(rows[end - 1]) + window[0])
            held = replace(
                self,
                values=Plane.of(self.values).read(band, EVERYTHING),
                dark=self.dark.rows(band),
                ready=None,
            )
            light[order[at:end]] = held.cut(origin[order[at:end]] - (first, 0), window)
            at = end
        return light


class _Cutter:
    """Windows that are all on the sensor, and what is the same for any of them."""

    def __init__(self, readout: Readout, origin: np.ndarray, window: tuple[int, ...]) -> None:
        self.readout, self.origin, self.count = readout, origin, window[0] * window[1]
        dark = readout.dark
        assert isinstance(readout.values, np.ndarray)  # bands of Planes are read before
        self.raw = np.lib.stride_tricks.sliding_window_view(readout.values, window)
        self.mean = None if dark.flat else DarkWindows(dark, origin, window)
        if readout.ready is not None and readout.ready.origin is origin:
            self.mean = readout.ready
        self.level = (
            np.float32(dark.black.flat[0])
            if np.ptp(dark.black) == 0
            else _tiles(dark.black, window)
        )
        self.growth = None if dark.flat else dark.growth(readout.exposure_s)
        black = np.asarray(readout.black, float)
        top = black + SATURATION * (readout.white - black)
        self.least = top.min()
        self.top = (
            np.float32(self.least)
            if np.ptp(black) == 0 or not np.isfinite(self.least)
            else _tiles(top, window)
        )

    def __call__(self, part: np.ndarray | slice) -> np.ndarray:
        origin, readout = self.origin[part], self.readout
        at = origin[:, 0], origin[:, 1]
        raw = self.raw[at].reshape(-1, self.count)
        if self.mean is None:
            mean = self._of(self.level, origin)
        else:
            mean = self.mean(part)
            if self.growth is not None:  # as Dark.at
                level = self._of(self.level, origin)
                mean = level + (mean - level) * self.growth
        light = raw.astype(np.float32)
        np.subtract(light, mean, out=light, dtype=np.float32, casting="same_kind")
        if readout.scale != 1.0:
            light *= np.float32(readout.scale)
        if readout.offset:
            light -= np.float32(readout.offset)
        if raw.max() >= self.least:
            light[raw >= self._of(self.top, origin)] = np.nan
        if readout.brightest is not None and raw.dtype.kind == "f":
            require_in_reach(light, readout.path, readout.brightest)
        return light

    def _of(self, level: np.ndarray | np.floating, origin: np.ndarray) -> np.ndarray | np.floating:
        """A level under windows: one number, or (lenslet, pixel)."""
        return level[origin[:, 0] % 2, origin[:, 1] % 2] if isinstance(level, np.ndarray) else level


class DarkWindows:
    """The dark image under windows; `keep` holds them all, for many captures."""

    def __init__(self, dark: Dark, origin: np.ndarray, window: tuple[int, ...]) -> None:
        self.origin, self.count = origin, window[0] * window[1]
        self.kept: np.ndarray | None = None
        self.view = np.lib.stride_tricks.sliding_window_view(dark.mean, window)

    def keep(self) -> DarkWindows:
        """Cut them all now; returns itself."""
        kept = np.empty((len(self.origin), self.count), np.float32)
        for first in range(0, len(kept), 64):
            kept[first : first + 64] = self(slice(first, first + 64))
        self.kept = kept
        return self

    def __call__(self, part: np.ndarray | slice) -> np.ndarray:
        if self.kept is not None:
            return self.kept[part]
        origin = self.origin[part]
        return self.view[origin[:, 0], origin[:, 1]].reshape(-1, self.count)


def _tiles(level: np.ndarray, window: tuple[int, ...]) -> np.ndarray:
    """A (2, 2) level by position under a window that starts at an even or odd row and column,
    (2, 2, h*w) float32.
    """
    out = np.empty((2, 2, *window), np.float32)
    for row in (0, 1):
        for column in (0, 1):
            tile = np.roll(np.asarray(level, np.float32), (-row, -column), (0, 1))
            out[row, column] = np.tile(tile, (window[0] // 2 + 1, window[1] // 2 + 1))[
                : window[0], : window[1]
            ]
    return out.reshape(2, 2, -1)
