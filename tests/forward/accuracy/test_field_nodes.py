"""Matrices of a few places of the field that stand for a whole array."""

import math
from functools import lru_cache

import numpy as np
import pytest

from plenocli.forward.accuracy.field_nodes import (
    PlansOfPlaces,
    field_nodes,
    lay_nodes,
    turned_blocks,
)
from plenocli.forward.propagation.system_matrix import build_pif
from tests.forward.propagation.cameras import WAVELENGTH
from tests.forward.propagation.test_exact import errors, image_points
from tests.forward.propagation.test_oblique import POINTS, wide_camera
from tests.reference.oblique import oblique_columns

ACCURACY = 1e-3


@lru_cache
def fifteen_degrees(f_number=8.0, pitch=40e-6, **changes):
    """(camera, nodes, plans, matrix of a place) of an array whose corner is 15 degrees from the
    axis.
    """
    camera = wide_camera(f_number, pitch, 11.0, **changes)
    plan_at = PlansOfPlaces(
        camera, accuracy=ACCURACY, superpixels=(1, 1), coherent_ring=0, dtype="float64"
    )
    nodes = field_nodes(camera, plan_at)
    made = [build_pif(camera, plan_at(place)) for place in nodes.places]

    def at(place):
        shapes = made[0].pixel_shape, made[0].object_shape
        return sum(
            weight * turned_blocks(made[number].A[0], made[0].lenslet_offset, shapes, how)
            for weight, number, how in nodes.mix(place)
        )[0]

    return camera, nodes, plan_at, at


def missed(camera, at, place):
    """Largest relative error of columns of the lenslet at a place, against sums of spherical waves
    in which nothing is expanded.
    """
    found = at(place)[:, POINTS].T.reshape(-1, *camera.sensor.pixels_per_lenslet)
    truth = oblique_columns(camera, WAVELENGTH, place, image_points(camera, POINTS), pixel_nodes=8)
    return errors(found, truth).max()


def test_few_places_serve_fifteen_degrees():
    camera, nodes, plan_at, _ = fifteen_degrees()
    corner = math.hypot(nodes.rows[-1], nodes.columns[-1]) / camera.lenslet_array.distance
    assert math.degrees(math.atan(corner)) == pytest.approx(15, abs=0.3)
    assert nodes.error < 0.5 * ACCURACY
    assert len(nodes.rows) <= 7 and len(nodes.numbers) <= 10
    one = field_nodes(camera, plan_at, 1)
    assert one.error > 0.1  # what one matrix is off by


@pytest.mark.parametrize("way", [(1.0, 1.0), (0.9, 0.9), (-0.95, 0.3), (0.4, -0.65)])
def test_lenslets_between_places_meet_the_oracle(way):
    """At the corner and where polynomials err most."""
    camera, nodes, _, at = fifteen_degrees()
    assert missed(camera, at, (way[0] * nodes.rows[-1], way[1] * nodes.columns[-1])) < ACCURACY


@pytest.mark.slow
@pytest.mark.parametrize(
    "array",
    [
        {},
        {"f_number": 4.0, "pitch": 24e-6},
        {"f_number": 6.0, "lenslet_array__aperture_shape": "circle"},
        {"lenslet_array__aperture_shape": "circle", "lenslet_array__fill_factor": 0.7},
        {"lenslet_array__aperture_shape": "hexagon", "lenslet_array__fill_factor": 0.86},
    ],
    ids=str,
)
def test_every_place_and_all_in_the_middle_between_meet_the_oracle(array):
    """In an octant, edges and corner included."""
    camera, nodes, _, at = fifteen_degrees(**array)
    halves = np.sort(np.r_[nodes.rows, (nodes.rows[1:] + nodes.rows[:-1]) / 2])
    places = [(y, x) for y in halves for x in halves if -1e-12 < y <= x + 1e-12]
    assert len(places) >= 15
    assert max(missed(camera, at, place) for place in places) < ACCURACY


def test_a_place_s_matrix_is_that_of_its_mirror_image_turned():
    camera, nodes, plan_at, at = fifteen_degrees()
    i, j = 1, len(nodes.columns) - 1
    assert nodes.turn[i, j].any()
    place = float(nodes.rows[i]), float(nodes.columns[j])
    direct = build_pif(camera, plan_at(place)).A[0, 0]
    assert np.abs(at(place) - direct).max() < 1e-3 * direct.max()
    other = at((-place[0], place[1]))
    assert np.abs(other - direct).max() > 0.02 * direct.max()


def test_what_no_symmetry_joins_is_computed():
    camera = wide_camera()
    plain = lay_nodes(camera, 5, (1, 1))
    assert len(plain.numbers) == 6 and plain.file[0, 0] == plain.file[4, 4] == plain.file[0, 4]
    wide = camera.replace(**{"lenslet_array.count": (3, 11)})
    assert len(lay_nodes(wide, 5, (1, 1)).numbers) == 9
    line = camera.replace(**{"lenslet_array.count": (1, 11)})
    assert lay_nodes(line, 5, (1, 1)).file.shape == (1, 5)
    tilted = camera.replace(**{"main_lens.aberrations": [{"noll": 2, "coefficient": 1e-8}]})
    assert len(lay_nodes(tilted, 5, (1, 1)).numbers) == 25
    oblong = camera.replace(**{"object.samples_per_lenslet": (5, 4)})
    assert len(lay_nodes(oblong, 5, (1, 1)).numbers) == 9


def test_weights_are_polynomials_through_the_places():
    nodes = lay_nodes(wide_camera(), 5, (1, 1))
    places = np.linspace(nodes.rows[0], nodes.rows[-1], 9)
    weights = nodes.weights(0, places)
    assert np.allclose(weights.sum(axis=1), 1)
    assert np.allclose(weights @ nodes.rows**4, places**4, rtol=1e-12)
    assert np.allclose(nodes.weights(1, nodes.columns), np.eye(5))
