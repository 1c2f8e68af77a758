"""Estimators against textbook formulas written out with explicit matrices, and against
their own statistics.
"""

import numpy as np
import pytest
from scipy.optimize import nnls

from plenocli.base.errors import NumericsError
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra import demultiplex as spectral

READ, QUANT = 3.0, 1.0
SIZE, BANDS = 36, 4


@pytest.fixture(scope="module")
def system():
    """36 pixels in four 3x3 quadrants, 300 electrons a pixel at unit radiance, leak of about 5 %
    between quadrants.
    """
    rng = np.random.default_rng(3)
    response = 300 * 0.05 * rng.uniform(0.5, 1.5, (SIZE, BANDS))
    row, column = np.divmod(np.arange(SIZE), 6)
    quadrant = 2 * (row // 3) + column // 3
    response[np.arange(SIZE), quadrant] = 300 * rng.uniform(0.85, 1.0, SIZE)
    mean = np.array([0.4, 0.5, 0.45, 0.55])
    step = np.abs(np.subtract.outer(np.arange(BANDS), np.arange(BANDS)))
    covariance = 0.15**2 * 0.7**step
    variance = response @ mean + READ**2 + QUANT**2 / 12
    return response, mean, covariance, variance


def draws(system, count, seed=0):
    response, mean, covariance, variance = system
    rng = np.random.default_rng(seed)
    b = rng.multivariate_normal(mean, covariance, count)
    return b, b @ response.T + rng.normal(size=(count, SIZE)) * np.sqrt(variance)


def formula(system, method):
    """Covariance of the error by the closed formulas with explicit inverses (well
    conditioned here).
    """
    response, _, covariance, variance = system
    inverse = np.linalg.inv
    weight = np.diag(1 / variance)
    if method == "pinv":
        plus = inverse(response.T @ response) @ response.T
        return plus @ np.diag(variance) @ plus.T
    if method == "wls":
        return inverse(response.T @ weight @ response)
    gain = covariance @ response.T @ inverse(response @ covariance @ response.T + np.diag(variance))
    return covariance - gain @ response @ covariance


@pytest.mark.parametrize("method", ["pinv", "wls", "lmmse"])
def test_predicted_error_is_the_formula_and_what_happens(system, method):
    response, mean, covariance, variance = system
    b, x = draws(system, 40000)
    estimate, sigma = spectral.demultiplex(
        response, x, method, variance=variance, prior=(mean, covariance)
    )
    expected = formula(system, method)
    np.testing.assert_allclose(sigma[0] ** 2, np.diag(expected), rtol=1e-10)
    measured = np.cov((estimate - b).T)
    np.testing.assert_allclose(np.diag(measured), np.diag(expected), rtol=0.03)
    assert np.abs(measured - expected).max() < 0.03 * np.diag(expected).max()
    assert np.abs((estimate - b).mean(axis=0)).max() < 5 * sigma[0].max() / 200


def test_errors_are_ordered_and_single_pixel_pays_for_crosstalk(system):
    response, mean, covariance, variance = system
    traces = [np.trace(formula(system, m)) for m in ("lmmse", "wls", "pinv")]
    assert traces[0] < traces[1] < traces[2] < 1.1 * traces[0]
    b, x = draws(system, 20000, seed=1)
    pixels = spectral.choose_pixels(response)
    estimate, sigma = spectral.demultiplex(
        response, x, "single-pixel", variance=variance, pixels=pixels
    )
    bias = np.stack(
        [
            sum(response[p, j] * b[:, j] for j in range(BANDS) if j != k) / response[p, k]
            for k, p in enumerate(pixels)
        ],
        axis=1,
    )
    np.testing.assert_allclose((estimate - b - bias).std(axis=0), sigma[0], rtol=0.02)
    assert ((estimate - b) ** 2).mean() > 20 * traces[2] / BANDS


def test_noiseless_values_give_back_radiances_for_every_method(system):
    response, mean, *_ = system
    for method in ("pinv", "nnls"):
        estimate, _ = spectral.demultiplex(response, response @ mean, method)
        np.testing.assert_allclose(estimate, mean, rtol=1e-12)
    pure = np.where(response == response.max(axis=1, keepdims=True), response, 0)
    estimate, _ = spectral.demultiplex(pure, pure @ mean, "single-pixel")
    np.testing.assert_allclose(estimate, mean, rtol=1e-12)


def test_ill_conditioned_response_keeps_the_digits_that_normal_equations_lose():
    rng = np.random.default_rng(5)
    u = np.linalg.qr(rng.normal(size=(60, 4)))[0]
    v = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    response = u @ np.diag([1, 1e-2, 1e-5, 1e-8]) @ v.T
    truth = np.array([1.0, 2.0, 3.0, 4.0])
    estimate, _ = spectral.demultiplex(response, response @ truth)
    assert np.abs(estimate - truth).max() < 1e-6  # F^T F would have condition 1e16: no digit left
    assert spectral.condition_number(response) == pytest.approx(1e8, rel=1e-6)


def test_non_negative_agrees_with_scipy_on_the_full_matrix(system):
    response, mean, _, variance = system
    rng = np.random.default_rng(8)
    x = rng.normal(size=(50, SIZE)) * 40 + response @ np.array([0.3, 0.0, 0.0, 0.4])
    estimate, _ = spectral.demultiplex(response, x, "nnls")
    weighted, _ = spectral.demultiplex(response, x, "nnls", variance=variance)
    root = 1 / np.sqrt(variance)
    for i in range(50):
        np.testing.assert_allclose(estimate[i], nnls(response, x[i])[0], atol=1e-9)
        np.testing.assert_allclose(
            weighted[i], nnls(response * root[:, None], x[i] * root)[0], atol=1e-9
        )


def test_lenslets_with_their_own_response_and_masked_pixels(system):
    response, mean, _, variance = system
    rng = np.random.default_rng(2)
    own = response * rng.uniform(0.5, 1.5, (3, 5, SIZE, 1))
    truth = rng.uniform(0, 1, (3, 5, BANDS))
    x = (own @ truth[..., None])[..., 0]
    x[0, 0, 4] = np.nan
    own[1, 1, 7, 2] = np.nan
    x[2, 2] = np.nan
    for method in ("pinv", "wls"):
        estimate, sigma = spectral.demultiplex(own, x, method, variance=np.full(SIZE, 4.0))
        assert np.isnan(estimate[2, 2]).all() and np.isnan(sigma[2, 2]).all()
        estimate[2, 2] = truth[2, 2]
        np.testing.assert_allclose(estimate, truth, rtol=1e-9)
    keep = np.delete(np.arange(SIZE), 4)
    part = own[0, 0][keep]
    np.testing.assert_allclose(
        sigma[0, 0] ** 2, 4 * np.diag(np.linalg.inv(part.T @ part)), rtol=1e-9
    )


def test_batches_do_not_change_the_answer(system, monkeypatch):
    response, *_, variance = system
    _, x = draws(system, 500)
    whole = spectral.demultiplex(response, x, "wls", variance=variance)
    monkeypatch.setattr(spectral, "BATCH_NUMBERS", 37 * SIZE * BANDS)
    np.testing.assert_allclose(
        spectral.demultiplex(response, x, "wls", variance=variance), whole, rtol=1e-12
    )


def test_sigma_from_residual_where_noise_is_unknown(system):
    response, mean, *_ = system
    rng = np.random.default_rng(11)
    x = response @ mean + rng.normal(size=(20000, SIZE)) * 7
    estimate, sigma = spectral.demultiplex(response, x)
    np.testing.assert_allclose(np.sqrt((sigma**2).mean(axis=0)), estimate.std(axis=0), rtol=0.03)
    for method in ("wls", "lmmse"):
        with pytest.raises(NumericsError, match="noise"):
            spectral.demultiplex(response, x, method)


def test_noise_variance_and_angles(system):
    response, mean, *_ = system
    value = spectral.noise_variance(
        response, mean, Noise(gain=0.25, read_variance=2.0), np.full(BANDS, 9.0)
    )
    np.testing.assert_allclose(value, 0.25 * response @ mean + 2.0 + 9.0 * (mean**2).sum())
    angles = spectral.column_angles(np.array([[1.0, 1.0], [0.0, 1.0], [0.0, 0.0]]))
    np.testing.assert_allclose(angles, [[0, 45], [45, 0]], atol=1e-5)


def test_band_that_no_pixel_sees_is_not_invented():
    response = np.zeros((9, 2))
    response[:, 0] = 1.0
    estimate, sigma = spectral.demultiplex(response, np.ones((4, 9)))
    assert np.isnan(estimate).all() and np.isnan(sigma).all()
    assert np.isinf(spectral.condition_number(response))


def test_bias_of_a_noisy_calibration_is_the_one_of_repeated_calibrations(system):
    response = system[0]
    rng = np.random.default_rng(12)
    variance = (0.12 * response.max()) ** 2 * rng.uniform(0.3, 1, response.shape)
    truth = np.array([0.8, 0.2, 0.6, 0.4])
    noisy = response + rng.normal(size=(60000, *response.shape)) * np.sqrt(variance)
    found, _ = spectral.demultiplex(noisy, np.broadcast_to(response @ truth, (len(noisy), SIZE)))
    bias = spectral.calibration_bias(response, variance) @ truth
    measured = found.mean(axis=0) - truth
    error = found.std(axis=0) / np.sqrt(len(found))
    assert (np.abs(bias) > 30 * error).sum() >= 2  # far from nothing
    # second order: the next one is 15 % here
    np.testing.assert_allclose(measured, bias, atol=0.2 * np.abs(bias).max())
    few = response[[0, 5, 20, 35]]  # as many pixels as bands: no attenuation, amplification is left
    assert (np.diag(spectral.calibration_bias(few, variance[:4])) > 0).all()


def test_lmmse_without_a_prior_is_refused():
    with pytest.raises(NumericsError, match="mean and covariance"):
        spectral.demultiplex(np.eye(3), np.ones(3), "lmmse", variance=1.0)
