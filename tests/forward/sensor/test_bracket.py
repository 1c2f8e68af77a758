"""Exposure brackets of sensors whose light is known."""

import numpy as np
import pytest

from plenocli.forward.sensor.bracket import linearity, merge_bracket

TIMES = [0.01, 0.1, 1.0]


def shots(rate, black=0.0, bend=0.0):
    """What an 8-bit converter that cuts off reads of light `rate` DN/s at TIMES,
    saturation included.
    """
    return [
        np.clip(np.floor(rate * t - bend * (rate * t) ** 2 / 255 + black), 0, 255).astype(np.uint8)
        for t in TIMES
    ]


def test_every_level_from_dark_to_bright_comes_back_from_the_exposures_that_show_it():
    rate = np.geomspace(8, 20000, 4000).reshape(40, 100)
    found = merge_bracket(shots(rate), TIMES, [0.0] * 3, 255.0)
    assert np.abs(found / rate - 1).max() < 0.13  # one digit of four at worst
    bright = rate > 50
    assert (
        np.abs((found / rate - 1)[bright]).max() < 0.025
        and abs((found / rate - 1)[bright].mean()) < 5e-4
    )


def test_weights_are_the_exposure_times():
    frames = [np.full((1, 1), 10), np.full((1, 1), 130)]
    assert merge_bracket(frames, [0.1, 1.0], [1.0, 4.0], 255.0, truncated=False)[
        0, 0
    ] == pytest.approx((9 + 126) / 1.1)
    assert merge_bracket(frames, [0.1, 1.0], [1.0, 4.0], 255.0)[0, 0] == pytest.approx(
        (9.5 + 126.5) / 1.1
    )
    # the longer one saturates
    assert merge_bracket(frames, [0.1, 1.0], [1.0, 4.0], 130.0, truncated=False)[
        0, 0
    ] == pytest.approx(90)


def test_pixels_beyond_the_range_are_dim_or_unknown():
    rate = np.array([[1.5, 1e5]])
    found = merge_bracket(shots(rate), TIMES, [0.0] * 3, 255.0)
    # 1 DN read in 1 s, half a digit added
    assert found[0, 0] == pytest.approx(1.5) and np.isnan(found[0, 1])


def test_linearity_sees_a_bent_sensor_and_passes_a_straight_one():
    labels = np.repeat([0, 1, 2], 400).reshape(3, 400)
    rng = np.random.default_rng(0)
    rate = np.array([100.0, 230.0, 2100.0])[:, None] * rng.uniform(0.95, 1.05, (3, 400))
    found = linearity(shots(rate, 0.5), TIMES, [0.0] * 3, labels, 255.0)
    assert [f[:3] for f in found] == [(1, 0.1, 1.0), (2, 0.01, 0.1)]
    assert all(f[3] == pytest.approx(1, abs=0.005) for f in found)
    bent = linearity(shots(rate, 0.5, bend=0.1), TIMES, [0.0] * 3, labels, 255.0)
    assert all(
        f[3] == pytest.approx((1 - 0.1 * r / 255) / (1 - 0.1 * r / 2550), abs=0.005)
        for f, r in zip(bent, (230, 210))
    )
