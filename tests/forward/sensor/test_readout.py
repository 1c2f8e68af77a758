"""Superpixels cut from a mosaic as light: the same as the whole mosaic worked out first."""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.forward.sensor.frames import Dark, saturated, tiled
from plenocli.forward.sensor.readout import DarkWindows, Readout
from plenocli.forward.sensor.superpixel import extract

SHAPE, WINDOW, BLACK = (60, 70), (9, 8), np.array([[100.0, 102.0], [98.0, 101.0]])
# the last two are not wholly on the sensor
ORIGIN = np.array([[0, 0], [3, 11], [51, 62], [20, 7], [-1, 5], [52, 0]])


def mosaic(seed=0):
    return np.random.default_rng(seed).integers(90, 4096, SHAPE).astype(np.uint16)


def whole(readout):
    light = (
        np.asarray(readout.values, np.float32) - readout.dark.at(readout.exposure_s)
    ) * np.float32(readout.scale) - np.float32(readout.offset)
    return np.where(saturated(readout.values, readout.black, readout.white), np.nan, light)


@pytest.mark.parametrize("seconds", [None, 0.1, 0.4])
@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.parametrize("black", [BLACK, np.full((2, 2), 100.0)])
def test_windows_hold_what_the_whole_mosaic_holds(seconds, flat, black):
    level = tiled(black, SHAPE)
    noise = 0 if flat else np.random.default_rng(1).normal(0, 2, SHAPE).astype(np.float32)
    dark = Dark(mean=level + noise, black=black, exposure=0.1, sigma=2.0)
    assert dark.flat == flat
    readout = (
        Readout(
            values=mosaic(), dark=dark, exposure_s=seconds, black=black, white=4095.0, scale=0.25
        )
        - 3.0
    )
    np.testing.assert_allclose(
        readout.cut(ORIGIN, WINDOW), extract(whole(readout), ORIGIN, WINDOW), rtol=1e-6, atol=1e-4
    )
    np.testing.assert_array_equal(
        extract(readout, ORIGIN.reshape(2, 3, 2), WINDOW),
        readout.cut(ORIGIN, WINDOW).reshape(2, 3, -1),
    )
    assert np.isnan(readout.cut(ORIGIN, WINDOW)).any(axis=-1)[:4].any()  # saturated pixels


def test_levels_cut_before_change_nothing():
    dark = Dark(
        mean=tiled(BLACK, SHAPE) + np.random.default_rng(1).normal(0, 2, SHAPE).astype(np.float32),
        black=BLACK,
        exposure=None,
        sigma=2.0,
    )
    origin = ORIGIN[:4]
    plain = Readout(values=mosaic(), dark=dark, exposure_s=None, black=BLACK, white=np.inf)
    ready = replace(plain, ready=DarkWindows(dark, origin, WINDOW).keep())
    np.testing.assert_array_equal(ready.cut(origin, WINDOW), plain.cut(origin, WINDOW))
    np.testing.assert_array_equal(ready.cut(origin + 1, WINDOW), plain.cut(origin + 1, WINDOW))
    np.testing.assert_array_equal(
        ready.cutter(origin, WINDOW)(np.array([2, 0])), plain.cut(origin[[2, 0]], WINDOW)
    )
