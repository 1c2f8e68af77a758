"""Samples of captures and spectra, along a calibration's grid or the tiles of a simulated one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.tiling import EVERYTHING, Plane, bands
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.forward.sensor.frames import require_in_reach, require_sensor
from plenocli.inverse.lightfield.samples import (
    AT_ONCE,
    TEMPORARY_BYTES,
    Channels,
    SampleBands,
    Samples,
    collect,
    joined,
    picture_rows,
    unlit,
)

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

PIXEL_BYTES = 14
"""Memory for each pixel of a capture whose samples are held."""


@dataclass(frozen=True, kw_only=True)
class _Sensor:
    """What the samples of a capture are made of.

    signal: (row, column) the light of the capture.
    white: (row, column) of each channel, that of white; 0 where a pixel has another colour.
    light: (channel,) of white, on the whole.
    centres: (lenslet, 2) px, row and column, of superpixels.
    pitch: lenslet spacing, px.
    """

    signal: Plane
    white: list[Plane]
    light: list[float]
    centres: np.ndarray
    pitch: float


def samples_of(
    capture: Capture,
    calibration: Calibration | None = None,
    *,
    where: str | Path | None = None,
) -> tuple[Samples, tuple[int, int]]:
    """All samples of a capture, in memory; as `bands_of`.

    Returns the samples and (rows, columns) of a picture, in lenslet pitches.
    Raises as bands_of; NumericsError where memory does not suffice.
    """
    source = bands_of(capture, calibration, where=where)
    needed = source.held + PIXEL_BYTES * math.prod(capture.shape) + TEMPORARY_BYTES * AT_ONCE
    budget().require(needed, "looking at all pixels", source.where, "cut the capture")
    found = [joined(parts) for parts in zip(*source)]
    if not any(part.value.size for part in found):
        raise unlit(source.where)
    return found[0] if source.channels is None else joined(found, source.channels), source.shape


def bands_of(
    capture: Capture,
    calibration: Calibration | None = None,
    *,
    where: str | Path | None = None,
) -> SampleBands:
    """Samples of a capture, along a calibration's grid or the tiles that it tells of itself.

    Pixels of a colour filter array keep their colours apart: each is a sample of its own colour,
    relative to what its own pixel has of white, and none is interpolated.
    capture: of which no more than some rows are in memory where its mosaic is a Plane.
    calibration: with the white image of this sensor; None: the capture was simulated.
    where: the calibration's file, for messages.

    Raises InputError where lenslets are missing, or light where samples are asked for.
    docs/model.md, "Refocusing and depth".
    """
    colour = capture.cfa != "mono"
    letters = [letter for letter in "RGB" if letter in capture.cfa] if colour else [None]
    sensor = (
        _along_tiles(capture, letters)
        if calibration is None
        else _along_grid(capture, calibration, where, letters)
    )
    shape, pitch = _pitches(capture.shape, sensor.pitch), sensor.pitch
    cell = picture_rows(sensor.centres, pitch, shape[0])
    centres = sensor.centres[np.argsort(cell, kind="stable")]
    rows = bands(shape[0], int(AT_ONCE * shape[0] / math.prod(capture.shape)))
    ends = np.searchsorted(np.sort(cell), [0, *(part.stop for part in rows)])

    def read(number: int) -> tuple[Samples, ...]:
        own = centres[ends[number] : ends[number + 1]]
        low, high = own[:, 0].min(initial=shape[0] * pitch), own[:, 0].max(initial=0)
        first, last = (int(n) for n in np.clip([low - pitch, high + pitch], 0, capture.shape[0]))
        seen, corner = slice(first, max(last, first)), np.array([first, 0])
        signal = sensor.signal.read(seen, EVERYTHING)
        require_in_reach(signal, capture.metadata.path)
        every = np.ones(len(own), bool)
        parts = (
            collect(signal, white.read(seen, EVERYTHING), own - corner, every, pitch)
            for white in sensor.white
        )
        return tuple(replace(part, centres=own) for part in parts)

    channels = None
    if colour:
        light = np.array(sensor.light)
        matrix = np.eye(3) if capture.profile is None else capture.profile.to_rgb
        channels = Channels(
            names=tuple(str(letter) for letter in letters),
            to_rgb=matrix[:, ["RGB".index(str(letter)) for letter in letters]],
            weights=light / max(light.sum(), 1e-30),
        )
    images: list[Any] = [capture.mosaic]
    if calibration is not None and calibration.white is not None:
        images += [calibration.white.flat, calibration.dark and calibration.dark.mean]
    return SampleBands(
        shape=shape,
        pitch=pitch,
        channels=channels,
        rows=tuple(rows),
        read=read,
        held=sum(image.nbytes for image in images if isinstance(image, np.ndarray)),
        where=capture.metadata.path,
    )


def _pitches(shape: tuple[int, ...], pitch: float) -> tuple[int, int]:
    """(rows, columns) of a picture, in lenslet pitches, which are measured."""
    rows, columns = (max(1, int(np.ceil(n / pitch - 0.1))) for n in shape)
    return rows, columns


def samples_of_spectra(
    value: np.ndarray,
    wavelengths: np.ndarray,
    calibration: Calibration,
    *,
    where: str | Path | None = None,
) -> tuple[Samples, tuple[int, int]]:
    """Samples of demultiplexed spectra: each band of a lenslet is what that lenslet saw through the
    part of the pupil that lets the band through.

    value: (band, lenslet_row, lenslet_column), NaN where unknown.
    wavelengths: (band,) m.
    calibration: that the spectra were made with; the middle of each band's response is where its
        view stands.
    where: the calibration's file, for messages.

    Returns the samples and (rows, columns) of a picture, in lenslet pitches.
    Raises InputError where the calibration has no response, or one of other bands or lenslets.
    docs/model.md, "Refocusing and depth".
    """
    from plenocli.forward.scene.colour import preview_rgb

    grid, windows, response = calibration.grid, calibration.windows, calibration.response
    if response is None or windows is None:
        raise InputError(
            "holds no response, which says through which part of the pupil each band came",
            where,
            "give the calibration that the spectra were made with",
        )
    same = response.wavelengths.shape == wavelengths.shape and np.allclose(
        response.wavelengths, wavelengths, rtol=1e-6
    )
    if not same or value.shape[1:] != grid.valid.shape:
        raise InputError(
            f"is of {len(response.wavelengths)} bands and {grid.valid.size} lenslets, the spectra "
            f"of {len(wavelengths)} and {value[0].size}, or of other wavelengths",
            where,
            "give the calibration that the spectra were made with",
        )
    middle = _middles(np.asarray(response.matrix, np.float64), windows.shape)
    corner = windows.origin - grid.centres  # of the window, from the lenslet's centre
    pitch, parts = float(np.mean(grid.pitch)), []
    for band, layer in enumerate(value):
        offset = corner + (middle[band] if response.shared else middle[..., band, :])
        used = grid.valid & np.isfinite(layer) & np.isfinite(offset).all(axis=-1)
        seen = layer[used].astype(np.float32)
        parts.append(
            Samples(
                centres=grid.centres[used],
                lenslet=np.arange(len(seen), dtype=np.int32),
                offset=offset[used].astype(np.float32),
                value=seen,
                pitch=pitch,
            )
        )
    count = len(wavelengths)
    matrix = preview_rgb(wavelengths, np.eye(count)[:, :, None])[..., 0].astype(float)
    channels = Channels(
        names=tuple(f"{1e9 * w:.4g} nm" for w in wavelengths),
        to_rgb=matrix,
        weights=np.full(count, 1 / count),
        wavelengths=np.asarray(wavelengths, float),
    )
    ends = np.nanmax(np.where(grid.valid[..., None], grid.centres, np.nan), axis=(0, 1))
    rows, columns = np.ceil(ends + pitch / 2)
    return joined(parts, channels), _pitches((int(rows), int(columns)), pitch)


def _middles(response: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(..., band, 2) px from a window's first pixel: where each column of F (..., pixel, band) has
    its middle; NaN for columns without light.
    """
    rows, columns = np.indices(shape).reshape(2, -1)
    light = np.nan_to_num(np.clip(response, 0, None))
    with np.errstate(divide="ignore", invalid="ignore"):
        share = light / light.sum(axis=-2, keepdims=True)
    return np.stack([np.einsum("...pb,p->...b", share, axis) for axis in (rows, columns)], axis=-1)


def _lit(white: np.ndarray, cfa: str, letter: str | None, corner: tuple[int, int]) -> np.ndarray:
    """The light of white (row, column) of a part of the sensor, 0 where pixels have another colour.

    corner: its first pixel.
    """
    if letter is None:
        return white
    colours = cfa_map((white.shape[0], white.shape[1]), cfa, (corner[0] % 2, corner[1] % 2))
    return np.where(colours == letter, white, 0.0)


def _along_grid(
    shot: Capture,
    calibration: Calibration,
    path: str | Path | None,
    letters: Sequence[str | None],
) -> _Sensor:
    """Along the grid of a calibration, relative to its white image."""
    white, grid = calibration.white, calibration.grid
    if white is None or white.flat is None:
        raise InputError(
            "holds no white image of this sensor",
            path,
            "calibrate with the white image of the camera that took the capture",
        )
    require_sensor(shot.shape, white.flat.shape, shot.metadata.path)
    # the flat image is 1 in every superpixel: what light each has comes back
    level = 1.0 if white.level is None else float(np.nanmedian(white.level))
    mosaic, flat = Plane.of(shot.mosaic), Plane.of(white.flat)
    dark = None if calibration.dark is None else Plane.of(calibration.dark.mean)

    def light(rows: slice, columns: slice) -> np.ndarray:
        own = 0.0 if dark is None else dark.read(rows, columns)
        return (mosaic.read(rows, columns) - own) / level

    def lit(rows: slice, columns: slice, letter: str | None = None) -> np.ndarray:
        corner = rows.start or 0, columns.start or 0
        return _lit(np.nan_to_num(flat.read(rows, columns)), shot.cfa, letter, corner)

    shown = [Plane(mosaic.shape, partial(lit, letter=letter)) for letter in letters]
    return _Sensor(
        signal=Plane(mosaic.shape, light),
        white=shown,
        light=[
            float(sum(plane.window(band).sum() for band in plane.in_bands()))
            for plane in (shown if len(shown) > 1 else ())
        ],
        centres=grid.centres[grid.valid],
        pitch=float(np.mean(grid.pitch)),
    )


def _along_tiles(shot: Capture, letters: Sequence[str | None]) -> _Sensor:
    """Along the superpixels that a simulated capture tells of, relative to what all of them have in
    common, which stands for a white image.
    """
    size = shot.grid.shape if shot.grid else None
    if size is None or shot.shape[0] % size[0] or shot.shape[1] % size[1]:
        raise InputError(
            "does not say where its lenslets are, or holds no whole number of them",
            shot.metadata.path,
            "give --calibration (from calibrate) with the white image of this camera",
        )
    shape, count = (shot.shape[0], shot.shape[1]), [shot.shape[n] // size[n] for n in (0, 1)]

    def light(rows: slice, columns: slice) -> np.ndarray:
        return shot.window(rows, columns).signal()

    seen, number = np.zeros((2, len(letters), *size))
    signal = Plane(shape, light)
    for rows in signal.in_bands(size[0]):
        values = signal.window(rows)
        for channel, letter in enumerate(letters):
            counted = _lit(np.ones(values.shape), shot.cfa, letter, (rows.start, 0)) > 0
            tiles = -1, size[0], count[1], size[1]
            seen[channel] += np.where(counted, values, 0.0).reshape(tiles).sum(axis=(0, 2))
            number[channel] += counted.reshape(tiles).sum(axis=(0, 2))
    mean = seen / np.maximum(number, 1)

    def lit(rows: slice, columns: slice, channel: int = 0) -> np.ndarray:
        down, right = (np.arange(*part.indices(n)) for part, n in zip((rows, columns), shape))
        flat = mean[channel][down[:, None] % size[0], right % size[1]]
        return _lit(flat, shot.cfa, letters[channel], (rows.start or 0, columns.start or 0))

    places = ((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size))
    return _Sensor(
        signal=signal,
        white=[Plane(shape, partial(lit, channel=n)) for n in range(len(letters))],
        light=[float((n * m).sum()) for n, m in zip(number, mean)],
        centres=np.stack(np.meshgrid(*places, indexing="ij"), axis=-1).reshape(-1, 2),
        pitch=float(np.mean(size)),
    )
