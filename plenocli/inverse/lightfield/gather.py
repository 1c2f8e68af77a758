"""Samples of captures and spectra, along a calibration's grid or the tiles of a simulated one."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.inverse.lightfield.samples import AT_ONCE, Channels, Samples, collect, joined

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

PIXEL_BYTES, LENSLET_BYTES, PLANE_BYTES, TEMPORARY_BYTES = 14, 1150, 72, 140
"""Memory for each pixel of the capture, for each lenslet, for each lenslet and each plane, and for
each of the pixels that are worked on together (measured).
"""


def samples_of(
    capture: Capture,
    calibration: Calibration | None = None,
    *,
    planes: int = 1,
    where: str | Path | None = None,
) -> tuple[Samples, tuple[int, int]]:
    """Samples of a capture, along a calibration's grid or the tiles that it tells of itself.

    Pixels of a colour filter array keep their colours apart: each is a sample of its own colour,
    relative to what its own pixel has of white, and none is interpolated.
    calibration: with the white image of this sensor; None: the capture was simulated.
    planes: that will be made of them, for the memory that they need.
    where: the calibration's file, for messages.

    Returns the samples and (rows, columns) of a picture, in lenslet pitches.
    Raises InputError where lenslets or light are missing; NumericsError where memory does not
    suffice.
    docs/model.md, "Refocusing and depth".
    """
    pixels = math.prod(capture.shape)
    told = None if capture.grid is None else capture.grid.shape
    side = float(np.mean(calibration.grid.pitch if calibration is not None else told or 1))
    lenslets = pixels / side**2
    budget().require(
        pixels * PIXEL_BYTES
        + lenslets * (LENSLET_BYTES + PLANE_BYTES * planes)
        + min(pixels, AT_ONCE) * TEMPORARY_BYTES,
        "refocusing",
        capture.metadata.path,
        "cut the capture",
    )
    letters = [letter for letter in "RGB" if letter in capture.cfa]
    if capture.cfa == "mono":
        samples = _grey(capture, calibration, where, None)[0]
    else:
        found = [_grey(capture, calibration, where, letter) for letter in letters]
        light = np.array([level for _, level in found])
        matrix = np.eye(3) if capture.profile is None else capture.profile.to_rgb
        samples = joined(
            [part for part, _ in found],
            Channels(
                names=tuple(letters),
                to_rgb=matrix[:, ["RGB".index(letter) for letter in letters]],
                weights=light / max(light.sum(), 1e-30),
            ),
        )
    if samples.value.size == 0:
        raise InputError(
            "has no lit superpixel on the grid",
            capture.metadata.path,
            "check the white image and the calibration",
        )
    return samples, _pitches(capture.shape, samples.pitch)


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


def _grey(
    shot: Capture,
    calibration: Calibration | None,
    path: str | Path | None,
    letter: str | None,
) -> tuple[Samples, float]:
    """(samples, mean light of white) of the pixels of one colour, or of all."""
    if calibration is None:
        return _along_tiles(shot, letter)
    return _along_grid(shot, calibration, path, letter)


def _lit(white: np.ndarray, cfa: str, letter: str | None, corner: tuple[int, int]) -> np.ndarray:
    """The light of white (row, column) of a part of the sensor, 0 where pixels have another colour.

    corner: its first pixel.
    """
    if letter is None:
        return white
    colours = cfa_map((white.shape[0], white.shape[1]), cfa, (corner[0] % 2, corner[1] % 2))
    return np.where(colours == letter, white, 0.0)


def _along_grid(
    shot: Capture, calibration: Calibration, path: str | Path | None, letter: str | None
) -> tuple[Samples, float]:
    """Samples along the grid of a calibration, relative to its white image."""
    white, grid = calibration.white, calibration.grid
    if white is None or white.flat is None or white.flat.shape != shot.shape:
        raise InputError(
            "holds no white image of this sensor",
            path,
            "calibrate with the white image of the camera that took the capture",
        )
    # the flat image is 1 in every superpixel: what light each has comes back
    level = 1.0 if white.level is None else float(np.nanmedian(white.level))
    mosaic, flat = Plane.of(shot.mosaic), Plane.of(white.flat)
    dark = None if calibration.dark is None else Plane.of(calibration.dark.mean)

    def light(rows: slice, columns: slice) -> np.ndarray:
        own = 0.0 if dark is None else dark.read(rows, columns)
        return (mosaic.read(rows, columns) - own) / level

    def lit(rows: slice, columns: slice) -> np.ndarray:
        corner = rows.start or 0, columns.start or 0
        return _lit(np.nan_to_num(flat.read(rows, columns)), shot.cfa, letter, corner)

    signal, shown = Plane(mosaic.shape, light), Plane(mosaic.shape, lit)
    made = collect(signal, shown, grid.centres, grid.valid, float(np.mean(grid.pitch)))
    return made, float(sum(shown.window(band).sum() for band in shown.in_bands()))


def _along_tiles(shot: Capture, letter: str | None) -> tuple[Samples, float]:
    """Samples along the superpixels that a simulated capture tells of, relative to what all of
    them have in common, which stands for a white image.
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

    seen, number = np.zeros(size), np.zeros(size)
    signal = Plane(shape, light)
    for rows in signal.in_bands(size[0]):
        values = signal.window(rows)
        counted = _lit(np.ones(values.shape), shot.cfa, letter, (rows.start, 0)) > 0
        tiles = -1, size[0], count[1], size[1]
        seen += np.where(counted, values, 0.0).reshape(tiles).sum(axis=(0, 2))
        number += counted.reshape(tiles).sum(axis=(0, 2))
    mean = seen / np.maximum(number, 1)
    top = mean.max() if mean.max() > 0 else 1.0

    def lit(rows: slice, columns: slice) -> np.ndarray:
        down, right = (np.arange(*part.indices(n)) for part, n in zip((rows, columns), shape))
        flat = (mean / top)[down[:, None] % size[0], right % size[1]]
        return _lit(flat, shot.cfa, letter, (int(down[0]), int(right[0])))

    places = ((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size))
    made = collect(
        signal.through(lambda values: values / top),
        Plane(shape, lit),
        np.stack(np.meshgrid(*places, indexing="ij"), axis=-1),
        np.ones(count, bool),
        float(np.mean(size)),
    )
    return made, float((number * mean).sum())
