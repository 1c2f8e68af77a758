"""The main lens as lenslets off the axis see it: rims, and aberrations that grow with the field."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from plenocli.base.errors import ConfigError, NumericsError
from plenocli.files.config.camera_file import parse_camera, to_toml
from plenocli.forward.camera.field import at_field, overlap, pupil_change, shift_of
from plenocli.forward.camera.geometry import chief_ray, geometry
from plenocli.forward.camera.lens import camera_lens, transmitted, wavefront
from plenocli.forward.camera.prescription import Prescription
from plenocli.forward.camera.pupil import aperture_area, aperture_picture
from plenocli.forward.camera.pupil import wavefront as of_pupil
from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import cell_rows
from tests.forward.camera.lenses import triplet
from tests.forward.propagation.cameras import TEXT, WAVELENGTH, small_camera


def row(height, transmission=1.0, **terms):
    """A row of the table; terms: z8=2e-7."""
    return {
        "height": height,
        "transmission": transmission,
        "aberrations": [{"noll": int(j[1:]), "coefficient": c} for j, c in terms.items()],
    }


def wide(*rows, **changes):
    """The small camera with 201 x 201 lenslets and a table of its field."""
    return small_camera(**{"main_lens__field": rows, "lenslet_array__count": (201, 201)} | changes)


def open_share(camera, chief):
    """Share of the whole pupil that a lenslet sees, by the rule that matrices are made with."""
    seen = at_field(camera, WAVELENGTH, chief)
    rows = pupil_rows(seen, geometry(camera, WAVELENGTH, None, chief), 1e4)
    # with W weights are waves; without, those of a hole are negative
    size = np.abs if seen.main_lens.aberrations else np.real
    return sum(size(r.weight).sum() for r in rows) / aperture_area(seen.main_lens)


@pytest.mark.parametrize("share", [1 - 1e-6, 0.999, 0.9, 0.5, 0.1])
@pytest.mark.parametrize("azimuth", [0.0, 0.3, math.pi / 2])
def test_two_discs_overlap_as_the_closed_form_says(share, azimuth):
    shift = shift_of(share)
    lens = (math.acos(shift / 2) * 2 - shift / 2 * math.sqrt(4 - shift**2)) / math.pi
    assert lens == pytest.approx(share, abs=1e-12) == overlap(shift)
    moved = (-shift * math.sin(azimuth), -shift * math.cos(azimuth), 1.0)
    parts = cell_rows((-1, 1, -1, 1), [(0.0, 0.0, 1.0), moved], 30.0)
    assert sum(r.weight.sum() for r in parts) / math.pi == pytest.approx(share, abs=1e-12)


def test_what_two_discs_leave_is_integrated_to_nine_digits():
    """Inclusion and exclusion: three whole discs in Airy's closed form, one of them far inside."""
    discs = [(0.0, 0.0, 1.0), (0.1, -0.2, 1.4), (0.05, 0.02, 0.5)]
    rows = cell_rows((-1, 1, -1, 1), discs, 30.0)
    wave = sum(np.sum(r.weight * np.exp(1j * (12 * r.x - 9 * r.y[:, None]))) for r in rows)
    inner = 2 * np.pi * 0.5 * j1(15 * 0.5) / 15 * np.exp(1j * (12 * 0.02 - 9 * 0.05))
    assert wave == pytest.approx(inner, abs=1e-9)


@pytest.mark.parametrize("shape", ["circle", "annulus", "square"])
@pytest.mark.parametrize("filters", [False, True])
def test_rims_cut_every_pupil_as_a_raster_of_it(shape, filters):
    changes = {"main_lens__aperture_shape": shape}
    if shape == "annulus":
        changes["main_lens__obscuration"] = 0.4
    if filters:
        band = {"center": WAVELENGTH, "fwhm": 50e-9, "peak": 1.0}
        changes["filter_array"] = {"layout": (2, 2), "gap": 2e-4, "filters": [band] * 4}
    camera = wide(row(0.0), row(0.01, 0.4), **changes)
    chief = (0.003, -0.005)
    axis = (np.arange(2001) - 1000) / 1000 * camera.main_lens.aperture_diameter / 2
    seen = at_field(camera, WAVELENGTH, chief)
    lit = aperture_picture(seen.main_lens, axis[:, None], axis)
    if filters:
        half, gap = camera.filter_array.size / 2, 1e-4
        inside = (np.abs(axis) <= half) & (np.abs(axis) >= gap)
        lit = lit * np.outer(inside, inside)
    whole = aperture_area(seen.main_lens)
    expected = lit.sum() * (axis[1] - axis[0]) ** 2 / whole
    assert open_share(camera, chief) == pytest.approx(expected, rel=2e-3)


def test_rows_are_interpolated_and_turned_to_the_lenslet():
    """A term in the direction of the lenslet is that of its row there, and no other across."""
    camera = wide(row(0.0, z8=0.0), row(0.004, z8=2e-7, z6=1e-7), row(0.008, z8=3e-7, z6=-1.4e-7))
    chief = (-0.003 * math.sqrt(3), 0.003)  # 6 mm, 60 degrees up
    lens = at_field(camera, WAVELENGTH, chief).main_lens
    rho, theta = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 2 * np.pi, 9))
    r, a = rho * lens.aperture_diameter / 2, theta - math.pi / 3
    found = of_pupil(lens, r * np.sin(a), r * np.cos(a))
    coma = 2.5e-7 * math.sqrt(8) * (3 * rho**3 - 2 * rho) * np.cos(theta)
    # astigmatism is linear in the squared height: 1e-7 - 2.4e-7 (36 - 16)/(64 - 16) is none
    assert np.abs(found - coma).max() < 1e-18
    assert at_field(camera, WAVELENGTH).main_lens.aberrations == ()


def test_terms_of_one_index_add_up():
    coma = {"noll": 8, "coefficient": 1e-8}
    camera = wide(row(0.0, z4=1e-8), row(0.01) | {"aberrations": [coma, coma]})
    lens = at_field(camera, WAVELENGTH, (0.0, 0.01)).main_lens
    assert [(a.noll, a.coefficient) for a in lens.aberrations] == [(8, pytest.approx(2e-8))]


def test_right_angles_keep_the_symmetry_exactly():
    camera = wide(row(0.0), row(0.01, 0.7, z8=2e-7, z6=1e-7, z10=1e-7))
    right, down = (at_field(camera, WAVELENGTH, c).main_lens for c in ((0.0, 4e-3), (4e-3, 0.0)))
    y, x = np.linspace(-3e-3, 3e-3, 7)[:, None], np.linspace(-2e-3, 3e-3, 5)
    assert np.allclose(of_pupil(right, y, x), of_pupil(down, x.T[:, None], y.T).T, rtol=1e-13)
    assert np.array_equal(of_pupil(right, y, x), of_pupil(right, -y, x))
    assert [(y, x) for y, x, _ in right.rims] == [(x, y) for y, x, _ in down.rims]


@pytest.mark.parametrize(
    "rows, message",
    [
        ([row(1e-3)], "must ascend from 0"),
        ([row(0.0), row(0.0)], "must ascend from 0"),
        ([row(0.0), row(1e-4)], "main_lens.field ends at 100 um from the axis, the array"),
        ([row(0.0), row(0.01, z7=1e-9)], "Noll terms 7 are sines"),
        ([row(0.0, z8=1e-9), row(0.01)], "the same in all directions"),
        ([row(0.0, 0.9), row(0.01)], "the same in all directions"),
        ([row(0.0), row(0.01, 1.2)], "transmission"),
    ],
)
def test_rows_that_cannot_be_are_refused(rows, message):
    with pytest.raises(ValueError, match=message):
        wide(*rows)


def test_a_table_is_written_as_it_was_read():
    lines = (
        'field = [{ height = "0 mm" }, { height = "40 um", transmission = 0.8, '
        'aberrations = [{ noll = 8, coefficient = "20 nm" }] }]\n'
    )
    camera = parse_camera(TEXT.replace("[object]", lines + "[object]"))
    assert camera.main_lens.field[1].transmission == 0.8
    assert parse_camera(to_toml(camera)) == camera


def test_an_aperture_image_has_no_rim():
    image = {"main_lens__aperture_image": "a.exr", "main_lens__aperture_shape": "image"}
    camera = wide(row(0.0), row(0.01), **image)
    with pytest.raises(ValueError, match="transmission below 1"):
        wide(row(0.0), row(0.01, 0.5), **image)
    assert at_field(camera, WAVELENGTH, (0.0, 1e-3)).main_lens.rims == ()


# prescriptions


def with_rims(scale=1.0) -> Prescription:
    """The triplet with clear apertures, over which `scale` is 1 where they are as usual."""
    sizes = [9.5e-3, 9.5e-3, 5e-3, 5e-3, math.inf, 7.5e-3, 7.5e-3]
    lens = triplet()
    surfaces = [replace(s, semi_diameter=scale * d) for s, d in zip(lens.surfaces, sizes)]
    return replace(lens, surfaces=tuple(surfaces))


def traced_camera(lens, f_number=6.0):
    camera = small_camera(
        main_lens__prescription="triplet.toml",
        main_lens__aperture_diameter=55e-3 / f_number,
        lenslet_array__count=(1101, 1101),
    )
    return camera.attach(prescription=lens)


@pytest.mark.parametrize("height", [1e-3, 6e-3, 12e-3])
def test_a_traced_wavefront_is_that_of_its_rays(height):
    """Other rays than it was fitted to, of a field found by bisection; as similar triangles between
    stop and pupil have it, which the fit does not use: right to the pupil's own distortion.
    """
    camera = traced_camera(triplet())
    lens, z2 = at_field(camera, WAVELENGTH, (0.0, height)).main_lens, 55e-3
    inside = camera_lens(triplet(), 0.55, camera.main_lens.aperture_diameter, WAVELENGTH)
    rng = np.random.default_rng(5)
    rho, turn = np.sqrt(rng.random(60)) * 0.9, rng.random(60) * 2 * np.pi
    points = np.stack([rho * np.cos(turn), rho * np.sin(turn)])
    angle = _angle_of(inside, height * inside.z2 / z2)
    wave = wavefront(inside.lens, WAVELENGTH, points, angle, inside.object_distance)
    # tracing has the field along +y, this lenslet stands along +x
    across, along = points * lens.aperture_diameter / 2
    found = of_pupil(lens, across, along)
    assert np.std(found - wave.error) < 0.04 * np.std(wave.error)
    assert np.std(of_pupil(lens, across, -along) - wave.error) > 0.3 * np.std(wave.error)


@pytest.mark.parametrize("scale", [0.8, 0.6, 0.5])
@pytest.mark.parametrize("height", [0.0, 6e-3, 12e-3])
def test_rims_of_a_lens_leave_the_share_that_its_rays_say(scale, height):
    """Of the stop's area, as counted ray by ray; the pupil's own distortion is the rest."""
    lens = with_rims(scale)
    camera = traced_camera(lens)
    inside = camera_lens(lens, 0.55, camera.main_lens.aperture_diameter, WAVELENGTH)
    angle = _angle_of(inside, height * inside.z2 / 55e-3) if height else 0.0
    expected = transmitted(inside.lens, WAVELENGTH, angle, inside.object_distance, rings=64)
    assert open_share(camera, (0.0, height)) == pytest.approx(expected, rel=0.03)


def test_the_field_begins_where_the_axis_ends():
    camera = traced_camera(triplet())
    y, x = np.linspace(-4e-3, 4e-3, 9)[:, None], np.linspace(-4e-3, 4e-3, 9)
    inside = np.hypot(y, x) < camera.main_lens.aperture_diameter / 2
    axis, beside = (
        of_pupil(at_field(camera, WAVELENGTH, c).main_lens, y, x)[inside]
        for c in ((0.0, 0.0), (1e-7, 0.0))
    )
    assert np.std(axis - beside) < 0.02 * np.std(axis)


def test_lenslets_without_light_are_told():
    camera = traced_camera(with_rims(0.3))
    with pytest.raises(NumericsError, match="keep all light from a lenslet 2[0-9.]* degrees off"):
        at_field(camera, WAVELENGTH, (0.0, 22e-3))
    assert pupil_change(camera, WAVELENGTH, (0.0, 22e-3)) == 1.0


def test_a_camera_is_resolved_once():
    camera = wide(row(0.0), row(0.01, 0.9, z8=1e-7))
    seen = at_field(camera, WAVELENGTH, (0.0, 3e-3))
    assert at_field(seen, WAVELENGTH, (0.0, 5e-3)) is seen
    plain = small_camera()
    assert at_field(plain, WAVELENGTH, (0.0, 3e-3)) is plain
    with pytest.raises(ConfigError, match="the rows end at"):
        at_field(camera, WAVELENGTH, (0.0, 0.02))


def test_the_change_of_a_pupil_is_what_it_is_made_of():
    chief = (0.0, 5e-3)
    cut = pupil_change(wide(row(0.0), row(5e-3, 0.91)), WAVELENGTH, chief)
    assert cut == pytest.approx(0.3, rel=0.02)
    bent = pupil_change(wide(row(0.0), row(5e-3, z8=5e-9)), WAVELENGTH, chief)
    assert bent == pytest.approx(2 * np.pi * 5e-9 / WAVELENGTH, rel=0.02)
    camera = wide(row(0.0), row(5e-3))
    assert pupil_change(camera, WAVELENGTH, chief_ray(camera, 100, 110)) == 0.0


def _angle_of(inside, height):
    """Field angle of an image height, by bisection."""
    from scipy.optimize import brentq

    from plenocli.forward.camera.lens import chief_height, image_plane

    plane = image_plane(inside.lens, inside.object_distance)
    return brentq(
        lambda a: chief_height(inside.lens, WAVELENGTH, a, inside.object_distance, plane) - height,
        1e-6,
        0.4,
    )
