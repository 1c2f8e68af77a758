import numpy as np
import pytest

from plenocli.evaluation.metrics.chart import (
    against_white,
    compare_chart,
    lobe_reflectance,
    nominal_reflectance,
)

NM = np.arange(350, 800.5, 1.0) * 1e-9


def test_a_lobe_leaves_the_floor_and_other_peaks_of_a_filter_out():
    peak = np.exp(-(((NM - 543e-9) / 6e-9) ** 2))
    dirty = peak + 0.02 + 0.9 * np.exp(-(((NM - 400e-9) / 10e-9) ** 2))
    slope = np.stack([NM * 1e6, 1 - NM * 1e6])
    found = lobe_reflectance(NM, [dirty], [550e-9], slope)
    # the floor is even about the peak
    np.testing.assert_allclose(found[:, 0], [0.543, 0.457], atol=5e-5)
    step = (NM > 570e-9).astype(float)[None]
    assert lobe_reflectance(NM, [dirty], [550e-9], step)[0, 0] == 0


def test_nominal_bands_average_over_a_gaussian():
    curve = ((NM - 600e-9) * 1e8) ** 2
    found = nominal_reflectance(NM, [600e-9, 610e-9], curve[None])
    variance = (10e-9 * 1e8) ** 2 / (8 * np.log(2))
    np.testing.assert_allclose(found[0], [variance, 1 + variance], rtol=1e-6)


def test_errors_by_band_are_those_of_the_patches():
    truth = np.full((24, 3), 0.5)
    found = truth.copy()
    found[3, 0], found[5, 1] = 0.7, 0.4
    scores = compare_chart(found, truth, (3, 7), np.array([True, True, False]))
    assert scores.rmse_24_per_band == pytest.approx([0.2 / np.sqrt(24), 0.1 / np.sqrt(24), 0])
    assert scores.rmse_six_per_band == pytest.approx(
        [0.2 / np.sqrt(2), 0, 0]
    ) and scores.rmse_six == pytest.approx(0.1 / np.sqrt(2))
    angles = np.degrees([np.arctan(7 / 5) - np.pi / 4, np.pi / 4 - np.arctan(4 / 5)])
    assert scores.spectral_angle_deg == pytest.approx(
        angles.sum() / 24
    ) and scores.spectral_angle_worst_deg == pytest.approx(angles.max())
    np.testing.assert_allclose(against_white(3 * found, truth, 0), found)
