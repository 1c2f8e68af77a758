"""Shares of the light that system matrices at single wavelengths stand for, against the integral
over all wavelengths.
"""

import numpy as np
import pytest

from plenocli.base.errors import UsageError
from plenocli.files.config.camera_file import parse_camera
from plenocli.forward.camera.pupil import filter_transmittance
from plenocli.forward.scene.light import band_weights, broadband

CAMERA = """
[main_lens]
focal_length = "50 mm"
f_number = 8
aperture_shape = "square"
[object]
distance = "550 mm"
samples_per_lenslet = [2, 2]
[lenslet_array]
distance = "55 mm"
superpixel_pitch = "104 um"
focal_length = "832 um"
count = [2, 2]
[sensor]
distance = "832 um"
pixel_pitch = "2 um"
pixels_per_lenslet = [52, 52]
[light]
wavelengths = ["450 nm", "540 nm", "650 nm"]
"""
FILTERS = """
[filter_array]
layout = [2, 2]
filters = [ { center = "450 nm", fwhm = "15 nm" },
            { center = "540 nm", fwhm = "20 nm", peak = 0.6 },
            { center = "650 nm", fwhm = "15 nm" },
            { center = "650 nm", fwhm = "15 nm" } ]
"""


def power(wavelengths):
    return 1 + (wavelengths / 1e-6) ** 2


def test_nodes_carry_a_spectrum_that_is_linear_between_the_bands():
    camera = parse_camera(CAMERA + FILTERS)
    light = broadband(camera, power)
    bands, weights = band_weights(camera, light.wavelengths, power)
    np.testing.assert_allclose(bands, [450e-9, 540e-9, 650e-9])
    values = np.array([0.2, 0.9, 0.4])
    matrices = np.random.default_rng(0).random((len(light.wavelengths), 5))
    direct = sum(
        n * np.interp(w, bands, values) * a
        for n, w, a in zip(light.photons, light.wavelengths, matrices)
    )
    np.testing.assert_allclose(values @ weights @ matrices, direct, rtol=1e-12)
    some = slice(3, -4)  # wavelengths without light were left out
    np.testing.assert_allclose(
        band_weights(camera, light.wavelengths[some], power)[1], weights[:, some], rtol=1e-12
    )


def test_one_wavelength_a_filter_stands_for_all_that_it_passes():
    camera = parse_camera(CAMERA + FILTERS)
    light = broadband(camera, power)
    bands, weights = band_weights(camera, [451e-9, 540e-9, 650e-9], power)
    np.testing.assert_allclose(bands, [451e-9, 540e-9, 650e-9])
    for k, (filter_, wavelength) in enumerate(zip(camera.filter_array.filters, bands)):
        passed = sum(
            n * filter_transmittance(filter_, w) for n, w in zip(light.photons, light.wavelengths)
        )
        assert weights[k, k] * filter_transmittance(filter_, wavelength) == pytest.approx(
            passed, rel=1e-12
        )
    assert np.count_nonzero(weights) == 3
    twice = band_weights(camera, [445e-9, 455e-9, 540e-9, 650e-9], power)[1]
    assert twice[0, 0] == pytest.approx(twice[1, 1]) and twice[2, 2] == pytest.approx(weights[1, 1])
    with pytest.raises(UsageError, match="500 nm"):
        band_weights(camera, [450e-9, 500e-9], power)


def test_without_filters_lines_are_equally_strong():
    bands, weights = band_weights(parse_camera(CAMERA), [450e-9, 540e-9, 650e-9], power)
    assert bands.shape == (1,) and weights.tolist() == [[1 / 3] * 3]


def test_light_without_power_is_refused():
    with pytest.raises(UsageError, match="has no power between 400 and 700 nm"):
        broadband(parse_camera(CAMERA + FILTERS), lambda wavelengths: 0 * wavelengths)
