"""Colour filter array: which colour a pixel has, and what it makes of light."""

import numpy as np

from plenocli.base.errors import ConfigError

MONO = "Y"


def cfa_map(shape, cfa, origin=(0, 0)):
    """Colour letter of every pixel, (rows, columns) of one-letter strings; "Y"
    everywhere for "mono".

    cfa: "mono" or the four letters of the top left 2x2 pixels, row by row.
    origin: sensor position (row, column) of the first pixel, for windows cut out of a sensor.
    """
    if cfa == "mono":
        return np.full(shape, MONO)
    if len(cfa) != 4:
        raise ConfigError(f"a colour filter array is mono or four letters, not {cfa!r}")
    tile = np.array(list(cfa)).reshape(2, 2)
    rows, columns = ((np.arange(n) + first) % 2 for n, first in zip(shape, origin))
    return tile[np.ix_(rows, columns)]


def sensitivity(camera, wavelengths):
    """Quantum efficiency by colour: (letters, (colour, wavelength)) for `wavelengths` in m.

    A mono sensor has one colour "Y" with [sensor] quantum_efficiency at every wavelength; another
    one has the measured relative sensitivities of [sensor] camera (peak 1)
    times quantum_efficiency.
    """
    wavelengths = np.atleast_1d(np.asarray(wavelengths, float))
    efficiency = camera.sensor.quantum_efficiency
    efficiency = 1.0 if efficiency is None else efficiency
    if camera.sensor.cfa == "mono":
        return (MONO,), np.full((1, len(wavelengths)), efficiency)
    from plenocli.forward.scene.tables import camera_sensitivity

    curves = camera_sensitivity(camera.sensor.camera, wavelengths)
    letters = tuple(dict.fromkeys(camera.sensor.cfa))
    return letters, efficiency * np.stack([curves[letter] for letter in letters])
