"""What a camera takes from a traced lens: wavefronts, colour and the thin lens it stands for,
against closed forms.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.forward.camera.glass import medium
from plenocli.forward.camera.lens import (
    camera_lens,
    chief_height,
    disc_points,
    distortion,
    first_order,
    focal_shift,
    image_plane,
    lateral_colour,
    noll_coefficients,
    paraxial_image,
    transmitted,
    wavefront,
)
from plenocli.forward.camera.prescription import Prescription, Surface
from plenocli.forward.camera.pupil import zernike
from plenocli.forward.camera.raytrace import aim, to_plane, trace
from tests.forward.camera.lenses import D_LINE, glass, singlet, triplet

POINTS, WEIGHTS = disc_points(12, 48)


def perfect_lens(n=1.7, focal_length=50e-3):
    """Plano-hyperbolic: a plane, then a hyperboloid of conic constant -n^2, free of spherical
    aberration for infinity.
    """
    return Prescription(
        surfaces=(
            Surface(curvature=0.0, thickness=5e-3, medium=glass(n)),
            Surface(curvature=-1 / (focal_length * (n - 1)), thickness=0.0, conic=-n * n),
        ),
        stop=0,
        stop_radius=10e-3,
    )


def test_disc_points_integrate_polynomials():
    x, y = POINTS
    assert WEIGHTS.sum() == pytest.approx(math.pi)
    assert (WEIGHTS * x**2 * y**4).sum() == pytest.approx(math.pi / 64, rel=1e-13)


def test_the_hyperbolic_lens_has_no_wavefront_error_on_axis():
    wave = wavefront(perfect_lens(), D_LINE, POINTS)
    assert first_order(perfect_lens(), D_LINE).focal_length == pytest.approx(50e-3)
    assert np.abs(wave.error).max() < 1e-16
    # the stop, 5 mm inside the glass, is seen 1/(n/5 mm - 1/f) before the last vertex
    assert wave.radius == pytest.approx(50e-3 + 1 / (1.7 / 5e-3 - 1 / 50e-3))


def test_defocus_is_the_textbook_s():
    """The perfect lens with its sensor moved by dz: W is the difference of two spheres' sags; W > 0
    at the rim where the sensor is too near, as k eps r^2/2 with eps = 1/z1 + 1/z2 - 1/f has it.
    """
    lens, dz = perfect_lens(), -40e-6
    image = paraxial_image(lens, D_LINE)
    wave = wavefront(lens, D_LINE, POINTS, image_distance=image + dz)
    sine = np.hypot(*wave.cosines)
    cosine = np.sqrt(1 - sine**2)
    assert wave.error == pytest.approx(-dz * (1 - cosine), rel=2e-3)
    z2, f = 50e-3 + dz, 50e-3
    eps = 1 / z2 - 1 / f
    assert eps > 0
    near = sine < 0.05
    assert wave.error[near] == pytest.approx(eps * (z2 * sine[near]) ** 2 / 2, rel=5e-3)


def test_third_order_spherical_aberration_of_a_plano_convex_lens():
    """Seidel's sum for a thin lens at infinity: W040 = h^4 (n-1)... of shape q, position p = -1
    (Welford, thin lens); here by its closed form W = h^4/(32 f^3 n (n-1)) [(n+2)/(n-1) q^2 - 4
    (n+1) q + (3n+2)(n-1) + n^3/(n-1)] for p = -1.
    """
    n, f, h = 1.5, 0.5, 5e-3
    for radii, q in (
        ((f * (n - 1), math.inf), 1.0),
        ((math.inf, -f * (n - 1)), -1.0),
        ((2 * f * (n - 1), -2 * f * (n - 1)), 0.0),
    ):
        lens = singlet(*radii, 1e-9, n, stop_radius=h)
        wave = wavefront(lens, D_LINE, np.array([[0.0], [1.0]]))
        expected = (
            h**4
            / (32 * f**3 * n * (n - 1))
            * ((n + 2) / (n - 1) * q * q - 4 * (n + 1) * q + (3 * n + 2) * (n - 1) + n**3 / (n - 1))
        )
        # a positive lens focuses its rim short of the paraxial image: there the wave runs ahead
        assert wave.error[0] == pytest.approx(-expected, rel=2e-3)


def test_transverse_aberration_is_the_slope_of_the_wavefront():
    """Rays leave the reference sphere along the gradient of W: -R dW/d(pupil) is where
    they miss the centre.
    """
    lens, h = triplet(), 1e-4
    lens = replace(
        lens, surfaces=(*lens.surfaces[:-1], replace(lens.surfaces[-1], thickness=42.0e-3))
    )
    angle = math.radians(12)
    base = np.random.default_rng(1).uniform(-0.6, 0.6, (2, 30))
    waves = [
        wavefront(lens, 550e-9, base + np.array([[dx], [dy]]), angle)
        for dx, dy in ((h, 0), (-h, 0), (0, h), (0, -h))
    ]
    rays = to_plane(trace(lens.surfaces, aim(lens, 550e-9, base, angle=angle), 550e-9), 42.0e-3)
    missed = rays.position[:2] - waves[0].centre[:2, None]
    for plus, minus in ((0, 1), (2, 3)):
        # of the radii; the sphere's points move by -R step
        step = waves[plus].cosines - waves[minus].cosines
        # dW = D.dQ, and D differs from the radius, normal to dQ, by miss/R
        assert waves[plus].error - waves[minus].error == pytest.approx(
            -(missed * step).sum(axis=0), rel=2e-2, abs=2e-12
        )


def test_telecentric_and_distant_pupils_agree():
    """With the stop in the front focus the exit pupil is at infinity and the reference
    sphere a plane wave's.
    """
    n, f = 1.6, 30e-3
    lens = singlet(math.inf, -f * (n - 1), 4e-3, n)
    first = first_order(lens, D_LINE)
    gap = first.focal_length - first.front_principal
    near, far = (
        Prescription(
            surfaces=(Surface(curvature=0.0, thickness=gap + shift), *lens.surfaces),
            stop=0,
            stop_radius=2e-3,
        )
        for shift in (0.0, 1e-7)
    )
    a, b = (wavefront(lens, D_LINE, POINTS, math.radians(4)) for lens in (near, far))
    assert abs(b.radius) > 1e3
    assert a.error == pytest.approx(b.error, abs=1e-10) and a.error.std() > 5e-7
    assert a.cosines == pytest.approx(b.cosines, abs=1e-6)


def test_zernike_coefficients_give_the_wavefront_back():
    lens, angle = triplet(), math.radians(14)
    for pupil in ("stop", "exit"):
        terms, rest = noll_coefficients(lens, 486e-9, 45, pupil, angle=angle)
        wave = wavefront(lens, 486e-9, POINTS, angle)
        at = wave.points if pupil == "stop" else None
        assert rest < 2e-3 * wave.rms(WEIGHTS)
        if at is not None:
            rebuilt = sum(c * zernike(j, at[1], at[0]) for j, c in enumerate(terms, 1))
            assert rebuilt == pytest.approx(wave.error, abs=2e-2 * wave.rms(WEIGHTS))
            assert math.sqrt((terms[1:] ** 2).sum()) == pytest.approx(wave.rms(WEIGHTS), rel=1e-4)
        # the meridional plane is a plane of symmetry: no term that is odd in x
        odd = [j for j in range(1, 46) if abs(zernike(j, 0.3, 0.4) - zernike(j, 0.3, -0.4)) > 1e-9]
        assert np.abs(terms[np.array(odd) - 1]).max() < 1e-6 * wave.rms(WEIGHTS)


def test_focal_shift_of_a_thin_singlet():
    """f (n - 1) is constant: the back focus of a thin BK7 lens moves as 1/(n - 1)."""
    bk7 = medium("N-BK7")
    lens = Prescription(
        surfaces=(
            Surface(curvature=1 / 40e-3, thickness=1e-9, medium=bk7),
            Surface(curvature=-1 / 40e-3),
        ),
        stop=0,
        stop_radius=2e-3,
    )
    f = {w: 1 / ((bk7.index(w) - 1) * 2 / 40e-3) for w in (450e-9, 650e-9, D_LINE)}
    assert focal_shift(lens, [450e-9, 650e-9]) == pytest.approx(
        [f[450e-9] - f[D_LINE], f[650e-9] - f[D_LINE]], rel=1e-5
    )
    near = focal_shift(lens, [450e-9], 0.2)[0]
    assert near == pytest.approx(1 / (1 / f[450e-9] - 5) - 1 / (1 / f[D_LINE] - 5), rel=1e-5)


def test_lateral_colour_of_a_plate_and_a_prism_like_field():
    """A thin singlet with the stop on it has none to first order; the triplet's is the
    difference of its chief rays, object held.
    """
    bk7 = medium("N-BK7")
    thin = Prescription(
        surfaces=(
            Surface(curvature=1 / 40e-3, thickness=1e-9, medium=bk7),
            Surface(curvature=-1 / 40e-3),
        ),
        stop=0,
        stop_radius=1e-3,
    )
    assert abs(lateral_colour(thin, [450e-9], 0.01)[0]) < 1e-12
    lens = triplet()
    heights = [chief_height(lens, w, 0.2) for w in (486e-9, D_LINE)]
    assert (
        lateral_colour(lens, [486e-9], 0.2)[0] == pytest.approx(heights[0] - heights[1])
        and abs(heights[0] - heights[1]) > 1e-7
    )
    # near object: the object point stays, whatever the entrance pupil does
    shift = lateral_colour(lens, [486e-9], 0.2, 0.3)[0]
    assert abs(shift) < 20e-6


def test_distortion_vanishes_for_a_stop_at_a_thin_lens_and_for_symmetry_at_unit_magnification():
    lens = singlet(40e-3, -40e-3, 1e-9, 1.5)
    assert abs(distortion(lens, D_LINE, 0.2)) < 1e-7
    half = (
        Surface(curvature=1 / 20e-3, thickness=4e-3, medium=medium("N-SK16")),
        Surface(curvature=1 / 60e-3, thickness=3e-3),
    )
    turned = Prescription(surfaces=half, stop=0, stop_radius=2e-3).reversed().surfaces
    whole = Prescription(
        surfaces=(
            *half,
            Surface(curvature=0.0, thickness=3e-3),
            replace(turned[0], thickness=4e-3),
            replace(turned[1], thickness=0.0),
        ),
        stop=2,
        stop_radius=1e-3,
    )
    data = first_order(whole, D_LINE)
    unit = 2 * data.focal_length - data.front_principal
    assert paraxial_image(whole, D_LINE, unit) == pytest.approx(unit)
    assert abs(distortion(whole, D_LINE, 0.15, unit)) < 1e-4 < abs(distortion(whole, D_LINE, 0.15))
    with pytest.raises(NumericsError, match="off axis"):
        distortion(lens, D_LINE, 0.0)


def test_vignetting_is_the_overlap_of_two_circles():
    """A stop of radius r and a diaphragm of the same radius a distance d before it cut a lens
    shape for oblique light.
    """
    r, d, angle = 2e-3, 5e-3, 0.3
    lens = Prescription(
        surfaces=(
            Surface(curvature=0.0, thickness=d, semi_diameter=r),
            Surface(curvature=1 / 40e-3, thickness=1e-9, medium=glass(1.5)),
            Surface(),
        ),
        stop=1,
        stop_radius=r,
    )
    # the stop is on the first curved vertex; its sag is 0.05 mm at the rim
    shift = d * math.tan(angle) / r
    overlap = (2 * math.acos(shift / 2) - shift / 2 * math.sqrt(4 - shift * shift)) / math.pi
    assert transmitted(lens, D_LINE, angle, rings=96) == pytest.approx(overlap, abs=0.01)
    assert transmitted(lens, D_LINE, 0.0) == 1.0
    assert np.isnan(wavefront(lens, D_LINE, POINTS, angle).error).mean() == pytest.approx(
        1 - overlap, abs=0.05
    )


def test_the_image_plane_is_the_described_one_for_the_described_object_only():
    lens = replace(
        perfect_lens(),
        surfaces=(perfect_lens().surfaces[0], replace(perfect_lens().surfaces[1], thickness=49e-3)),
    )
    assert image_plane(lens) == 49e-3
    assert image_plane(lens, 0.5) == pytest.approx(paraxial_image(lens, D_LINE, 0.5)) != 49e-3


# --- in a camera ----------------------------------------------------------------------------------


def test_a_thin_lens_in_a_camera_is_itself():
    bk7 = medium("N-BK7")
    f = {w: 1 / ((bk7.index(w) - 1) * 2 / 100e-3) for w in (450e-9, 550e-9, 650e-9)}
    lens = Prescription(
        surfaces=(
            Surface(curvature=1 / 100e-3, thickness=1e-9, medium=bk7),
            Surface(curvature=-1 / 100e-3),
        ),
        stop=0,
        stop_radius=5e-3,
    )
    inside = camera_lens(lens, 1.0, 6e-3, 550e-9)
    assert inside.z2 == pytest.approx(1 / (1 / f[550e-9] - 1), rel=1e-6)
    for w in f:
        assert inside.focal_length(w) == pytest.approx(f[w], rel=1e-6)
    # but for what spherical aberration bends the rim's ray more than paraxial ones
    assert inside.lens.stop_radius == pytest.approx(3e-3, rel=3e-4)


def test_a_traced_lens_in_a_camera_has_the_wavefront_of_its_rays():
    """eps(l) and the Noll terms of W(l) together are the wavefront about the fixed sensor plane,
    over direction cosines.
    """
    lens, z1 = triplet(), 0.55
    inside = camera_lens(lens, z1, 9e-3, 550e-9)
    sensor = paraxial_image(inside.lens, 550e-9, inside.object_distance)
    for w in (450e-9, 550e-9, 650e-9):
        wave = wavefront(
            inside.lens, w, POINTS, object_distance=inside.object_distance, image_distance=sensor
        )
        y, x = (-c * inside.z2 for c in wave.cosines[::-1])
        eps = 1 / z1 + 1 / inside.z2 - 1 / inside.focal_length(w)
        unit = (
            np.hypot(
                *wavefront(
                    inside.lens, w, np.array([[0.0], [1.0]]), object_distance=inside.object_distance
                ).cosines
            )[0]
            * inside.z2
        )
        assert unit == pytest.approx(4.5e-3 / math.hypot(1, 4.5e-3 / inside.z2), rel=3e-3)
        model = eps * (x * x + y * y) / 2 + sum(
            c * zernike(j, y / unit, x / unit) for j, c in inside.aberrations(w)
        )
        gap = wave.error - model
        assert np.ptp(gap) < 0.01 * w, w / 1e-9
        assert np.ptp(wave.error) > 0.2 * w


def test_a_lens_cannot_be_opened_beyond_its_stop_or_focus_behind_itself():
    widest = 2 * 4.1e-3
    with pytest.raises(ConfigError, match="opens to"):
        camera_lens(triplet(), 0.55, 3 * widest, 550e-9)
    with pytest.raises(ConfigError, match="no real image"):
        camera_lens(triplet(), 0.04, 1e-3, 550e-9)


def test_rays_that_do_not_get_through_are_told_with_their_number_and_angle():
    with pytest.raises(NumericsError, match="64 rays get through, too few for 40 Zernike terms"):
        noll_coefficients(triplet(), D_LINE, 40, rings=4)
    with pytest.raises(NumericsError, match="chief ray at 80 degrees"):
        wavefront(singlet(math.inf, 6e-3, 4e-3, 1.5, 1e-4), D_LINE, POINTS, angle=math.radians(80))
    telecentric = Prescription(
        surfaces=(
            Surface(curvature=100.0, thickness=0.0, medium=glass(1.5)),
            Surface(curvature=0.0, thickness=0.02),
            Surface(curvature=0.0, thickness=5e-3),
        ),
        stop=2,
        stop_radius=1e-3,
    )
    with pytest.raises(NumericsError, match="telecentric entrance pupils"):
        wavefront(telecentric, D_LINE, POINTS)
    inside = camera_lens(triplet(), 0.55, 8e-3, 550e-9)
    with pytest.raises(NumericsError, match="rays at the rim of the aperture"):
        replace(inside, lens=replace(inside.lens, stop_radius=12e-3)).aberrations(550e-9)
