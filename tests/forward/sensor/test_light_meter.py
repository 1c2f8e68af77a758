"""Captures that show nothing, or too much, are told."""

import numpy as np
import pytest

from plenocli.forward.sensor.light_meter import Light

SHAPE = (60, 70)


def noise(seed=0):
    return np.random.default_rng(seed).normal(0, 3.0, SHAPE)


def told(light, clipped=None):
    return Light.of([(light, clipped)]).told() or ""


def test_parts_count_as_the_whole():
    light = 40 + noise()
    light[3, 4], clipped = np.nan, light > 45
    found = Light.of((light[rows], clipped[rows]) for rows in (slice(7), slice(7, 60)))
    assert found.pixels == light.size - 1 and found.saturated == clipped.sum() / found.pixels
    np.testing.assert_allclose(
        [found.mean, found.spread, found.least, found.most],
        [np.nanmean(light), np.nanstd(light), np.nanmin(light), np.nanmax(light)],
    )


def test_neither_light_nor_detail():
    for level in (0.0, 7.0, -3.0):
        assert f"every pixel shows {level:.4g}" in told(np.full(SHAPE, level))
    # about the black level, or below it: a dark frame
    for light in (noise(), noise() - 20):
        assert "no light" in told(light)


@pytest.mark.parametrize("seed", range(20))
def test_faint_light_counts(seed):
    """A fifth of the noise is 13 standard errors of 4,200 pixels, noise alone less than five."""
    assert told(0.6 + noise(seed)) == ""
    assert told(noise(seed)) != ""


def test_saturation_comes_first():
    over = np.zeros(SHAPE, bool)
    over[:6] = True
    assert "10.00% of the pixels are saturated" in told(np.full(SHAPE, 100.0), over)
    over[:] = False
    assert told(40 + noise(), over) == ""
    over[0, 0] = True  # one of 4,200 counts, one hot pixel of 42,000 does not
    assert "saturated" in told(40 + noise(), over)
    assert Light.of([(40 + noise(n), over & (n == 0)) for n in range(10)]).told() is None
