"""The planes of a specimen are found again by pixels put aside, and no more than it has."""

import numpy as np
import pytest

from plenocli.base.linear_maps import BlockCirculant
from plenocli.inverse.volume.choose import supported_planes
from plenocli.inverse.volume.measurement import Measurement, Problem, Voxels


def kernels(planes, seed=1):
    """Of every plane kernels of its own, four points on nine pixels of 3x3 superpixels."""
    rng = np.random.default_rng(seed)
    offsets = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return [(rng.random((9, 9, 4)) ** 6, offsets) for _ in range(planes)]


@pytest.mark.parametrize("held", [(1,), (0, 3), (1, 4)])
def test_planes_are_found_and_no_more_than_there_are(held):
    rng, parts = np.random.default_rng(5), kernels(6)
    seen = BlockCirculant([parts[i] for i in held], (9, 9), (10, 10))
    light = seen.forward(rng.random(seen.domain.shape) ** 4)
    sigma = 0.02 * light.std()
    measurement = Measurement(
        signal=light + rng.normal(0, sigma, light.shape), read_variance=sigma**2
    )

    def problem_of(planes):
        op = BlockCirculant([parts[i] for i in planes], (9, 9), (10, 10))
        depths = tuple(float(i) for i in planes)
        return Problem(op, measurement, Voxels((2, 2), 1e-6, depths), hold_out=0.1)

    chosen, trials = supported_planes(problem_of, 6, 4)
    assert tuple(chosen) == held
    assert len(trials) == len({trial.what for trial in trials}) >= 6
    assert len(supported_planes(problem_of, 6, 1)[0]) == 1
