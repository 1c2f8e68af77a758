"""Shares of the light that system matrices at single wavelengths stand for, against the integral
over all wavelengths.
"""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, UsageError
from plenocli.files.config.camera_file import parse_camera
from plenocli.forward.camera.pupil import filter_transmittance
from plenocli.forward.scene.light import band_weights, broadband, narrow_band, photon_radiance
from plenocli.forward.scene.tables import illuminant

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


def lit(strength, camera=CAMERA):
    """A camera with a light of known strength."""
    return parse_camera(camera.replace("[light]", f"[light]\n{strength}"))


def test_photons_of_one_line_are_those_of_the_photometric_definition():
    """683 lm/W at 540 THz, where V is 1 but for the standard observer's table."""
    camera = lit('luminance = "683 cd/m2"')
    photon = 6.62607015e-34 * 540e12
    found = photon_radiance(camera, narrow_band(299792458.0 / 540e12))
    assert found == pytest.approx(1 / photon, rel=1e-3)
    same = lit(f'illuminance = "{683 * np.pi} lx"')
    assert photon_radiance(same, narrow_band(299792458.0 / 540e12)) == pytest.approx(found)


@pytest.mark.parametrize("name", ["D65", "A", "E"])
def test_photons_of_white_light_are_the_integral_over_its_spectrum(name):
    import colour

    camera = lit(f'luminance = "100 cd/m2"\nilluminant = "{name}"', CAMERA + FILTERS)
    found = photon_radiance(camera, broadband(camera, lambda w: illuminant(name, w)))
    nm = np.arange(400, 701)
    spectrum = colour.SDS_ILLUMINANTS[name].copy().interpolate(colour.SpectralShape(400, 700, 1))
    power = spectrum.values
    eye = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"].copy()
    seen = eye.align(colour.SpectralShape(400, 700, 1)).values
    radiance = power * 100 / (683 * np.sum(power * seen))  # W/m2/sr in each nm
    photons = np.sum(radiance * nm * 1e-9) / (6.62607015e-34 * 299792458.0)
    assert found == pytest.approx(photons, rel=5e-3)


def test_a_spectral_radiance_is_that_at_the_design_wavelength():
    camera = lit('spectral_radiance = "2 mW/m2/sr/nm"', CAMERA + FILTERS)
    flat = photon_radiance(camera, broadband(camera, lambda w: np.ones_like(w)))
    nm = np.arange(400, 701)
    weights = np.where((nm == 400) | (nm == 700), 0.5, 1.0)
    photons = 2e-3 * np.sum(weights * nm * 1e-9) / (6.62607015e-34 * 299792458.0)
    assert flat == pytest.approx(photons, rel=1e-6)
    total = lit('radiance = "0.6 W/m2/sr"', CAMERA + FILTERS)
    assert photon_radiance(total, broadband(total, lambda w: np.ones_like(w))) == pytest.approx(
        flat
    )


@pytest.mark.parametrize(
    "strength, wavelength, words",
    [
        ('spectral_radiance = "2 mW/m2/sr/nm"', 550e-9, "a line of light has no width"),
        ('illuminance = "500 lx"', 900e-9, "no wavelengths that the eye sees"),
    ],
)
def test_a_strength_that_its_wavelengths_do_not_have_is_refused(strength, wavelength, words):
    camera = lit(strength)
    with pytest.raises(ConfigError, match=words):
        photon_radiance(camera, narrow_band(wavelength))


def test_two_strengths_and_an_exposure_without_strength_are_refused():
    with pytest.raises(ConfigError, match="at most one of illuminance and luminance"):
        lit('illuminance = "500 lx"\nluminance = "100 cd/m2"')
    with pytest.raises(ConfigError, match="how strong the light is"):
        parse_camera(CAMERA.replace("[sensor]", '[sensor]\nexposure = "10 ms"'))
