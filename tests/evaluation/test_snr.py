import numpy as np
import pytest

from plenocli.evaluation.metrics import snr


def test_capture_snr_over_frames_sees_time_and_not_space():
    rng = np.random.default_rng(0)
    shading = np.linspace(0.5, 1.5, 400)
    frames = shading + 0.01 * rng.standard_normal((16, 2, 400)) * np.array([1, 3])[:, None]
    np.testing.assert_allclose(snr.snr_capture(frames), [40, 40 - 20 * np.log10(3)], atol=0.3)
    np.testing.assert_allclose(
        snr.snr_capture(frames[:1]), 20 * np.log10(1 / shading.std()), atol=0.1
    )


def test_two_frames_are_their_difference_over_root_two():
    rng = np.random.default_rng(1)
    first, second = 1 + 0.02 * rng.standard_normal((2, 1, 100000))
    expected = 20 * np.log10(1 / (np.std(first - second) / np.sqrt(2)))
    assert snr.snr_capture([first, second])[0] == pytest.approx(expected, abs=0.02)


def test_predicted_snr():
    sigma = np.array([[0.01, 0.03], [0.1, 0.1]])
    value = np.ones((2, 2))
    np.testing.assert_allclose(snr.snr_predicted(value, sigma), [-10 * np.log10(5e-4), 20])


def test_sensor_snr_takes_the_power_and_not_the_variance():
    signal = 1 + 0.1 * np.random.default_rng(2).standard_normal(200000)
    assert snr.snr_sensor(signal, 1e-3) == pytest.approx(60 + 10 * np.log10(1.01), abs=0.01)
    noisy = signal + 0.5 * np.random.default_rng(3).standard_normal(signal.size)
    assert snr.snr_sensor(noisy, 0.5, noisy=True) == pytest.approx(
        snr.snr_sensor(signal, 0.5), abs=0.03
    )
    assert snr.snr_sensor(signal, 10.0, noisy=True) == -np.inf


def test_edges_are_named_not_raised():
    assert np.isnan(snr.snr_capture(np.ones((1, 1, 1)))).all()
    assert np.isinf(snr.snr_capture(np.ones((2, 1, 5)))).all()
    assert np.isnan(snr.snr_capture(np.full((2, 3, 5), np.nan))).all()
    assert np.isnan(snr.snr_predicted(np.zeros((1, 4)), np.zeros((1, 4)))).all()
