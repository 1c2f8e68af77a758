"""Exact propagation through openings of any shape, off the axis and with neighbours."""

import math

import numpy as np
import pytest

from plenocli.forward.accuracy import dial
from plenocli.forward.camera.geometry import chief_ray, lenslet_shift
from plenocli.forward.propagation.models import model_named
from plenocli.forward.propagation.system_matrix import build_pif
from tests.forward.propagation import foreign
from tests.forward.propagation.cameras import WAVELENGTH, small_camera
from tests.reference import tensor
from tests.reference.oblique import oblique_columns

ISOLATED = {"superpixels": (1, 1), "coherent_ring": 0}


@pytest.fixture
def by(monkeypatch):
    """(plan, matrix) of a camera by the model of this name alone."""

    def made(name, camera, **request):
        with monkeypatch.context() as only:
            only.setattr(dial, "MODELS", (model_named(name),))
            plan = dial.plan_pif(camera, **request)
        return plan, build_pif(camera, plan)

    return made


def missed(found, truth):
    """Largest relative error of a column; both (..., point)."""
    found, truth = (a.reshape(-1, a.shape[-1]).astype(float) for a in (found, truth))
    return (np.linalg.norm(found - truth, axis=0) / np.linalg.norm(truth, axis=0)).max()


@pytest.mark.parametrize(
    "shape, lattice, request_",
    [
        ("square", "square", {"superpixels": (1, 1), "coherent_ring": 1, "lenslet": (300, 300)}),
        ("square", "square", ISOLATED | {"lenslet": (400, 300)}),
        ("circle", "square", ISOLATED),
        ("hexagon", "hexagonal", ISOLATED),
    ],
)
def test_it_says_what_the_other_exact_models_say(by, shape, lattice, request_):
    """Which share no product with it: separable terms of square ones, harmonics of others."""
    camera = small_camera(
        main_lens__aperture_diameter=5e-3,
        lenslet_array__aperture_shape=shape,
        lenslet_array__lattice=lattice,
        lenslet_array__count=(401, 401),
    )
    other = "exact, low rank" if shape == "square" else "exact, harmonics"
    truth = by(other, camera, accuracy=1e-5, **request_)[1]
    for asked in (1e-2, 1e-3):
        plan, matrix = by("exact, openings", camera, accuracy=asked, **request_)
        assert missed(matrix.A[0], truth.A[0]) < min(asked, 10 * plan.estimated)


def coma_camera(shape, lattice, **changes):
    return small_camera(
        **{
            "main_lens__aperture_diameter": 2.5e-3,
            "main_lens__aberrations": ({"noll": 8, "coefficient": 90e-9},),
            "object__samples_per_lenslet": (1, 2),
            "sensor__pixels_per_lenslet": (3, 3),
            "sensor__pixel_pitch": 4e-6,
            "lenslet_array__aperture_shape": shape,
            "lenslet_array__lattice": lattice,
            "lenslet_array__fill_factor": 0.4,
        }
        | changes
    )


@pytest.mark.parametrize(
    "shape, lattice, ring",
    [
        ("hexagon", "square", 0),
        ("square", "hexagonal", 0),
        pytest.param("circle", "square", 1, marks=pytest.mark.slow),
        pytest.param("hexagon", "hexagonal", 1, marks=pytest.mark.slow),
    ],
)
def test_pupils_without_symmetry_hold(shape, lattice, ring):
    camera = coma_camera(shape, lattice)
    request = ISOLATED | {"coherent_ring": ring, "accuracy": 1e-4}
    plan = dial.plan_pif(camera, **request)
    assert plan.rung == "exact, openings"
    lenslets = foreign.lenslets_of(camera, plan.bands[0].window) if ring else None
    truth = tensor.exact(camera, foreign.points_of(camera), lenslets, [(0, 0)])
    error = missed(build_pif(camera, plan).A[0], truth.reshape(len(truth), -1).T)
    assert error < 1e-4
    assert 0.1 < plan.estimated / error < 10


@pytest.mark.parametrize("shape, lattice", [("circle", "square"), ("hexagon", "hexagonal")])
def test_slow_lenslets_with_neighbours_are_paraxial(by, shape, lattice):
    """By chords and a triple product, which have no node or weight in common with it."""
    camera = coma_camera(
        shape,
        lattice,
        main_lens__aperture_diameter=1e-3,
        lenslet_array__fill_factor=0.8,
        lenslet_array__pitch=40e-6,
        lenslet_array__focal_length=2.2e-3,
        sensor__distance=2.3e-3,
        sensor__pixels_per_lenslet=(8, 8),
        sensor__pixel_pitch=5e-6,
        object__samples_per_lenslet=(2, 3),
    )
    request = {"superpixels": (1, 1), "coherent_ring": 1}
    truth = by("fresnel, triple product", camera, accuracy=1e-5, model="fresnel", **request)
    plan, matrix = by("exact, openings", camera, accuracy=1e-4, model="exact", **request)
    error = missed(matrix.A[0], truth[1].A[0])
    assert error < truth[0].model_error < 8e-3
    assert error > 0.1 * truth[0].model_error


@pytest.mark.parametrize("shape", ["circle", "hexagon"])
def test_lenslets_off_the_axis_hold(shape):
    """Against spheres from every point of the pupil, 10 degrees off."""
    camera = small_camera(
        main_lens__aperture_diameter=5e-3,
        object__samples_per_lenslet=(3, 3),
        lenslet_array__aperture_shape=shape,
        lenslet_array__fill_factor=0.8,
        lenslet_array__count=(601, 601),
    )
    place = (500, 400)
    plan = dial.plan_pif(camera, accuracy=1e-3, lenslet=place, **ISOLATED)
    assert plan.rung == "exact, openings"
    assert math.hypot(*chief_ray(camera, *place)) > 0.1 * 55e-3
    points = [0, 2, 4, 7]
    truth = oblique_columns(
        camera,
        WAVELENGTH,
        chief_ray(camera, *place),
        [foreign.points_of(camera)[n] for n in points],
        shift=lenslet_shift(camera, *place)[2],
    )
    found = build_pif(camera, plan).A[0][..., points]
    assert missed(found, truth.reshape(len(points), -1).T) < 1e-3


def test_a_paraxial_request_beyond_its_reach_is_now_computed():
    """Round lenslets with neighbours' light were refused under auto."""
    camera = small_camera(lenslet_array__aperture_shape="circle", lenslet_array__fill_factor=0.9)
    plan = dial.plan_pif(camera, accuracy=1e-3, superpixels=(3, 3), coherent_ring=1)
    assert plan.rung == "exact, openings" and plan.estimated <= 1e-3
    assert plan.chosen.seconds() < 60
