"""What is told to be wrong with a camera whose captures another camera made."""

import re

import numpy as np
import pytest

from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.fit.causes import coarse_points, likeliest_cause, without_neighbours
from plenocli.inverse.fit.problem import CapturedLenslets
from tests.forward.propagation.cameras import WAVELENGTH, accuracy
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


def test_neighbours_light_is_that_of_even_lenslets():
    """Which is taken away to the accuracy it is asked in; an isolated capture at the same noise
    keeps its parameters' names.
    """
    plan = accuracy.plan_pif(CAMERA, superpixels=(3, 3), accuracy=1e-3)
    built = build_pif(CAMERA, plan)
    level = 0.5 + 0.1 * np.arange(25.0).reshape(5, 5)
    wide, seen = np.pad(level, 1, mode="edge"), np.zeros((5, 5, 256))
    for block, (r, c) in zip(built.A[0].sum(axis=2), built.lenslet_offset):
        seen += wide[1 - r : 6 - r, 1 - c : 6 - c, None] * block
    own = built.A[0][[not any(o) for o in built.lenslet_offset]][0].sum(axis=1)
    alone = without_neighbours(CAMERA, CapturedLenslets(seen, 1e-3)).y
    beside = seen - level[..., None] * own
    assert np.abs(beside).max() > 0.02 * own.max()
    left = alone - level[..., None] * own
    assert np.linalg.norm(left[1:-1, 1:-1]) < 0.3 * np.linalg.norm(beside[1:-1, 1:-1])
    assert without_neighbours(CAMERA, CapturedLenslets(seen, 100.0)) is None
