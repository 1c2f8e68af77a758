"""What is told to be wrong with a camera whose captures another camera made."""

import re

import numpy as np
import pytest

from plenocli.forward.camera.geometry import geometry
from plenocli.inverse.fit.causes import coarse_points, likeliest_cause
from tests.forward.propagation.cameras import WAVELENGTH
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


def with_points(n):
    return CAMERA.replace(**{"object.samples_per_lenslet": (n, n)})


def test_points_that_are_too_coarse_are_named_and_not_the_camera():
    """Where points are too few the camera that a fit would find is another one."""
    cause = likeliest_cause(with_points(5), captured(FAMILY.start), TRAINING)
    assert "finer than 5 x 5 points" in cause and "fit" not in cause
    found = re.search(r"is ([\d.]+) times the noise instead of ([\d.]+) ", cause)
    after, before = map(float, found.groups())
    assert after < 1.1 < 1.3 < before


def test_points_are_not_blamed_for_another_camera():
    values = FAMILY.start.copy()
    values[NAMES.index("focus")] += 1.0 * FAMILY.tolerance[NAMES.index("focus")]
    assert "points" not in likeliest_cause(CAMERA, captured(values), TRAINING)


def test_fewer_points_than_diffraction_cells_may_be_the_cause():
    cells = geometry(CAMERA, CAMERA.light.wavelengths[0]).diffraction_cells
    few, enough = int(cells), int(np.ceil(cells))
    assert f"finer than {few} x {few} points" in coarse_points(with_points(few))
    assert f"{cells:.0f} diffraction cells" in coarse_points(with_points(few))
    assert coarse_points(with_points(enough)) is None
    # too many cells for points that would show them: nothing is measured
    wide = with_points(4).replace(**{"main_lens.aperture_diameter": 0.04})
    assert geometry(wide, WAVELENGTH).diffraction_cells > 40
    assert likeliest_cause(wide, captured(FAMILY.start), TRAINING) == coarse_points(wide)
