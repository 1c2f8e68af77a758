"""Dark, exposure and saturation handling, and the windows of superpixels, on arrays small
enough to see through.
"""

import numpy as np
import pytest

from plenocli.base.errors import ConfigError
from plenocli.forward.sensor import frames, superpixel
from plenocli.forward.sensor.cfa import cfa_map, sensitivity

BLACK = np.array([[64.0, 60.0], [66.0, 62.0]])


def test_dark_current_scales_with_time_above_the_black_level():
    level = frames.tiled(BLACK, (5, 7))
    dark = frames.make_dark([level + 10, level + 14], [2.0, 2.0], BLACK, (5, 7))
    np.testing.assert_allclose(dark.at(2.0), level + 12)
    np.testing.assert_allclose(dark.at(0.5), level + 3)
    np.testing.assert_allclose(dark.at(None), level + 12)
    np.testing.assert_allclose(frames.make_dark([], [], BLACK, (5, 7)).at(1.0), level)


def test_dark_noise_from_pairs_ignores_the_fixed_pattern():
    rng = np.random.default_rng(0)
    pattern = rng.normal(0, 20, (300, 300))
    dark = frames.make_dark(
        [64 + pattern + rng.normal(0, 3, (300, 300)) for _ in range(2)],
        [1.0, 1.0],
        np.full((2, 2), 64.0),
        (300, 300),
    )
    assert dark.sigma == pytest.approx(3, rel=0.03)


def test_merge_is_exposure_weighted_and_leaves_saturation_out():
    rate = np.array([[100.0, 5000.0, 60000.0, 900000.0]])
    times = [0.1, 0.01]
    dark = frames.make_dark([], [], np.full((2, 2), 10.0), rate.shape)
    shots = [np.minimum(10 + rate * t, 4095) for t in times]
    signal, weight = frames.merge(shots, times, dark, 4095.0, 0.1)
    np.testing.assert_allclose(signal[0, :3], rate[0, :3] * 0.1, rtol=1e-5)
    assert np.isnan(signal[0, 3])
    np.testing.assert_allclose(weight[0], [1.1, 1.1, 0.1, 0.0], rtol=1e-6)


def test_merge_without_exposure_times_is_the_mean():
    dark = frames.make_dark([], [], np.zeros((2, 2)), (2, 3))
    signal, _ = frames.merge(
        [np.full((2, 3), 4.0), np.full((2, 3), 6.0)], [None, None], dark, np.inf, None
    )
    np.testing.assert_allclose(signal, 5.0)


def test_bad_pixels_are_found_and_spots_are_not():
    y, x = np.indices((120, 120))
    white = 1000 * np.exp(-((y % 12 - 6) ** 2 + (x % 12 - 6) ** 2) / 18.0) + np.random.default_rng(
        1
    ).normal(0, 5, (120, 120))
    white[30, 30], white[6, 54] = 0.0, 0.0
    dark = frames.make_dark(
        [np.random.default_rng(2).normal(64, 3, (120, 120))],
        [1.0],
        np.full((2, 2), 64.0),
        (120, 120),
    )
    dark.mean[77, 5] = 900
    bad = frames.bad_pixels(white, dark, 4095.0, 1)
    assert bad[30, 30] and bad[6, 54] and bad[77, 5] and bad.sum() == 3


def test_windows_start_at_whole_pixels_around_centres():
    centres = np.array([[[25.5, 25.5], [25.9, 77.7]], [[77.5, np.nan], [2.0, 3.0]]])
    np.testing.assert_array_equal(superpixel.windows(centres, (52, 52))[0], [[0, 0], [0, 52]])
    np.testing.assert_array_equal(superpixel.windows(np.array([[[2.0, 3.2]]]), (5, 3)), [[[0, 2]]])
    origin = superpixel.windows(centres, (52, 52))
    np.testing.assert_array_equal(
        superpixel.inside(origin, (52, 52), (104, 104)), [[True, True], [False, False]]
    )


def test_extract_cuts_what_slicing_cuts_and_marks_what_is_outside():
    mosaic = np.arange(200.0).reshape(10, 20)
    origin = np.array([[[0, 0], [3, 4]], [[8, 0], [-1, 2]]])
    cells = superpixel.extract(mosaic, origin, (4, 5))
    np.testing.assert_array_equal(cells[0, 1], mosaic[3:7, 4:9].ravel())
    np.testing.assert_array_equal(cells[0, 0], mosaic[:4, :5].ravel())
    assert np.isnan(cells[1]).all()
    assert superpixel.extract(mosaic.astype(np.uint16), origin, (4, 5)).dtype == float


def test_colour_letters_by_position():
    np.testing.assert_array_equal(
        cfa_map((3, 4), "GBRG"), [list("GBGB"), list("RGRG"), list("GBGB")]
    )
    np.testing.assert_array_equal(cfa_map((2, 2), "RGGB", origin=(1, 0)), [list("GB"), list("RG")])
    assert (cfa_map((2, 2), "mono") == "Y").all()
    with pytest.raises(ConfigError):
        cfa_map((2, 2), "RGB")


class _Sensor:
    def __init__(self, **values):
        self.__dict__.update(values)


def test_sensitivity_by_colour():
    def camera(**values):
        return _Sensor(sensor=_Sensor(**values))

    letters, efficiency = sensitivity(
        camera(cfa="mono", camera=None, quantum_efficiency=0.55), [450e-9, 550e-9]
    )
    assert letters == ("Y",) and efficiency.tolist() == [[0.55, 0.55]]
    letters, efficiency = sensitivity(
        camera(cfa="RGGB", camera="Nikon 5100 (NPL)", quantum_efficiency=0.5),
        [450e-9, 540e-9, 610e-9],
    )
    assert letters == ("R", "G", "B") and efficiency.shape == (3, 3)
    assert efficiency.argmax(axis=0).tolist() == [2, 1, 0] and efficiency.max() <= 0.5
