"""Exact propagation behind round and hexagonal lenslets, by harmonics, against direct sums of
Rayleigh and Sommerfeld's integral, and what must hold of it.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1, jv

from plenocli.base.errors import NumericsError
from plenocli.files.config.camera_file import load_camera
from plenocli.forward.accuracy import dial
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.exact.debye import radial_waves
from plenocli.forward.propagation.harmonics import corners
from plenocli.forward.propagation.harmonics.bessel import bessel_orders, bessel_tail
from plenocli.forward.propagation.harmonics.interpolation import tap_error, tap_weights
from plenocli.forward.propagation.harmonics.lenslets import CentredLenslets
from plenocli.forward.propagation.harmonics.sizing import harmonic_band
from plenocli.forward.propagation.models import model_named
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import WAVELENGTH, small_camera
from tests.reference.fresnel import disc_nodes
from tests.reference.rayleigh import (
    energies_behind_opening,
    field_of_spheres,
    field_on_array,
    opening_nodes,
    pupil_directions,
)

HEXAGONAL = {
    "lenslet_array__aperture_shape": "hexagon",
    "lenslet_array__lattice": "hexagonal",
}
ISOLATED = {"superpixels": (1, 1), "coherent_ring": 0}
pytestmark = pytest.mark.usefixtures("without_openings")


def round_camera(f_number=2.5, pitch=18e-6, pixels=9, **changes):
    """Round lenslets of `pixels` x 2 um at the f-number of the main lens."""
    focal = pitch * f_number
    return small_camera(
        **{
            "main_lens__aperture_diameter": 55e-3 / f_number,
            "lenslet_array__aperture_shape": "circle",
            "lenslet_array__focal_length": focal,
            "lenslet_array__pitch": pitch,
            "sensor__distance": focal,
            "sensor__pixels_per_lenslet": (pixels, pixels),
        }
        | changes
    )


def image_points(camera, points):
    view = geometry(camera, WAVELENGTH)
    rows, columns = np.divmod(points, camera.object.samples_per_lenslet[1])
    return list(zip(view.points(0)[rows], view.points(1)[columns]))


def plan_of(camera, asked, **request):
    return dial.plan_pif(camera, **{"accuracy": asked, "model": "exact"} | ISOLATED | request)


def columns(camera, points, asked=1e-4, **changes):
    """Pixel energies (point, row, column) by harmonics."""
    plan = replace(plan_of(camera, asked), **changes)
    assert plan.rung == "exact, harmonics"
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    return builder.columns(points)[0].T.reshape(-1, *builder.pixel_shape)


def direct(camera, points, rows, *, nodes=48, pixel_nodes=9):
    """The same on some rows of pixels by the sum over every node of the lenslet."""
    width = camera.lenslet_array.pitch * camera.lenslet_array.fill_factor
    places = opening_nodes(camera.lenslet_array.aperture_shape, width, nodes)
    return energies_behind_opening(
        camera, image_points(camera, points), places, rows=rows, pixel_nodes=pixel_nodes
    )


def errors(found, truth):
    """Relative L2 error of each column."""
    return np.sqrt(((found - truth) ** 2).sum(axis=(1, 2)) / (truth**2).sum(axis=(1, 2)))


@pytest.mark.parametrize("profile", ["hyperbolic", "parabolic"])
@pytest.mark.parametrize("change", [{}, HEXAGONAL], ids=["round", "hexagonal"])
def test_every_accuracy_holds_in_the_worst_column(profile, change):
    """The corner's column too, which has 3 % of the brightest one's light."""
    camera = round_camera(lenslet_array__profile=profile, **change)
    points, rows = [0, 3, 9, 27, 35], [0, 3, 7]
    truth = direct(camera, points, rows, pixel_nodes=11)
    for asked in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        found = columns(camera, points, asked)[:, rows]
        assert errors(found, truth).max() <= asked, asked


@pytest.mark.parametrize(
    "change",
    [
        {"sensor__pixels_per_lenslet": (7, 10)},
        {"object__samples_per_lenslet": (5, 9)},
        {"object__distance": 0.53},
        {"lenslet_array__fill_factor": 0.5},
        {"sensor__distance": 41e-6, "sensor__pixel_fill_factor": 0.64},
        {"lenslet_array__lattice": "hexagonal"},
        HEXAGONAL | {"lenslet_array__fill_factor": 0.7, "sensor__pixels_per_lenslet": (8, 11)},
        HEXAGONAL | {"object__distance": 0.545, "object__samples_per_lenslet": (5, 9)},
        {"main_lens__aberrations": ({"noll": 11, "coefficient": 60e-9},)},
        {
            "main_lens__apodisation": "uniform-sine",
            "main_lens__aperture_shape": "annulus",
            "main_lens__obscuration": 0.4,
        },
    ],
    ids=str,
)
def test_every_kind_of_camera(change):
    camera, points = round_camera(**change), [0, 12, 19]
    # a blurred point lights a patch of a superpixel
    rows = range(9) if "object__distance" in change else [0, 5]
    if "main_lens__aberrations" in change:
        # the reference knows of no aberrations
        found = columns(camera, points, 1e-6)
        assert errors(columns(camera, points, 1e-3), found).max() <= 1e-3
        assert errors(columns(round_camera(), points, 1e-6), found).max() > 0.05
        return
    truth = direct(camera, points, rows)
    assert errors(columns(camera, points, 1e-5)[:, rows], truth).max() <= 1e-5


def test_a_window_of_pixels_off_the_superpixel_s_centre():
    camera, points, rows, shift = round_camera(), [0, 12, 63], [0, 4, 8], (0.3, -0.2)
    places = opening_nodes("circle", camera.lenslet_array.pitch, 48)
    truth = energies_behind_opening(
        camera,
        image_points(camera, points),
        places,
        rows=rows,
        pixel_nodes=9,
        centre=[s * camera.sensor.pixel_pitch for s in shift],
    )
    found = columns(camera, points, plan_of(camera, 1e-4).accuracy, **shifted(camera, shift))
    assert errors(found[:, rows], truth).max() <= 1e-4


def shifted(camera, shift):
    """What a plan has for a window off the centre."""
    view = geometry(camera, WAVELENGTH, shift)
    return {"pixel_shift": shift, "bands": (harmonic_band(camera, view, (1, 1), 0, 1e-4, 1e-4),)}


def test_the_reference_has_converged():
    camera, points, rows = round_camera(), [0, 20], [2]
    coarse, fine = (
        direct(camera, points, rows, nodes=n, pixel_nodes=p) for n, p in ((48, 9), (64, 13))
    )
    assert errors(coarse, fine).max() < 1e-9


# the field on the lenslets


def test_harmonics_of_the_main_lens_s_field_are_the_field():
    """By the addition theorem about the lenslet's centre, against the sum over pupil directions."""
    camera, point = round_camera(4.0, object__distance=0.54), (3e-6, -4e-6)
    view, (y, x, _) = geometry(camera, WAVELENGTH), disc_nodes(9e-6, 5, 7)
    k, q, alpha = view.k, np.hypot(y, x), np.arctan2(y, x)
    r, phi = np.hypot(*point), np.arctan2(*point)
    sines, weights = radial_waves(camera, view, 2e-5)
    m = np.arange(60)
    terms = bessel_orders(60, k * np.outer(q, sines)) * bessel_orders(60, k * r * sines)[:, None]
    turn = np.where(m, 2, 1)[:, None] * np.cos(m[:, None] * (alpha - phi))
    found = ((terms @ weights) * turn).sum(axis=0) * np.exp(0.5j * k / view.z2 * q * q)
    directions = pupil_directions(camera)
    true = [
        field_on_array(camera, WAVELENGTH, point, np.array([a]), np.array([b]), directions)[0, 0]
        for a, b in zip(y, x)
    ]
    assert np.abs(found - true).max() < 1e-9 * np.abs(true).max()


def test_the_field_of_an_even_cone_is_airy_s():
    camera = round_camera(main_lens__apodisation="uniform-sine")
    view = geometry(camera, WAVELENGTH)
    sines, weights = radial_waves(camera, view, 3e-5)
    d, edge = np.linspace(1e-8, 3e-5, 50), view.D1 / 2 / np.hypot(view.D1 / 2, view.z2)
    found = jv(0, view.k * np.outer(d, sines)) @ weights
    x = view.k * edge * d
    airy = 2 * np.sqrt(np.pi) * edge / WAVELENGTH * j1(x) / x
    assert np.abs(found - airy).max() < 1e-11 * airy[0]


def test_the_field_is_that_of_spheres_about_the_image_point():
    """Exact distances from each point of an evenly lit exit pupil, in which no direction cosine
    stands: at f/4.4 the field on the lenslet differs by 1.9e-4 of its root energy.
    """
    camera = round_camera(4.4, 60e-6, main_lens__apodisation="uniform-pupil")
    view, point = geometry(camera, WAVELENGTH), (8e-6, -14e-6)
    y = np.linspace(-30e-6, 30e-6, 25)
    spheres = field_of_spheres(camera, WAVELENGTH, point, y, y, radial=60, turns=200)
    sines, weights = radial_waves(camera, view, 9e-5)
    d = np.hypot(y[:, None] - point[0], y - point[1])
    found = (jv(0, view.k * d[..., None] * sines) @ weights) * np.exp(
        0.5j * view.k / view.z2 * (y[:, None] ** 2 + y**2)
    )
    turn = np.vdot(found, spheres) / abs(np.vdot(found, spheres))  # a phase of the point's own
    assert np.linalg.norm(turn * found - spheres) < 3e-4 * np.linalg.norm(spheres)


def fields_of(camera, asked=1e-6):
    plan = plan_of(camera, asked)
    return PifBuilder(camera, WAVELENGTH, plan).lenslets


def test_light_that_enters_is_that_of_the_field_on_the_opening():
    camera = round_camera(lenslet_array__fill_factor=0.8)
    view, points = geometry(camera, WAVELENGTH), [0, 13, 27]
    y, x, w = disc_nodes(0.4 * camera.lenslet_array.pitch, 30, 90)
    sines, weights = radial_waves(camera, view, 3e-5)
    found = fields_of(camera).incident(*np.divmod(points, 8))
    for light, (py, px) in zip(found, image_points(camera, points)):
        h = jv(0, view.k * np.hypot(y - py, x - px)[:, None] * sines) @ weights
        assert light == pytest.approx((np.abs(h) ** 2 * w).sum(), rel=1e-7)


# invariants


def test_corners_with_four_sides_are_those_of_a_square(monkeypatch):
    """What is added to the inscribed circle gives the columns of the low-rank model then, which
    shares no formula with it but the main lens's field.
    """
    square = round_camera(lenslet_array__aperture_shape="square")
    points = [0, 3, 9, 27, 35]
    plan = plan_of(square, 1e-6)
    assert plan.rung == "exact, low rank"
    builder = PifBuilder(square, WAVELENGTH, plan, dtype=np.float64)
    true = builder.columns(points)[0].T.reshape(-1, 9, 9)
    monkeypatch.setattr(corners, "SIDES", 4)
    view = replace(geometry(square, WAVELENGTH), lenslet_shape="hexagon")
    wide = {"lenslet_extent": property(lambda self: 2 * (self.lenslet_width / np.sqrt(2),))}
    monkeypatch.setattr(type(view), "lenslet_extent", wide["lenslet_extent"])
    band = harmonic_band(square, view, (1, 1), 0, 1e-6, 1e-6)
    fields = CentredLenslets(square, view, replace(plan, double=True), band)
    found = np.empty((5, 9, 9))
    fields.on_superpixel(0, 0)(*np.divmod(points, 8), found)
    assert errors(found, true).max() < 2e-6


def test_a_round_lenslet_takes_less_light_than_the_square_around_it():
    rows, columns_ = (a.ravel() for a in np.indices((8, 8)))
    square = round_camera(lenslet_array__aperture_shape="square")
    less, more = (fields_of(c, 1e-4).incident(rows, columns_) for c in (round_camera(), square))
    assert (less < more).all() and (less > 0.7 * more)[(rows > 1) & (columns_ > 1)].any()


def test_what_enters_reaches_a_sensor_that_is_large_enough():
    camera = round_camera(sensor__pixels_per_lenslet=(41, 41))
    points = np.arange(64)
    energy = columns(camera, points, 1e-3).sum(axis=(1, 2))
    entered = fields_of(camera).incident(*np.divmod(points, 8))
    assert (energy < entered * (1 + 1e-4)).all()
    assert (energy > 0.9 * entered).all() and energy.sum() > 0.97 * entered.sum()


def test_turned_points_have_turned_columns():
    """Points (1, 7) and (5, 5) half spacings from the axis lie on one circle: in rings their
    columns are alike.
    """
    camera = round_camera(sensor__pixels_per_lenslet=(45, 45), sensor__pixel_pitch=0.5e-6)
    points = [4 * 8 + 7, 6 * 8 + 6]
    one, other = columns(camera, points, 1e-4)
    y = np.arange(45) - 22
    rings = (np.hypot(y[:, None], y) // 3).astype(int)
    sums = [np.bincount(rings.ravel(), a.ravel())[:6] for a in (one, other)]
    assert np.abs(sums[0] - sums[1]).max() < 0.03 * sums[0].max()
    moments = [[(a * y[:, None]).sum(), (a * y).sum()] / a.sum() for a in (one, other)]
    assert np.hypot(*moments[0]) == pytest.approx(np.hypot(*moments[1]), rel=0.02)
    turned = np.subtract(*(np.arctan2(*moment) for moment in moments))
    assert abs(turned) == pytest.approx(np.arctan2(5, 5) - np.arctan2(1, 7), abs=0.02)


@pytest.mark.parametrize("f_number, most", [(12, 2e-2), (50, 1e-3)])
def test_slow_lenslets_are_paraxial(f_number, most):
    camera = round_camera(f_number, 60e-6, 30)
    points = [0, 12, 27]
    plan = plan_of(camera, 1e-5, model="fresnel")
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    paraxial = builder.columns(points)[0].T.reshape(-1, 30, 30)
    off = errors(paraxial, columns(camera, points, 1e-5)).max()
    stated = model_named(plan.rung).error_bound(camera, geometry(camera, WAVELENGTH), (1, 1), 0)
    assert off < most and 0.3 * stated < off < 1.1 * stated


# parts


def test_bessel_functions_of_all_orders():
    x = np.concatenate([[0, 1e-9, 1e-3, 0.5], np.linspace(0, 900, 200)])
    found = bessel_orders(250, x)
    assert np.abs(found - jv(np.arange(250)[:, None], x)).max() < 1e-12
    for largest in (0.1, 10, 400):
        for error in (1e-3, 1e-9):
            assert jv(bessel_tail(largest, error), largest) < error


@pytest.mark.parametrize("taps, finer", [(4, 1.3), (8, 1.6), (16, 1.8)])
def test_waves_of_the_band_are_interpolated(taps, finer):
    rng = np.random.default_rng(5)
    cycles, places = rng.beta(1, 5, 200) / (2 * finer), rng.uniform(0, 1, 50)
    weights = tap_weights(places, taps, finer)
    stand = np.arange(taps) - (taps / 2 - 1)
    found = weights @ np.exp(2j * np.pi * np.outer(stand, cycles))
    missed = np.abs(found - np.exp(2j * np.pi * np.outer(places, cycles)))
    assert np.sqrt((missed**2).mean()) < 2 * tap_error(taps, finer)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-3 * tap_error(taps, finer)


# what is refused, and what is said before


@pytest.mark.parametrize(
    "change, request_, why",
    [
        ({}, {"coherent_ring": 1}, "an isolated lenslet to its own superpixel.*paraxial.*about 0"),
        ({}, {"superpixels": (3, 3)}, "an isolated lenslet to its own superpixel"),
        ({"main_lens__aperture_shape": "square"}, {}, "same in all directions.*the paraxial"),
        ({"main_lens__aberrations": ({"noll": 7, "coefficient": 3e-8},)}, {}, "same in all"),
        ({"sensor__distance": 5e-6}, {}, r"lies [\d.]+ wavelengths behind.*within 10"),
    ],
    ids=str,
)
def test_what_is_not_followed_is_refused_in_words(change, request_, why):
    with pytest.raises(NumericsError, match=why):
        plan_of(round_camera(**change), 1e-3, **request_)


def test_the_dial_takes_it_where_the_paraxial_model_is_too_far_off():
    camera = round_camera(4.4, 60e-6, 30)
    assert plan_of(camera, 1e-3, model="auto").rung == "exact, harmonics"
    others = {c.name: c.why for c in plan_of(camera, 1e-3, model="auto").candidates}
    assert others["fresnel, triple product"].startswith("model error")


@pytest.mark.slow
@pytest.mark.parametrize("shape, lattice", [("circle", "square"), ("hexagon", "hexagonal")])
def test_full_size(shape, lattice):
    """52x52 pixels and 40x40 points at f/4.4, the corner's column too, on two rows of pixels: what
    was asked, and not a fiftieth of it.
    """
    camera = load_camera("sample_configs/seed_spatial_250um.toml").replace(
        **{"lenslet_array.aperture_shape": shape, "lenslet_array.lattice": lattice}
    )
    points, rows = [0, 19, 137, 205, 820], [0, 25]
    truth = direct(camera, points, rows, nodes=236, pixel_nodes=7)
    for asked in (1e-2, 1e-3, 1e-4, 1e-5):
        off = errors(columns(camera, points, asked)[:, rows], truth)
        assert asked / 50 < off.max() <= asked
