"""Light that is the same behind all lenslets, beside a specimen that is not."""

import numpy as np
import pytest

from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume import measurement
from plenocli.inverse.volume.haze import haze, without_haze
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from plenocli.inverse.volume.richardson_lucy import richardson_lucy
from tests.reference import volumes


def seen(pattern, filled, seed=1):
    """A specimen before the middle lenslets, or all, and light of `pattern` on all."""
    rng = np.random.default_rng(seed)
    op = BlockCirculant(volumes.kernels(2, 4, 9), (10, 11), (12, 12))
    x = np.zeros(op.domain.shape)
    part = slice(0, 12) if filled else slice(4, 7)
    x[part, part] = rng.random(x[part, part].shape) ** 4
    light = op.forward(x)
    signal = light + pattern + 0.005 * rng.standard_normal(light.shape)
    measurement = Measurement(signal=signal, read_variance=2.5e-5)
    voxels = Voxels((2, 2), 1e-6, (-1e-6, 1e-6))
    return Problem(op, measurement, voxels, hold_out=0.1, seed=seed), x


def error(problem, x):
    """Of the volume, over the truth."""
    found = richardson_lucy(problem, 150).value
    return np.linalg.norm(found - problem.inside(x)) / np.linalg.norm(x)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_specimen_in_haze_is_seen_without_it(seed):
    pattern = 0.4 + 0.3 * np.random.default_rng(seed).random(9)
    problem, x = seen(pattern, filled=False, seed=seed)
    clear = without_haze(problem, haze(problem.measurement))
    assert clear.measurement.offset[0, 0] == pytest.approx(0.95 * pattern, abs=0.02)
    assert error(clear, x) < 0.6 * error(problem, x)
    assert np.array_equal(clear.held, problem.held)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_specimen_that_fills_the_field_is_not_taken_for_haze_at_a_loss(seed):
    problem, x = seen(0.0, filled=True, seed=seed)
    assert error(without_haze(problem, haze(problem.measurement)), x) < 1.05 * error(problem, x)


def test_haze_is_the_light_of_lenslets_without_a_specimen():
    rng = np.random.default_rng(3)
    pattern = 1 + 0.3 * np.cos(np.arange(9))
    signal = np.tile(pattern, (8, 8, 1)) + rng.normal(0, 0.01, (8, 8, 9))
    signal[2:5, 2:5] += 3
    found = haze(Measurement(signal=signal, read_variance=1e-4))
    assert found == pytest.approx(0.95 * pattern, abs=0.03)


def test_pixels_that_count_behind_no_lenslet_hide_no_haze():
    signal = np.tile(np.arange(1.0, 5.0), (6, 6, 1))
    signal[..., 0] = signal[2, 3] = np.nan
    found = haze(Measurement(signal=signal, read_variance=0.0))
    assert found == pytest.approx(0.95 * np.array([0.0, 2.0, 3.0, 4.0]))


def test_haze_in_bands_is_that_of_one_sort_of_all_lenslets(monkeypatch):
    """Written out for all at once."""
    rng = np.random.default_rng(9)
    signal = rng.gamma(2.0, 1.0, (23, 11, 1)) * (1 + 0.3 * rng.random((23, 11, 7)))
    signal[rng.random(signal.shape) < 0.03] = np.nan
    signal[..., 6] = np.nan
    monkeypatch.setattr(measurement, "AT_ONCE", 200)
    found = haze(Measurement(signal=signal, read_variance=0.0))
    flat = signal.reshape(-1, 7)
    known = np.isfinite(flat).sum(axis=1)
    flat = flat[known >= 0.8 * known.max()]
    usual = np.nanmean(flat[:, :6], axis=0)
    seen = np.isfinite(flat[:, :6])
    level = np.nansum(flat, axis=1) / (seen * usual).sum(axis=1)
    darkest = np.argsort(level)[: int(0.05 * len(flat))]
    assert found[:6] == pytest.approx(0.95 * np.nanmean(flat[darkest, :6], axis=0))
    assert found[6] == 0


def test_too_few_lenslets_have_no_haze():
    assert not haze(Measurement(signal=np.ones((3, 3, 4)), read_variance=0.0)).any()


@pytest.mark.filterwarnings("error")
def test_a_capture_below_the_dark_level_has_no_haze():
    noise = np.random.default_rng(4).normal(-1.0, 0.1, (8, 8, 4)).astype(np.float32)
    assert not haze(Measurement(signal=noise, read_variance=1e-2)).any()
