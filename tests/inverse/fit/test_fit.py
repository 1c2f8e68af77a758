"""A camera fitted to captures that another one made, of pictures unlike those of training."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from skimage import data

from plenocli.base.errors import InputError
from plenocli.base.progress import collected_notes
from plenocli.base.tiling import to_blocks
from plenocli.files.config.camera_file import parse_camera, to_toml
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.fit import fit as fit_module
from plenocli.inverse.fit.captures import tell_rotation
from plenocli.inverse.fit.fit import accepted_ratios, believed_ratio, fit_camera
from plenocli.inverse.fit.optics import CameraFamily, all_parameters
from plenocli.inverse.fit.problem import CapturedLenslets
from tests.forward.propagation.cameras import WAVELENGTH, accuracy, small_camera

CAMERA = small_camera(
    object__samples_per_lenslet=(10, 10),
    sensor__pixels_per_lenslet=(16, 16),
    lenslet_array__pitch=31.5e-6,
    lenslet_array__focal_length=256e-6,
    sensor__distance=256e-6,
)
FAMILY = CameraFamily(CAMERA, geometry(CAMERA, WAVELENGTH, (0.0, 0.0)), all_parameters(CAMERA))
TRAINING = [np.asarray(getattr(data, n)(), float) / 255 for n in ("camera", "brick", "moon")]
SNR = 50


@cache
def exact(values, finer, model="fresnel"):
    """The matrix of a forward model, of points `finer` times as fine."""
    camera = FAMILY.camera_at(np.array(values)).replace(
        **{"object.samples_per_lenslet": (10 * finer, 10 * finer)}
    )
    plan = accuracy.plan_pif(
        camera, accuracy=1e-4, model=model, superpixels=(1, 1), coherent_ring=0
    )
    shift = FAMILY.geometry_at(np.array(values)).pixel_shift
    return np.asarray(build_pif(camera, replace(plan, pixel_shift=shift)).A[0, 0], float)


def captured(values, count=6, scale=1.0, model="fresnel", corner=(60, 150), finer=2, seed=3):
    """Superpixels of a part of a photograph `finer` times as fine as it is modelled."""
    picture = np.asarray(data.coffee(), float).mean(axis=2)[corner[0] :, corner[1] :] / 255
    side = 10 * finer
    scene = to_blocks(picture[: side * count, : side * count], (side, side))
    y = scene @ exact(tuple(values), finer, model).T / finer**2
    sigma = np.sqrt(np.mean(y**2)) * 10 ** (-SNR / 20)
    noise = np.random.default_rng(seed).standard_normal(y.shape)
    return CapturedLenslets(scale * (y + sigma * noise), scale * sigma)


@cache
def fitted(kind):
    x = {
        "all": 0.2 * np.random.default_rng(8).uniform(-1, 1, 12),
        "exact": 0.1 * np.random.default_rng(9).uniform(-1, 1, 12),
        "mirrored": np.array([-0.5, 0, 0, 0, 0, 0.2, 0, 0.3, 0, 0, -0.3, 0]),
    }[kind]
    truth = FAMILY.start + x * FAMILY.tolerance
    scale = 1e-9 if kind == "all" else 1.0
    model = "exact" if kind == "exact" else "fresnel"
    capture = captured(truth, scale=scale, model=model)
    return truth, fit_camera(CAMERA, [capture], TRAINING, model=model)


@pytest.mark.parametrize("kind", ["all", "mirrored", "exact"])
def test_a_camera_is_found_from_a_photograph(kind):
    truth, fit = fitted(kind)
    right = exact(tuple(truth), 1, "exact" if kind == "exact" else "fresnel")
    start = np.linalg.norm(exact(tuple(FAMILY.start), 1) - right) / np.linalg.norm(right)
    error = np.linalg.norm(fit.matrix - right) / np.linalg.norm(right)
    assert fit.accepted, fit.why
    assert error < 0.1 * start
    assert error < 3 * fit.model_error < 0.3 * start
    assert fit.noise_ratio < 1.05 < fit.noise_ratio_before
    assert fit.turned > 1.2
    wrong = [
        p.name for p, t in zip(fit.parameters, truth) if abs(p.value - t) > 4 * p.sigma + 1e-30
    ]
    assert not wrong
    unmeasured = [p.name for p in fit.parameters if not p.measured]
    assert ("pitch", "wavelength") in fit.inseparable or "pitch" in unmeasured


def test_astigmatism_is_not_taken_for_a_defocus(monkeypatch):
    """The way from the described camera ends out of focus, where noise hides what is wrong."""
    monkeypatch.setattr(f"{__name__}.SNR", 30)
    x = np.zeros(12)
    x[FAMILY.place("astigmatism, vertical")] = -1
    truth = FAMILY.start + x * FAMILY.tolerance
    fit = fit_camera(CAMERA, [captured(truth, finer=1)], TRAINING, model="fresnel")
    right = exact(tuple(truth), 1)
    assert fit.accepted, fit.why
    assert np.linalg.norm(fit.matrix - right) < 3 * fit.model_error * np.linalg.norm(right)
    assert np.abs([(p.value - t) / p.sigma for p, t in zip(fit.parameters, truth)]).max() < 4


def test_a_camera_that_its_mirror_image_explains_as_well_is_not_accepted(monkeypatch):
    """Objects that go on from lenslet to lenslet no better than turned ones tell nothing."""
    monkeypatch.setattr(fit_module, "_border_steps", lambda *_: 1.0)
    fit = fitted.__wrapped__("all")[1]
    assert not fit.accepted and "mirror image" in fit.why and fit.turned == 1.0
    assert fit.camera == CAMERA and fit.noise_ratio < 1.05
    # where noise hides which of them it is, either will do
    monkeypatch.setattr(fit_module, "MATTERS", np.inf)
    assert fitted.__wrapped__("all")[1].accepted


def test_the_fitted_camera_is_a_camera_file_like_any_other():
    truth, fit = fitted("all")
    camera = parse_camera(to_toml(fit.camera))
    plan = accuracy.plan_pif(
        camera, accuracy=1e-4, model="fresnel", superpixels=(1, 1), coherent_ring=0
    )
    found = build_pif(camera, plan)
    A = found.A[0, 0]
    assert np.linalg.norm(A - fit.matrix) < 5e-4 * np.linalg.norm(A)
    assert found.accuracy.model_error >= fit.model_error > 0
    # what this camera's model is off by, which its defocus makes more, and what the fit left open
    unfitted = fit.camera.model_copy(update={"fitted": None})
    plain = accuracy.plan_pif(
        unfitted, accuracy=1e-4, model="fresnel", superpixels=(1, 1), coherent_ring=0
    )
    bare = float(np.hypot(plain.model_error, fit.model_error))
    assert abs(found.accuracy.model_error - bare) < 1e-3 * bare
    values = tuple(p.value for p in fit.parameters)
    right, paraxial = exact(values, 1, "exact"), exact(values, 1)
    off = np.linalg.norm(right - paraxial, axis=0) / np.linalg.norm(right, axis=0)
    assert off.max() < plain.model_error < 2 * off.max()


def test_several_captures_tell_more_than_one():
    """Standard deviations fall about as with the root of the number, and the truth stays within."""
    truth, _ = fitted("all")
    corners = ((60, 150), (120, 150), (60, 210))
    captures = [captured(truth, corner=c, finer=1, seed=k) for k, c in enumerate(corners)]
    one, three = (
        fit_camera(CAMERA, c, TRAINING, model="fresnel") for c in (captures[:1], captures)
    )
    assert three.accepted and three.lenslets == 3 * one.lenslets == 108
    measured = [i for i, p in enumerate(one.parameters) if p.sigma < 0.1 * p.tolerance]
    ratio = [three.parameters[i].sigma / one.parameters[i].sigma for i in measured]
    assert len(measured) > 6 and 0.4 < np.mean(ratio) < 0.8 and max(ratio) < 1
    assert np.abs([(p.value - t) / p.sigma for p, t in zip(three.parameters, truth)]).max() < 4
    right = exact(tuple(truth), 1)
    assert np.linalg.norm(three.matrix - right) < np.linalg.norm(one.matrix - right)


@pytest.mark.parametrize("what", ["dead and hot", "saturated"])
def test_defective_and_saturated_pixels_count_for_nothing(what):
    """The camera is found as if they did not exist, though the described one tells them badly."""
    truth, _ = fitted("all")
    whole = captured(truth)
    y, clipped = whole.y.copy(), None
    if what == "saturated":
        limit = np.quantile(y, 0.98)
        clipped, y = y >= limit, np.minimum(y, limit)
    else:
        lost = np.random.default_rng(5).random(y.shape)
        y[lost < 0.005], y[lost > 0.999] = 0.0, 1.2 * y.max()
    fit = fit_camera(CAMERA, [CapturedLenslets(y, whole.sigma, clipped)], TRAINING, model="fresnel")
    right = exact(tuple(truth), 1)
    assert fit.accepted, fit.why
    assert np.linalg.norm(fit.matrix - right) < 3 * fit.model_error * np.linalg.norm(right)
    assert np.abs([(p.value - t) / p.sigma for p, t in zip(fit.parameters, truth)]).max() < 4


def test_a_fit_that_cannot_be_says_so_and_changes_nothing():
    rng = np.random.default_rng(1)
    noise = CapturedLenslets(rng.random((2, 2, 256)), 1e-2)
    fit = fit_camera(CAMERA, [noise], TRAINING, parameters=all_parameters(CAMERA)[:3])
    assert not fit.accepted
    assert fit.camera == CAMERA
    described = exact(tuple(FAMILY.start), 1, "exact")
    assert np.linalg.norm(fit.matrix - described) < 0.02 * np.linalg.norm(described)
    assert "noise" in fit.why


@pytest.mark.parametrize(
    "capture",
    [CapturedLenslets(np.zeros((2, 2, 256)), 1.0), CapturedLenslets(np.ones((2, 2, 256)), 0.0)],
)
def test_captures_without_light_or_noise_are_refused(capture):
    with pytest.raises(InputError):
        fit_camera(CAMERA, [capture], TRAINING)


def test_few_pixels_and_quiet_captures_may_look_noisier():
    near, far = accepted_ratios(100, 1.0)
    assert 1.2 < near < far < near + 0.01
    near, far = accepted_ratios(10**6, 1000.0)
    assert 1.005 < near < 1.01 < 1.02 < far < 1.15


def test_what_is_left_over_is_believed_as_far_as_pictures_go_on():
    limits = 1.01, 1.09
    believed = [believed_ratio(limits, turned) for turned in (None, 0.5, 1.0, 1.5, 3.3, 4.0, 20.0)]
    assert believed == sorted(believed)
    assert believed[:3] == [1.01] * 3 and believed[-2:] == [pytest.approx(1.09)] * 2
    # where a mirrored camera does all but as well, little; the draw that was refused left 1.0128
    assert believed[3] < 1.02 and 1.05 < believed[4] < 1.08


def test_a_grid_that_is_turned_is_said():
    with collected_notes() as notes:
        tell_rotation(np.degrees(2e-4), (52, 52))
        assert not notes
        tell_rotation(np.degrees(-1e-3), (52, 52))
    assert "-1 mrad" in notes[0] and "0.037 px" in notes[0]
