"""Noise taken off responses of many lenslets, against the truth that was put in."""

import numpy as np
import pytest

from plenocli.inverse.calibration.low_rank import LEAST, low_rank
from plenocli.inverse.spectra.demultiplex import demultiplex
from tests.reference.prototype import superpixels

PIXELS, FULL = 18, 12000.0


def responses(count=150, seed=1):
    """True responses (lenslet, pixel, band) of lenslets that lie anywhere within a pixel, with
    gains of 0.4 to 1.
    """
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-0.5, 0.5, (count, 2))
    return superpixels(shift, pixels=PIXELS, side=14, gap=2) * rng.uniform(0.4, 1, (count, 1, 1))


def measured(truth, exposure, seed=2):
    """(noisy responses at unit exposure, variance (pixel, band))."""
    electrons = FULL * exposure
    rng = np.random.default_rng(seed)
    noisy = (rng.poisson(truth * electrons) + rng.normal(0, 4, truth.shape)) / electrons
    return noisy, (np.clip(noisy, 0, None) / electrons + 16 / electrons**2).mean(axis=0)


def rmse(a, b):
    return np.sqrt(np.nanmean((a - b) ** 2))


@pytest.mark.parametrize("exposure", [1.0, 1 / 16, 1 / 64])
def test_one_shot_cleaned_is_worth_many(exposure):
    truth = responses()
    noisy, variance = measured(truth, exposure)
    clean, left, rank = low_rank(noisy, variance)
    before, after = rmse(noisy, truth), rmse(clean, truth)
    assert 3 <= rank <= 20 and left < 0.2
    assert after < 0.45 * before  # as of five shots and more
    # radiances by the cleaned response, from captures of their own without noise
    light = np.random.default_rng(3).uniform(0.1, 0.9, (len(truth), 4))
    values = np.einsum("lpk,lk->lp", truth, light)
    error = [rmse(demultiplex(f, values)[0], light) for f in (noisy, clean)]
    assert error[1] < 0.6 * error[0]


def test_light_without_noise_is_left_as_it_is():
    truth = responses()
    clean, _, rank = low_rank(truth, np.full(truth.shape[1:], 1e-14))
    assert rank > 20
    np.testing.assert_allclose(clean, truth, atol=2e-5)


def test_lenslets_that_do_not_differ_are_averaged():
    truth = np.repeat(responses(1), 150, axis=0)
    noisy, variance = measured(truth, 1 / 16)
    clean, left, rank = low_rank(noisy, variance)
    assert rank == 1 and left < 0.01
    assert rmse(clean, truth) < 1.3 * rmse(noisy, truth) * np.sqrt(1 / 150 + 1 / truth[0].size)


def test_dead_pixels_stay_dead_and_do_no_harm():
    truth = responses()
    noisy, variance = measured(truth, 1 / 16)
    whole, *_ = low_rank(noisy, variance)
    dead = np.random.default_rng(6).random(truth.shape[:2]) < 0.01
    noisy[dead] = np.nan
    noisy[:, 7] = np.nan
    clean, *_ = low_rank(noisy, variance)
    assert (
        np.isnan(clean[dead]).all()
        and np.isnan(clean[:, 7]).all()
        and np.isfinite(clean[~dead & (np.arange(truth.shape[1]) != 7)]).all()
    )
    assert rmse(clean, truth) < 1.1 * rmse(whole, truth)


def test_groups_are_cleaned_apart_and_small_ones_not_at_all():
    truth = responses()
    groups = np.arange(len(truth)) % 2
    truth[groups == 1, ::2] *= 0.3  # another colour on every second pixel
    noisy, variance = measured(truth, 1 / 16)
    clean, *_ = low_rank(noisy, variance, groups)
    alone, *_ = low_rank(noisy[groups == 0], variance)
    np.testing.assert_array_equal(clean[groups == 0], alone)
    groups = np.where(np.arange(len(truth)) < LEAST - 1, 0, 1)
    few, left, _ = low_rank(noisy, variance, groups)
    np.testing.assert_array_equal(few[groups == 0], noisy[groups == 0].astype(np.float32))
    assert left > (LEAST - 1) / len(truth)
