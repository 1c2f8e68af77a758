"""Everything a camera can be made of beyond squares and discs: hexagonal lattices and lenslets,
pupils and wavefronts given as values, lenslets off the axis on the sensor's own raster. Against
brute force, closed forms and exact identities.
"""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import ConfigError
from plenocli.forward.camera.geometry import array_position, geometry, lenslet_shift
from plenocli.forward.camera.pupil import ray_reach, wavefront, zernike
from plenocli.forward.camera.quadrature import smooth_nodes
from plenocli.forward.propagation.fresnel.shaped import ShapedLenslets, chords, valid_for
from plenocli.forward.propagation.fresnel.spread_function import sampled_field
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import WAVELENGTH, plan_pif, pupil_conjugate, small_camera
from tests.reference.fresnel import (
    disc_nodes,
    hexagon_nodes,
    lenslet_centre,
    pixel_energies,
    rectangle_nodes,
)

HEXAGONAL = {
    "lenslet_array__lattice": "hexagonal",
    "lenslet_array__aperture_shape": "hexagon",
    "sensor__pixels_per_lenslet": (11, 13),
}
SEVENTEEN = [
    (r, int(x - r / 2))
    for r in range(-2, 3)
    for x in (np.arange(-1, 2) if r % 2 == 0 else np.arange(-1.5, 2))
]
"""The coherent window of one ring on a hexagonal lattice, in axial numbers."""
SLOW = {"main_lens__aperture_diameter": 2.5e-3}
"""f/22 at the main lens, for which few nodes are an exact reference."""
ROUGH = dict(pupil_nodes=(24, 56), lenslet_nodes=22)


def image_point(camera, index):
    rows, columns = camera.object.samples_per_lenslet
    high, wide = lenslet_centre(camera, 1, 0)[0], camera.lenslet_array.pitch
    return (index // columns - (rows - 1) / 2) * high / rows, (
        index % columns - (columns - 1) / 2
    ) * wide / columns


def column(camera, index, *, ring=0, grid=(1, 1), accuracy=1e-6, shift=None, wavelength=WAVELENGTH):
    plan = plan_pif(
        camera,
        wavelengths=(wavelength,),
        superpixels=grid,
        coherent_ring=ring,
        accuracy=accuracy,
        dtype=np.float64,
    )
    builder = PifBuilder(camera, wavelength, replace(plan, pixel_shift=shift), dtype=np.float64)
    return builder, builder.columns([index])[..., 0].reshape(-1, *camera.sensor.pixels_per_lenslet)


def apart(found, truth):
    return np.linalg.norm(found - truth) / np.linalg.norm(truth)


# lenslets


@pytest.mark.parametrize("shape", ["square", "circle", "hexagon"])
def test_chords_integrate_polynomials_and_waves_over_the_shape(shape):
    width, slope = 2.0, 60.0
    cut = chords(shape, width, slope, 1e-13)
    nodes = {
        "square": rectangle_nodes(-1, 1, -1, 1, 60),
        "circle": disc_nodes(1.0, 60, 160),
        "hexagon": hexagon_nodes(width, 60),
    }[shape]

    def integral(f):
        panels = [(x, w) for xs, ws in cut.pieces for x, w in zip(xs, ws)]
        assert len(panels) == len(cut.at)
        return sum(
            cut.weight[h, i] * sum(np.sum(w * f(cut.at[h, i], x)) for x, w in panels[: h + 1])
            for h in range(len(cut.at))
            for i in range(cut.at.shape[1])
        )

    turn = (lambda s, c: (c, s)) if cut.axis else (lambda s, c: (s, c))
    for f in (
        lambda y, x: 1.0 + 0 * x * y,
        lambda y, x: y**2 * x**4,
        lambda y, x: np.exp(1j * (36 * y + 48 * x)),
        lambda y, x: np.exp(1j * (-58 * y + 10 * x)),
    ):
        truth = np.sum(nodes[2] * f(nodes[0], nodes[1]))
        assert abs(integral(lambda s, c: f(*turn(s, c))) - truth) < 1e-9


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"lenslet_array__fill_factor": 0.7, "object__distance": 0.52},
        {
            "lenslet_array__aperture_shape": "circle",
            "lenslet_array__fill_factor": 0.95,
            "main_lens__aperture_shape": "square",
        },
        {
            "lenslet_array__aperture_shape": "square",
            "lenslet_array__fill_factor": 0.8,
            "sensor__distance": 230e-6,
        },
    ],
    ids=str,
)
def test_hexagonal_lattice_against_brute_force(change):
    camera = small_camera(**HEXAGONAL | change)
    pupil = (
        dict(pupil_nodes=(34, 100))
        if "main_lens__aperture_shape" in change or "object__distance" in change
        else {}
    )
    # a corner point's image lies outside of its own hexagon: the column is faint
    for index in (18, 29) if not change else (29,):
        builder, found = column(camera, index)
        assert isinstance(builder.lenslets, ShapedLenslets)
        assert (
            apart(
                found[0],
                pixel_energies(
                    camera,
                    WAVELENGTH,
                    image_point(camera, index),
                    [(0, 0)],
                    (0, 0),
                    **ROUGH | pupil,
                ),
            )
            < 1e-6
        )


def test_hexagons_on_a_square_lattice():
    camera = small_camera(lenslet_array__aperture_shape="hexagon", lenslet_array__fill_factor=0.8)
    _, found = column(camera, 11)
    y, x = (np.array(divmod(11, 8)) - 3.5) * camera.lenslet_array.pitch / 8
    assert (
        apart(found[0], pixel_energies(camera, WAVELENGTH, (y, x), [(0, 0)], (0, 0), **ROUGH))
        < 1e-6
    )


def test_hexagonal_neighbours_add_coherently_in_axial_numbers():
    camera = small_camera(**HEXAGONAL | SLOW)
    _, found = column(camera, 3, ring=1)
    truth = pixel_energies(
        camera,
        WAVELENGTH,
        image_point(camera, 3),
        SEVENTEEN,
        (0, 0),
        pupil_nodes=(14, 36),
        lenslet_nodes=19,
    )
    assert apart(found[0], truth) < 1e-6
    alone = pixel_energies(
        camera,
        WAVELENGTH,
        image_point(camera, 3),
        [(0, 0)],
        (0, 0),
        pupil_nodes=(14, 36),
        lenslet_nodes=19,
    )
    assert apart(alone, truth) > 0.05


def test_superpixels_of_a_hexagonal_lattice_are_numbered_axially():
    """Offset (1, 0) stands half a pitch to the right and sqrt(3)/2 down."""
    camera = small_camera(**HEXAGONAL | SLOW)
    builder, found = column(camera, 5, grid=(3, 3))
    assert not any(builder.symmetry)
    scale = camera.superpixel_pitch / camera.lenslet_array.pitch
    for offset, image in list(zip(builder.offsets.tolist(), found))[1::3]:
        centre = tuple(c * scale for c in lenslet_centre(camera, *offset))
        truth = pixel_energies(
            camera,
            WAVELENGTH,
            image_point(camera, 5),
            [tuple(offset)],
            centre,
            pupil_nodes=(14, 36),
            lenslet_nodes=18,
        )
        assert np.linalg.norm(image - truth) < 1e-6 * np.linalg.norm(found)


@pytest.mark.parametrize("shape", ["circle", "hexagon"])
def test_every_column_of_a_hexagonal_lattice_by_symmetry_is_the_column_itself(shape):
    camera = small_camera(
        **HEXAGONAL
        | {"lenslet_array__aperture_shape": shape, "object__samples_per_lenslet": (5, 6)}
    )
    plan = plan_pif(camera, superpixels=(1, 1), coherent_ring=1, accuracy=1e-6, dtype=np.float64)
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    assert tuple(builder.symmetry) == (True, True, False)
    whole = builder.columns(slice(None))
    seen = np.zeros(30, bool)
    for points, block in builder.blocks():
        np.testing.assert_allclose(block, whole[:, :, points], atol=1e-12 * whole.max())
        seen[points] = True
    assert seen.all()


def test_hexagons_pass_all_light_between_them():
    """Close-packed hexagons tile the plane: the light of a point enters its neighbourhood but
    for the tail of the spread function.
    """
    camera = small_camera(**HEXAGONAL)
    plan = plan_pif(camera, superpixels=(1, 1), coherent_ring=2, accuracy=1e-6, dtype=np.float64)
    lenslets = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64).lenslets
    share = lenslets.incident(np.array([0, 3, 4]), np.array([0, 5, 4]))
    # encircled energy within the window's nearest edge, 2/(pi v) outside of it
    view = geometry(camera, WAVELENGTH)
    inner = 2 * view.wavelength * view.z2 / (np.pi**2 * 2.0 * view.D2 * view.D1)
    assert np.all(share < 1) and np.all(share > 1 - 1.5 * inner)


# pupils and wavefronts as values


def gradual(n, seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (n, n))


def with_image(image, **changes):
    return small_camera(
        main_lens__aperture_shape="image", main_lens__aperture_image="pupil.png", **changes
    ).attach(aperture_image=image)


def cells(image, side, nodes):
    """Pupil of pixel_energies for an aperture image: (y, x, weight with the amplitude), and the
    area that counts as 1.
    """
    n = len(image)
    edge = (np.arange(n + 1) / n - 0.5) * side
    parts = []
    for i in range(n):
        for j in range(n):
            y, x, w = rectangle_nodes(edge[i], edge[i + 1], edge[j], edge[j + 1], nodes)
            parts.append((y, x, w * np.sqrt(image[i, j])))
    return tuple(np.concatenate(p) for p in zip(*parts)), side**2 * image.mean()


@pytest.mark.parametrize(
    "change", [{}, {"lenslet_array__aperture_shape": "circle", "object__distance": 0.53}], ids=str
)
def test_image_pupils_against_brute_force(change):
    image = gradual(3)
    camera = with_image(image, **change)
    pupil, area = cells(image, camera.main_lens.aperture_diameter, 18)
    y, x = (np.array(divmod(11, 8)) - 3.5) * camera.lenslet_array.pitch / 8
    _, found = column(camera, 11)
    assert (
        apart(
            found[0],
            pixel_energies(
                camera,
                WAVELENGTH,
                (y, x),
                [(0, 0)],
                (0, 0),
                pupil=pupil,
                area=area,
                lenslet_nodes=22,
            ),
        )
        < 1e-6
    )


def test_an_image_pupil_behind_a_filter_array_is_cut_at_both_their_edges():
    image = gradual(3, 1)
    camera = with_image(
        image,
        filter_array={
            "layout": (1, 2),
            "gap": 0.4e-3,
            "size": 5e-3,
            "filters": [dict(center=550e-9, fwhm=20e-9, peak=p, blocking=0.0) for p in (0.9, 0.4)],
        },
    )
    side = camera.main_lens.aperture_diameter
    edge, parts = (np.arange(4) / 3 - 0.5) * side, []
    for (x0, x1), t in (((-2.5e-3, -0.2e-3), 0.9), ((0.2e-3, 2.5e-3), 0.4)):
        for i in range(3):
            for j in range(3):
                box = (
                    max(edge[i], -2.5e-3),
                    min(edge[i + 1], 2.5e-3),
                    max(edge[j], x0),
                    min(edge[j + 1], x1),
                )
                if box[0] < box[1] and box[2] < box[3]:
                    y, x, w = rectangle_nodes(*box, 18)
                    parts.append((y, x, w * np.sqrt(t * image[i, j])))
    pupil = tuple(np.concatenate(p) for p in zip(*parts))
    _, found = column(camera, 11)
    y, x = (np.array(divmod(11, 8)) - 3.5) * camera.lenslet_array.pitch / 8
    assert (
        apart(
            found[0],
            pixel_energies(
                camera,
                WAVELENGTH,
                (y, x),
                [(0, 0)],
                (0, 0),
                pupil=pupil,
                area=side**2 * image.mean(),
            ),
        )
        < 1e-6
    )


def painted(n, inner):
    """An annulus as n x n cells, each with the share of it that is open (by 16 x 16 points)."""
    t = (np.arange(16 * n) + 0.5) / (8 * n) - 1
    r = np.hypot(t[:, None], t[None, :])
    return ((r <= 1) & (r >= inner)).reshape(n, 16, n, 16).mean(axis=(1, 3))


def test_pictures_of_an_annulus_converge_to_it():
    reference = column(
        small_camera(main_lens__aperture_shape="annulus", main_lens__obscuration=0.4), 11
    )[1][0]
    errors = [
        apart(column(with_image(painted(n, 0.4)), 11)[1][0], reference) for n in (16, 64, 256)
    ]
    assert errors[2] < 5e-3 and errors[1] < errors[0] / 2.5 and errors[2] < errors[1] / 2.5


def test_a_flipped_pupil_gives_the_flipped_matrix():
    """Rows of the picture run as the sensor's: turning it upside down turns A, for the
    object turned too.
    """
    image = gradual(5, 2)
    # with curvature left, so that nothing is symmetric by itself
    (_, straight), (_, flipped) = (
        column(with_image(image), 11),
        column(with_image(image[::-1]), (7 - 1) * 8 + 3),
    )
    np.testing.assert_allclose(flipped[0], straight[0][::-1], atol=1e-10 * straight.max())
    assert apart(flipped[0], straight[0]) > 0.05


def test_light_through_one_corner_of_the_pupil_lands_in_the_opposite_corner_of_the_superpixel():
    """The picture's upper left is the pupil's upper left, looking along the light;
    lenslets invert it.
    """
    image = np.zeros((4, 4))
    image[0, 0] = 1
    camera = with_image(image)
    camera = camera.replace(
        **{"sensor.distance": pupil_conjugate(camera), "object.samples_per_lenslet": (1, 1)}
    )
    _, found = column(camera, 0)
    y, x = np.indices(found[0].shape)
    assert np.average(y, weights=found[0]) > 8 and np.average(x, weights=found[0]) > 8


def grid_of(function, camera, n):
    centres = ((np.arange(n) + 0.5) / n - 0.5) * camera.main_lens.aperture_diameter
    return function(centres[:, None], centres[None, :])


def test_a_wavefront_grid_that_samples_zernike_terms_equals_their_coefficients():
    terms = ((4, 60e-9), (6, -35e-9), (8, 45e-9), (11, 30e-9))
    named = small_camera(
        main_lens__aberrations=tuple(dict(noll=j, coefficient=c) for j, c in terms)
    )
    radius = named.main_lens.aperture_diameter / 2
    truth = column(named, 11)[1][0]
    errors = []
    for n in (12, 24, 48):
        values = grid_of(
            lambda y, x: sum(c * zernike(j, y / radius, x / radius) for j, c in terms), named, n
        )
        camera = small_camera(main_lens__wavefront="w.h5").attach(wavefront=values)
        errors.append(apart(column(camera, 11)[1][0], truth))
    # cubic splines: third-order terms exactly, the fourth order of Noll 11 as the fourth
    # power of the spacing
    assert errors[2] < 2e-6 and errors[1] < errors[0] / 8 and errors[2] < errors[1] / 6
    exact = small_camera(main_lens__wavefront="w.h5").attach(
        wavefront=grid_of(lambda y, x: 40e-9 * zernike(7, y / radius, x / radius), named, 9)
    )
    coma = small_camera(main_lens__aberrations=(dict(noll=7, coefficient=40e-9),))
    assert apart(column(exact, 11)[1][0], column(coma, 11)[1][0]) < 1e-9


def test_a_wavefront_grid_adds_to_the_named_terms():
    camera = small_camera(
        main_lens__wavefront="w.h5", main_lens__aberrations=(dict(noll=5, coefficient=30e-9),)
    )
    camera = camera.attach(wavefront=grid_of(lambda y, x: 1e-6 * y * x / 1e-6, camera, 5) * 1e-6)
    radius = camera.main_lens.aperture_diameter / 2
    y, x = np.array([1e-3, -2e-3]), np.array([0.5e-3, 3.4e-3])
    np.testing.assert_allclose(
        wavefront(camera.main_lens, y, x),
        1e-6 * y * x + 30e-9 * zernike(5, y / radius, x / radius),
        rtol=1e-9,
    )


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_a_defocus_grid_is_a_changed_object_distance(shape):
    """W = a (x^2 + y^2) is eps -> eps + 2 a, exactly."""
    plain = small_camera(lenslet_array__aperture_shape=shape)
    a = 0.02
    moved = plain.replace(**{"object.distance": 1 / (1 / plain.object.distance + 2 * a)})
    bent = small_camera(lenslet_array__aperture_shape=shape, main_lens__wavefront="w.h5")
    bent = bent.attach(wavefront=grid_of(lambda y, x: a * (y * y + x * x), plain, 6))
    one, other = (column(camera, 11, ring=1) for camera in (moved, bent))
    assert (
        one[0].geometry.blur == pytest.approx(other[0].geometry.blur, rel=1e-3)
        and one[0].plan.bands[0].window == other[0].plan.bands[0].window
    )
    # the image points agree: both are counted on the array
    np.testing.assert_allclose(other[1], one[1], atol=1e-9 * one[1].max())


def test_a_tilt_moves_the_image_by_its_slope_times_z2():
    """W = g x moves the image of a point by z2 g: here by one object point to the right, and the
    pupil's image stays.
    """
    plain = small_camera()
    step = plain.lenslet_array.pitch / 8
    slope = step / plain.lenslet_array.distance
    tilted = small_camera(main_lens__wavefront="w.exr").attach(
        wavefront=grid_of(lambda y, x: slope * x + 0 * y, plain, 4)
    )
    np.testing.assert_allclose(column(tilted, 11)[1], column(plain, 12)[1], atol=1e-9)
    far = small_camera(main_lens__wavefront="w.exr").attach(
        wavefront=grid_of(lambda y, x: 16 * slope * x + 0 * y, plain, 4)
    )
    assert ray_reach(far.main_lens, 0.0, far.lenslet_array.distance) == pytest.approx(
        16 * step, rel=1e-6
    )
    # two lenslets away: the plan's coherent window follows the light
    assert column(far, 11, ring=1)[0].plan.bands[0].window >= 3


def test_rays_of_an_aberrated_pupil_reach_as_far_as_the_spread_function():
    camera = small_camera(
        main_lens__aberrations=(dict(noll=7, coefficient=1.5e-6), dict(noll=11, coefficient=1e-6))
    )
    view = geometry(camera, WAVELENGTH)
    reach = view.blur / 2
    t, w = np.polynomial.legendre.leggauss(180)
    half = 1.6 * reach
    energy = np.abs(sampled_field(camera, view, half * t, half * t)) ** 2 * np.outer(w, w) * half**2
    inside = np.maximum(np.abs(t)[:, None], np.abs(t)[None, :]) * half <= reach
    assert energy[inside].sum() > 0.97
    outer = np.maximum(np.abs(t)[:, None], np.abs(t)[None, :]) * half <= 0.8 * reach
    assert energy[outer].sum() < energy[inside].sum() - 5e-3


@pytest.mark.parametrize("phase", [0.01, 0.3, 1.0, 3.0, 9.0])
def test_few_nodes_suffice_for_little_phase(phase):
    count = smooth_nodes(phase, 1e-10)
    t, w = np.polynomial.legendre.leggauss(count)
    assert abs(w @ np.exp(1j * phase * t) - 2 * np.sinc(phase / np.pi)) < 2e-10
    if count > 1:
        t, w = np.polynomial.legendre.leggauss(count - 1)
        assert abs(w @ np.cos(phase * t) - 2 * np.sinc(phase / np.pi)) > 1e-12


# colour


@pytest.mark.parametrize("wavelength", [450e-9, 650e-9])
def test_glass_changes_both_focal_lengths_with_wavelength(wavelength):
    """Sellmeier's equation of N-BK7 and fused silica written out, the lens-maker's law, and
    brute force with these focal lengths.
    """
    camera = small_camera(
        main_lens__glass="N-BK7",
        lenslet_array__glass="fused silica",
        light__design_wavelength=550e-9,
    )

    def index(b, c, w):
        w2 = (w * 1e6) ** 2
        return np.sqrt(1 + sum(bi * w2 / (w2 - ci) for bi, ci in zip(b, c)))

    bk7 = (1.03961212, 0.231792344, 1.01046945), (0.00600069867, 0.0200179144, 103.560653)
    silica = (0.6961663, 0.4079426, 0.8974794), (0.0684043**2, 0.1162414**2, 9.896161**2)
    f1, f2 = (
        f * (index(*g, 550e-9) - 1) / (index(*g, wavelength) - 1)
        for f, g in ((50e-3, bk7), (208e-6, silica))
    )
    assert abs(f1 / 50e-3 - 1) > 2e-3
    point = (np.array(divmod(11, 8)) - 3.5) * camera.lenslet_array.pitch / 8
    _, found = column(camera, 11, wavelength=wavelength)
    truth = pixel_energies(
        camera,
        wavelength,
        point,
        [(0, 0)],
        (0, 0),
        f1=f1,
        f2=f2,
        pupil_nodes=(50, 130),
        lenslet_nodes=52,
    )
    assert apart(found[0], truth) < 1e-6
    achromatic = pixel_energies(
        camera, wavelength, point, [(0, 0)], (0, 0), pupil_nodes=(50, 130), lenslet_nodes=52
    )
    assert apart(found[0], achromatic) > 0.02


# lenslets off the axis

OFF = {"lenslet_array__count": (5, 5), "sensor__pixels_per_lenslet": (13, 13)}


def off_raster(**changes):
    """Superpixels 13.31 pixels apart on a raster of 13 a lenslet."""
    return small_camera(**OFF | {"lenslet_array__pitch": 26.62e-6 / (1 + 208e-6 / 55e-3)} | changes)


@pytest.mark.parametrize(
    "shape, place", [("square", (0, 3)), ("circle", (4, 4)), ("hexagon", (0, 2))]
)
def test_an_off_axis_lenslet_sees_the_raster_shifted_by_part_of_a_pixel(shape, place):
    """Brute force on the whole camera: the lenslet off the axis, its object points, and pixels
    of one centred raster.
    """
    camera = off_raster(lenslet_array__aperture_shape=shape, lenslet_array__fill_factor=0.8, **SLOW)
    pitch, pixel = camera.lenslet_array.pitch, camera.sensor.pixel_pitch
    first_row, first_column, shift = lenslet_shift(camera, *place)
    assert 0 < max(abs(s) for s in shift) <= 0.5
    builder, found = column(camera, 11, shift=shift)
    lenslet = place[0] - 2, place[1] - 2  # from the middle of the array, where the axis is
    point = [(l + (i - 3.5) / 8) * pitch for l, i in zip(lenslet, divmod(11, 8))]
    middle = [(first + 6 - (5 * 13 - 1) / 2) * pixel for first in (first_row, first_column)]
    truth = pixel_energies(
        camera,
        WAVELENGTH,
        point,
        [lenslet],
        middle,
        pupil_nodes=(20, 52),
        lenslet_nodes=36 if shape == "square" else 24,
    )
    assert apart(found[0], truth) < 1e-6
    assert tuple(builder.symmetry) == (
        shift[0] == 0,
        shift[1] == 0,
        shift[0] == shift[1] and shape != "hexagon",
    )
    assert apart(column(camera, 11)[1][0], truth) > 1e-3


def test_neighbours_of_an_off_axis_lenslet_have_their_own_windows():
    """The block at offset (0, 1) is the window of the next lenslet on the same raster."""
    camera = off_raster()
    pixel, pitch = camera.sensor.pixel_pitch, camera.lenslet_array.pitch
    *_, shift = lenslet_shift(camera, 1, 3)
    _, found = column(camera, 11, grid=(3, 3), shift=shift)
    row, first, _ = lenslet_shift(camera, 1, 4)
    point = [(l + (i - 3.5) / 8) * pitch for l, i in zip((-1, 1), divmod(11, 8))]
    middle = [(n + 6 - 32) * pixel for n in (row, first)]
    truth = pixel_energies(
        camera, WAVELENGTH, point, [(-1, 2)], middle, pupil_nodes=(40, 110), lenslet_nodes=40
    )
    assert apart(found[5], truth) < 1e-5


def test_superpixels_on_whole_pixels_need_no_shift():
    camera = small_camera(**OFF)
    for place in ((0, 0), (2, 2), (4, 1)):
        row, first, shift = lenslet_shift(camera, *place)
        assert (row, first, shift) == (13 * place[0], 13 * place[1], (0.0, 0.0))
    builder, found = column(camera, 11, shift=(0.0, 0.0))
    np.testing.assert_array_equal(found, column(camera, 11)[1])
    assert all(builder.symmetry)


def test_lenslets_that_are_not_there_are_refused():
    with pytest.raises(ConfigError, match=r"no lenslet \(5, 0\).*5 x 5"):
        lenslet_shift(small_camera(**OFF), 5, 0)


def test_hexagonal_arrays_have_upright_rows():
    camera = small_camera(**HEXAGONAL | {"lenslet_array__count": (5, 4)})
    assert array_position(camera, 2, 2) == (0, 0)
    assert array_position(camera, 3, 2) == pytest.approx((np.sqrt(0.75), 0.5)) and array_position(
        camera, 0, 1
    ) == pytest.approx((-np.sqrt(3), -1))
    axial = {array_position(camera, r, c) for r in range(5) for c in range(4)}
    view = geometry(camera, WAVELENGTH)
    assert axial <= {view.centre(r, c) for r in range(-3, 4) for c in range(-6, 7)}


def test_the_triple_product_serves_every_camera():
    for camera in (small_camera(), small_camera(**HEXAGONAL), with_image(gradual(4))):
        assert valid_for(camera, geometry(camera, WAVELENGTH)) is None


def test_low_rank_and_triple_product_agree_on_squares():
    """Two routes that share only the spread function, whole superpixel neighbourhood and
    raster shift included.
    """
    camera = off_raster(object__distance=0.53)
    plan = plan_pif(camera, superpixels=(3, 3), coherent_ring=1, accuracy=1e-6, dtype=np.float64)
    plan = replace(plan, pixel_shift=lenslet_shift(camera, 0, 3)[2])
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    assert not isinstance(builder.lenslets, ShapedLenslets)
    other = ShapedLenslets(camera, builder.geometry, plan, plan.bands[0])
    rows, columns_ = np.array([0, 3, 7]), np.array([2, 2, 5])
    out = np.empty((3, 3, 3, 13, 13))
    other.columns(rows, columns_, out)
    truth = builder.columns(rows * 8 + columns_).transpose(2, 0, 1).reshape(out.shape)
    assert apart(out, truth) < 1e-6
    np.testing.assert_allclose(
        other.incident(rows, columns_), builder.lenslets.incident(rows, columns_), rtol=1e-6
    )
