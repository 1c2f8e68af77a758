"""A capture as superpixels in the units of the system matrix, y = A x + noise with x relative to
white: tiled, or cut out along the grid of a calibration.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.text import by
from plenocli.base.tiling import EVERYTHING, Plane, Room, bands, to_blocks
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.sensor.frames import saturated
from plenocli.forward.sensor.noise import Noise
from plenocli.forward.sensor.superpixel import extract_rows
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.nuisances.vignetting import falloff_in_bands
from plenocli.inverse.picture.real_light import EachPixel, above_dark
from plenocli.inverse.picture.tiles import EVERY, Area

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

AT_ONCE = 1 << 20
"""Pixels that are worked on at a time."""
TOLD = 0.01
"""Difference between the white image and the matrix's, root mean square, that is told."""


def superpixels(
    capture: Capture,
    system: LensletMatrix,
    calibration: Calibration | None = None,
    *,
    where: str | Path | None = None,
    each_pixel: bool = False,
) -> Superpixels:
    """Superpixels of a capture.

    system: the system matrix in whose units they are wanted.
    calibration: along whose lenslet grid they are cut out, with windows, white and dark; without it
        the capture is tiled as it says itself.
    where: the calibration's file, for messages.
    each_pixel: with a calibration, sample superpixels about their lenslets, and tell the variance
        of every pixel (plenocli.inverse.picture.real_light).

    Raises InputError where sizes disagree or the scale is not known.
    """
    path = capture.metadata.path
    if calibration is not None:
        return along_the_grid(capture, system, calibration, where=where, each_pixel=each_pixel).cut(
            *EVERY
        )
    shape = require_tiled(capture, system)
    light = capture.metadata.illuminant
    if system.illuminant and light and light != system.illuminant:
        note(
            f"{capture.name} was lit by {light}, the system matrix has its bands for "
            f"{system.illuminant}: colours will be off"
        )
    signal, unit = capture.signal(), _unit(capture, path)
    levels = capture.levels
    clipped = (
        to_blocks(saturated(capture.mosaic, levels.black, levels.white), shape)
        if np.isfinite(levels.white)
        else None
    )
    noise = capture.white_noise
    return Superpixels(
        y=to_blocks(signal, shape) / unit,
        noise=None if noise is None else Noise.of_sigma(noise.sigma / unit),
        scene=capture.metadata.target,
        accuracy=AccuracyRecord.from_json(capture.metadata.accuracy),
        pif_digest=capture.metadata.matrix,
        saturated=clipped,
    )


def along_the_grid(
    capture: Capture,
    system: LensletMatrix,
    calibration: Calibration,
    *,
    where: str | Path | None = None,
    each_pixel: bool = False,
    room: Room = np.empty,
) -> EachPixel | AlongTheGrid:
    """Superpixels cut out along the grid of a calibration, of which parts are asked for.

    Arguments as of superpixels.

    room: for numbers of a shape and dtype, put and looked at by slices.

    Raises InputError where sizes differ, or for a sensor with colours.
    """
    _require_grey(capture)
    along = EachPixel if each_pixel else AlongTheGrid
    return along(capture, system, calibration, where, room)


def require_tiled(capture: Capture, system: LensletMatrix) -> tuple[int, int]:
    """(rows, columns) of a superpixel, px; InputError where the capture is not tiled like the
    system matrix.
    """
    _require_grey(capture)
    path = capture.metadata.path
    shape = (capture.grid.shape if capture.grid else None) or system.pixel_shape
    if shape != system.pixel_shape:
        raise InputError(
            (f"has superpixels of {by(shape)} pixels, the system matrix {by(system.pixel_shape)}"),
            path,
            "use the pif of this camera",
        )
    if capture.shape[0] % shape[0] or capture.shape[1] % shape[1]:
        raise InputError(
            f"has {by(capture.shape)} pixels, no whole number of superpixels of {by(shape)}",
            path,
            "give --calibration to find the lenslets",
        )
    return shape


def _require_grey(capture: Capture) -> None:
    if capture.cfa != "mono":
        raise InputError(
            f"has the colour filter array {capture.cfa}; the system matrix knows none",
            capture.metadata.path,
            "use --calibration with --method block-mean, or demux",
        )


def windows_of(
    capture: Capture, calibration: Calibration, rows: slice = EVERYTHING
) -> tuple[np.ndarray, np.ndarray]:
    """Windows of a capture and of the white reference along the grid of a calibration.

    calibration: with windows, white and dark.
    rows: of lenslets; of a capture, white and dark in files no more are read.

    Returns (signal, white), (lenslet_row, lenslet_column, pixel) each, dark subtracted; NaN where a
    superpixel is not wholly on the sensor.
    Raises InputError where the two sensors differ.
    """
    windows = there(calibration.windows)
    light = Plane(capture.shape, lambda some, _: above_dark(capture, calibration, some))
    signal = extract_rows(light, windows.origin[rows], windows.shape)
    signal[~calibration.grid.valid[rows]] = np.nan
    white = there(there(calibration.white).superpixels)
    return signal, np.broadcast_to(white if white.ndim == 1 else white[rows], signal.shape)


class AlongTheGrid:
    """Superpixels in units of A x, by the light of a white object, NaN where a pixel is off the
    sensor, or bad to the calibration; worked out in bands of lenslets, and cut when they are asked
    for.

    capture, calibration: what of them stays in files is read in bands.
    system, where: as of superpixels.
    room: as of along_the_grid.

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
        self.count: tuple[int, int] = calibration.grid.valid.shape
        self.pixels = int(np.prod(there(calibration.windows).shape))
        if self.pixels != system.own.shape[0]:
            wholly = np.mod(there(calibration.windows).shape, system.pixel_shape) == 0
            raise InputError(
                f"holds windows of {self.pixels} pixels, the system matrix {system.own.shape[0]}",
                where,
                "simulate-pif with pixels_per_lenslet as measured"
                + (", or take --method weighted, which bins pixels" if wholly.all() else ""),
            )
        rows = bands(self.count[0], AT_ONCE // (self.pixels * self.count[1]))
        even, columns = system.blocks.sum(axis=(0, 2), dtype=float), self.count[1]
        white = room((self.count[0] * columns, self.pixels), np.dtype(float))
        lenslets = [slice(some.start * columns, some.stop * columns) for some in rows]
        for some, own in zip(rows, lenslets):
            _, light, known = _known_windows(capture, calibration, some)
            relative = light * _brightness(light, even, known)[:, :, None]
            white[own, :] = np.where(known, relative, np.nan).reshape(-1, self.pixels)
        flat = falloff_in_bands(white, even, system.pixel_shape, lenslets, room)
        self._y = white  # which nobody needs any more
        self._clipped = None
        if np.isfinite(_white_level(capture, calibration)):
            self._clipped = room((self.count[0] * columns, self.pixels), np.dtype(bool))
        off = np.zeros(self.pixels)
        for some, own in zip(rows, lenslets):
            signal, light, known = _known_windows(capture, calibration, some)
            falls = flat[own, :].reshape(signal.shape)
            known &= np.isfinite(falls)
            scale = _brightness(light, even * falls, known)
            off += np.where(known, (falls - 1) ** 2, 0.0).sum(axis=(0, 1))
            y = np.where(known, signal, np.nan) * (scale[:, :, None] / falls)
            self._y[own, :] = y.reshape(-1, self.pixels)
            if self._clipped is not None:
                self._clipped[own, :] = clipped_windows(capture, calibration, some)
        away = float(np.sqrt(np.average(off / np.prod(self.count), weights=even)))
        if away > TOLD:
            note(
                f"{capture.name}: within superpixels a white object's light differs by {away:.1%} "
                "from what the system matrix expects (vignetting, or a matrix that is not quite "
                "this camera's): it is divided out by the white image"
            )

    def cut(self, rows: slice, columns: slice, own: Area = EVERY) -> Superpixels:
        """As of plenocli.inverse.picture.tiles.Source."""
        first, last, _ = rows.indices(self.count[0])
        lenslets = slice(first * self.count[1], last * self.count[1])
        shape = last - first, self.count[1], self.pixels

        def part(values: Any) -> np.ndarray:
            return values[lenslets, :].reshape(shape)[:, columns]

        clipped = None if self._clipped is None else part(self._clipped)
        return Superpixels(y=part(self._y), saturated=clipped, own=own)


def _known_windows(
    capture: Capture, calibration: Calibration, rows: slice
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Windows of a capture and of white, and where both are numbers."""
    signal, white = windows_of(capture, calibration, rows)
    return signal, white, np.isfinite(signal) & np.isfinite(white)


def _white_level(capture: Capture, calibration: Calibration) -> float:
    """Where the sensor saturates; infinite where nobody says."""
    return min(capture.levels.white, calibration.sensor.white_level)


def _brightness(white: np.ndarray, even: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What makes the white of each lenslet (lenslet_row, lenslet_column) as bright as `even`.

    white, known: (lenslet_row, lenslet_column, pixel); even: likewise, or (pixel,).
    """
    light = np.where(known, white, 0.0).sum(axis=2)
    expected = np.where(known, even, 0.0).sum(axis=2)
    return np.divide(expected, light, out=np.zeros_like(light), where=light > 0)


def clipped_windows(capture: Capture, calibration: Calibration, rows: slice) -> np.ndarray:
    """Which pixels of the windows of some rows of lenslets are saturated, (lenslet, pixel)."""
    windows, white = there(calibration.windows), _white_level(capture, calibration)

    def over(some: slice, _: slice) -> np.ndarray:
        part = capture.window(some, EVERYTHING)
        return saturated(part.mosaic, part.levels.black, white)

    cut = extract_rows(Plane(capture.shape, over), windows.origin[rows], windows.shape)
    return (cut == 1).reshape(-1, cut.shape[2])


def _unit(capture: Capture, path: Path | None) -> float:
    """What one unit of A x is in the units of the mosaic."""
    if capture.units == "relative":
        return 1.0
    electrons = capture.metadata.electrons_per_unit
    if not electrons:
        raise InputError(
            "does not say how many electrons white gives, so that the picture would have no scale",
            path,
            "give --calibration with a white reference",
        )
    return electrons * ((capture.levels.gain or 1.0) if capture.units == "DN" else 1.0)
