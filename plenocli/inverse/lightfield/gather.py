"""Samples of captures and spectra, along a calibration's grid or the tiles of a simulated one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.forward.sensor.cfa import cfa_map
from plenocli.inverse.lightfield.samples import AT_ONCE, Channels, Samples, collect, joined

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

PIXEL_BYTES, PLANE_BYTES, TEMPORARY_BYTES = 92, 1, 34
"""Memory for each pixel of the capture, for each of its pixels and each plane, and for each of the
pixels that are worked on together (measured).
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
    budget().require(
        capture.mosaic.size * (PIXEL_BYTES + PLANE_BYTES * planes)
        + min(capture.mosaic.size, AT_ONCE) * TEMPORARY_BYTES,
        "refocusing",
        capture.metadata.path,
        "cut the capture",
    )
    letters = [letter for letter in "RGB" if letter in capture.cfa]
    if capture.cfa == "mono":
        samples = _grey(capture, calibration, where, None)[0]
    else:
        colour = cfa_map((capture.shape[0], capture.shape[1]), capture.cfa)
        found = [_grey(capture, calibration, where, colour == letter) for letter in letters]
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
        seen = layer[used].astype(float)
        parts.append(
            Samples(centre=grid.centres[used], offset=offset[used], value=seen, pitch=pitch)
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
    some: np.ndarray | None,
) -> tuple[Samples, float]:
    """(samples, mean light of white) of the pixels `some` (row, column), or of all."""
    if calibration is None:
        return _along_tiles(shot, some)
    return _along_grid(shot, calibration, path, some)


def _along_grid(
    shot: Capture, calibration: Calibration, path: str | Path | None, some: np.ndarray | None
) -> tuple[Samples, float]:
    """Samples along the grid of a calibration, relative to its white image."""
    white = calibration.white
    if white is None or white.flat is None or white.flat.shape != shot.shape:
        raise InputError(
            "holds no white image of this sensor",
            path,
            "calibrate with the white image of the camera that took the capture",
        )
    signal = shot.mosaic - (0.0 if calibration.dark is None else calibration.dark.mean)
    # the flat image is 1 in every superpixel: what light each has comes back
    if white.level is not None:
        signal = signal / float(np.nanmedian(white.level))
    grid, flat = calibration.grid, np.nan_to_num(white.flat)
    if some is not None:
        flat = np.where(some, flat, 0.0)
    made = collect(signal, flat, grid.centres, grid.valid, float(np.mean(grid.pitch)))
    return made, float(flat.sum())


def _along_tiles(shot: Capture, some: np.ndarray | None) -> tuple[Samples, float]:
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
    count = [shot.shape[axis] // size[axis] for axis in (0, 1)]
    counted = np.ones(shot.shape, bool) if some is None else some
    signal, tiles = shot.signal(), (count[0], size[0], count[1], size[1])
    seen = np.where(counted, signal, 0.0).reshape(tiles).sum(axis=(0, 2))
    number = counted.reshape(tiles).sum(axis=(0, 2))
    mean = seen / np.maximum(number, 1)
    places = ((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size))
    top = mean.max() if mean.max() > 0 else 1.0
    flat = np.where(counted, np.tile(mean / top, count), 0.0)
    made = collect(
        signal / top,
        flat,
        np.stack(np.meshgrid(*places, indexing="ij"), axis=-1),
        np.ones(count, bool),
        float(np.mean(size)),
    )
    return made, float(flat.sum() * top)
