"""Measures of one response against another, with differences put in by hand."""

import numpy as np
import pytest

from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.response import DEFINITIONS, response_error, score_response

RNG = np.random.default_rng(4)
TRUTH = RNG.uniform(0.1, 1, (5, 40, 3)) + 3 * np.repeat(np.eye(3), [14, 13, 13], axis=0)


def test_gains_divide_out_and_errors_are_relative():
    gains = np.array([2.0, 0.5, 1.0])
    error = RNG.normal(size=(40, 3))
    mean = TRUTH.mean(axis=0)
    error -= mean * (error * mean).sum(axis=0) / (mean * mean).sum(axis=0)  # no gain hides in it
    error *= 0.01 * np.linalg.norm(mean, axis=0) / np.linalg.norm(error, axis=0)
    same = np.repeat(mean[None], 5, axis=0)
    found = score_response((same + error) / gains, same)
    np.testing.assert_allclose(found.response_gain_per_band, gains, rtol=2e-4)
    np.testing.assert_allclose(found.response_error_per_band, 0.01, rtol=1e-3)
    np.testing.assert_allclose(found.response_error_lenslet_per_band, 0.01, rtol=1e-3)
    np.testing.assert_allclose(
        found.response_pixel_per_band, np.abs(error).max(axis=0) / mean.max(axis=0), rtol=0.02
    )
    assert set(figures(found)) == set(DEFINITIONS)


def test_noise_counts_for_single_lenslets_and_not_for_their_mean():
    many = np.repeat(TRUTH, 40, axis=0)
    found = score_response(many, many + RNG.normal(0, 0.2, many.shape))
    single, mean = (
        np.array(found.response_error_lenslet_per_band),
        np.array(found.response_error_per_band),
    )
    np.testing.assert_allclose(
        single, 0.2 * np.sqrt(40) / np.linalg.norm(many, axis=1).mean(axis=0), rtol=0.1
    )
    np.testing.assert_allclose(mean, single / np.sqrt(len(many)), rtol=0.3)


def test_leak_is_the_share_that_least_squares_takes_for_another_band():
    mixed = TRUTH[:1].copy()
    mixed[..., 0] += 0.04 * TRUTH[:1, :, 2]
    assert score_response(TRUTH[:1], mixed).response_leak == pytest.approx(0.04, rel=0.02)


def test_dead_pixels_are_left_out():
    broken = TRUTH.copy()
    broken[:, 7] = np.nan
    broken[2, 9, 1] = np.nan
    error, gain, mean = response_error(broken, TRUTH)
    assert (
        np.isnan(error[7]).all()
        and np.isfinite(np.delete(error, 7, axis=0)).all()
        and np.isnan(mean[7]).all()
    )
    np.testing.assert_allclose(gain, 1)
    found = score_response(broken, TRUTH)
    assert (
        max(found.response_error_per_band) < 1e-12
        and max(found.response_error_lenslet_per_band) < 1e-12
        and found.response_leak < 1e-9
    )
