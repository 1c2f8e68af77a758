"""The pupil from a white superpixel, against white images by sums of plane waves over lenslets."""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.inverse.calibration.pupil_rings import pupil_rings
from tests.forward.volume.test_waves import OPTICS


def white_of(intensity, optics, directions=41, lenslets=2):
    """White superpixel of a pupil: plane waves of all directions through lenslets side by side,
    by sums over points of the lenslets.
    """
    s = (np.arange(directions) + 0.5) / directions * 2 - 1
    s = s * optics.aperture
    n = 60
    inner = ((np.arange(n) + 0.5) / n - 0.5) * optics.pitch
    middles = np.arange(-lenslets, lenslets + 1) * optics.pitch
    nodes = (middles[:, None] + inner).ravel()
    pixels = optics.pixels[0] * 4
    t = ((np.arange(pixels) + 0.5) / pixels - 0.5) * optics.pitch
    k = optics.k
    lens = np.tile(np.exp(-0.5j * k * inner**2 / optics.focal_length), len(middles))
    to = np.exp(0.5j * k * (t[:, None] - nodes) ** 2 / optics.sensor_distance) * lens
    field = to @ np.exp(1j * k * np.outer(nodes, s) / optics.magnification)
    light = np.abs(field) ** 2
    two = intensity(np.hypot(s[:, None], s)) * (np.hypot(s[:, None], s) <= optics.aperture)
    white = light @ two @ light.T
    return white.reshape(optics.pixels[0], 4, optics.pixels[1], 4).sum((1, 3))


def test_the_pupil_that_made_a_white_image_is_found_again():
    optics = replace(OPTICS, pixels=(11, 11))

    def intensity(s):
        return 1 / (1 + np.exp((s - 0.36) / 0.03))

    found = pupil_rings(white_of(intensity, optics), optics)
    radii = np.linspace(0, found.aperture, len(found.intensity))
    rings = np.array(found.intensity) / np.mean(found.intensity[:6])
    assert found.alike > 0.998 and found.described < found.alike
    assert np.abs(rings - intensity(radii))[radii < 0.3].max() < 0.2
    half = np.interp(0.5, rings[::-1], radii[::-1])
    assert half == pytest.approx(0.36, abs=0.025)


def test_an_ideal_pupil_is_seen_as_one():
    optics = replace(OPTICS, pixels=(11, 11))
    ideal = white_of(lambda s: optics.amplitude(s) ** 2, optics)
    found = pupil_rings(ideal, optics)
    assert found.described > 0.99 and found.aperture == pytest.approx(0.5)


def test_a_white_image_of_another_microscope_is_refused():
    other = replace(OPTICS, pixels=(11, 11))
    white = np.indices((11, 11)).sum(0) % 2 + 0.1
    with pytest.raises(InputError, match="unlike any pupil"):
        pupil_rings(white, other)
    with pytest.raises(InputError, match="dark"):
        pupil_rings(np.zeros((11, 11)), other)
