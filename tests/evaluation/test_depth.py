import numpy as np
import pytest

from plenocli.evaluation.metrics.depth import DEFINITIONS, score_depth, sharpest
from plenocli.evaluation.metrics.figures import figures


def test_a_map_is_as_far_off_as_it_was_moved():
    slope, confidence = np.full((10, 10), 0.7), np.ones((10, 10))
    slope[:, 0], confidence[:, :2] = 99.0, 0.39  # one column is wild, two are not sure
    slope[0, 5] = np.nan
    planes = np.linspace(-1, 1, 9)
    found = score_depth(slope, confidence, 0.6, planes, 5 - (planes - 0.35) ** 2)
    assert (
        found.depth_slope_error == pytest.approx(0.1)
        and found.depth_slope_found == pytest.approx(0.7)
        and found.depth_sure_share == 0.79
    )
    assert found.sharpest_slope_error == pytest.approx(0.35 - 0.6) and set(figures(found)) <= set(
        DEFINITIONS
    )


def test_nothing_sure_is_no_number_and_an_end_is_an_end():
    assert np.isnan(
        score_depth(
            np.ones((2, 2)), np.zeros((2, 2)), 0.0, np.arange(3.0), np.array([3.0, 2.0, 1.0])
        ).depth_slope_error
    )
    assert sharpest(np.arange(3.0), np.array([3.0, 2.0, 1.0])) == 0.0
