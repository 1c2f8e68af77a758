import numpy as np
import pytest

from plenocli.evaluation.metrics import spectral
from plenocli.forward.scene.tables import colorchecker

WAVELENGTHS = np.array([450, 540, 570, 650]) * 1e-9


def test_rmse_per_band_is_by_band():
    truth = np.zeros((5, 7, 3))
    np.testing.assert_allclose(
        spectral.rmse_per_band(truth + [0.1, 0.0, -0.3], truth), [0.1, 0.0, 0.3]
    )


@pytest.mark.parametrize("angle", [0, 1e-9, 1e-3, 1.0, np.pi / 2])
def test_angle_of_known_vectors(angle):
    u = np.array([3.0, 0.0])
    v = 0.2 * np.array([np.cos(angle), np.sin(angle)])
    assert spectral.spectral_angle(u, v) == pytest.approx(angle, rel=1e-6, abs=1e-16)


def test_angle_is_blind_to_brightness_and_defined_for_zero():
    spectrum = np.random.default_rng(0).random(6)
    assert spectral.spectral_angle(spectrum, 7 * spectrum) == pytest.approx(0, abs=1e-15)
    assert spectral.spectral_angle(np.zeros(6), spectrum) == pytest.approx(np.pi / 2)
    assert spectral.spectral_angle(np.zeros(6), np.zeros(6)) == 0


def test_colour_difference_of_equal_spectra_is_zero_and_of_black_and_white_is_100():
    spectra = colorchecker(WAVELENGTHS)[2]
    assert spectral.colour_difference(WAVELENGTHS, spectra, spectra).max() < 1e-9
    assert spectral.colour_difference(WAVELENGTHS, np.ones(4), np.zeros(4)) == pytest.approx(
        100, abs=1e-6
    )


def test_cube_scores_leave_invalid_lenslets_out():
    truth = np.random.default_rng(1).random((4, 6, 8)) + 0.1
    estimate = truth + np.array([0.01, 0.02, 0.03, 0.04])[:, None, None]
    estimate[2, 0, 0] = np.nan
    scores = spectral.score_cube(estimate, truth, WAVELENGTHS)
    assert scores.lenslets == 47 and scores.rmse == pytest.approx(0.025)
    np.testing.assert_allclose(scores.rmse_per_band, [0.01, 0.02, 0.03, 0.04])
    assert spectral.score_cube(np.full_like(truth, np.nan), truth, WAVELENGTHS) is None


def test_patch_scores_separate_bias_from_spread():
    labels = np.repeat(np.arange(4), 10).reshape(4, 10)  # row 0 is no patch
    truth = np.zeros((2, 4, 10))
    estimate = truth.copy()
    estimate[0, 1] = 0.3 * np.where(np.arange(10) % 2, 1, -1)  # spread without bias
    estimate[1, 2] = 0.2  # bias without spread
    estimate[:, 0] = 99
    scores = spectral.score_patches(estimate, truth, labels, six=(1, 2, 24))
    assert scores.patches == 3 and scores.six_patches_seen == 2
    np.testing.assert_allclose(scores.patch_rmse_per_band, [0, np.sqrt(0.04 / 3)], atol=1e-15)
    np.testing.assert_allclose(scores.six.six_patch_rmse_per_band, [0.15, 0.1])
    assert scores.six.six_patch_rmse == pytest.approx(0.125)


def test_patch_statistics():
    labels = np.array([[0, 1, 1], [2, 1, 0]])
    cube = np.arange(12.0).reshape(2, 2, 3)
    cube[0, 1, 0] = np.nan
    found = spectral.patch_statistics(cube, labels)
    assert set(found) == {1} and found[1].count == 3
    np.testing.assert_allclose(found[1].mean, [(1 + 2 + 4) / 3, (7 + 8 + 10) / 3])
    np.testing.assert_allclose(found[1].std, np.std([1, 2, 4], ddof=1))
