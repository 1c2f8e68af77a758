"""Registration of captures whose lenslets moved, painted in closed form
(tests/reference/prototype.py), never interpolated.
"""

import numpy as np
import pytest

from plenocli.forward.sensor.noise import Noise
from plenocli.forward.sensor.superpixel import extract
from plenocli.inverse.registration.motion import _products, motion_since
from plenocli.inverse.registration.reference import Reference
from plenocli.inverse.registration.smooth_response import SmoothResponses, spline_matrix
from plenocli.inverse.spectra.demultiplex import demultiplex
from tests.reference.prototype import superpixels

ROWS, COLUMNS, PITCH, FRAME, ELECTRONS, GAIN, READ = 6, 8, 40, 8, 12000, 0.25, 4.0
SIZE = dict(pixels=PITCH, side=33.0, gap=1.5)
NOISE = Noise(gain=GAIN, read_variance=(GAIN * READ) ** 2 + 1 / 12)
SIX = np.array(
    [
        [0.9, 0.9, 0.9, 0.9],
        [0.03, 0.03, 0.03, 0.03],
        [0.05, 0.06, 0.08, 0.6],
        [0.1, 0.15, 0.35, 0.55],
        [0.07, 0.23, 0.18, 0.06],
        [0.25, 0.06, 0.05, 0.04],
    ]
)
COLOURS = {"R": [0.04, 0.1, 0.2, 1.0], "G": [0.4, 1.0, 0.9, 0.15], "B": [1.0, 0.3, 0.1, 0.05]}
INDEX = np.stack(np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij"), axis=-1)
ORIGIN = FRAME + PITCH * INDEX
CENTRES = ORIGIN + (PITCH - 1) / 2


def colours(cfa):
    if cfa == "mono":
        return 1.0
    tile = np.array([COLOURS[c] for c in cfa]).reshape(2, 2, 4)
    return np.tile(tile, (PITCH // 2, PITCH // 2, 1)).reshape(-1, 4)


def capture(radiance, shift, seed, *, cfa="mono", offset=0.0, exposure=1.0, frames=1, **kind):
    """Signal (rows, columns) of lenslets that each see radiance (R, C, 4), in DN at exposure 1."""
    response = superpixels(np.broadcast_to(shift, (ROWS, COLUMNS, 2)), **SIZE | kind) * colours(cfa)
    mean = ELECTRONS * exposure * np.einsum("rcpk,rck->rcp", response, radiance)
    rng = np.random.default_rng(seed)
    values = (
        np.mean(
            [
                np.rint(GAIN * (rng.poisson(mean) + rng.normal(0, READ, mean.shape)) + offset)
                for _ in range(frames)
            ],
            axis=0,
        )
        / exposure
    )
    plane = (
        values.reshape(ROWS, COLUMNS, PITCH, PITCH)
        .swapaxes(1, 2)
        .reshape(ROWS * PITCH, COLUMNS * PITCH)
    )
    return np.pad(plane, FRAME)


def calibrated(cfa="mono", **kind):
    bands = [
        capture(
            np.broadcast_to(np.eye(4)[k], (ROWS, COLUMNS, 4)),
            0.0,
            100 + k,
            cfa=cfa,
            frames=8,
            **kind,
        )
        for k in range(4)
    ]
    return np.stack([extract(band, ORIGIN, (PITCH, PITCH)) for band in bands], axis=-1)


def find_motion(signal, response, cfa="mono", noise=None):
    return motion_since(
        Reference(response, ORIGIN, (PITCH, PITCH), CENTRES, cfa, signal.shape), signal, noise
    )


@pytest.fixture(scope="module", params=["mono", "GRBG"])
def camera(request):
    return request.param, calibrated(request.param)


def error(signal, response, truth, motion=None, cfa="mono"):
    """RMS error of plain least squares, after the motion where one is given."""
    origin = ORIGIN
    if motion is not None:
        shifts = motion.at(CENTRES)
        whole = np.rint(shifts).astype(int)
        smooth = SmoothResponses(
            response.reshape(-1, PITCH * PITCH, 4), ORIGIN.reshape(-1, 2), (PITCH, PITCH), cfa
        )
        origin = ORIGIN + whole
        response = smooth.at(origin.reshape(-1, 2), (shifts - whole).reshape(-1, 2)).reshape(
            response.shape
        )
        signal = signal - motion.offset
    found, _ = demultiplex(response, extract(signal, origin, (PITCH, PITCH)))
    return np.sqrt(((found - truth) ** 2).mean())


@pytest.fixture(scope="module")
def truth():
    return SIX[np.random.default_rng(0).integers(0, 6, (ROWS, COLUMNS))]


@pytest.mark.parametrize("shift", [(0.5, 0.3), (1.0, 1.0), (-1.3, 0.6)])
def test_a_moved_array_is_found_and_costs_nothing_after_registration(camera, truth, shift):
    cfa, response = camera
    still = error(capture(truth, 0.0, 5, cfa=cfa), response, truth)
    signal = capture(truth, shift, 6, cfa=cfa)
    motion = find_motion(signal, response, cfa, NOISE)
    np.testing.assert_allclose(motion.shift, shift, atol=0.01)
    assert motion.moved and motion.after < 4 < motion.before
    assert error(signal, response, truth) > 3 * still
    assert error(signal, response, truth, motion, cfa) < 1.5 * still


def test_a_capture_that_did_not_move_is_left_alone(camera, truth):
    cfa, response = camera
    motion = find_motion(capture(truth, 0.0, 7, cfa=cfa), response, cfa, NOISE)
    assert not motion.moved and not motion.lifted and not motion.strayed
    assert motion.after == pytest.approx(1, abs=0.3)


def test_standard_deviations_of_the_motion_are_what_repeated_captures_show(truth):
    response = calibrated()
    found = [
        find_motion(
            capture(truth, 0.25, 20 + i, offset=3.0, exposure=0.1),
            response,
            "mono",
            NOISE.scaled(1 / 0.1),
        )
        for i in range(8)
    ]
    for axis in (0, 1):
        values = np.array([m.shift[axis] for m in found])
        assert 0.4 < values.std(ddof=1) / np.mean([m.sigma[axis] for m in found]) < 1.8  # 8 draws
    offsets = np.array([m.offset for m in found])
    assert offsets.mean() == pytest.approx(30, abs=3 * found[0].sigma[2])
    assert all(m.lifted for m in found) and 0.4 < offsets.std(ddof=1) / found[0].sigma[2] < 1.8


def test_rotation_and_stretch_of_the_array(truth):
    turn, stretch = 1.2e-3, 4e-4
    matrix = np.array([[stretch, -turn], [turn, stretch]])
    shifts = (CENTRES - CENTRES.mean(axis=(0, 1))) @ matrix.T
    motion = find_motion(capture(truth, shifts, 8), calibrated(), "mono", NOISE)
    np.testing.assert_allclose(motion.matrix, matrix, atol=4e-5)
    assert motion.rotation == pytest.approx(turn, rel=0.03)
    assert motion.reach == pytest.approx(np.linalg.norm(shifts, axis=-1).max(), rel=0.03)


@pytest.mark.parametrize("leak", [0.03, 0.07])
def test_a_diffuse_leak_of_another_size_is_seen_as_stray_light(truth, leak):
    response = calibrated(kind="diffuse")
    motion = find_motion(capture(truth, 0.0, 9, kind="diffuse", leak=leak), response, "mono", NOISE)
    assert motion.strayed and np.sign(motion.stray) == np.sign(leak - 0.05) and not motion.moved


def test_stray_light_below_zero_is_not_believed(truth):
    """A capture darker in the dark and as bright elsewhere, of a calibration that is dark there:
    free stray light explains it by -0.1.
    """
    from plenocli.inverse.registration.motion import _solve

    signal, response = capture(truth, 0.0, 9), calibrated()
    level = signal[FRAME:-FRAME, FRAME:-FRAME].reshape(ROWS, PITCH, COLUMNS, PITCH)
    less = 0.1 * level.mean(axis=(1, 3), keepdims=True) * np.ones_like(level)
    signal[FRAME:-FRAME, FRAME:-FRAME] -= less.reshape(ROWS * PITCH, -1)
    motion = find_motion(signal, response, "mono", NOISE)
    assert motion.stray > -0.03  # of what the gaps between the cells have
    normal, right = np.diag([1.0, 2.0, 3.0, 4.0]) + 0.2, np.array([0.3, 0.1, 0.2, -0.9])
    free, bound = _solve(normal, right)[0], _solve(normal, right, -0.01)[0]
    np.testing.assert_allclose(free, np.linalg.solve(normal, right))
    assert free[-1] < -0.2 and bound[-1] == -0.01
    rest = np.linalg.solve(normal[:3, :3], right[:3] + 0.01 * normal[:3, 3])
    np.testing.assert_allclose(bound[:3], rest)


def test_without_noise_figures_the_motion_is_found_too(truth):
    motion = find_motion(capture(truth, (0.4, -0.2), 10), calibrated())
    np.testing.assert_allclose(motion.shift, (0.4, -0.2), atol=0.01)
    assert motion.moved


def test_darkness_tells_no_motion():
    assert find_motion(np.full((ROWS * PITCH, COLUMNS * PITCH), np.nan), calibrated()) is None


def test_spline_matrices_move_polynomials_exactly_and_know_their_slope():
    x = np.arange(30.0)
    # slopes vanish at the middle only: the ends' mirror bends them
    f = ((x - 14.5) ** 2 - 14.5**2) ** 2 / 1e4
    moved = spline_matrix(30, 0.3) @ f
    exact = ((x - 14.8) ** 2 - 14.5**2) ** 2 / 1e4
    np.testing.assert_allclose(moved[12:18], exact[12:18], atol=1e-4)
    # mirror-symmetric at both ends: the spline's own boundary
    wave = np.cos(np.pi * (x + 0) / 29 * 3)
    np.testing.assert_allclose(
        spline_matrix(30, 0.4) @ wave, np.cos(np.pi * (x - 0.4) / 29 * 3), atol=3e-7
    )
    step = 1e-5
    slope = (spline_matrix(30, 0.4 + step) - spline_matrix(30, 0.4 - step)) / (2 * step)
    np.testing.assert_allclose(spline_matrix(30, 0.4, derivative=True), slope, atol=1e-8)


def test_products_with_parts_for_all_are_those_lenslet_by_lenslet():
    rng = np.random.default_rng(6)
    parts, x, weight = rng.normal(size=(1, 5, 70)), rng.normal(size=(9, 70)), rng.random((9, 70))
    weight[rng.random(weight.shape) < 0.2] = 0
    rows = np.concatenate([np.repeat(parts, 9, axis=0), np.ones((9, 1, 70)), x[:, None]], axis=1)
    expected = np.einsum("lip,ljp,lp->lij", rows, rows, weight)
    for given in (parts, np.repeat(parts, 9, axis=0)):
        np.testing.assert_allclose(_products(given, weight, x), expected, rtol=0, atol=1e-12)
