"""The ray tracer against closed forms and invariants; no other tracer is needed."""

import math
from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.glass import AIR, Medium, medium
from plenocli.forward.camera.lens import first_order, paraxial_image
from plenocli.forward.camera.prescription import Prescription, Surface
from plenocli.forward.camera.raytrace import (
    Rays,
    aim,
    entrance_pupil,
    exit_pupil,
    intersect,
    paraxial_matrix,
    refract,
    sag,
    to_plane,
    trace,
)
from tests.forward.camera.lenses import D_LINE, glass, singlet, triplet


def bundle(count=200, spread=5e-3, tilt=0.1, seed=4):
    rng = np.random.default_rng(seed)
    position = np.stack([*rng.uniform(-spread, spread, (2, count)), np.zeros(count)])
    direction = np.stack([*rng.uniform(-tilt, tilt, (2, count)), np.ones(count)])
    return Rays(position, direction / np.linalg.norm(direction, axis=0), np.zeros(count))


def parallel(heights):
    h = np.asarray(heights, float)
    return Rays(np.stack([0 * h, h, 0 * h]), np.stack([0 * h, 0 * h, 0 * h + 1]), 0 * h)


# --- one surface ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "surface",
    [
        Surface(curvature=1 / 20e-3),
        Surface(curvature=-1 / 20e-3),
        Surface(),
        Surface(curvature=1 / 20e-3, conic=-1.0),
        Surface(curvature=1 / 20e-3, conic=-3.2),
        Surface(curvature=-1 / 20e-3, conic=2.5),
        Surface(curvature=1 / 13.255e-3, conic=-2.364143, asphere=(0.0, 9.556697e4, -2.609526e8)),
        Surface(curvature=0.0, asphere=(3.0, 2e4)),
    ],
)
def test_rays_end_on_the_surface(surface):
    rays = bundle()
    t = intersect(surface, rays.position, rays.direction)
    at = rays.position + t * rays.direction
    assert np.isfinite(t).all()
    assert np.abs(at[2] - sag(surface, at[0] ** 2 + at[1] ** 2)).max() < 2e-17


def test_a_ray_beside_the_sphere_or_on_the_hyperboloid_s_other_sheet_is_lost():
    rays = parallel([0.0, 9.9e-3, 10.1e-3])
    assert np.isnan(
        intersect(Surface(curvature=1 / 10e-3), rays.position, rays.direction)
    ).tolist() == [
        False,
        False,
        True,
    ]
    steep = Rays(np.array([[0.0], [5e-3], [-1.0]]), np.array([[0.0], [0.0], [-1.0]]), np.zeros(1))
    assert intersect(Surface(curvature=1 / 10e-3, conic=-2.0), steep.position, steep.direction)[
        0
    ] == pytest.approx(-1 - sag(Surface(curvature=1 / 10e-3, conic=-2.0), np.array(25e-6)))


def test_an_asphere_without_polynomial_is_its_conic():
    """Newton's way must find the closed form's point."""
    rays, conic = bundle(), Surface(curvature=1 / 15e-3, conic=-0.7)
    newton = replace(conic, asphere=(0.0, 1e-30))
    assert (
        np.abs(
            intersect(conic, rays.position, rays.direction)
            - intersect(newton, rays.position, rays.direction)
        ).max()
        < 1e-17
    )


def test_snell_s_law_as_angles():
    surface, ratio = Surface(curvature=1 / 30e-3, conic=0.4, asphere=(0.0, 1e3)), 1 / 1.7
    rays = bundle()
    t = intersect(surface, rays.position, rays.direction)
    at = rays.position + t * rays.direction
    out = refract(surface, at, rays.direction, ratio)
    step = 1e-8
    normals = []
    for i in range(at.shape[1]):

        def r(dx, dy, x=at[0, i], y=at[1, i]):
            return sag(surface, np.array((x + dx) ** 2 + (y + dy) ** 2))

        normals.append(
            [
                -(r(step, 0) - r(-step, 0)) / (2 * step),
                -(r(0, step) - r(0, -step)) / (2 * step),
                1.0,
            ]
        )
    normal = np.array(normals).T / np.linalg.norm(np.array(normals).T, axis=0)
    before, behind = (
        np.linalg.norm(np.cross(normal.T, d.T), axis=1) for d in (rays.direction, out)
    )
    assert behind == pytest.approx(before * ratio, abs=1e-7)
    # one plane of incidence
    assert np.abs(np.einsum("ij,ij->j", np.cross(rays.direction.T, out.T).T, normal)).max() < 1e-8


def test_total_reflection_ends_a_ray():
    """From n = 1.5 into air beyond 41.8 degrees."""
    angles = np.radians([41.0, 42.5])
    rays = Rays(
        np.zeros((3, 2)), np.stack([0 * angles, np.sin(angles), np.cos(angles)]), np.zeros(2)
    )
    out = trace(
        (Surface(curvature=0.0, thickness=1e-3, medium=glass(1.5)), Surface(curvature=0.0)),
        Rays(rays.position, rays.direction, rays.path),
        D_LINE,
        upto=1,
    )
    assert out.alive.all()  # a plate lets everything out again
    inside = refract(Surface(curvature=0.0), rays.position, rays.direction, 1.5)
    assert np.isnan(inside[2]).tolist() == [False, True]


def test_axial_crossing_of_one_sphere_is_the_law_of_sines():
    """A parallel ray of height h on a sphere R: crossing at R + R sin(t)/sin(i -
    t) from the vertex.
    """
    radius, n, h = 20e-3, 1.6, 7e-3
    rays = trace(
        (Surface(curvature=1 / radius, thickness=0.0, medium=glass(n)),), parallel([h]), D_LINE
    )
    crossing = (
        rays.position[2, 0] - rays.position[1, 0] * rays.direction[2, 0] / rays.direction[1, 0]
    )
    i = math.asin(h / radius)
    t = math.asin(h / radius / n)
    assert crossing == pytest.approx(radius + radius * math.sin(t) / math.sin(i - t), rel=1e-13)


def test_an_ellipsoid_of_conic_constant_minus_1_over_n2_brings_parallel_light_to_one_point():
    """Descartes' oval for infinity: no spherical aberration at f' = n R/(n - 1), all optical
    paths equal (Malus-Dupin).
    """
    n, radius = 1.7, 10e-3
    surface = Surface(curvature=1 / radius, thickness=0.0, medium=glass(n), conic=-1 / n**2)
    rays = trace((surface,), parallel(np.linspace(-8e-3, 8e-3, 33)), D_LINE)
    focus = to_plane(rays, n * radius / (n - 1), n)
    assert np.abs(focus.position[1]).max() < 1e-16 and np.ptp(focus.path) < 1e-16


def test_the_aplanatic_points_of_a_sphere_image_perfectly():
    """Object R (1 + 1/n) and image R (1 + n) from the vertex, inside and behind: paths equal,
    sine condition n^2 (Weierstrass).
    """
    n, radius = 1.52, 5e-3
    surface = Surface(curvature=-1 / radius, thickness=0.0, medium=AIR)
    angles = np.radians(np.linspace(-55, 55, 29))
    start = np.stack([0 * angles, 0 * angles, np.full_like(angles, -radius * (1 + 1 / n))])
    direction = np.stack([0 * angles, np.sin(angles), np.cos(angles)])
    t = intersect(surface, start, direction)
    at = start + t * direction
    out = refract(surface, at, direction, n)
    back = (-radius * (1 + n) - at[2]) / out[2]
    assert np.abs(at[1] + back * out[1]).max() < 1e-16
    assert np.ptp(n * t + back) < 1e-16
    assert np.sin(angles) == pytest.approx(out[1] * n, abs=1e-14)


# --- whole lenses ---------------------------------------------------------------------------------


def test_the_thick_lensmaker_s_formula():
    r1, r2, d, n = 30e-3, -45e-3, 6e-3, 1.62
    lens = singlet(r1, r2, d, n)
    power = (n - 1) * (1 / r1 - 1 / r2 + (n - 1) * d / (n * r1 * r2))
    data = first_order(lens, D_LINE)
    assert data.focal_length == pytest.approx(1 / power, rel=1e-13)
    assert data.back_focus == pytest.approx((1 - (n - 1) * d / (n * r1)) / power, rel=1e-13)
    assert data.front_principal == pytest.approx(-(n - 1) * d / (n * r2 * power), rel=1e-12)
    assert data.rear_principal == pytest.approx(-(n - 1) * d / (n * r1 * power), rel=1e-12)


def test_paraxial_optics_is_the_limit_of_rays():
    lens = triplet()
    for distance in (math.inf, 0.3):
        h = 1e-6 * np.array([0.5, 1.0])
        start = (
            parallel(h)
            if math.isinf(distance)
            else Rays(
                np.stack([0 * h, h, 0 * h]),
                np.stack([0 * h, h, 0 * h + distance]) / np.hypot(h, distance),
                0 * h,
            )
        )
        out = trace(lens.surfaces, start, D_LINE)
        crossing = out.position[2] - out.position[1] * out.direction[2] / out.direction[1]
        assert crossing == pytest.approx(paraxial_image(lens, D_LINE, distance), rel=1e-8)


def test_lagrange_s_invariant():
    """n (y1 u2 - y2 u1) keeps its value through every surface: the matrices' determinant is 1."""
    surfaces = triplet().surfaces
    for end in range(1, len(surfaces) + 1):
        assert np.linalg.det(paraxial_matrix(surfaces[:end], 500e-9)) == pytest.approx(
            1.0, abs=1e-13
        )


def test_light_finds_its_way_back():
    """Rays traced through, turned round and traced through the reversed lens return to where
    they came from, on equal paths.
    """
    lens = triplet()
    rays = aim(
        lens, D_LINE, np.random.default_rng(2).uniform(-0.6, 0.6, (2, 50)), angle=math.radians(15)
    )
    out = trace(lens.surfaces, rays, D_LINE)
    there = to_plane(out, 0.0)
    flip = np.array([[1.0], [1.0], [-1.0]])
    back = trace(
        lens.reversed().surfaces,
        Rays(there.position * flip, -there.direction * flip, 0 * there.path),
        D_LINE,
    )
    home = to_plane(back, 0.0)
    assert np.abs(home.position[:2] - rays.position[:2]).max() < 1e-15
    assert np.abs(-home.direction * flip - rays.direction).max() < 1e-13
    assert home.path + rays.path == pytest.approx(there.path, abs=1e-15)


def test_rays_and_their_wavefront_are_normal_to_each_other():
    """Malus and Dupin: behind the lens, moving to a neighbour ray changes the path by D . dP."""
    lens = triplet()
    h = 1e-4
    centre = np.random.default_rng(3).uniform(-0.5, 0.5, (2, 20))
    out = [
        to_plane(
            trace(
                lens.surfaces, aim(lens, D_LINE, centre + np.array([[dx], [dy]]), angle=0.2), D_LINE
            ),
            10e-3,
        )
        for dx, dy in ((0, 0), (h, 0), (-h, 0), (0, h), (0, -h))
    ]
    for plus, minus in ((1, 2), (3, 4)):
        slope = ((out[plus].position - out[minus].position) * out[0].direction).sum(axis=0)
        assert out[plus].path - out[minus].path == pytest.approx(slope, abs=1e-14)


def test_a_symmetric_lens_has_mirrored_pupils_and_no_chief_ray_shift():
    half = (
        Surface(curvature=1 / 20e-3, thickness=4e-3, medium=medium("N-SK16")),
        Surface(curvature=1 / 60e-3, thickness=3e-3),
    )
    lens = Prescription(surfaces=half, stop=0, stop_radius=2e-3)
    surfaces = (
        *half,
        Surface(curvature=0.0, thickness=3e-3),
        *(replace(s, thickness=t) for s, t in zip(lens.reversed().surfaces, (4e-3, 0.0))),
    )
    whole = Prescription(surfaces=surfaces, stop=2, stop_radius=2e-3)
    front, back = entrance_pupil(whole, D_LINE), exit_pupil(whole, D_LINE)
    assert front.position == pytest.approx(
        -back.position, rel=1e-12
    ) and front.radius == pytest.approx(back.radius, rel=1e-12)
    chief = aim(whole, D_LINE, np.zeros((2, 1)), angle=0.3)
    out = trace(whole.surfaces, chief, D_LINE)
    assert out.direction[1, 0] == pytest.approx(math.sin(0.3), abs=1e-13)


@pytest.mark.parametrize("angle, distance", [(0.0, math.inf), (0.33, math.inf), (0.2, 0.15)])
def test_aimed_rays_meet_their_point_of_the_stop(angle, distance):
    lens = triplet()
    points = np.random.default_rng(5).uniform(-0.7, 0.7, (2, 300))
    rays = aim(lens, 486e-9, points, angle=angle, object_distance=distance)
    at = trace(lens.surfaces, rays, 486e-9, upto=lens.stop).position
    assert np.abs(at[:2] / lens.stop_radius - points).max() < 1e-10
    if math.isinf(distance):
        assert rays.direction[1] == pytest.approx(math.sin(angle))
        # paths count from one plane wave
        assert np.ptp(rays.path - (rays.position * rays.direction).sum(axis=0)) < 1e-16
    else:
        origin = rays.position - rays.path * rays.direction
        assert np.ptp(origin, axis=1).max() < 1e-15 and origin[2, 0] == pytest.approx(-distance)


def test_clear_apertures_cut_and_the_stop_does_not_move():
    lens = triplet()
    cut = replace(
        lens, surfaces=(replace(lens.surfaces[0], semi_diameter=3e-3), *lens.surfaces[1:])
    )
    points = np.random.default_rng(6).uniform(-0.7, 0.7, (2, 500))
    rays = aim(cut, D_LINE, points)
    alive = trace(cut.surfaces, rays, D_LINE, clip=True).alive
    t = intersect(cut.surfaces[0], rays.position, rays.direction)
    height = np.hypot(*(rays.position + t * rays.direction)[:2])
    assert (alive == (height <= 3e-3)).all() and 0 < alive.sum() < 500
    assert trace(cut.surfaces, rays, D_LINE).alive.all()


def test_a_field_that_no_ray_serves_is_refused():
    with pytest.raises(NumericsError, match="85 degrees"):
        aim(triplet(), D_LINE, np.zeros((2, 1)), angle=math.radians(85))


def test_scaling_scales():
    lens = replace(
        triplet(),
        surfaces=(
            replace(triplet().surfaces[0], conic=-0.4, asphere=(0.5, 3e3)),
            *triplet().surfaces[1:],
        ),
    )
    big = lens.scaled(3.0)
    rays = bundle(50, 3e-3)
    small, large = (
        trace(lens.surfaces, rays, D_LINE),
        trace(big.surfaces, Rays(3 * rays.position, rays.direction, rays.path), D_LINE),
    )
    assert large.position == pytest.approx(
        3 * small.position, rel=1e-12
    ) and large.path == pytest.approx(3 * small.path, rel=1e-12)
    assert big.stop_radius == 3 * lens.stop_radius


# --- glasses --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name, code",
    [
        ("N-SK16", 620603),
        ("N-SF2", 648338),
        ("N-LAK9", 691547),
        ("F2", 620364),
        ("SF6", 805254),
        ("N-FK51A", 487845),
        ("N-LASF44", 804465),
        ("N-BAF10", 670471),
        ("S-FPL53", 439949),
        ("S-LAH60", 834372),
        ("L-BAL35", 589612),
        ("S-TIH53", 847238),
        ("N-SF66", 923209),
        ("N-KZFS4", 613445),
        ("N-PK51", 529770),
        ("K10", 501564),
    ],
)
def test_glasses_have_the_index_and_abbe_number_of_their_six_digit_code(name, code):
    n = [medium(name).index(l * 1e-9) for l in (587.5618, 486.1327, 656.2725)]
    assert n[0] - 1 == pytest.approx(code // 1000 / 1000, abs=6e-4)
    assert (n[0] - 1) / (n[1] - n[2]) == pytest.approx(code % 1000 / 10, abs=0.08)


def test_a_glass_known_by_nd_and_vd_alone_is_near_the_real_one():
    for name, error in (("N-BK7", 5e-5), ("F2", 1e-4), ("N-SK16", 1e-4), ("N-SF5", 5e-4)):
        real = medium(name)
        n = [real.index(l * 1e-9) for l in (587.5618, 486.1327, 656.2725)]
        guess = Medium("x", "abbe", (n[0], (n[0] - 1) / (n[1] - n[2])))
        assert guess.index(D_LINE) == pytest.approx(n[0], abs=1e-12)
        assert guess.index(486.1327e-9) - guess.index(656.2725e-9) == pytest.approx(
            n[1] - n[2], abs=1e-12
        )
        assert (
            max(abs(guess.index(l * 1e-9) - real.index(l * 1e-9)) for l in range(420, 701, 20))
            < error
        )


def test_dispersion_formulas():
    assert Medium("x", "polynomial", ((2.25, 0.0), (0.01, -2.0))).index(500e-9) == pytest.approx(
        math.sqrt(2.25 + 0.04)
    )
    assert Medium("x", "cauchy", ((1.5, 0.0), (0.004, -2.0))).index(500e-9) == pytest.approx(1.516)
    assert Medium("x", "sellmeier", ((1.0, 0.01),)).index(500e-9) == pytest.approx(
        math.sqrt(1 + 0.25 / 0.24)
    )
