"""The method is chosen by what it predicts of pixels that were put aside."""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume import choose
from plenocli.inverse.volume.choose import SOLVERS, volume_of
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels
from tests.reference import volumes

VOXELS = Voxels((2, 2), 1e-6, (-1e-6, 1e-6))


def specimen(kind, hold_out=0.1):
    rng = np.random.default_rng(4)
    op = BlockCirculant(volumes.kernels(2, 4, 9), (7, 7), (8, 8))
    if kind == "waves":
        prior = volumes.covariance((8, 8), (2, 2), 1e-6, VOXELS.depths, 4e-6)
        x = (np.linalg.cholesky(prior) @ rng.standard_normal(len(prior))).reshape(op.domain.shape)
    else:
        x = np.zeros(op.domain.shape)
        x[rng.random(x.shape) < 0.02] = 8
    light = op.forward(x)
    signal = light + 0.03 * rng.standard_normal(light.shape)
    return Problem(op, Measurement(signal=signal, read_variance=0.03**2), VOXELS, hold_out=hold_out)


@pytest.mark.parametrize("kind", ["waves", "points"])
def test_the_best_by_held_out_pixels_is_taken(kind):
    problem = specimen(kind)
    chosen = volume_of(problem)
    errors = {name: problem.misfit(predicted(problem, name)) for name in choose.COMPARED}
    assert chosen.method == min(errors, key=lambda name: errors[name])
    assert (chosen.method == "lmmse") == (kind == "waves")
    assert [trial.what for trial in chosen.trace[:3]] == list(choose.COMPARED)
    assert {t.what: t.misfit for t in chosen.trace[:3]} == pytest.approx(errors, rel=1e-9)


def predicted(problem, name):
    light = np.zeros(problem.signal.shape)
    held = SOLVERS[name](problem).held_out
    light[tuple(held.index.T)] = held.predicted
    return light


@pytest.mark.parametrize("method", sorted(SOLVERS))
def test_each_method_says_its_name(method):
    volume = volume_of(specimen("points"), method)
    assert volume.method == method and volume.value.shape == (2, 14, 14)
    assert (volume.sigma is not None) == (method in ("lmmse", "tikhonov"))
    assert volume.held_out.explained_db > 3


def test_nothing_to_choose_by_is_refused():
    with pytest.raises(NumericsError, match="held out"):
        volume_of(specimen("points", hold_out=0), "auto")
    with pytest.raises(KeyError):
        volume_of(specimen("points"), "best")
