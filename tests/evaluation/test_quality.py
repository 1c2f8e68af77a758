import numpy as np
import pytest
from skimage.metrics import structural_similarity

from plenocli.base import tiling
from plenocli.evaluation.metrics import quality


def test_psnr_of_a_constant_error_is_its_decibels():
    truth = np.random.default_rng(0).random((20, 30))
    assert quality.psnr(truth + 0.01, truth) == pytest.approx(40, abs=1e-9)
    assert quality.psnr(truth * 1, truth) == float("inf")


def test_the_peak_is_one_whatever_the_picture_holds():
    truth = np.zeros((8, 8))
    truth[0, 0] = 7.0
    assert quality.psnr(truth + 0.1, truth) == pytest.approx(20)


def test_psnr_is_that_of_the_whole_picture_not_the_mean_of_blocks():
    truth = np.zeros((2, 2, 2))
    estimate = truth.copy()
    estimate[0] = 0.1
    assert quality.psnr(estimate, truth) == pytest.approx(20 + 10 * np.log10(2))


def test_the_border_ring_is_left_out():
    truth = np.zeros((12, 15))
    estimate = truth + 1.0
    estimate[4:8, 5:10] = 0.1
    scores = quality.score_picture(estimate, truth, (4, 5))
    assert scores.lenslets.psnr_inner_db == pytest.approx(20)
    assert np.isnan(quality.score_picture(estimate[:8], truth[:8], (4, 5)).lenslets.psnr_inner_db)


def test_ssim_has_the_settings_it_claims():
    rng = np.random.default_rng(1)
    truth = rng.random((40, 50))
    estimate = truth + 0.1 * rng.standard_normal(truth.shape)
    expected = structural_similarity(
        truth,
        estimate,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    assert quality.ssim(estimate, truth) == pytest.approx(expected)
    assert quality.ssim(np.stack([estimate, truth]), np.stack([truth, truth])) == pytest.approx(
        (expected + 1) / 2
    )
    assert np.isnan(quality.ssim(truth[:10], truth[:10]))


def test_ssim_of_flat_pictures_is_the_luminance_term():
    a, b, c1 = 0.5, 0.6, 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    assert quality.ssim(np.full((20, 20), a), np.full((20, 20), b)) == pytest.approx(expected)


def test_block_mean_baseline_error_is_the_variance_inside_blocks():
    truth = np.random.default_rng(2).random((20, 30))
    blocks = truth.reshape(4, 5, 3, 10).transpose(0, 2, 1, 3).reshape(4, 3, 50)
    expected = -10 * np.log10(blocks.var(axis=-1).mean())
    scores = quality.score_picture(truth + 0.05, truth, (5, 10))
    assert scores.lenslets.block_mean_psnr_db == pytest.approx(expected)
    assert scores.lenslets.gain_over_block_mean_db == pytest.approx(scores.psnr_db - expected)


def test_clipping_helps_only_where_values_leave_the_range():
    truth = np.array([[0.0, 1.0], [0.5, 0.5]])
    scores = quality.score_picture(truth + [[-0.2, 0.2], [0.1, 0]], truth)
    assert scores.psnr_clipped_db == pytest.approx(-10 * np.log10(0.01 / 4))
    assert scores.psnr_db == pytest.approx(-10 * np.log10(0.09 / 4))


def test_a_picture_in_bands_has_the_measures_of_the_whole(monkeypatch):
    """Against formulas over all of it, where the last band is thin and where it is not."""
    rng = np.random.default_rng(5)
    for rows, columns in ((180, 90), (174, 90), (48, 90)):
        truth = rng.random((rows, columns))
        estimate = truth + 0.2 * rng.standard_normal(truth.shape)
        sigma = 0.2 * rng.random(truth.shape)
        monkeypatch.setattr(tiling, "BAND", 40 * columns)
        found = quality.score_picture(estimate, truth, (6, 9), sigma)
        error = estimate - truth
        assert found.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-12)
        kept = error[6:-6, 9:-9]
        assert found.lenslets.psnr_inner_db == pytest.approx(-10 * np.log10(np.mean(kept**2)))
        inside = (error < 1.96 * sigma) & (error > -1.96 * sigma)
        assert found.interval_coverage == pytest.approx(inside.mean(), rel=1e-12)
        blocks = truth.reshape(rows // 6, 6, columns // 9, 9)
        spread = (blocks - blocks.mean(axis=(1, 3), keepdims=True)) ** 2
        assert found.lenslets.block_mean_psnr_db == pytest.approx(-10 * np.log10(spread.mean()))
        expected = structural_similarity(
            truth,
            estimate,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        assert found.ssim == pytest.approx(expected, rel=1e-12)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match="truth"):
        quality.psnr(np.zeros((2, 3)), np.zeros((3, 2)))
