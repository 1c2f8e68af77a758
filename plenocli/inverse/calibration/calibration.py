"""What is known of a camera before it takes a capture: measured by calibrate or predicted from a
description.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.sensor import superpixel
from plenocli.forward.sensor.frames import Dark
from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds
from plenocli.inverse.grid.lenslet_grid import LensletGrid

T = TypeVar("T")


@dataclass(frozen=True)
class Windows:
    """The superpixels as windows of whole pixels, all of one shape.

    origin: (lenslet_row, lenslet_column, 2) int, first pixel (row, column).
    shape: rows and columns, px.
    """

    origin: np.ndarray
    shape: tuple[int, int]


def windows_on(grid: LensletGrid, sensor_shape: tuple[int, ...]) -> tuple[Windows, np.ndarray]:
    """The windows of a grid's superpixels, and which lenslets have one wholly on the sensor.

    sensor_shape: rows and columns, px.

    Returns Windows and (lenslet_row, lenslet_column) bool.
    Raises NumericsError where no lenslet does.
    """
    shape = grid.window_shape()
    origin = superpixel.windows(grid.centres, shape)
    valid = grid.valid & superpixel.inside(origin, shape, sensor_shape)
    if not valid.any():
        raise NumericsError(
            "no lenslet lies wholly on the sensor", fix="use a larger part of the sensor"
        )
    return Windows(origin, shape), valid


@dataclass(frozen=True)
class White:
    """The white reference.

    superpixels: (lenslet_row, lenslet_column, pixel), or (pixel,) for all, in the calibration's
        unit; None: the file has none.
    level: (lenslet_row, lenslet_column), 98th percentile of each superpixel, or None.
    flat: (row, column), the white image over that level, or None.
    """

    superpixels: np.ndarray | None = None
    level: np.ndarray | None = None
    flat: np.ndarray | None = None

    @classmethod
    def measured(cls, signal: np.ndarray, windows: Windows, valid: np.ndarray) -> White:
        """The white reference from a white image.

        signal: (row, column), dark removed, NaN where a pixel is bad.
        windows: of the superpixels.
        valid: (lenslet_row, lenslet_column), which of them lie on the sensor.
        """
        (rows, columns), kept = windows.shape, valid
        superpixels = superpixel.extract(signal, windows.origin, windows.shape)
        superpixels[~valid] = np.nan
        level = np.full(valid.shape, np.nan, np.float32)
        level[valid] = np.nanpercentile(superpixels[valid], 98, axis=-1)
        if not (level[valid] > 0).all():
            kept = valid & (level > 0)
        flat = np.full(signal.shape, np.nan, np.float32)
        for (row, column), peak in zip(windows.origin[kept], level[kept]):
            part = (slice(row, row + rows), slice(column, column + columns))
            flat[part] = signal[part] / peak
        return cls(superpixels, level, flat)

    @classmethod
    def predicted(cls, signal: np.ndarray, kinds: SuperpixelKinds) -> White:
        """The white reference of a description.

        signal: (kind, pixel), without noise.
        kinds: of the superpixels.
        """
        (rows, columns), valid = kinds.window, kinds.valid
        peak = signal.max(axis=1)
        flat = np.full(kinds.sensor_shape, np.nan, np.float32)
        for (row, column), kind in zip(kinds.origin[valid], kinds.kind[valid]):
            part = (slice(row, row + rows), slice(column, column + columns))
            flat[part] = (signal[kind] / peak[kind]).reshape(kinds.window)
        level = np.where(valid, peak[kinds.kind], np.nan).astype(np.float32)
        return cls(kinds.by_lenslet(signal).astype(np.float32), level, flat)


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """What the numbers of the calibrated sensor mean.

    cfa: "mono" or the four letters of the colour filter array.
    units: of the signal, DN or another unit.
    white_level: where the sensor saturates, in `units`; inf: nowhere.
    exposure: s, to which white and response refer; None: unknown.
    gain_e_per_dn: electrons for one unit of signal; None: unknown, or noise does not depend on it.
    read_noise: standard deviation of a dark pixel, in `units`; None: unknown.
    notes: where these come from, in words.
    """

    cfa: str = "mono"
    units: str = "DN"
    white_level: float = np.inf
    exposure: float | None = None
    gain_e_per_dn: float | None = None
    read_noise: float | None = None
    notes: str | None = None

    @property
    def gain(self) -> float | None:
        """Units of signal per electron; None: unknown."""
        return None if self.gain_e_per_dn is None else 1 / self.gain_e_per_dn

    @property
    def read_variance(self) -> float:
        """Variance of a dark pixel, units^2; 0 where it is not known."""
        return 0.0 if self.read_noise is None else self.read_noise**2


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How well a response tells its bands apart.

    condition: median condition number of F over lenslets.
    angles: (band, band) degrees, median angles between the columns of F; 90 is perfect separation.
    single_pixel: (band,), pixel of the window that answers most to each band.
    bias: (band,), share by which the noise of F itself changes least-squares radiances, or None.
    """

    condition: float
    angles: list[list[float]]
    single_pixel: list[int]
    bias: list[float] | None = None


@dataclass(frozen=True, kw_only=True)
class Response:
    """The response matrix F: signal of a pixel for unit relative radiance in a band.

    matrix: (lenslet_row, lenslet_column, pixel, band), or (pixel, band) for all lenslets; NaN where
        it is not known.
    variance: of its entries, (pixel, band) in the square of its unit; None: unknown.
    wavelengths: (band,) m.
    polarised: like matrix, what F has more of light along 0 degrees, and less of light along 90
        degrees, than of light that is not polarised; None: it tells none apart.
    states: (band,) polarisation of the light of each band in degrees, NaN for light that is not
        polarised; None: of no band.
    mixture: (measured band, band), of which columns in narrow bands those of matrix are made; None:
        each of its own.
    energy: (band,), relative radiance of the source of each band, or None.
    quality: None where the file does not say it.
    notes: how it came about, as JSON ("source": "predicted" for one from a description).
    """

    matrix: np.ndarray
    variance: np.ndarray | None
    wavelengths: np.ndarray
    polarised: np.ndarray | None = None
    states: np.ndarray | None = None
    mixture: np.ndarray | None = None
    energy: np.ndarray | None = None
    quality: Quality | None = None
    notes: dict[str, Any] | None = None

    @property
    def shared(self) -> bool:
        """Whether one F serves all lenslets."""
        return self.matrix.ndim == 2

    @property
    def predicted(self) -> bool:
        """Whether F comes from a description of the camera, not from captures."""
        return self.notes is not None and self.notes.get("source") == "predicted"


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A calibrated camera: lenslets, white and dark levels, and the response of every superpixel.

    grid: the lenslets; its `valid` says which of them can be used.
    sensor: what the sensor's numbers mean.
    windows: None where the file does not say them.
    white: None where it was not kept.
    dark: None where the file has none.
    response: None where only the grid was calibrated.
    """

    grid: LensletGrid
    sensor: Sensor
    windows: Windows | None = None
    white: White | None = None
    dark: Dark | None = None
    response: Response | None = None


def there(part: T | None) -> T:
    """A part of a calibration that its reader made sure of.

    Raises ValueError where it is missing, which is a mistake of the caller.
    """
    if part is None:
        raise ValueError("the calibration lacks a part that is needed")
    return part


class MadeResponses(Protocol):
    """Responses (lenslet_row, lenslet_column, pixel, band) that are made lenslet by lenslet, and
    never held whole: plenocli.inverse.registration.moved_response.
    """

    shape: tuple[int, ...]
    ndim: int

    def __getitem__(self, places: Any) -> np.ndarray: ...
