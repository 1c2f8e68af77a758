"""Richardson-Lucy keeps the light, climbs, stops, and finds what it should."""

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from plenocli.inverse.volume.richardson_lucy import iterate, richardson_lucy
from tests.reference import volumes

VOXELS = Voxels((2, 2), 1e-6, (-1e-6, 1e-6))


def seen(hold_out=0.05, noise=0.01, background=0.0, gain=0.0, mask=0.0, seed=0):
    rng = np.random.default_rng(seed)
    op = BlockCirculant(volumes.kernels(2, 4, 9), (6, 7), (8, 9))
    x = rng.random(op.domain.shape) ** 8
    light = op.forward(x)
    signal = light + background + noise * rng.standard_normal(light.shape)
    measurement = Measurement(
        signal=np.where(rng.random(light.shape) >= mask, signal, np.nan),
        read_variance=noise**2,
        gain=gain,
        background=background,
    )
    return Problem(op, measurement, VOXELS, hold_out=hold_out, seed=seed), x


@pytest.mark.parametrize("iterations", [2, 3, 10])
def test_light_is_kept(iterations):
    problem, _ = seen(hold_out=0, noise=0, mask=0.1)
    x = iterate(problem, iterations, accelerated=False).x
    through = np.sum(problem.op.adjoint(problem.counts.astype(float)) * x)
    assert through == pytest.approx(problem.signal[problem.counts].sum(), rel=1e-9)


@pytest.mark.parametrize("accelerated", [False, True])
@pytest.mark.parametrize("gain", [0.0, 1e-3])
def test_the_likelihood_never_falls(accelerated, gain):
    problem, _ = seen(hold_out=0, background=0.02, gain=gain)
    likelihoods = np.array(iterate(problem, 60, accelerated).likelihoods)
    assert len(likelihoods) == 60
    assert np.all(np.diff(likelihoods) >= -1e-10 * np.abs(likelihoods[-1]))


def test_one_step_is_the_textbook_one():
    problem, _ = seen(hold_out=0, noise=0, background=0.1)
    a = volumes.matrix(volumes.kernels(2, 4, 9), (6, 7), (8, 9))
    x = iterate(problem, 1, accelerated=False).x.ravel()
    y = problem.measurement.signal.ravel()
    light = a.sum(axis=0)
    seen_at_all = light > 1e-2
    expected = x * (a.T @ (y / (a @ x + 0.1))) / np.where(seen_at_all, light, 1)
    found = iterate(problem, 2, accelerated=False).x.ravel()
    np.testing.assert_allclose(found[seen_at_all], expected[seen_at_all], rtol=1e-9)


def test_acceleration_gets_farther_in_as_many_steps():
    problem, _ = seen(hold_out=0, noise=0)
    plain, fast = (iterate(problem, 25, a).likelihoods for a in (False, True))
    longer = iterate(problem, 75, False).likelihoods
    assert fast[-1] > plain[-1] and fast[-1] > longer[-1]


def test_it_stops_by_pixels_that_were_put_aside():
    problem, x = seen(noise=0.1)
    volume = richardson_lucy(problem, 2000)
    assert len(volume.trace) < 500
    best = min(trial.misfit for trial in volume.trace)
    error = np.mean((volume.held_out.measured - volume.held_out.predicted) ** 2)
    assert best == pytest.approx(error / np.var(volume.held_out.measured), rel=1e-6)
    assert volume.value.shape == (2, 12, 14) and np.all(volume.value >= 0)
    assert volume.sigma is None and volume.method == "rl" and volume.margin == problem.margin


def test_the_specimen_is_found_without_noise():
    problem, x = seen(noise=0, hold_out=0)
    volume = richardson_lucy(problem, 400)
    truth = problem.inside(x)[:, 2:-2, 2:-2]
    found = volume.value[:, 2:-2, 2:-2]
    assert np.linalg.norm(found - truth) < 0.1 * np.linalg.norm(truth)


def test_memory_is_asked_for():
    problem, _ = seen()
    with within(Budget(1 << 10)), pytest.raises(NumericsError, match="mem-limit"):
        richardson_lucy(problem)
