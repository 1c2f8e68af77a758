"""What limits a picture: noise or model, from records alone."""

import pytest

from plenocli.forward.accuracy.limits import what_limits

MATRIX = {"model": "fresnel", "estimated": 1e-4, "model_error": 3e-2}


def test_a_real_capture_feels_the_error_of_the_model_itself():
    found = what_limits(1e-3, MATRIX)
    assert found["limited_by"] == "model" and found["model_error"] == pytest.approx(3e-2, rel=1e-3)
    assert what_limits(0.1, MATRIX)["limited_by"] == "noise"


def test_a_simulated_capture_feels_only_the_difference():
    assert what_limits(1e-3, MATRIX, {"model": "fresnel", "estimated": 3e-4, "model_error": 3e-2})[
        "model_error"
    ] == pytest.approx(3.16e-4, rel=1e-2)
    assert (
        what_limits(1e-3, MATRIX, {"model": "exact", "estimated": 3e-4, "model_error": 0.0})[
            "limited_by"
        ]
        == "model"
    )
    same = what_limits(1e-6, MATRIX, {"model": "fresnel", "estimated": 1e-4}, same=True)
    assert same["model_error"] == 0 and same["limited_by"] == "noise"


def test_nothing_is_said_where_nothing_is_known():
    assert (
        what_limits(None, MATRIX) is None
        and what_limits(1e-3, {}) is None
        and what_limits(1e-3, {"asked": 1e-3}) is None
    )
