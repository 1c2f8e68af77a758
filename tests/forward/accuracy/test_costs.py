"""What costs are counted from: the columns that symmetry leaves, and the separable terms of
the spread function.
"""

import numpy as np
import pytest

from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.fresnel.shaped import _chord_counts, chords
from plenocli.forward.propagation.fresnel.spread_function import separable_field
from plenocli.forward.propagation.sampling import distinct, expected_terms
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import small_camera

CHANGES = {
    "plain": {},
    "odd": {"object.samples_per_lenslet": (5, 5)},
    "oblong": {"object.samples_per_lenslet": (4, 6)},
    "oblong pixels": {"sensor.pixels_per_lenslet": (8, 6)},
    "coma": {"main_lens.aberrations": ({"noll": 8, "coefficient": 30e-9},)},
}


def counted(camera, plan):
    """Columns that a builder asks its maker for: pairs of a superpixel and a point."""
    builder, asked = PifBuilder(camera, plan.bands[0].wavelength, plan), []
    original = builder._lenslets.superpixel

    def superpixel(sy, sx, rows, columns, out):
        asked.append(len(rows))
        return original(sy, sx, rows, columns, out)

    builder._lenslets.superpixel = superpixel
    builder.fill(np.empty(plan.shape[1:]))
    return sum(asked)


@pytest.mark.parametrize("superpixels", [(1, 1), (3, 3)])
@pytest.mark.parametrize("name", CHANGES)
def test_columns_left_by_symmetry_are_those_computed(name, superpixels):
    camera = small_camera().replace(**CHANGES[name])
    plan = plan_pif(camera, model="fresnel", accuracy=1e-2, superpixels=superpixels)
    assert plan.rung == "fresnel, low rank"
    _, pairs = distinct(camera, geometry(camera, plan.bands[0].wavelength), plan.shape)
    # an aberrated pupil may have one mirror left, on which the plan does not count
    assert pairs == (2 if name == "coma" else 1) * counted(camera, plan)


@pytest.mark.parametrize(
    "half_pitches, tolerance", [(1, 1e-2), (1, 1e-5), (3, 1e-3), (3, 1e-7), (7, 1e-4), (7, 1e-8)]
)
def test_expected_terms_are_those_found(half_pitches, tolerance):
    camera = small_camera()
    view = geometry(camera, camera.light.wavelengths[0])
    half = half_pitches * view.D2 / 2
    found = separable_field(camera, view, half, tolerance).terms
    assert (
        abs(expected_terms(view.k * view.D1 / 2 * half / view.z2, tolerance) - found)
        <= 2 + 0.1 * found
    )


@pytest.mark.parametrize("shape", ["square", "circle", "hexagon"])
@pytest.mark.parametrize("slope, error", [(1e4, 1e-10), (3e5, 1e-6), (2e6, 1e-4)])
def test_chords_are_counted_as_they_are_made(shape, slope, error):
    cut = chords(shape, 200e-6, slope, error)
    assert _chord_counts(shape, 200e-6, slope, error) == (
        cut.axis,
        len(cut.at),
        cut.at.size,
        sum(x.size for x, _ in cut.pieces),
    )


@pytest.mark.parametrize("shape, lattice", [("circle", "square"), ("hexagon", "hexagonal")])
def test_chords_are_shared_by_the_points_of_a_line(shape, lattice):
    """What the cost of the triple product counts on: blocks of columns begin a line of points
    anew at their borders only.
    """
    camera = small_camera().replace(
        **{
            "lenslet_array.aperture_shape": shape,
            "lenslet_array.lattice": lattice,
            "lenslet_array.fill_factor": 0.9,
            "object.samples_per_lenslet": (9, 7),
            "main_lens.aberrations": ({"noll": 7, "coefficient": 30e-9},),
        }
    )
    plan = plan_pif(camera, model="fresnel", accuracy=1e-2, superpixels=(1, 1), coherent_ring=0)
    assert plan.rung == "fresnel, triple product"
    builder, begun, blocks = PifBuilder(camera, plan.bands[0].wavelength, plan), [], []
    spread, columns = builder._lenslets._spread, builder._lenslets.columns
    builder._lenslets._spread = lambda product, across, index: (
        begun.append(index) or spread(product, across, index)
    )
    builder._lenslets.columns = lambda *block: blocks.append(len(block[0])) or columns(*block)
    builder.fill(np.empty(plan.shape[1:]))
    assert len(blocks) > 4 and len(begun) <= len(set(begun)) + len(blocks)
