"""Colour filter array: which colour a pixel has, and what it makes of light."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import ConfigError

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

MONO = "Y"


def cfa_map(shape: tuple[int, int], cfa: str, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Colour letter of every pixel.

    shape: (rows, columns).
    cfa: "mono" or the four letters of the top left 2x2 pixels, row by row.
    origin: sensor position (row, column) of the first pixel, for windows cut out of a sensor.

    Returns (row, column) of one-letter strings, MONO everywhere for "mono".
    Raises ConfigError where `cfa` is neither.
    """
    if cfa == "mono":
        return np.full(shape, MONO)
    if len(cfa) != 4:
        raise ConfigError(f"a colour filter array is mono or four letters, not {cfa!r}")
    tile = np.array(list(cfa)).reshape(2, 2)
    rows, columns = ((np.arange(n) + first) % 2 for n, first in zip(shape, origin))
    return tile[np.ix_(rows, columns)]


def sensitivity(camera: Camera, wavelengths: ArrayLike) -> tuple[tuple[str, ...], np.ndarray]:
    """Quantum efficiency by colour.

    A mono sensor has one colour MONO with [sensor] quantum_efficiency at every wavelength; another
    one has the measured relative sensitivities of [sensor] camera (peak 1) times
    quantum_efficiency.
    wavelengths: (wavelength,) m.

    Returns the colours' letters and (colour, wavelength).
    """
    wavelengths = np.atleast_1d(np.asarray(wavelengths, float))
    efficiency = camera.sensor.quantum_efficiency
    efficiency = 1.0 if efficiency is None else efficiency
    if camera.sensor.cfa == "mono":
        return (MONO,), np.full((1, len(wavelengths)), efficiency)
    from plenocli.forward.scene.tables import camera_sensitivity

    assert camera.sensor.camera is not None  # a description with colours has one
    curves = camera_sensitivity(camera.sensor.camera, wavelengths)
    letters = tuple(dict.fromkeys(camera.sensor.cfa))
    return letters, efficiency * np.stack([curves[letter] for letter in letters])
