"""What limits a picture: noise or model, from records alone."""

import json
from dataclasses import replace

import pytest

from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.accuracy.limiting_error import what_limits
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from tests.forward.propagation.cameras import small_camera

MATRIX = AccuracyRecord(model="fresnel", estimated=1e-4, model_error=3e-2)


def test_a_real_capture_feels_the_error_of_the_model_itself():
    found = what_limits(1e-3, MATRIX)
    assert found.limited_by == "model" and found.model_error == pytest.approx(3e-2, rel=1e-3)
    assert what_limits(0.1, MATRIX).limited_by == "noise"


def test_a_simulated_capture_feels_only_the_difference():
    alike = what_limits(1e-3, MATRIX, replace(MATRIX, estimated=3e-4))
    assert alike.model_error == pytest.approx(3.16e-4, rel=1e-2)
    exact = AccuracyRecord(model="exact", estimated=3e-4, model_error=0.0)
    assert what_limits(1e-3, MATRIX, exact).limited_by == "model"
    same = what_limits(1e-6, MATRIX, replace(MATRIX, model_error=None), same=True)
    assert same.model_error == 0 and same.limited_by == "noise"
    assert list(same.as_json()) == ["noise", "model_error", "limited_by", "reason"]


def test_nothing_is_said_where_nothing_is_known():
    assert what_limits(None, MATRIX) is None
    assert what_limits(1e-3, None) is None
    assert what_limits(1e-3, AccuracyRecord(asked=1e-3)) is None


def test_a_record_comes_back_from_json_as_it_went():
    record = plan_pif(small_camera(), accuracy=1e-2).accuracy_record()
    written = json.dumps(record.as_json())
    assert AccuracyRecord.from_json(json.loads(written)) == record
    assert list(record.as_json()) == [
        "asked",
        "asked_by",
        "estimated",
        "by_source",
        "model",
        "model_error",
        "field_error",
        "rung",
        "reasons",
        "left_out",
    ]
    partial = {"model": "ray", "rung": "closed form, even object"}
    assert AccuracyRecord.from_json(partial).as_json() == partial
    assert AccuracyRecord.from_json({}) is None
