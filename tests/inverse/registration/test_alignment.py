"""Responses that follow a motion, against superpixels painted where they went;
patterns of stray light.
"""

import numpy as np
import pytest

from plenocli.forward.sensor.cfa import cfa_map
from plenocli.forward.sensor.frames import Dark
from plenocli.forward.sensor.superpixel import extract
from plenocli.inverse.registration.alignment import moved_with
from plenocli.inverse.registration.motion import Motion
from plenocli.inverse.registration.moved_response import WidenedResponses, even_light, widened
from plenocli.inverse.registration.reference import own_pixels
from tests.reference.calibrations import lenslet_responses
from tests.reference.prototype import superpixels

ROWS, COLUMNS, PITCH, FRAME = 3, 4, 40, 8
SHAPE = ROWS * PITCH + 2 * FRAME, COLUMNS * PITCH + 2 * FRAME
ORIGIN = FRAME + PITCH * np.stack(
    np.meshgrid(np.arange(ROWS), np.arange(COLUMNS), indexing="ij"), axis=-1
)
CENTRES = ORIGIN + (PITCH - 1) / 2.0
COLOURS = {
    "R": [0.04, 0.1, 0.2, 1.0],
    "G": [0.4, 1.0, 0.9, 0.15],
    "B": [1.0, 0.3, 0.1, 0.05],
    "Y": [1.0, 1.0, 1.0, 1.0],
}


def painted(shift, origin, cfa):
    """Response (..., pixel, 4) within windows at `origin` (..., 2) of lenslets whose light moved
    by `shift` (..., 2).
    """
    light = superpixels(
        np.asarray(shift, float) - (origin - ORIGIN[: len(origin), : origin.shape[1]]),
        pixels=PITCH,
        side=33.0,
    )
    letters = cfa_map((2, 2), cfa)
    index = (origin[..., None, :] + np.stack(np.divmod(np.arange(PITCH**2), PITCH), axis=-1)) % 2
    return (
        light
        * np.array([[COLOURS[one] for one in row] for row in letters.tolist()])[
            index[..., 0], index[..., 1]
        ]
    )


def calibration(cfa, shared):
    response = painted(np.zeros((ROWS, COLUMNS, 2)), ORIGIN, cfa).astype(np.float32)
    valid = np.ones((ROWS, COLUMNS), bool)
    valid[1, 2] = False
    dark = Dark(mean=np.zeros(SHAPE, np.float32), black=np.zeros((2, 2)), exposure=None, sigma=None)
    return lenslet_responses(
        response[0, 0] if shared else response,
        np.array([450e-9, 540e-9, 570e-9, 650e-9]),
        valid,
        origin=ORIGIN,
        window=(PITCH, PITCH),
        centres=CENTRES,
        dark=dark,
        cfa=cfa,
    )


def motion(shift, turn=0.0):
    return Motion(
        shift=np.array(shift),
        matrix=np.array([[0.0, -turn], [turn, 0.0]]),
        middle=CENTRES.mean(axis=(0, 1)),
        offset=0.0,
        stray=0.0,
        sigma=np.zeros(3),
        beyond_chance=9.0,
        stray_sigma=0.0,
        before=1.0,
        after=1.0,
        lenslets=48,
        reach=1.0,
    )


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("cfa", ["mono", "GRBG"])
@pytest.mark.parametrize("shift, turn", [((0.3, -0.2), 0.0), ((1.4, 2.0), 0.0), ((0.1, 0.6), 6e-3)])
def test_a_moved_response_is_that_of_the_moved_superpixel(shared, cfa, shift, turn):
    c, move = calibration(cfa, shared), motion(shift, turn)
    found = moved_with(c, move)
    assert found.shared == (shared and not turn)
    response = (
        np.broadcast_to(found.response, (*c.valid.shape, PITCH**2, 4))[c.sites]
        if found.shared
        else found.response[c.sites]
    )
    truth = painted(move.at(CENTRES), found.origin, cfa)[c.sites]
    known = np.isfinite(response).all(axis=-1)
    assert known.mean() > 0.75
    np.testing.assert_allclose(response[known], truth[known], rtol=0, atol=0.02)
    light = truth.sum(axis=-1)
    assert np.abs((response - truth)[known]).mean() < 0.002 * light.mean()


@pytest.mark.parametrize("cfa", ["mono", "GBRG"])
def test_stray_light_is_even_within_each_colour(cfa):
    patterns, window = even_light((17, 20), cfa), (17, 20)
    origin = np.array([[[3, 5], [4, 4]], [[2, 7], [9, 6]]])
    letters = dict.fromkeys(cfa if cfa != "mono" else "Y")
    whole = WidenedResponses(np.zeros((17 * 20, 0), np.float32), patterns, origin)[
        np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    ]
    for k, letter in enumerate(letters):
        expected = extract(
            (cfa_map((40, 40), cfa) == letter).astype(np.float32), origin, window
        ).reshape(4, -1)
        inner = own_pixels(window)
        np.testing.assert_array_equal(whole[:, inner, k], expected[:, inner])
        assert np.isnan(whole[:, ~inner, k]).all()
    sites = np.array([0, 1]), np.array([0, 0])
    one = widened(np.ones((17 * 20, 2), np.float32), patterns, np.full((2, 2, 2), 4), sites)
    assert isinstance(one, np.ndarray) and one.shape == (17 * 20, 2 + len(letters))
    many = widened(np.ones((17 * 20, 2), np.float32), patterns, origin, sites)
    assert many.ndim == 4 and many[sites].shape == (2, 17 * 20, 2 + len(letters))
