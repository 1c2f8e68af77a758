"""The matrix that a fit works with: the same as the one that plenocli makes, and derivatives that
finite differences confirm.
"""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import UsageError
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.fit.lenslet import LensletFamily
from plenocli.inverse.fit.optics import (
    CameraFamily,
    all_parameters,
    require_fittable,
)
from tests.forward.propagation.cameras import WAVELENGTH, accuracy, small_camera

RANDOM = np.random.default_rng(20)
PLACE = RANDOM.uniform(-1, 1, 12)


def family(**changes):
    camera = small_camera(**changes)
    return CameraFamily(camera, geometry(camera, WAVELENGTH, (0.0, 0.0)), all_parameters(camera))


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"main_lens__aperture_shape": "annulus", "main_lens__obscuration": 0.3},
        {"main_lens__aperture_shape": "square", "lenslet_array__fill_factor": 0.8},
        {
            "main_lens__aberrations": (
                {"noll": 7, "coefficient": 3e-8},
                {"noll": 9, "coefficient": 4e-8},
            )
        },
    ],
)
def test_the_matrix_is_that_of_the_forward_model(changes):
    cameras = family(**changes)
    values = cameras.start + 0.5 * cameras.tolerance * PLACE
    found = LensletFamily(cameras, double=True).at(values).matrix
    camera = cameras.camera_at(values)
    plan = accuracy.plan_pif(
        camera, accuracy=1e-6, model="fresnel", superpixels=(1, 1), coherent_ring=0
    )
    shift = cameras.geometry_at(values).pixel_shift
    told = build_pif(camera, replace(plan, pixel_shift=shift)).A[0, 0]
    assert np.linalg.norm(found - told) < 2e-5 * np.linalg.norm(told)
    single = LensletFamily(cameras).at(values).matrix
    assert np.linalg.norm(single - found) < 2e-6 * np.linalg.norm(found)


def test_one_pass_gives_all_derivatives():
    cameras = family(main_lens__aberrations=({"noll": 4, "coefficient": 4e-8},))
    lenslets = LensletFamily(cameras, double=True, tolerance=1e-9)
    values = cameras.start + 0.5 * cameras.tolerance * PLACE
    at, turn = lenslets.at(values), cameras.jacobian(values)
    slopes = np.zeros((len(turn), *at.matrix.T.shape))
    for points, part in at.slopes():
        slopes[:, points] = part
    for i, tolerance in enumerate(cameras.tolerance):
        step = np.zeros(len(values))
        step[i] = 1e-4 * tolerance
        rise = lenslets.at(values + step).matrix - lenslets.at(values - step).matrix
        told = rise.T / 2e-4
        error = np.tensordot(turn[:, i], slopes, 1) * tolerance - told
        assert np.linalg.norm(error) < 3e-4 * np.linalg.norm(told), cameras.parameters[i].name


def test_the_mirrored_camera_sees_turned_objects():
    cameras = family()
    lenslets = LensletFamily(cameras, double=True, tolerance=1e-9)
    values = cameras.start + 0.5 * cameras.tolerance * PLACE
    other = cameras.mirrored(values)
    assert abs(other - values)[3] > 0.005 * values[3]
    A, B = (lenslets.at(v).matrix for v in (values, other))
    assert np.linalg.norm(A - B[:, ::-1]) < 1e-7 * np.linalg.norm(A)
    assert np.linalg.norm(A - B) > 0.1 * np.linalg.norm(A)
    assert np.allclose(cameras.mirrored(other), values, rtol=1e-12, atol=1e-18)


def test_half_mirrored_cameras_see_objects_turned_over_along_one_axis():
    """Exactly so where everything is a product of rows and columns, and lenslets image the pupil:
    one sign of the defocus and astigmatism that change places turns rows, the other columns.
    """
    cameras = family(main_lens__aperture_shape="square")
    values, g = cameras.start.copy(), cameras.geometry
    values[cameras.place("lenslet focal length")] = 1 / (1 / g.z2 + 1 / g.z3)
    for name, far in (("focus", 0.6), ("astigmatism, vertical", 0.3), ("shift, rows", 0.2)):
        values[cameras.place(name)] += far * cameras.tolerance[cameras.place(name)]
    lenslets = LensletFamily(cameras, double=True, tolerance=1e-9)
    A = lenslets.at(values).matrix.reshape(-1, *g.object_shape)
    halves = cameras.half_mirrored(values)
    B = [lenslets.at(v).matrix.reshape(A.shape) for v in halves]
    turned = [A[:, ::-1], A[:, :, ::-1]]
    error = np.array([[np.linalg.norm(b - t) for t in turned] for b in B]) / np.linalg.norm(A)
    assert min(np.trace(error), np.trace(error[::-1])) < 2e-7
    assert np.linalg.norm(turned[0] - A) > 0.05 * np.linalg.norm(A)
    again = [cameras.half_mirrored(v) for v in halves]
    assert all(min(np.abs(v - values).max() for v in each) < 1e-12 * values.max() for each in again)


@pytest.mark.parametrize(
    "changes",
    [
        {"lenslet_array__aperture_shape": "circle"},
        {"light__wavelengths": (500e-9, 550e-9)},
    ],
)
def test_what_cannot_be_fitted_is_refused(changes):
    with pytest.raises(UsageError, match="cannot be fitted"):
        require_fittable(small_camera(**changes))
