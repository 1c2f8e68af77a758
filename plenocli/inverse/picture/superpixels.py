"""A capture as superpixels in the units of the system matrix, y = A x + noise with x relative to
white: tiled, or cut out along the grid of a calibration.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.text import by
from plenocli.base.tiling import EVERYTHING, Plane, to_blocks
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.sensor.frames import saturated
from plenocli.forward.sensor.noise import Noise
from plenocli.forward.sensor.superpixel import extract, extract_rows
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.nuisances.vignetting import falloff
from plenocli.inverse.picture.real_light import above_dark, along_the_grid

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

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
    if capture.cfa != "mono":
        raise InputError(
            f"has the colour filter array {capture.cfa}; the system matrix knows none",
            path,
            "use --calibration with --method block-mean, or demux",
        )
    if calibration is not None:
        cut_out = along_the_grid if each_pixel else _along_the_grid
        return cut_out(capture, system, calibration, where)
    light = capture.metadata.illuminant
    if system.illuminant and light and light != system.illuminant:
        note(
            f"{capture.name} was lit by {light}, the system matrix has its bands for "
            f"{system.illuminant}: colours will be off"
        )
    shape = _tiles(capture, system, path)
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


def _along_the_grid(
    capture: Capture, system: LensletMatrix, calibration: Calibration, where: str | Path | None
) -> Superpixels:
    """Superpixels in units of A x, by the light of a white object; NaN where a pixel is off the
    sensor, or bad to the calibration.
    """
    signal, white = windows_of(capture, calibration)
    if signal.shape[2] != system.own.shape[0]:
        wholly = np.mod(there(calibration.windows).shape, system.pixel_shape) == 0
        raise InputError(
            f"holds windows of {signal.shape[2]} pixels, the system matrix {system.own.shape[0]}",
            where,
            "simulate-pif with pixels_per_lenslet as measured"
            + (", or take --method weighted, which bins pixels" if wholly.all() else ""),
        )
    even = system.blocks.sum(axis=(0, 2), dtype=float)
    known = np.isfinite(signal) & np.isfinite(white)
    relative = np.where(known, white * _brightness(white, even, known)[:, :, None], np.nan)
    flat = falloff(relative.reshape(-1, even.size), even, system.pixel_shape).reshape(signal.shape)
    known &= np.isfinite(flat)
    scale = _brightness(white, even * flat, known)
    off = np.where(known, (flat - 1) ** 2, 0.0).mean(axis=(0, 1))
    away = float(np.sqrt(np.average(off, weights=even)))
    if away > TOLD:
        note(
            f"{capture.name}: within superpixels a white object's light differs by {away:.1%} from "
            "what the system matrix expects (vignetting, or a matrix that is not quite this "
            "camera's): it is divided out by the white image"
        )
    y = np.where(known, signal, np.nan) * (scale[:, :, None] / flat)
    return Superpixels(y=y, saturated=_clipped(capture, calibration))


def _brightness(white: np.ndarray, even: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What makes the white of each lenslet (lenslet_row, lenslet_column) as bright as `even`.

    white, known: (lenslet_row, lenslet_column, pixel); even: likewise, or (pixel,).
    """
    light = np.where(known, white, 0.0).sum(axis=2)
    expected = np.where(known, even, 0.0).sum(axis=2)
    return np.divide(expected, light, out=np.zeros_like(light), where=light > 0)


def _clipped(capture: Capture, calibration: Calibration) -> np.ndarray | None:
    """Which pixels of the windows are saturated, (lenslet_row, lenslet_column, pixel); None where
    nobody says where the sensor saturates.
    """
    white = min(capture.levels.white, calibration.sensor.white_level)
    if not np.isfinite(white):
        return None
    windows = there(calibration.windows)
    clipped = saturated(capture.mosaic, capture.levels.black, white).astype(float)
    return extract(clipped, windows.origin, windows.shape) == 1


def _tiles(capture: Capture, system: LensletMatrix, path: Path | None) -> tuple[int, int]:
    """(rows, columns) of a superpixel, px; InputError where the capture is not tiled like the
    system matrix.
    """
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
