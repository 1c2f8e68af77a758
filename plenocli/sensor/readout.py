"""A capture as light, cut out superpixel by superpixel: dark taken off, exposure divided out, saturation masked.

A whole mosaic in single precision would pass through memory several times; windows of some lenslets stay in the cache.
"""

from dataclasses import dataclass, replace

import numpy as np

from plenocli.sensor.frames import SATURATION, Dark
from plenocli.sensor.superpixel import inside


@dataclass(frozen=True)
class Readout:
    """values (rows, columns) as the sensor reports them; dark: plenocli.sensor.frames.Dark; seconds: exposure (None: unknown); black
    (2, 2) and white: levels beyond which pixels are saturated (white inf: none); scale: to the light of the calibration's
    exposure; offset: taken off after that. `readout - number` is the capture with a larger offset.
    """

    values: np.ndarray
    dark: Dark
    seconds: float | None
    black: np.ndarray
    white: float
    scale: float = 1.0
    offset: float = 0.0

    @property
    def shape(self):
        """(rows, columns)."""
        return self.values.shape

    def __sub__(self, offset):
        return replace(self, offset=self.offset + float(offset))

    def cut(self, origin, window):
        """Light (lenslet, h*w) float32 of windows (h, w) whose first pixels are at `origin` (lenslet, 2); NaN where a pixel is
        saturated, and everywhere in windows that are not wholly on the sensor."""
        whole = inside(origin, window, self.shape)
        if not whole.all():
            out = np.full((len(origin), window[0] * window[1]), np.nan, np.float32)
            if whole.any():
                out[whole] = self.cut(origin[whole], window)
            return out
        count = window[0] * window[1]
        raw = _windows(self.values, origin, window).reshape(-1, count)
        light = raw.astype(np.float32)
        light -= self._dark(origin, window)
        if self.scale != 1.0:
            light *= np.float32(self.scale)
        if self.offset:
            light -= np.float32(self.offset)
        top = np.asarray(self.black) + SATURATION * (self.white - np.asarray(self.black)) if np.isfinite(self.white) else None
        if top is not None and raw.max() >= top.min():
            light[raw >= (top.min() if np.ptp(top) == 0 else _tiles(top, origin, window))] = np.nan
        return light

    def _dark(self, origin, window):
        """What `Dark.at` gives for the whole sensor, within the windows."""
        dark, seconds = self.dark, self.seconds
        flat = dark.flat
        if flat and np.ptp(dark.black) == 0:
            return np.float32(dark.black.flat[0])
        level = _tiles(dark.black, origin, window) if flat or dark.grows(seconds) else None
        if flat:
            return level
        mean = _windows(dark.mean, origin, window).reshape(-1, window[0] * window[1])
        return mean if level is None else level + (mean - level) * np.float32(seconds / dark.exposure)


def _windows(mosaic, origin, window):
    """Windows (lenslet, h, w) of a mosaic."""
    return np.lib.stride_tricks.sliding_window_view(mosaic, window)[origin[:, 0], origin[:, 1]]


def _tiles(level, origin, window):
    """A (2, 2) level by position under windows (lenslet, h*w), float32."""
    parts = np.empty((2, 2, *window), np.float32)
    for row in (0, 1):
        for column in (0, 1):
            tile = np.roll(np.asarray(level, np.float32), (-row, -column), (0, 1))
            parts[row, column] = np.tile(tile, (window[0] // 2 + 1, window[1] // 2 + 1))[: window[0], : window[1]]
    return parts[origin[:, 0] % 2, origin[:, 1] % 2].reshape(len(origin), -1)
