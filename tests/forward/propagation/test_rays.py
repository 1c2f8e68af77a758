"""The geometric rung: closed areas against counting, rays traced one by one, and the wave model
as the wavelength falls.
"""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad

from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.ray.rays import (
    RayLenslets,
    disc_below,
    error_bound,
    size_band,
    valid_for,
)
from tests.forward.propagation.cameras import WAVELENGTH, pupil_conjugate, small_camera
from tests.reference.window import column_energies


def ray_image(camera, point, grid=3, ring=1, wavelength=WAVELENGTH):
    """All superpixels of one column as one picture."""
    view = geometry(camera, wavelength)
    maker = RayLenslets(
        camera,
        view,
        SimpleNamespace(superpixels=(grid, grid)),
        size_band(camera, view, (grid, grid), ring, 1e-2, 1e-2),
    )
    rows, columns = view.pixel_shape
    out = np.empty((1, grid, grid, rows, columns))
    maker.columns(np.array([point[0]]), np.array([point[1]]), out)
    assert out.sum() <= maker.incident(np.array([0]), np.array([0]))[0] + 1e-12
    return out[0].transpose(0, 2, 1, 3).reshape(grid * rows, grid * columns)


def traced(camera, point, transmittance, grid=3, count=1200):
    """The same by tracing a dense grid of rays from the object through both lenses, a row
    of formulas a hop.
    """
    view = geometry(camera, WAVELENGTH)
    pitch, radius = view.superpixel_pitch, view.D1 / 2
    axis = (np.arange(count) + 0.5) / count * 2 * radius - radius
    places, inside = [], []
    for number, n, pixels in zip(point, view.object_shape, view.pixel_shape):
        source = -view.z1 / view.z2 * (number - (n - 1) / 2) * view.D2 / n
        angle = (axis - source) / view.z1 - axis / view.f1
        u = axis + view.z2 * angle
        lenslet = np.round(u / view.D2)
        t = u + view.z3 * (angle - (u - lenslet * view.D2) / view.f2)
        superpixel = np.round(t / pitch)
        pixel = (t - superpixel * pitch) / view.pixel_pitch + pixels / 2
        fits = (
            (np.abs(u - lenslet * view.D2) < view.lenslet_width / 2)
            & (np.abs(superpixel) <= grid // 2)
            & (pixel >= 0)
            & (pixel < pixels)
        )
        inside.append(fits & (np.abs(pixel % 1 - 0.5) < view.pixel_active / view.pixel_pitch / 2))
        places.append(((superpixel + grid // 2) * pixels + np.floor(pixel)).astype(int))
    weight = transmittance(axis[:, None], axis) * (inside[0][:, None] & inside[1])
    where = np.clip(places[0], 0, grid * view.pixel_shape[0] - 1)[
        :, None
    ] * grid * view.pixel_shape[1] + np.clip(places[1], 0, grid * view.pixel_shape[1] - 1)
    image = np.bincount(
        where.ravel(), weight.ravel(), grid**2 * view.pixel_shape[0] * view.pixel_shape[1]
    )
    return image.reshape(grid * view.pixel_shape[0], -1) / count**2 * view.D1**2


def disc(camera):
    radius = camera.main_lens.aperture_diameter / 2
    return lambda y, x: (
        (np.hypot(y, x) < radius) & (np.hypot(y, x) >= camera.main_lens.obscuration * radius)
    )


@pytest.mark.parametrize(
    "corner",
    [(0.3, -0.2), (-0.9, 0.7), (0.6, 0.95), (-0.4, -0.99), (1.0, 0.1), (2.0, 2.0), (-1.5, 0.3)],
)
def test_area_of_a_disc_below_a_corner(corner):
    y, x = corner
    heights = [np.sqrt(1 - y * y)] if abs(y) < 1 else []
    breaks = sorted({-1.0, *(b for h in heights for b in (-h, h) if b < x), min(max(x, -1), 1)})
    area = sum(
        quad(
            lambda s: max(0.0, min(y, np.sqrt(1 - s * s)) + np.sqrt(1 - s * s)), a, b, epsabs=1e-13
        )[0]
        for a, b in zip(breaks, breaks[1:])
    )
    assert disc_below(np.array(y), np.array(x)) == pytest.approx(area, abs=1e-11)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"object__distance": 0.53, "sensor__distance": 225e-6},
        {"object__distance": 0.6, "sensor__distance": 180e-6},
        {
            "object__distance": 0.5,
            "lenslet_array__fill_factor": 0.9,
            "sensor__pixel_fill_factor": 0.7,
        },
        {
            "main_lens__aperture_shape": "annulus",
            "main_lens__obscuration": 0.4,
            "object__distance": 0.52,
        },
        {"object__samples_per_lenslet": (6, 9), "sensor__pixels_per_lenslet": (11, 13)},
    ],
    ids=str,
)
def test_every_pixel_holds_the_rays_that_land_in_it(change):
    camera = small_camera(**change)
    lens = camera.main_lens
    area = np.pi * lens.aperture_diameter**2 / 4 * (1 - lens.obscuration**2)
    expected = traced(camera, (1, 6), disc(camera)) / area
    found = ray_image(camera, (1, 6))
    assert np.abs(found - expected).sum() < 1.2e-2 * expected.sum() and found.max() > 0


def test_filters_and_square_pupils():
    filters = [dict(center=550e-9, fwhm=20e-9, peak=p) for p in (0.9, 0.2, 0.4, 0.7)]
    camera = small_camera(
        main_lens__aperture_shape="square",
        object__distance=0.53,
        filter_array={"layout": (2, 2), "gap": 0.4e-3, "size": 5e-3, "filters": filters},
    )

    def transmittance(y, x):
        open_ = (
            (np.abs(y) > 0.2e-3)
            & (np.abs(y) < 2.5e-3)
            & (np.abs(x) > 0.2e-3)
            & (np.abs(x) < 2.5e-3)
        )
        return open_ * np.where(y < 0, np.where(x < 0, 0.9, 0.2), np.where(x < 0, 0.4, 0.7))

    expected = traced(camera, (3, 1), transmittance) / camera.main_lens.aperture_diameter**2
    assert np.abs(ray_image(camera, (3, 1)) - expected).sum() < 1.2e-2 * expected.sum()


def test_pupil_given_as_a_picture():
    picture = np.random.default_rng(3).random((7, 7)) * (np.arange(7) != 3)
    camera = small_camera(
        main_lens__aperture_shape="image", main_lens__aperture_image="p.png", object__distance=0.53
    ).attach(aperture_image=picture)
    width = camera.main_lens.aperture_diameter

    def transmittance(y, x):
        return picture[
            np.clip((y / width + 0.5) * 7, 0, 6).astype(int),
            np.clip((x / width + 0.5) * 7, 0, 6).astype(int),
        ]

    expected = traced(camera, (1, 6), transmittance) / picture.mean() / width**2
    assert np.abs(ray_image(camera, (1, 6)) - expected).sum() < 1.2e-2 * expected.sum()


@pytest.mark.parametrize("distance", [0.55, 0.53, 0.6])
def test_with_all_lenslets_no_light_is_lost(distance):
    camera = small_camera(
        object__distance=distance, sensor__distance=pupil_conjugate(small_camera())
    )
    camera = camera.replace(**{"sensor.pixel_pitch": camera.superpixel_pitch / 13})
    assert ray_image(camera, (0, 3), grid=7).sum() == pytest.approx(1, abs=1e-12)


def test_sensor_conjugate_to_the_pupil_does_not_see_the_focus():
    """kappa = 0: defocus moves light between lenslets only; all superpixels on top of each other
    show the same image.
    """
    z3 = pupil_conjugate(small_camera())
    piles = [
        ray_image(small_camera(object__distance=z, sensor__distance=z3), (0, 3))
        .reshape(3, 13, 3, 13)
        .sum((0, 2))
        for z in (0.55, 0.52)
    ]
    assert np.abs(piles[0] - piles[1]).max() < 1e-12


def test_rays_that_meet_in_one_point_light_one_pixel():
    """The lenslets image the plane that the main lens images the object onto: a = 0."""
    distance = 0.5
    view = geometry(small_camera(object__distance=distance), WAVELENGTH)
    image = 1 / (1 / view.z2 - view.eps)  # where the point is imaged, from the main lens
    camera = small_camera(
        object__distance=distance, sensor__distance=1 / (1 / view.f2 - 1 / (view.z2 - image))
    )
    view = geometry(camera, WAVELENGTH)
    assert abs(view.kappa * view.z2 * view.eps * view.z2 - 1) < 1e-9
    found = (
        ray_image(camera, (2, 5), grid=5)
        .reshape(5, 13, 5, 13)
        .transpose(0, 2, 1, 3)
        .reshape(25, -1)
    )
    assert (
        max(np.count_nonzero(s) for s in found) == 1
        and np.count_nonzero(found) > 3
        and found.sum() <= 1 + 1e-12
    )


def test_tilt_and_defocus_of_the_wavefront_are_shift_and_distance():
    camera = small_camera(object__distance=0.53)
    view = geometry(camera, WAVELENGTH)
    radius = camera.main_lens.aperture_diameter / 2
    term = dict(noll=4, coefficient=-view.eps * radius**2 / (4 * np.sqrt(3)))
    focused = small_camera(object__distance=0.53, main_lens__aberrations=(term,))
    assert np.abs(ray_image(focused, (2, 5)) - ray_image(small_camera(), (2, 5))).max() < 1e-12
    step = view.D2 / 8
    tilted = small_camera(
        object__distance=0.53,
        main_lens__aberrations=(dict(noll=2, coefficient=2 * step / view.z2 * radius / 2),),
    )
    assert np.abs(ray_image(tilted, (2, 3)) - ray_image(camera, (2, 5))).max() < 1e-12
    assert "affine" in valid_for(
        small_camera(main_lens__aberrations=(dict(noll=7, coefficient=50e-9),)), view
    )


def test_round_lenslets_in_focus_only():
    camera = small_camera(lenslet_array__aperture_shape="circle")
    assert valid_for(camera, geometry(camera, WAVELENGTH)) is None
    assert ray_image(camera, (0, 0)).sum() == 0 and ray_image(camera, (0, 3)).sum() > 0.9
    blurred = small_camera(lenslet_array__aperture_shape="circle", object__distance=0.53)
    assert "circle" in valid_for(blurred, geometry(blurred, WAVELENGTH))


@pytest.mark.parametrize("distance", [0.55, 0.52])
def test_waves_tend_to_rays(distance):
    """Ever shorter waves: the L1 distance falls, and the error that is stated beforehand is that
    found, within a factor.
    """
    errors = []
    for wavelength in (1.1e-6, 400e-9, 137.5e-9):
        camera = small_camera(
            object__distance=distance,
            light__wavelengths=(wavelength,),
            light__design_wavelength=wavelength,
        )
        view = geometry(camera, wavelength)
        point = (view.points(0)[1], view.points(1)[3])
        wave = column_energies(
            camera,
            wavelength,
            point,
            2,
            [(0, 0)],
            pixel_nodes=int(4 + 8 * view.D2 * 2e-6 / (wavelength * view.z3)),
        )[0, 0]
        rays = ray_image(camera, (1, 3), grid=1, wavelength=wavelength)
        errors.append(np.abs(rays - wave).sum() / wave.sum())
        assert (
            0.1
            < error_bound(camera, view, True) / (np.linalg.norm(rays - wave) / np.linalg.norm(wave))
            < 10
        )
    assert errors[1] < 0.75 * errors[0] and errors[2] < 0.7 * errors[1]


@pytest.mark.parametrize("f_number", [11, 12])
def test_no_pixel_has_less_than_no_light(f_number):
    """Where the pupil's image is smaller than the superpixel most pixels are dark: differences
    of equal areas, which round.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.forward.accuracy.dial import system_matrix

    camera = load_camera(Path(__file__).resolve().parents[3] / "sample_configs" / "tiny.toml")
    camera = camera.replace(
        **{
            "main_lens.aperture_diameter": 0.055 / f_number,
            "sensor.pixels_per_lenslet": (9, 9),
            "lenslet_array.pitch": 18e-6 / (1 + 208e-6 / 55e-3),
        }
    )
    matrix = system_matrix(camera, model="ray", superpixels=(1, 1)).A
    assert matrix.min() == 0 and matrix.max() > 0
