"""Volumes of two colours of one specimen: tied where they share structure, else left alone."""

import numpy as np
import pytest

from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from plenocli.inverse.volume.total_variation import total_variation
from tests.reference import volumes

VOXELS = Voxels((2, 2), 1e-6, (-1e-6, 1e-6))


def specimen(seed, parts=5, shape=(2, 20, 20)):
    """Boxes, one over the other."""
    rng, light = np.random.default_rng(seed), np.zeros(shape)
    for plane, row, column in rng.integers(0, [2, 15, 15], (parts, 3)):
        light[plane, row : row + 4, column : column + 5] += rng.uniform(0.5, 1)
    return light


def seen(truth, noise, seed, kernels=0):
    """What lenslets see of a specimen, through kernels of its colour."""
    parts = volumes.kernels(2, 4, 25, seed=kernels)
    op = BlockCirculant(parts, (8, 8), (10, 10))
    light = op.forward(VOXELS.lenslets(truth))
    sigma = noise * np.sqrt(np.mean(light**2))
    rng = np.random.default_rng(seed)
    signal = light + sigma * rng.standard_normal(light.shape)
    return Problem(op, Measurement(signal=signal, read_variance=sigma**2), VOXELS, hold_out=0.1)


def error(volume, truth):
    return np.linalg.norm(volume.value - truth[:, :16, :16])


@pytest.mark.parametrize("name", ["alike", "partly", "varied"])
def test_what_a_clearer_colour_shows_helps_another(name):
    """The same structure; that and another; its parts of another brightness. Other kernels."""
    clear = specimen(1)
    gradient = np.linspace(0.4, 1.6, 20)
    truth = {
        "alike": 0.6 * clear,
        "partly": 0.6 * clear + 0.4 * specimen(2, parts=2),
        "varied": 0.6 * clear * gradient,
    }[name]
    other = total_variation(seen(clear, 0.01, 3, kernels=1)).value
    problem = seen(truth, 0.3, 4)
    alone, tied = total_variation(problem), total_variation(problem, like=other)
    assert alone.likeness is None and 0.2 < tied.likeness.share < 1
    assert 0.3 < tied.likeness.factor < 0.9
    least = {"alike": 0.7, "partly": 0.85, "varied": 0.9}[name]
    assert error(tied, truth) < least * error(alone, truth)


def test_held_out_pixels_may_object(monkeypatch):
    """Then it is the volume without the other, and the trace has what was tried."""
    other = total_variation(seen(specimen(1), 0.3, 3, kernels=1)).value
    problem = seen(specimen(1), 0.01, 4)
    alone, tied = total_variation(problem), total_variation(problem, like=other)
    assert tied.likeness.factor > 0.3 and not np.array_equal(tied.value, alone.value)
    assert tied.trace[-1].misfit < tied.trace[-2].misfit
    monkeypatch.setattr("plenocli.inverse.volume.total_variation.VETO", -0.5)
    vetoed = total_variation(problem, like=other)
    assert vetoed.likeness.factor == 0 and np.array_equal(vetoed.value, alone.value)
    assert np.array_equal(vetoed.held_out.predicted, alone.held_out.predicted)
    assert [trial.what for trial in vetoed.trace] == [trial.what for trial in tied.trace]


@pytest.mark.parametrize("seed", range(4))
def test_another_structure_changes_nothing(seed):
    problem = seen(specimen(10 + seed), 0.1, 4)
    other = total_variation(seen(specimen(20 + seed), 0.01, 3)).value
    alone, tied = total_variation(problem), total_variation(problem, like=other)
    assert error(tied, specimen(10 + seed)) < 1.01 * error(alone, specimen(10 + seed))
