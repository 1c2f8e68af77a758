"""Superpixels in single precision over factored responses: the same answers as least squares in
double, one by one.
"""

import numpy as np
import pytest

import plenocli.inverse.spectra.factored as factored_module
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra.demultiplex import demultiplex, noise_variance
from plenocli.inverse.spectra.factored import factor, normal_equations, solve

LENSLETS, PIXELS, BANDS, GAIN, READ = 90, 20 * 20, 4, 0.4, 3.0
NOISE = Noise(gain=GAIN, read_variance=READ)
PRIOR = np.full(BANDS, 0.4), 0.04 * (0.6 * np.ones((BANDS, BANDS)) + 0.4 * np.eye(BANDS))


@pytest.fixture(params=["shared", "each"])
def case(request):
    """(response, values, rng) of lenslets with one F or one each, some of whose pixels the
    calibration does not know.
    """
    rng = np.random.default_rng(3)
    response = 4000 * rng.uniform(0, 1, (PIXELS, BANDS)) ** 6
    response[rng.integers(PIXELS, size=5)] = np.nan
    if request.param == "each":
        response = response * rng.uniform(0.7, 1.3, (LENSLETS, PIXELS, BANDS))
        response[rng.integers(LENSLETS, size=30), rng.integers(PIXELS, size=30)] = np.nan
    truth = rng.uniform(0.05, 0.9, (LENSLETS, BANDS))
    mean = np.nan_to_num(response @ truth[..., None])[..., 0]
    values = mean + rng.normal(0, np.sqrt(GAIN * mean + READ))
    return response.astype(np.float32), values.astype(np.float32), rng


def both(response, values, method, known=None, **settings):
    """(ours, the reference's) radiances and standard deviations."""
    factored = factor(response)
    sums = normal_equations(
        factored,
        lambda part: values[part].copy(),
        len(values),
        NOISE,
        known,
        sandwich=True,
        **settings,
    )
    start = np.clip(np.nan_to_num(demultiplex(response, values)[0]), 0, None)
    variance = np.maximum(
        noise_variance(response, settings.get("radiance", start), NOISE, known), READ
    )
    return solve(factored, sums, method, PRIOR), demultiplex(
        response, values, method, variance=variance, prior=PRIOR
    )


@pytest.mark.parametrize("least", [0, 10_000, 60_000])
def test_products_in_pieces_are_those_of_the_whole(least, monkeypatch):
    rng = np.random.default_rng(8)
    monkeypatch.setattr(factored_module, "SMALL_PRODUCT", least)
    left, right = rng.normal(size=(100, 300)), rng.normal(size=(4, 300))
    found = factored_module._narrow(left, right)
    np.testing.assert_allclose(found, np.einsum("ip,bp->ib", left, right), rtol=0, atol=1e-11)


@pytest.mark.parametrize("method", ["pinv", "wls", "lmmse", "nnls"])
def test_all_methods_agree_with_double_precision(case, method):
    response, values, _ = case
    (b, sigma), (expected, spread) = both(response, values, method)
    np.testing.assert_allclose(b, expected, rtol=0, atol=1e-3 * spread.min())
    np.testing.assert_allclose(sigma, spread, rtol=2e-4)


@pytest.mark.parametrize("method", ["pinv", "wls"])
def test_pixels_that_a_capture_lacks_take_no_part(case, method):
    response, values, rng = case
    values[rng.uniform(size=values.shape) < 0.1] = np.nan
    values[::7] = np.nan_to_num(values[::7])  # some lenslets lack none
    values[5, 40:] = np.nan
    values[6] = np.nan
    values[8, 2:] = np.nan
    (b, sigma), (expected, spread) = both(response, values, method)
    hard = normal_equations(factor(response), lambda part: values[part].copy(), len(values)).hard
    assert hard[6] and hard[8] and hard.sum() < 5 and np.isnan(b[hard]).all()
    np.testing.assert_allclose(b[~hard], expected[~hard], rtol=0, atol=2e-3 * np.nanmin(spread))
    np.testing.assert_allclose(sigma[~hard], spread[~hard], rtol=5e-4)


def test_what_the_calibration_does_not_know_counts(case):
    response, values, rng = case
    known = rng.uniform(0, 2000, (PIXELS, BANDS))
    (b, sigma), (expected, spread) = both(response, values, "wls", known)
    np.testing.assert_allclose(b, expected, rtol=0, atol=2e-3 * spread.min())
    np.testing.assert_allclose(sigma, spread, rtol=5e-4)


def test_weights_may_follow_another_radiance(case):
    response, values, _ = case
    radiance = np.broadcast_to(PRIOR[0], (len(values), BANDS))
    (b, sigma), (expected, spread) = both(response, values, "lmmse", radiance=radiance)
    np.testing.assert_allclose(b, expected, rtol=0, atol=1e-3 * spread.min())
    np.testing.assert_allclose(sigma, spread, rtol=2e-4)


@pytest.mark.parametrize("doubted", [False, True])
def test_chi_is_the_weighted_residual(case, doubted):
    response, values, rng = case
    values[rng.uniform(size=values.shape) < 0.02] = np.nan
    known = rng.uniform(0, 2000, (PIXELS, BANDS))
    settings = dict(doubt=known) if doubted else dict(response_variance=known)
    sums = normal_equations(
        factor(response), lambda part: values[part].copy(), len(values), NOISE, **settings
    )
    b = demultiplex(response, values)[0]
    mean = (response @ b[..., None])[..., 0]
    variance = noise_variance(response, b, NOISE, known)
    residual = (values - mean) ** 2 / variance
    np.testing.assert_allclose(sums.chi, np.nansum(residual, axis=-1), rtol=1e-3)
    np.testing.assert_array_equal(sums.count, np.isfinite(residual).sum(axis=-1))


def test_unknown_noise_comes_from_the_residual(case):
    response, values, rng = case
    values[rng.uniform(size=values.shape) < 0.02] = np.nan
    factored = factor(response)
    found = solve(
        factored,
        normal_equations(factored, lambda part: values[part].copy(), len(values)),
        "pinv",
        None,
        False,
    )
    np.testing.assert_allclose(found[0], demultiplex(response, values)[0], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found[1], demultiplex(response, values)[1], rtol=1e-3)


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6, 1e9])
def test_factors_give_the_response_back(condition):
    rng = np.random.default_rng(8)
    u, v = (np.linalg.qr(rng.normal(size=shape))[0] for shape in ((7, 50, 3), (3, 3)))
    f = u * np.array([1, condition**-0.5, 1 / condition]) @ v
    factored = factor(f)
    q = np.swapaxes(factored.q, -1, -2).astype(float)
    np.testing.assert_allclose(q @ factored.r, f, atol=2e-7)
    np.testing.assert_allclose(
        np.swapaxes(q, -1, -2) @ q, np.broadcast_to(np.eye(3), (7, 3, 3)), atol=1e-6
    )
    assert factored.sound.all() and factored.used is None


def test_threads_change_nothing(monkeypatch):
    monkeypatch.setattr(factored_module, "FACTOR_NUMBERS", 2000)
    f = np.random.default_rng(2).uniform(size=(60, 50, 3))
    one, four = factor(f), factor(f, threads=4)
    np.testing.assert_array_equal(one.q, four.q)
    np.testing.assert_array_equal(one.r, four.r)


def test_a_response_that_cannot_tell_bands_apart_gives_nothing():
    f = np.ones((30, 2)) * np.arange(30)[:, None]
    factored = factor(f)
    sums = normal_equations(factored, lambda part: np.ones((3, 30), np.float32)[part], 3)
    assert not factored.sound[0] and np.isnan(solve(factored, sums, "pinv", None, False)[0]).all()
