"""Planes of a scene's depth: interpolated columns against those computed at their own distance."""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.forward.accuracy.depth_planes import (
    depth_planes,
    left_for_planes,
    plane_camera,
    plane_weights,
)
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import small_camera

WAVELENGTH = 550e-9
POINTS = np.array([0, 4, 27])


def columns(camera, distance):
    """Columns (superpixel, pixel, point) at a distance, far finer than planes are apart."""
    camera = plane_camera(camera, distance)
    plan = plan_pif(
        camera, superpixels=(5, 5), coherent_ring=0, model="fresnel", accuracy=1e-6, dtype="float64"
    )
    return PifBuilder(camera, WAVELENGTH, plan, dtype="float64").columns(POINTS)


def worst_between(camera, planes):
    """Largest relative error of a column anywhere between planes, and the error of half of them."""
    rng = np.random.default_rng(len(planes.distances))
    stored = [columns(camera, d) for d in planes.distances]
    near, far = planes.depth
    ends = () if len(stored) > 1 else (near, far)
    errors = []
    for inverse in (*(1 / d for d in ends), *rng.uniform(1 / far, 1 / near, 12)):
        used, weights = plane_weights(planes.distances, 1 / inverse)
        mixed = sum(w * stored[n] for n, w in zip(used, weights))
        truth = columns(camera, 1 / inverse)
        error = np.linalg.norm(mixed - truth, axis=(0, 1))
        errors.append((error / np.linalg.norm(truth, axis=(0, 1))).max())
    return max(errors)


@pytest.mark.parametrize(
    "pupil", [{}, {"main_lens__aperture_shape": "square"}, {"main_lens__aperture_diameter": 4e-3}]
)
@pytest.mark.parametrize("accuracy", [0.2, 2e-2, 2e-3])
@pytest.mark.parametrize("depth", [(0.549, 0.5512), (0.54, 0.56)])
def test_interpolation_is_as_exact_as_it_says(depth, accuracy, pupil):
    camera = small_camera(**pupil)
    planes = depth_planes(camera, WAVELENGTH, depth, accuracy)
    worst = worst_between(camera, planes)
    assert planes.error <= accuracy / 2
    assert planes.error / 12 < worst < 1.05 * planes.error


def test_fewer_planes_do_not_reach_it():
    """Half of the planes are off by more than what was asked for."""
    camera = small_camera()
    planes = depth_planes(camera, WAVELENGTH, (0.54, 0.56), 2e-3)
    few = np.linspace(1 / 0.54, 1 / 0.56, len(planes.distances) // 2)
    coarse = type(planes)(distances=tuple(1 / few), depth=planes.depth, error=0.0)
    assert worst_between(camera, coarse) > 2e-3


def test_far_planes_and_planes_without_depth_are_one():
    camera = small_camera()
    far = depth_planes(camera, WAVELENGTH, (1e5, 1e6), 1e-2)
    assert len(far.distances) == 1 and 1e5 < far.distances[0] < 1e6 and 0 < far.error < 5e-3
    one = depth_planes(camera, WAVELENGTH, (2.0, 2.0), 1e-8)
    assert one.distances == (2.0,) and one.error == 0
    assert plane_weights(one.distances, 2.0)[1] == pytest.approx([1])


def test_planes_grow_with_depth_and_accuracy_and_are_refused_beyond_reason():
    camera = small_camera()
    counts = [
        [len(depth_planes(camera, WAVELENGTH, (0.55, z), a).distances) for a in (0.1, 1e-2, 1e-3)]
        for z in (0.5501, 0.56, 0.6)
    ]
    assert (np.diff(counts, axis=0) >= 0).all() and (np.diff(counts, axis=1) >= 0).all()
    assert counts[0][0] == 1 and counts[-1][-1] > 15
    with pytest.raises(NumericsError, match="takes .* planes"):
        depth_planes(camera, WAVELENGTH, (0.1, 10.0), 1e-6)
    with pytest.raises(ConfigError, match="depth 0.0001 m"):
        plane_camera(camera, 1e-4)


def test_planes_keep_the_rest_of_the_accuracy():
    assert np.hypot(left_for_planes(1e-3), 0.5e-3) == pytest.approx(1e-3)
