"""What is told to be wrong with a camera whose captures another camera made."""

import re

import numpy as np
import pytest

from plenocli.inverse.fit.causes import likeliest_cause
from tests.inverse.fit.test_fit import CAMERA, FAMILY, TRAINING, captured

NAMES = [p.name for p in FAMILY.parameters]


@pytest.mark.parametrize(
    "name, far",
    [("focus", 0.4), ("wavelength", 1.0), ("shift, rows", -0.4)],
)
def test_the_parameter_that_is_off_is_named(name, far):
    values = FAMILY.start.copy()
    place = NAMES.index(name)
    values[place] += far * FAMILY.tolerance[place]
    cause = likeliest_cause(CAMERA, captured(values), TRAINING)
    assert f"the {name} alone" in cause
    numbers = [float(n) for n in re.findall(r"[-+]?[0-9]*\.?[0-9]+", cause)]
    *found, after, before = numbers
    assert after < 0.9 * before
    off = found[0] if len(found) == 1 else found[0] - found[1]
    assert np.sign(off) == np.sign(far)


def test_nothing_is_named_where_nothing_is_off():
    assert likeliest_cause(CAMERA, captured(FAMILY.start), TRAINING) is None
