"""Sensor noise against the EMVA 1288 equations and against direct counts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from plenocli.base.errors import NumericsError
from plenocli.forward.sensor.detector import SensorModel
from plenocli.forward.sensor.frames import photon_transfer
from plenocli.forward.sensor.noise import Noise, white_noise

MODEL = SensorModel(gain=0.25, read_noise=4.0, full_well=15000, bits=12, black_level=64)


def test_photon_transfer_slope_is_the_gain(count):
    rng = np.random.default_rng(1)
    levels = np.linspace(0, 12000, 40)
    values = np.stack([MODEL.expose(np.full(40000, level), rng) for level in levels]).astype(float)
    mean, variance = values.mean(axis=1), values.var(axis=1)
    slope, offset = np.polyfit(mean - 64, variance, 1, w=1 / variance)
    assert slope == pytest.approx(MODEL.gain, rel=0.01)
    assert offset == pytest.approx(MODEL.gain**2 * MODEL.read_noise**2 + 1 / 12, rel=0.03)
    np.testing.assert_allclose(mean, 64 + 0.25 * levels, atol=0.5)
    np.testing.assert_allclose(variance, MODEL.noise().variance(MODEL.gain * levels), rtol=0.04)
    count(
        "photon transfer, slope against gain",
        off_by_parts_per_10000=round(1e4 * abs(slope / MODEL.gain - 1)),
    )


CLASSES = {"dark": 0.0, "a few electrons": 3.0, "mid": 7500.0, "near full well": 14300.0}
"""Mean electrons of a class of pixels: shot noise reaches neither the black level's zero
nor the full well.
"""


def z_scores(values, mean, variance, third):
    """Distance of the sample's mean, variance and third central moment from what they should be,
    in standard errors.
    """
    d = values - mean
    moments = [d.mean(), (d**2).mean() - variance, (d**3).mean() - third]
    return [m / ((d**k).std() / np.sqrt(d.size)) for k, m in zip((1, 2, 3), moments)]


@pytest.mark.parametrize(
    "model",
    [
        MODEL,
        pytest.param(
            SensorModel(gain=1.0, read_noise=2.2, full_well=15000, bits=14, black_level=256),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["0.25 DN an electron", "1 DN an electron"],
)
def test_two_million_pixels_of_each_class_have_the_mean_variance_and_skewness_of_the_model(
    count, model
):
    """Poisson electrons and Gaussian read noise, rounded: third central moment K^3 mu.

    Together a false alarm once in a hundred seeds.
    """
    size, rng, worst = 2_000_000, np.random.default_rng(1288), 0.0
    for mean in CLASSES.values():
        values = model.expose(np.full(size, mean), rng).astype(float)
        worst = max(
            worst,
            *np.abs(
                z_scores(
                    values,
                    model.black_level + model.gain * mean,
                    model.noise().variance(model.gain * mean),
                    model.gain**3 * mean,
                )
            ),
        )
    tests = 3 * len(CLASSES) * 2
    assert worst < norm.isf((1 - 0.99 ** (1 / tests)) / 2)
    # the same test sees a gain off by 0.1 %, read noise off by 1 %, and electrons
    # that are not Poisson
    assert (
        abs(
            z_scores(
                model.expose(np.full(size, 7507.5), rng).astype(float),
                model.black_level + model.gain * 7500,
                model.noise().variance(model.gain * 7500),
                0,
            )[0]
        )
        > 6
    )
    noisier = replace(model, read_noise=1.01 * model.read_noise)
    assert (
        z_scores(
            noisier.expose(np.zeros(size), rng).astype(float),
            model.black_level,
            model.noise().variance(0),
            0,
        )[1]
        > 4
    )
    count(
        "noise, z-tests of mean, variance and skewness",
        pixel_classes=len(CLASSES),
        samples=size * len(CLASSES),
        beyond_chance=0,
    )


def test_photon_transfer_of_two_frames_finds_gain_and_read_noise():
    rng = np.random.default_rng(5)
    scene = np.tile(np.linspace(0, 12000, 600), (500, 1))
    a, b = (MODEL.expose(scene, rng).astype(float) - 64 for _ in range(2))
    found = photon_transfer(a, b)
    assert found.gain == pytest.approx(0.25, rel=0.02)
    assert found.read_variance == pytest.approx(1 + 1 / 12, rel=0.3)
    assert photon_transfer(np.full((90, 90), 5.0), np.full((90, 90), 5.0)) is None


def test_dark_frames_hold_black_level_read_noise_and_rounding():
    values = MODEL.expose(np.zeros((500, 500)), np.random.default_rng(2)).astype(float)
    assert values.mean() == pytest.approx(64, abs=0.02)
    assert values.std() == pytest.approx(np.sqrt(0.25**2 * 16 + 1 / 12), rel=0.02)


def test_full_well_and_converter_clip():
    rng = np.random.default_rng(3)
    full = SensorModel(gain=0.2, read_noise=0.0, full_well=10000, bits=12).expose(
        np.full(2000, 50000.0), rng
    )
    assert (full == 2000).all()
    assert MODEL.white_level == 64 + 3750
    converter = SensorModel(gain=1.0, read_noise=2.0, full_well=1e6, bits=8).expose(
        np.full(2000, 5000.0), rng
    )
    assert (converter == 255).all()
    assert MODEL.expose(np.full(9, -1e-12), rng).dtype == np.uint16


def test_impossible_light_is_a_programming_error():
    for bad in (-1.0, np.nan, np.inf):
        with pytest.raises(ValueError):
            MODEL.expose(np.array([1.0, bad]), np.random.default_rng(0))


def test_white_noise_has_the_ratio_to_the_mean_square():
    rng = np.random.default_rng(4)
    # mostly DC: definition by mean square and by variance differ by 25 dB
    signal = 5 + rng.uniform(0, 1, (400, 400))
    noise = white_noise([signal], 40.0)
    assert noise.white == pytest.approx((signal**2).mean() * 1e-4)
    assert white_noise([signal[:70], signal[70:]], 40.0).sigma == pytest.approx(noise.sigma)
    with pytest.raises(NumericsError):
        white_noise([np.zeros(5)], 60)


def test_the_same_seed_gives_the_same_frame():
    scene = np.linspace(0, 9000, 1000)
    one, two = (MODEL.expose(scene, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(one, two)


def test_parts_of_the_variance_add_and_scale_with_the_signal():
    noise = Noise(gain=0.5, read_variance=2.0, white=3.0, model=0.1)
    signal = np.array([-5.0, 0.0, 100.0])
    np.testing.assert_allclose(noise.variance(signal), [5.0, 5.0, 5.0 + 50.0 + 100.0])
    np.testing.assert_allclose(
        noise.scaled(3.0).variance(3.0 * signal), 9.0 * noise.variance(signal), rtol=1e-14
    )
    assert noise.without_signal == 5.0 and noise.sigma == np.sqrt(5.0)


def test_a_standard_deviation_is_given_back_to_the_last_bit():
    for sigma in np.random.default_rng(6).lognormal(0, 20, 1000):
        assert Noise.of_sigma(sigma).sigma == sigma
        assert Noise.of_sigma(sigma).is_white
