"""A white image that cannot be of the colour filter array it is said to be of."""

import itertools

import numpy as np
import pytest

from plenocli.forward.sensor.cfa import doubted_array

ARRAYS = ("mono", "RGGB", "BGGR", "GRBG", "GBRG")
BRIGHTNESS = {"R": 0.5, "G": 1.0, "B": 0.7, "m": 1.0, "o": 1.0, "n": 1.0}
CELLS = {  # what four filters in the pupil let through to R, G, B and a sensor without colours
    "R": (1.0, 0.5, 0.1, 0.05),
    "G": (0.3, 1.0, 0.6, 0.2),
    "B": (0.05, 0.2, 0.8, 1.0),
}


def white(rng, *, pitch, array, filters, noise, start):
    """Square lenslets, brightest in their middles, with a dark rim."""
    row, column = np.indices((300, 320)).astype(float)
    down = ((row - start[0]) / pitch + 0.5) % 1 - 0.5
    right = ((column - start[1]) / pitch + 0.5) % 1 - 0.5
    rim = np.clip((0.5 - np.maximum(abs(down), abs(right))) * pitch - 0.3, 0, 1)
    light = rim * np.cos(down) * np.cos(right)
    cell = 2 * (down > 0) + (right > 0)
    for i, j in itertools.product((0, 1), (0, 1)):
        colour = array[2 * i + j]
        part = np.full(4, BRIGHTNESS[colour])
        if filters:
            part = np.array(CELLS.get(colour, np.mean(list(CELLS.values()), axis=0)))
        light[i::2, j::2] *= part[cell[i::2, j::2]]
    return 1000 * (light + rng.normal(0, noise, light.shape))


def alike(one, other):
    return one == other or {one, other} in ({"RGGB", "BGGR"}, {"GRBG", "GBRG"})


@pytest.mark.parametrize("true", ARRAYS)
@pytest.mark.parametrize("filters", [False, True])
def test_what_white_says_of_the_colours(true, filters):
    rng = np.random.default_rng(7)
    for pitch, noise in itertools.product((6, 8, 10, 13, 14.3, 16, 24), (0.002, 0.02, 0.1)):
        start = rng.uniform(0, 2, 2).round(rng.integers(2))
        image = white(rng, pitch=pitch, array=true, filters=filters, noise=noise, start=start)
        for said in ARRAYS:
            doubt = doubted_array(image, said)
            if alike(true, said):
                assert doubt is None, (pitch, noise, start, doubt)
            elif true != "mono" and pitch >= 13 and noise < 0.1:
                assert doubt is not None and true in doubt, (pitch, noise, start, said)
