"""The linear estimate and its bars against dense matrices, and against draws from its prior."""

import numpy as np
import pytest

from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume import lmmse as module
from plenocli.inverse.volume.gain import gain_of
from plenocli.inverse.volume.lattice import exponential_factor, lattice_of
from plenocli.inverse.volume.likelihood import fit_prior
from plenocli.inverse.volume.lmmse import class_variance, conditional_mean, lmmse
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from tests.reference import volumes

COUNT, TORUS, PIXELS = (3, 4), (4, 5), 7
VOXELS = Voxels((2, 2), 1e-6, (-1.5e-6, 0.5e-6))
LENGTH, VARIANCE = 2e-6, 3.0
NOISE = 0.02 + 0.01 * np.arange(PIXELS)


def small(whole, mask=0.0, hold_out=0.0, dtype=float, signal=None):
    parts = [(blocks.astype(dtype), o) for blocks, o in volumes.kernels(2, 4, PIXELS)]
    op = BlockCirculant(parts, COUNT, TORUS)
    op = op.on_torus() if whole else op
    rng = np.random.default_rng(5)
    signal = rng.standard_normal(op.range.shape) if signal is None else signal
    usable = rng.random(op.range.shape) >= mask
    measurement = Measurement(signal=np.where(usable, signal, np.nan), read_variance=1.0)
    return Problem(op, measurement, VOXELS, hold_out=hold_out)


def gain_for(problem, noise=NOISE):
    lattice = lattice_of(problem.op.torus, problem.voxels)
    factor = exponential_factor(lattice, np.array(problem.voxels.depths), LENGTH)
    return gain_of(problem.op, lattice, np.sqrt(VARIANCE) * factor, 1 / np.sqrt(noise))


def dense(problem):
    """Conditional mean and variance by definition."""
    a = volumes.matrix(volumes.kernels(2, 4, PIXELS), problem.op.range.shape[:2], TORUS)
    prior = VARIANCE * volumes.covariance(TORUS, (2, 2), 1e-6, VOXELS.depths, LENGTH)
    counts = problem.counts.ravel()
    noise = np.broadcast_to(NOISE, problem.signal.shape).ravel()[counts]
    return volumes.conditional(a[counts], prior, noise, problem.signal.ravel()[counts])


@pytest.mark.parametrize("torus", [(4, 5), (5, 4), (1, 3)])
def test_frequencies_of_lenslets_and_of_points_are_the_same_numbers(torus):
    voxels = Voxels((2, 3), 1.0, (0.0,))
    lattice, rng = lattice_of(torus, voxels), np.random.default_rng(0)
    picture = rng.standard_normal((1, torus[0] * 2, torus[1] * 3))
    fine = np.fft.fft2(picture[0])
    coarse = np.fft.rfft2(voxels.lenslets(picture), axes=(0, 1)).reshape(-1, 6)
    number = np.rint(lattice.turns * np.array(fine.shape)).astype(int)
    mixed = np.einsum("kia,ka->ki", lattice.mixing, fine[number[..., 0], number[..., 1]])
    np.testing.assert_allclose(coarse, mixed / np.sqrt(6), atol=1e-10)
    assert lattice.times.sum() == torus[0] * torus[1]


def test_estimate_and_variance_are_those_of_the_dense_problem():
    problem = small(whole=True)
    gain = gain_for(problem)
    x, light = conditional_mean(problem, gain, 0.0, NOISE)
    expected, variance = dense(problem)
    np.testing.assert_allclose(x.ravel(), expected, atol=1e-8)
    np.testing.assert_allclose(np.tile(gain.variance, 20), variance, rtol=1e-8)
    np.testing.assert_allclose(light, problem.op.forward(x))


def test_leverage_is_what_a_pixel_says_of_itself():
    problem = small(whole=True)
    gain = gain_for(problem)
    for pixel in (0, 4):
        y = np.zeros(problem.op.range.shape)
        y[2, 1, pixel] = 1
        x = conditional_mean(small(True, signal=y), gain, 0.0, NOISE)[0]
        found = problem.op.forward(x)[2, 1, pixel]
        assert gain.leverage[pixel] == pytest.approx(found, rel=1e-8)


@pytest.mark.parametrize("whole, mask", [(True, 0.2), (False, 0.0), (False, 0.2)])
def test_missing_pixels_and_the_border_are_conditioned_on(monkeypatch, whole, mask):
    monkeypatch.setattr(module, "TOLERANCE", 1e-9)
    problem = small(whole, mask)
    x = conditional_mean(problem, gain_for(problem), 0.0, NOISE, 3000)[0]
    expected = dense(problem)[0]
    assert np.linalg.norm(x.ravel() - expected) < 1e-4 * np.linalg.norm(expected)


def test_pixels_have_their_own_photon_noise(monkeypatch):
    """The fixed point is that of the dense problem with each pixel's own variance."""
    monkeypatch.setattr(module, "TOLERANCE", 1e-10)
    monkeypatch.setattr(module, "MOST_WEIGHT", 100.0)
    rng = np.random.default_rng(8)
    problem = small(True)
    light = problem.op.forward(1 + rng.random(problem.op.domain.shape))
    signal = light + 0.1 * rng.standard_normal(light.shape)
    measurement = Measurement(signal=signal, read_variance=0.01, gain=0.05)
    problem = Problem(problem.op, measurement, VOXELS, hold_out=0.0)
    of_pixels = class_variance(problem)
    gain = gain_for(problem, of_pixels)
    used = {}
    original = module._weights

    def weights(*arguments):
        used["weight"] = original(*arguments)
        return used["weight"]

    monkeypatch.setattr(module, "_weights", weights)
    x = conditional_mean(problem, gain, 0.0, of_pixels, 3000)[0]
    own = of_pixels / used["weight"]
    assert own.max() > 1.2 * own.min() and np.all(own >= 0.01)
    np.testing.assert_allclose(own, 0.01 + 0.05 * light, rtol=0.3)
    a = volumes.matrix(volumes.kernels(2, 4, PIXELS), TORUS, TORUS)
    prior = VARIANCE * volumes.covariance(TORUS, (2, 2), 1e-6, VOXELS.depths, LENGTH)
    expected = volumes.conditional(a, prior, own.ravel(), signal.ravel())[0]
    assert np.linalg.norm(x.ravel() - expected) < 1e-4 * np.linalg.norm(expected)


def drawn(seed, torus=(8, 9), length=2e-6, noise=0.03, mean=0.0):
    """A draw from the prior on the fine grid, and what is seen of it, everywhere."""
    voxels, rng = Voxels((2, 2), 1e-6, (-2e-6, 0.0, 2e-6)), np.random.default_rng(seed)
    prior = volumes.covariance(torus, (2, 2), 1e-6, voxels.depths, length)
    x = np.linalg.cholesky(prior) @ rng.standard_normal(len(prior)) + mean
    op = BlockCirculant(volumes.kernels(3, 4, 25), (6, 7), torus)
    x = x.reshape(op.domain.shape)
    return op, voxels, x, noise * rng.standard_normal((*torus, 25))


def test_draws_from_the_prior_lie_as_far_off_as_sigma_says():
    z = []
    for seed in range(12):
        op, voxels, x, noise = drawn(seed)
        whole = op.on_torus()
        measurement = Measurement(signal=whole.forward(x) + noise, read_variance=0.03**2)
        volume = lmmse(Problem(whole, measurement, voxels))
        z.append((volume.value - voxels.picture(x)) / volume.sigma)
        assert volume.margin == 0 and volume.method == "lmmse"
    assert np.sqrt(np.mean(np.square(z))) == pytest.approx(1, abs=0.02)
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.01)


@pytest.mark.parametrize("whole, least", [(True, 2.5e-6), (False, 1.4e-6)])
def test_length_variance_and_noise_are_found(whole, least):
    """What is seen of a small array's border is completed by shorter waves than there are."""
    found = []
    for seed in range(6):
        op, voxels, x, noise = drawn(seed, length=3e-6)
        op = op.on_torus() if whole else op
        rows, columns = op.range.shape[:2]
        signal = op.forward(x) + noise[:rows, :columns]
        measurement = Measurement(signal=signal, read_variance=1.0)
        problem = Problem(op, measurement, voxels)
        lattice = lattice_of(op.torus, voxels)
        fitted = fit_prior(problem, lattice, class_variance(problem), 0.0, None)
        found.append([fitted.length, fitted.variance, fitted.noise])
    length, variance, noise = np.median(found, axis=0)
    assert least < length < 3.6e-6
    assert 0.6 < variance < 1.6
    assert noise == pytest.approx(0.03**2, rel=0.15)


def test_the_whole_estimate_beats_independent_voxels():
    errors = []
    for seed in range(4):
        op, voxels, x, noise = drawn(seed, length=4e-6, noise=0.1, mean=5.0)
        measurement = Measurement(
            signal=op.forward(x) + noise[:6, :7] + 2, read_variance=0.01, background=2.0
        )
        problem = Problem(op, measurement, voxels)
        truth = problem.inside(x)
        smooth, white = lmmse(problem), lmmse(problem, white=True)
        assert white.prior.correlation_length == 0 and white.method == "tikhonov"
        inner = slice(None), slice(2, -2), slice(2, -2)
        errors.append([np.linalg.norm((v.value - truth)[inner]) for v in (smooth, white)])
        assert 4 < smooth.prior.mean < 6 and smooth.background == 2
    assert np.all(np.mean(errors, axis=0) @ [1, -0.95] < 0)


def test_bars_follow_a_specimen_that_is_no_gaussian():
    op, voxels, x, noise = drawn(0)
    x = np.zeros_like(x)
    x[3, 3] = 5
    problem = Problem(
        op, Measurement(signal=op.forward(x) + noise[:6, :7], read_variance=1e-3), voxels
    )
    volume = lmmse(problem)
    on = problem.inside(x) > 0
    assert volume.sigma[on].mean() > 2 * volume.sigma[~on].mean()


def test_single_precision_is_enough():
    single, double = small(True, dtype=np.float32), small(True)
    x, y = (conditional_mean(p, gain_for(p), 0.0, NOISE)[0] for p in (single, double))
    assert x.dtype == np.float32
    np.testing.assert_allclose(x, y, atol=1e-4 * np.abs(y).max())


@pytest.mark.parametrize("gain", [0.0, 0.02])
def test_a_pixel_without_light_is_as_good_as_none(gain):
    op, voxels, x, noise = drawn(1, mean=4.0)
    parts, found = volumes.kernels(3, 4, 25), []
    signal = op.forward(x) + noise[:6, :7]
    usable = np.random.default_rng(0).random((6, 7)) > 0.1
    kept = np.arange(25) != 7
    for dark in (True, False):
        chosen = kept if not dark else np.ones(25, bool)
        some = [((blocks * kept[:, None])[:, chosen], o) for blocks, o in parts]
        measurement = Measurement(
            signal=np.where(usable[..., None], signal[..., chosen], np.nan),
            read_variance=0.03**2,
            gain=gain,
        )
        op = BlockCirculant(some, (6, 7), (8, 9))
        found.append(lmmse(Problem(op, measurement, voxels, hold_out=0.0)))
    assert found[0].held_out is None and np.isnan(found[0].trace[0].misfit)
    assert found[0].prior.correlation_length == pytest.approx(found[1].prior.correlation_length)
    np.testing.assert_allclose(found[0].value, found[1].value, atol=1e-6)
    np.testing.assert_allclose(found[0].sigma, found[1].sigma, rtol=1e-6)
