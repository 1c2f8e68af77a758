"""Limits that hold whatever the numbers of a camera: reciprocity, rank, energy, the path to
rays; and cameras drawn at random.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.special import j1, roots_legendre

from plenocli.files.config.camera_file import load_camera
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.quadrature import band_rule
from plenocli.forward.propagation.diagnosis import describe
from plenocli.forward.propagation.fresnel.spread_function import sampled_field
from tests.forward.propagation.cameras import (
    WAVELENGTH,
    pif_builder,
    pupil_conjugate,
    small_camera,
    system_matrix,
)
from tests.reference.fresnel import disc_nodes, pixel_energies, rectangle_nodes
from tests.reference.kernel import coherent_kernel
from tests.reference.rayleigh import pixel_energies as rayleigh_energies
from tests.reference.window import column_energies as window_energies

ISOLATED = dict(superpixels=(1, 1), coherent_ring=0)
BENT = {"object__distance": 0.53, "sensor__distance": 225e-6}
"""A camera with defocus and curvature left on the lenslets."""


# reciprocity


def square_system(camera, lenslets):
    """Distances and openings of coherent_kernel for a camera of square pupil and lenslets."""
    array = camera.lenslet_array
    distances = (camera.object.distance, array.distance, camera.sensor.distance)
    main = [(0.0, camera.main_lens.aperture_diameter, camera.main_lens.focal_length)]
    return distances, [main, [(m * array.pitch, array.pitch, array.focal_length) for m in lenslets]]


def object_points(camera):
    """Object coordinates (m) along one axis, from where the points are imaged."""
    n, array = camera.object.samples_per_lenslet[0], camera.lenslet_array
    return -camera.object.distance / array.distance * (np.arange(n) - (n - 1) / 2) * array.pitch / n


@pytest.mark.parametrize("change", [{}, BENT], ids=str)
@pytest.mark.parametrize("ring", [0, 1])
def test_kernel_and_matrix_are_those_of_the_reversed_system(change, ring):
    """Light that runs from the sensor back to the object meets the same kernel, quadratic phases
    included; its square, integrated over the pixels, is A.
    """
    camera = small_camera(
        main_lens__aperture_shape="square", object__samples_per_lenslet=(5, 5), **change
    )
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(1, 1), coherent_ring=ring, accuracy=1e-8, dtype=np.float64
    )
    window = builder.plan.bands[0].window or 0
    distances, lenses = square_system(camera, range(-window, window + 1))
    t, w = roots_legendre(12)
    sensor = ((np.arange(13) - 6)[:, None] * 2e-6 + 1e-6 * t).ravel()
    start = object_points(camera)
    forward = coherent_kernel(start, sensor, WAVELENGTH, distances, lenses, (110, 80))
    backward = coherent_kernel(
        sensor, start, WAVELENGTH, distances[::-1], lenses[::-1], (90, 130)
    ).T
    assert np.abs(forward - backward).max() < 1e-10 * np.abs(forward).max()
    # the share of a source's light in P1 per axis: |field|^2 = 1/(lambda z1) over the width D1
    energy = (np.abs(backward) ** 2).reshape(13, 12, 5).transpose(0, 2, 1) @ w * 1e-6
    energy *= WAVELENGTH * distances[0] / camera.main_lens.aperture_diameter
    matrix = builder.columns(slice(None))[0]
    assert np.linalg.norm(matrix - np.kron(energy, energy)) < 2e-8 * np.linalg.norm(matrix)


def test_field_on_the_sensor_is_the_kernel_with_its_phases():
    """What the model leaves out of its fields is exp(jk xi^2/(2 z1)) exp(jk t^2/(2
    z3)) and one constant.
    """
    camera = small_camera(
        main_lens__aperture_shape="square", object__samples_per_lenslet=(5, 5), **BENT
    )
    builder = pif_builder(camera, WAVELENGTH, accuracy=1e-8, dtype=np.float64, **ISOLATED)
    assert builder.notes.separable_terms == 1
    t, w = band_rule(builder.plan.bands[0].pixel_nodes, builder.plan.bands[0].pixel_rule)
    sensor = (1e-6 * t[:, None] + (np.arange(13) - 6) * 2e-6).ravel()
    distances, lenses = square_system(camera, (0,))
    start, k = object_points(camera), 2 * np.pi / WAVELENGTH
    backward = (
        coherent_kernel(sensor, start, WAVELENGTH, distances[::-1], lenses[::-1], (90, 130)).T
        * np.repeat(np.sqrt(w), 13)[:, None]
    )
    field = builder.lenslets.factors.wide[0, :, :, 0].T
    field = field * np.exp(
        0.5j * k * (start**2 / distances[0] + sensor[:, None] ** 2 / distances[2])
    )
    strongest = np.unravel_index(np.abs(backward).argmax(), backward.shape)
    assert np.abs(field / field[strongest] - backward / backward[strongest]).max() < 1e-8


def reversed_camera(camera):
    """The camera with light running the other way: its main lens is one lenslet, its one lenslet
    the main lens, its pixels the object points and its object points the pixels.
    """
    lens, array, sensor = camera.main_lens, camera.lenslet_array, camera.sensor
    points = camera.object.samples_per_lenslet[0]
    return small_camera(
        main_lens__focal_length=array.focal_length,
        main_lens__aperture_diameter=array.pitch,
        main_lens__aperture_shape=array.aperture_shape,
        object__distance=sensor.distance,
        object__samples_per_lenslet=sensor.pixels_per_lenslet,
        lenslet_array__pitch=lens.aperture_diameter,
        lenslet_array__focal_length=lens.focal_length,
        lenslet_array__aperture_shape=lens.aperture_shape,
        sensor__distance=camera.object.distance,
        sensor__pixels_per_lenslet=(points, points),
        sensor__pixel_fill_factor=sensor.pixel_fill_factor,
        sensor__pixel_pitch=camera.object.distance / array.distance * array.pitch / points,
    )


@pytest.mark.parametrize(
    "pupil, lenslet", [("square", "square"), ("circle", "square"), ("circle", "circle")]
)
def test_matrix_of_the_reversed_camera(pupil, lenslet):
    """Point-like pixels and points change places, eps and kappa too.

    A round pupil before square lenslets becomes a square pupil before round lenslets, so that the
    two ways to compute fields check each other.
    """
    z3, n = BENT["sensor__distance"], 13
    there = small_camera(
        main_lens__aperture_shape=pupil,
        lenslet_array__aperture_shape=lenslet,
        sensor__pixel_fill_factor=1e-12,
        sensor__pixel_pitch=z3 / 55e-3 * 6.875e-3 / n,
        **BENT,
    )
    back = reversed_camera(there)
    one, other = geometry(there, WAVELENGTH), geometry(back, WAVELENGTH)
    assert (
        other.eps == pytest.approx(one.kappa)
        and other.kappa == pytest.approx(one.eps)
        and abs(one.eps * one.kappa) > 0.1
    )
    densities = []
    for camera, view in ((there, one), (back, other)):
        area = camera.main_lens.aperture_diameter**2 * (
            np.pi / 4 if camera.main_lens.aperture_shape == "circle" else 1
        )
        matrix = system_matrix(camera, accuracy=1e-8, dtype=np.float64, **ISOLATED).A[0, 0]
        densities.append(matrix * area / (WAVELENGTH * view.z1) ** 2 / view.pixel_active**2)
    # both images are inverted, so both numberings turn
    expected = densities[1].T[::-1, ::-1]
    assert np.abs(densities[0] - expected).max() < 1e-6 * expected.max()


# the image on the array


@pytest.mark.parametrize("xi", [90e-6, -300e-6])
def test_image_moves_by_minus_the_magnification(xi):
    camera = small_camera()
    view, k = geometry(camera, WAVELENGTH), 2 * np.pi / WAVELENGTH
    y, x, w = disc_nodes(view.D1 / 2, 40, 96)
    t, weight = roots_legendre(120)
    u = -0.1 * xi + 40e-6 * t
    wave = w * np.exp(
        0.5j * k * ((y**2 + (x - xi) ** 2) / view.z1 - (y**2 + x**2) / view.f1 + y**2 / view.z2)
    )
    h1 = np.exp(0.5j * k / view.z2 * (u[:, None] - x) ** 2) @ wave
    power = np.abs(h1) ** 2 * weight
    assert power @ u / power.sum() == pytest.approx(-view.magnification * xi, rel=1e-6)
    model = np.abs(sampled_field(camera, view, np.zeros(1), u + view.magnification * xi)[0])
    assert np.abs(model / model.max() - np.abs(h1) / np.abs(h1).max()).max() < 1e-9


def test_distance_to_the_pupil_image_halves_with_the_wavelength():
    """kappa = 0, pixels finer than the fringes: L1 to the uniform disc is that of edge ringing,
    lambda z3/D2 wide; the Airy tails lost beside the lenslet give the logarithm that keeps the
    ratio above a half.
    """
    z3 = pupil_conjugate(small_camera())
    radius = 6.875e-3 * z3 / (2 * 55e-3)
    fine = (np.arange(104 * 16) - (104 * 16 - 1) / 2) * 0.5e-6 / 16
    disc = (np.hypot(fine[:, None], fine) < radius).reshape(104, 16, 104, 16).mean((1, 3))
    errors = []
    for wavelength in (1100e-9, 550e-9, 275e-9, 137.5e-9):
        camera = small_camera(
            sensor__distance=z3,
            sensor__pixel_pitch=0.5e-6,
            sensor__pixels_per_lenslet=(104, 104),
            object__samples_per_lenslet=(1, 1),
            light__wavelengths=(wavelength,),
        )
        image = system_matrix(camera, **ISOLATED).A[0, 0, :, 0].reshape(104, 104)
        errors.append(np.abs(image - disc / disc.sum()).sum())
    ratios = np.array(errors[1:]) / errors[:-1]
    assert (
        np.all((ratios > 0.45) & (ratios < 0.65))
        and np.all(np.diff(ratios) < 0)
        and ratios[2] < 0.55
        and errors[3] < 0.08
    )


# rank


def twentieth_wave(lens_radius):
    """Object distance (m) at which the defocus of small_camera is lambda/20 at the pupil's edge."""
    return 1 / (1 / 50e-3 - 1 / 55e-3 + 2 * WAVELENGTH / 20 / lens_radius**2)


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_a_twentieth_of_a_wave_restores_the_rank(shape):
    """One row of 40 points of the published camera, sensor at the pupil's image: 20 are seen in
    focus, all 40 out of it.
    """
    sizes = dict(
        lenslet_array__pitch=104e-6 / (1 + 832e-6 / 55e-3),
        lenslet_array__focal_length=832e-6,
        main_lens__aperture_shape=shape,
        sensor__distance=1 / (1 / 832e-6 - 1 / 55e-3),
        sensor__pixels_per_lenslet=(52, 52),
        object__samples_per_lenslet=(1, 40),
    )
    found = []
    for distance in (0.55, twentieth_wave(6.875e-3 / 2)):
        pif = system_matrix(
            small_camera(object__distance=distance, **sizes),
            dtype=np.float64,
            accuracy=1e-8,
            **ISOLATED,
        )
        found.append(describe(pif))
    values = [f.singular_values[0] / f.singular_values[0][0] for f in found]
    assert values[0][19] > 1e-6 and values[0][20] < 1e-13 and values[1][39] > 1e-6
    assert found[0].rank == [20] and found[1].rank == [40]
    assert found[0].symmetry_defect[0] < 1e-12 and found[1].symmetry_defect[0] > 0.1


def test_a_twentieth_of_a_wave_restores_the_rank_of_a_square_of_points():
    z3 = pupil_conjugate(small_camera())
    ranks = [
        describe(
            system_matrix(
                small_camera(object__distance=z1, sensor__distance=z3),
                dtype=np.float64,
                accuracy=1e-8,
                **ISOLATED,
            )
        ).rank[0]
        for z1 in (0.55, twentieth_wave(6.875e-3 / 2))
    ]
    assert ranks == [32, 64]


# energy


def seed_camera():
    return load_camera(Path(__file__).resolve().parents[3] / "sample_configs" / "seed_spatial.toml")


def airy_share(view, point, lenslet):
    """Share of the light of an image point (row, column in m) that enters lenslet (row, column),
    by Airy's formula.
    """
    t, w = roots_legendre(160)
    y, x = (m * view.D2 + view.D2 / 2 * t - p for m, p in zip(lenslet, point))
    r = np.pi * view.D1 / (view.wavelength * view.z2) * np.hypot(y[:, None], x)
    # |h(0)|^2 of unit light is S/(lambda z2)^2
    peak = np.pi * view.D1**2 / 4 / (view.wavelength * view.z2) ** 2
    return peak * (w @ (2 * j1(r) / r) ** 2 @ w) * view.D2**2 / 4


def test_light_missing_from_a_lenslet_is_with_its_neighbours():
    """5x5 superpixels hold what Airy's pattern lets into 5x5 lenslets, so what an isolated
    lenslet lacks is found again.
    """
    camera = seed_camera()
    (wavelength,) = camera.light.wavelengths
    view, points = geometry(camera, wavelength), [0, 820]
    places = [(view.points(0)[q // 40], view.points(1)[q % 40]) for q in points]
    blocks = {}
    for ring in (0, 1):
        builder = pif_builder(
            camera, wavelength, superpixels=(5, 5), coherent_ring=ring, accuracy=1e-3
        )
        blocks[ring] = builder.columns(points).sum(1)
    airy = np.array(
        [[airy_share(view, place, offset) for place in places] for offset in builder.offsets]
    )
    alone = pif_builder(camera, wavelength, accuracy=1e-4, **ISOLATED).columns(points)[0].sum(0)
    own = int(np.flatnonzero((builder.offsets == 0).all(1))[0])
    # a cut-off image of a point spreads beyond its superpixel: isolated lenslets hold
    # less than they let in
    assert blocks[0][own] == pytest.approx(alone, abs=1e-4) and np.all(
        blocks[0] < airy * (1 + 1e-4)
    )
    assert alone == pytest.approx([0.402, 0.982], abs=5e-3) and blocks[0][:, 0].sum() < 0.7
    # only fields that add keep the light: the corner point's interferes its way back
    # to where it belongs
    together = blocks[1].sum(0)
    assert (
        np.all(together >= 0.98)
        and np.all(together < airy.sum(0))
        and np.all(together > airy.sum(0) - 3e-3)
    )
    neighbours = together - blocks[1][own]
    assert (
        neighbours[0] == pytest.approx(1 - blocks[1][own, 0], rel=0.02)
        and blocks[1][own, 0] > alone[0] + 0.15
    )
    assert neighbours[1] == pytest.approx(airy[:, 1].sum() - airy[own, 1], rel=0.12)


def test_exact_fields_out_of_focus_are_as_fine_as_those_in_focus():
    """One lenslet gets a twentieth of the light of a point blurred over five: what is cut is
    measured against that, at the point in the middle, where the disc's rings meet, above all.
    """
    camera = load_camera(
        Path(__file__).resolve().parents[3] / "sample_configs" / "seed_spatial.toml"
    )
    lens, array = camera.main_lens, camera.lenslet_array
    defocus = 5 * array.pitch / (lens.aperture_diameter * array.distance)
    camera = camera.replace(
        **{
            "object.distance": 1 / (1 / lens.focal_length - 1 / array.distance + defocus),
            "object.samples_per_lenslet": (10, 10),
        }
    )
    place = (0.05 * array.pitch, 0.05 * array.pitch)
    truth = rayleigh_energies(
        camera, WAVELENGTH, place, [(0, 0)], (0, 0), rows=[18], pixel_nodes=10, density=1.2
    )
    for accuracy in (1e-4, 1e-5):
        column = (
            system_matrix(camera, model="exact", accuracy=accuracy, **ISOLATED)
            .A[0, 0, :, 55]
            .reshape(52, 52)[[18]]
        )
        assert np.linalg.norm(column - truth) < accuracy * np.linalg.norm(truth)


@pytest.mark.parametrize("blur", [2, 5])
def test_pixels_hold_the_fringes_of_all_lenslets_that_a_blurred_point_lights(blur):
    """Out of focus neighbours are as bright as the own lenslet, and their fringes finer: against
    as many lenslets in the open.
    """
    camera = load_camera(
        Path(__file__).resolve().parents[3] / "sample_configs" / "seed_spatial.toml"
    )
    lens, array = camera.main_lens, camera.lenslet_array
    defocus = blur * array.pitch / (lens.aperture_diameter * array.distance)
    camera = camera.replace(
        **{
            "object.distance": 1 / (1 / lens.focal_length - 1 / array.distance + defocus),
            "object.samples_per_lenslet": (10, 10),
        }
    )
    built = {
        a: pif_builder(camera, WAVELENGTH, accuracy=a, superpixels=(3, 3), coherent_ring=2)
        for a in (1e-2, 1e-3, 1e-4)
    }
    window, kept = built[1e-4].plan.bands[0].window, [(0, 0), (-1, 0), (-1, -1)]
    truth = window_energies(
        camera, WAVELENGTH, (-0.45 * array.pitch, -0.45 * array.pitch), window, kept, pixel_nodes=11
    )
    truth = np.array([truth[place].ravel() for place in kept])
    for accuracy, builder in built.items():
        column = builder.columns([0])[[4, 1, 0], :, 0]
        error = np.linalg.norm(column - truth) / np.linalg.norm(truth)
        assert error < accuracy and error < 2 * builder.plan.split["sampling"]


# cameras drawn at random

ZERNIKE = {  # Noll's order, written out
    4: lambda y, x: np.sqrt(3) * (2 * (x * x + y * y) - 1),
    5: lambda y, x: np.sqrt(6) * 2 * x * y,
    6: lambda y, x: np.sqrt(6) * (x * x - y * y),
    7: lambda y, x: np.sqrt(8) * (3 * (x * x + y * y) - 2) * y,
    8: lambda y, x: np.sqrt(8) * (3 * (x * x + y * y) - 2) * x,
}


def random_camera(rng, shape, cells):
    """A small camera with random defocus, curvature, aberrations, sampling and filters;

    cells: layout or None.
    """
    width = 6.875e-3
    changes = dict(
        main_lens__aperture_shape=shape,
        object__distance=1 / (1 / 50e-3 - 1 / 55e-3 + rng.uniform(-0.06, 0.06)),
        sensor__distance=208e-6 * rng.uniform(0.85, 1.15),
        lenslet_array__fill_factor=rng.uniform(0.8, 1),
        object__samples_per_lenslet=tuple(rng.integers(4, 10, 2).tolist()),
        sensor__pixels_per_lenslet=tuple(rng.integers(9, 15, 2).tolist()),
        sensor__pixel_fill_factor=rng.uniform(0.6, 1),
        main_lens__aberrations=tuple(
            dict(noll=int(j), coefficient=float(rng.uniform(-70e-9, 70e-9)))
            for j in rng.permutation(list(ZERNIKE))[:3]
        ),
    )
    if shape == "annulus":
        changes["main_lens__obscuration"] = rng.uniform(0.2, 0.6)
    if cells:
        filters = [
            dict(
                center=rng.uniform(535e-9, 565e-9),
                fwhm=20e-9,
                peak=rng.uniform(0.3, 1),
                blocking=2e-3,
            )
            for _ in range(cells[0] * cells[1])
        ]
        size = (
            width
            * {
                "square": rng.uniform(0.7, 1),
                "circle": rng.uniform(0.5, 0.7),
                "annulus": rng.uniform(0.8, 0.95),
            }[shape]
        )
        changes["filter_array"] = {
            "layout": cells,
            "gap": rng.uniform(0, 0.4e-3),
            "size": size,
            "filters": filters,
        }
    return small_camera(**changes)


def aberration(camera):
    """exp(j k W) as a function of (y, x)."""
    lens = camera.main_lens
    unit = lens.aperture_diameter / 2 * (np.sqrt(2) if lens.aperture_shape == "square" else 1)
    return lambda y, x: np.exp(
        2j
        * np.pi
        / WAVELENGTH
        * sum(a.coefficient * ZERNIKE[a.noll](y / unit, x / unit) for a in lens.aberrations)
    )


def cells_of(camera):
    """(y0, y1, x0, x1, amplitude) of each filter, row by row from the top left."""
    array = camera.filter_array
    sides = [(array.size - (n - 1) * array.gap) / n for n in array.layout]
    for index, f in enumerate(array.filters):
        start = [
            i * (side + array.gap) - array.size / 2
            for i, side in zip(divmod(index, array.layout[1]), sides)
        ]
        passed = (
            f.peak * np.exp(-4 * np.log(2) * ((WAVELENGTH - f.center) / f.fwhm) ** 2) + f.blocking
        )
        yield start[0], start[0] + sides[0], start[1], start[1] + sides[1], np.sqrt(passed)


def open_pupil(camera):
    """Quadrature (y, x, weight) of the open pupil with its filters, exact unless
    filters meet a rim.
    """
    lens = camera.main_lens
    radius = lens.aperture_diameter / 2
    if camera.filter_array is None:
        return (
            rectangle_nodes(-radius, radius, -radius, radius, 80)
            if lens.aperture_shape == "square"
            else disc_nodes(radius, 40, 96, radius * lens.obscuration)
        )
    parts = [
        (y, x, w * a) for *box, a in cells_of(camera) for y, x, w in [rectangle_nodes(*box, 44)]
    ]
    return tuple(np.concatenate(p) for p in zip(*parts))


def disagreement(camera, rng, ring, pupil):
    """Relative L2 difference of one random column of A from the brute-force integrals."""
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(1, 1), coherent_ring=ring, accuracy=1e-6, dtype=np.float64
    )
    window, (rows, columns) = builder.plan.bands[0].window or 0, camera.object.samples_per_lenslet
    i, j = rng.integers(rows), rng.integers(columns)
    pitch = camera.lenslet_array.pitch
    place = ((i - (rows - 1) / 2) * pitch / rows, (j - (columns - 1) / 2) * pitch / columns)
    lenslets = [(r, c) for r in range(-window, window + 1) for c in range(-window, window + 1)]
    truth = pixel_energies(
        camera,
        WAVELENGTH,
        place,
        lenslets,
        (0, 0),
        pupil=pupil,
        amplitude=aberration(camera),
        lenslet_nodes=44,
        pixel_nodes=7,
    )
    column = builder.columns([i * columns + j])[0, :, 0].reshape(truth.shape)
    return np.linalg.norm(column - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize(
    "seed, shape, cells, ring",
    [
        (1, "circle", None, 1),
        (2, "square", None, 0),
        (3, "annulus", None, 0),
        (4, "circle", (2, 3), 0),
        (5, "square", (2, 2), 1),
        (6, "square", (3, 1), 0),
    ],
)
def test_random_cameras_against_brute_force(seed, shape, cells, ring):
    rng = np.random.default_rng(seed)
    camera = random_camera(rng, shape, cells)
    assert disagreement(camera, rng, ring, open_pupil(camera)) < 1e-6


def test_filters_that_meet_both_rims_of_an_annulus():
    """The oracle is a mask on a grid in each filter, good to a few parts in ten thousand."""
    rng = np.random.default_rng(7)
    camera = random_camera(rng, "annulus", (2, 2))
    radius, hole, step = (
        camera.main_lens.aperture_diameter / 2,
        camera.main_lens.obscuration,
        (np.arange(240) + 0.5) / 240,
    )
    parts = []
    for y0, y1, x0, x1, amplitude in cells_of(camera):
        y, x = np.repeat(y0 + (y1 - y0) * step, 240), np.tile(x0 + (x1 - x0) * step, 240)
        inside = (np.hypot(y, x) < radius) & (np.hypot(y, x) > hole * radius)
        assert 0.4 < inside.mean() < 1
        parts.append((y, x, inside * amplitude * (y1 - y0) * (x1 - x0) / 240**2))
    assert disagreement(camera, rng, 0, tuple(np.concatenate(p) for p in zip(*parts))) < 1e-3
