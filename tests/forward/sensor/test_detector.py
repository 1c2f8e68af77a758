"""What is fixed about a sensor's pixels, its dark current and its crosstalk, as EMVA 1288 measures
them: from frames alone.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from plenocli.files.config.camera_file import parse_camera, to_toml
from plenocli.forward.sensor.detector import SensorModel, spread_to_neighbours

TINY = Path(__file__).resolve().parents[3] / "sample_configs" / "tiny.toml"
PLAIN = SensorModel(gain=0.5, read_noise=3.0, full_well=20000, bits=16, black_level=500)
SHAPE = (90, 110)


@pytest.fixture
def tiny_text():
    """The text of a small camera."""
    return TINY.read_text()


def frames(model, electrons, seconds, count=200, seed=0):
    """Frames of an even light, float64."""
    rng = np.random.default_rng(seed)
    even = np.full(SHAPE, float(electrons))
    return np.stack([model.expose(even, rng, seconds) for _ in range(count)]).astype(float)


def test_dark_current_grows_with_time_and_doubles_with_temperature(tiny_text):
    def rate(temperature):
        camera = parse_camera(
            tiny_text.replace(
                "[light]",
                f'dark_current = "50 e/s"\ntemperature = "{temperature}"\n'
                'dark_current_doubling = "6 K"\nblack_level = 500\n[light]',
            )
        )
        model = replace(SensorModel.from_camera(camera), gain=1.0, bits=16, full_well=1e6)
        dark = [frames(model, 0, seconds, 4) for seconds in (0.5, 2.0)]
        assert dark[1].var() - dark[0].var() == pytest.approx(  # dark current has shot noise
            dark[1].mean() - dark[0].mean(), rel=0.05
        )
        return (dark[1].mean() - dark[0].mean()) / 1.5

    assert rate("25 C") == pytest.approx(50, rel=0.01)
    assert rate("37 C") == pytest.approx(200, rel=0.01)
    assert rate("292.15 K") == pytest.approx(25, rel=0.02)


def test_nonuniformities_are_found_by_the_standards_own_method():
    model = replace(PLAIN, dsnu=12.0, prnu=0.015)
    dark, lit = frames(model, 0, 0.0).mean(axis=0), frames(model, 10000, 0.0).mean(axis=0)
    left = (PLAIN.noise().variance(0.5 * 10000)) / 200  # of the mean of 200 frames
    assert dark.std() == pytest.approx(0.5 * 12, rel=0.02)
    spread = np.sqrt(lit.var() - dark.var() - left) / (lit.mean() - dark.mean())
    assert spread == pytest.approx(0.015, rel=0.02)


def test_what_is_fixed_is_the_same_in_every_frame_and_another_in_another_sensor():
    model = replace(PLAIN, dsnu=12.0, prnu=0.015, hot_pixels=0.01, hot_current=3000.0)
    one, again = (frames(model, 3000, 1.0, 20, seed).mean(axis=0) for seed in (1, 2))
    other = frames(replace(model, serial=7), 3000, 1.0, 20, 3).mean(axis=0)
    assert np.corrcoef(one.ravel(), again.ravel())[0, 1] > 0.99
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.03


def test_hot_pixels_are_as_many_and_as_hot_as_said():
    model = replace(PLAIN, hot_pixels=0.02, hot_current=5000.0)
    dark = frames(model, 0, 1.0, 10).mean(axis=0) - 500
    hot = dark[dark > 20]  # 40 electrons: one hot pixel in 125 is cooler than that
    assert hot.size / dark.size == pytest.approx(0.02, rel=0.15)
    assert hot.mean() == pytest.approx(0.5 * 5000, rel=0.15)


def test_crosstalk_keeps_every_electron_and_goes_to_four_neighbours():
    point = np.zeros((7, 7))
    point[3, 3] = point[0, 0] = 1000.0
    spread = spread_to_neighbours(point, 0.08)
    assert spread.sum() == pytest.approx(2000.0, rel=1e-12)
    assert spread[3, 3] == pytest.approx(920)
    assert [spread[2, 3], spread[4, 3], spread[3, 2], spread[3, 4]] == pytest.approx([20] * 4)
    # means mix, the electrons stay independent: neighbours' noise does not correlate
    lit = frames(replace(PLAIN, crosstalk=0.08), 5000, 0.0, 2)
    noise = lit[0] - lit[1]
    assert abs(np.mean(noise[1:] * noise[:-1]) / noise.var()) < 0.03


def test_black_level_drifts_from_frame_to_frame_and_not_within():
    dark = frames(replace(PLAIN, black_drift=6.0), 0, 0.0, 400)
    level = dark.mean(axis=(1, 2))
    assert level.std() == pytest.approx(6.0, rel=0.1)
    assert (dark - level[:, None, None]).std() == pytest.approx(PLAIN.noise().sigma, rel=0.01)


@pytest.mark.parametrize("electrons", [0, 400, 12000])
def test_the_noise_that_is_stated_is_that_of_sensors_and_frames(electrons):
    model = replace(PLAIN, dark_current=300.0, dsnu=10.0, prnu=0.01, black_drift=2.0)
    values = np.stack(
        [frames(replace(model, serial=n), electrons, 2.0, 1, n)[0] for n in range(200)]
    )
    signal = 0.5 * electrons
    expected = model.noise(2.0).variance(signal)
    assert values.var(axis=0).mean() == pytest.approx(expected, rel=0.02)
    within = np.stack([frames(model, electrons, 2.0, 60)]).var(axis=1).mean() * 60 / 59
    temporal = model.temporal_noise(2.0).variance(signal) + 4.0 * 59 / 60
    assert within == pytest.approx(temporal, rel=0.03)


def test_a_description_is_written_as_it_was_read(tiny_text):
    keys = (
        'exposure = "20 ms"\ndark_current = "12.5 e/s"\ntemperature = "-10.5 C"\n'
        'dark_current_doubling = "6.3 K"\ndsnu = "2.5 e"\nprnu = 0.013\nhot_pixels = 1e-4\n'
        'hot_pixel_current = "1234.5 e/s"\ncrosstalk = 0.021\nblack_drift = "0.7 DN"\nserial = 9\n'
    )
    for strength in (
        'illuminance = "0.3 klx"',
        'luminance = "123 cd/m2"',
        'radiance = "12 mW/m2/sr"',
        'spectral_radiance = "0.123 mW/m2/sr/nm"',
    ):
        text = tiny_text.replace("[light]", f"{keys}[light]\n{strength}")
        camera = parse_camera(text)
        assert parse_camera(to_toml(camera)) == camera
