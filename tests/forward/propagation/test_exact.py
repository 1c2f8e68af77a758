"""The exact rung against direct sums of Rayleigh and Sommerfeld's integral, and
what must hold of it.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.budget import budget, within
from plenocli.base.errors import NumericsError
from plenocli.forward.accuracy import dial as accuracy
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.bands import spectral_nodes
from plenocli.forward.propagation.exact import interval_pairs, term_counts
from plenocli.forward.propagation.exact import lenslets as exact
from plenocli.forward.propagation.exact import low_rank_product as product
from plenocli.forward.propagation.exact.residual import Residual, ell, kappa, path, split
from plenocli.forward.propagation.fresnel import separable_fields
from plenocli.forward.propagation.fresnel.paraxial_error import paraxial_error
from plenocli.forward.propagation.fresnel.separable_fields import Factors, on_modes, pixel_modes
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import WAVELENGTH, small_camera
from tests.reference.fresnel import sensor_nodes
from tests.reference.rayleigh import (
    column_energies,
    field_of_spheres,
    field_on_array,
    lens_phase,
    main_lens_field,
    pupil_directions,
    rayleigh_products,
    rayleigh_sum,
)
from tests.reference.rayleigh import nodes as rayleigh_nodes

pytestmark = pytest.mark.usefixtures("without_openings")


ISOLATED = [(0, 0)]
NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]
ROWS = [0, 4]
PROFILES = ["hyperbolic", "parabolic"]
COMA = ({"noll": 8, "coefficient": 60e-9},)


def fast_camera(f_number=2.5, **changes):
    """18 um superpixels of 9x9 pixels at another f-number of main lens and lenslets: at f/2.5 a
    lenslet's corner is 3 rad from where the separable phase has it.
    """
    focal = 18e-6 * f_number
    return small_camera(
        **{
            "main_lens__aperture_diameter": 55e-3 / f_number,
            "lenslet_array__focal_length": focal,
            "lenslet_array__pitch": 18e-6,
            "sensor__distance": focal,
            "sensor__pixels_per_lenslet": (9, 9),
        }
        | changes
    )


def image_points(camera, points):
    shape, pitch = camera.object.samples_per_lenslet, camera.lenslet_array.pitch
    return [
        tuple((i - (n - 1) / 2) * pitch / n for i, n in zip(divmod(p, shape[1]), shape))
        for p in points
    ]


def columns(camera, points, *, superpixel=0, superpixels=(1, 1), ring=0, asked=1e-4, **changes):
    """Pixel energies (point, row, column) on one superpixel, or (superpixel, ...) on a slice of
    them, by the exact rung.
    """
    plan = replace(
        accuracy.plan_pif(
            camera, model="exact", accuracy=asked, superpixels=superpixels, coherent_ring=ring
        ),
        **changes,
    )
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    found = np.moveaxis(builder.columns(points)[superpixel], -1, -2)
    return found.reshape(*found.shape[:-1], *builder.pixel_shape)


def errors(found, truth):
    """Relative L2 error of each column."""
    return np.sqrt(((found - truth) ** 2).sum(axis=(1, 2)) / (truth**2).sum(axis=(1, 2)))


@pytest.mark.parametrize("profile", PROFILES)
def test_every_accuracy_holds_in_the_worst_column(profile):
    camera, points = fast_camera(lenslet_array__profile=profile), [0, 3, 9, 27, 35]
    truth = column_energies(
        camera, WAVELENGTH, image_points(camera, points), ISOLATED, (0, 0), pixel_nodes=11
    )
    for asked in (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        assert errors(columns(camera, points, asked=asked), truth).max() <= asked


def test_the_reference_has_converged():
    camera, point = fast_camera(), image_points(fast_camera(), [0])
    coarse, fine = (
        column_energies(
            camera, WAVELENGTH, point, ISOLATED, (0, 0), pixel_nodes=n, density=d, rows=[2, 7]
        )
        for n, d in ((11, 1.0), (13, 1.3))
    )
    assert errors(coarse, fine).max() < 2e-10


@pytest.mark.parametrize("place", [(0, 0), (0, 1), (-2, 1)], ids=str)
def test_the_reference_as_products_is_the_sum_itself(place):
    k, z, half, rng = 2 * np.pi / WAVELENGTH, 0.3e-3, 40e-6, np.random.default_rng(11)
    y, x = rng.uniform(-half, half, (2, 40))
    v, u = (rng.uniform(-half, half, 14) + 2 * half * n for n in place)
    fields = rng.normal(size=(2, 40, 40)) + 1j * rng.normal(size=(2, 40, 40))
    true = rayleigh_sum(fields, y, x, v, u, z, k)
    fields = fields[:, np.argsort(y)][:, :, np.argsort(x)]
    found = rayleigh_products(fields, np.sort(y), np.sort(x), np.sort(v), np.sort(u), z, k)
    assert np.linalg.norm(
        found - true[:, np.argsort(v)][:, :, np.argsort(u)]
    ) < 1e-10 * np.linalg.norm(true)


def test_the_reference_of_the_main_lens_by_axes_is_that_by_directions():
    camera = fast_camera(4.0, object__distance=0.54)
    y, point = np.linspace(-3e-5, 3e-5, 9), (3e-6, -4e-6)
    whole = field_on_array(camera, WAVELENGTH, point, y, y, pupil_directions(camera))
    assert np.linalg.norm(
        main_lens_field(camera, 4e-5)(point, y, y) - whole
    ) < 1e-8 * np.linalg.norm(whole)


@pytest.mark.parametrize(
    "change",
    [
        {"sensor__pixels_per_lenslet": (7, 10)},
        {"object__samples_per_lenslet": (5, 8)},
        {"object__distance": 0.53},
        {"lenslet_array__fill_factor": 0.8},
        {"sensor__distance": 41e-6, "sensor__pixel_fill_factor": 0.64},
        {"main_lens__aperture_shape": "square"},
        {"main_lens__apodisation": "uniform-pupil", "lenslet_array__profile": "parabolic"},
        {
            "main_lens__apodisation": "uniform-sine",
            "main_lens__aperture_shape": "annulus",
            "main_lens__obscuration": 0.4,
        },
    ],
    ids=str,
)
def test_every_kind_of_camera(change):
    camera, points = fast_camera(**change), [0, 12, 19]
    truth = column_energies(
        camera, WAVELENGTH, image_points(camera, points), ISOLATED, (0, 0), pixel_nodes=9
    )
    assert errors(columns(camera, points, asked=1e-5), truth).max() <= 1e-5


def test_a_pupil_given_as_a_picture():
    picture = np.random.default_rng(2).uniform(0.1, 1, (3, 3))
    camera, points = (
        fast_camera(main_lens__aperture_shape="image", main_lens__aperture_image="p.png").attach(
            aperture_image=picture
        ),
        [0, 12, 19],
    )
    truth = column_energies(
        camera, WAVELENGTH, image_points(camera, points), ISOLATED, (0, 0), pixel_nodes=9
    )
    assert errors(columns(camera, points, asked=1e-5), truth).max() <= 1e-5


def test_a_band_of_light_is_the_sum_of_its_wavelengths():
    camera, points = (
        fast_camera(
            light__wavelengths=(WAVELENGTH,),
            light__band={"center": WAVELENGTH, "fwhm": 15e-9, "shape": "gaussian"},
        ),
        [0, 12, 19],
    )
    truth = sum(
        share
        * column_energies(camera, w, image_points(camera, points), ISOLATED, (0, 0), pixel_nodes=9)
        for w, share in zip(*spectral_nodes(camera.light.band, 12))
    )
    for asked in (1e-2, 1e-4):
        plan = accuracy.plan_pif(camera, accuracy=asked, superpixels=(1, 1), coherent_ring=0)
        assert plan.model == "exact" and plan.band_nodes > 1
        assert errors(columns(camera, points, asked=asked), truth).max() <= asked


def test_a_window_of_pixels_off_the_superpixel_s_centre():
    camera, points, shift = fast_camera(), [0, 12, 63], (0.3, -0.2)
    truth = column_energies(
        camera,
        WAVELENGTH,
        image_points(camera, points),
        ISOLATED,
        tuple(s * camera.sensor.pixel_pitch for s in shift),
        pixel_nodes=9,
    )
    assert errors(columns(camera, points, pixel_shift=shift), truth).max() <= 1e-4


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"main_lens__aperture_shape": "square"},
        {"object__distance": 0.5, "lenslet_array__fill_factor": 0.7},
    ],
    ids=str,
)
@pytest.mark.parametrize("f_number", [1.5, 3, 10])
def test_functions_that_carry_the_field_bring_what_the_pixels_nodes_do(
    f_number, change, monkeypatch
):
    monkeypatch.setattr(term_counts, "MANY", 10**9)  # the same singular vectors of both
    pitch, pixels = 62e-6, 31
    camera = fast_camera(
        f_number,
        lenslet_array__pitch=pitch,
        sensor__pixels_per_lenslet=(pixels, pixels),
        lenslet_array__focal_length=pitch * f_number,
        sensor__distance=pitch * f_number,
        **change,
    )
    plan = accuracy.plan_pif(
        camera, model="exact", accuracy=1e-7, superpixels=(1, 1), coherent_ring=0
    )
    assert 0 < plan.bands[0].sensor_count < 0.6 * pixels * plan.bands[0].pixel_nodes
    found, true = (
        columns(camera, range(64), asked=1e-7, bands=[replace(plan.bands[0], sensor_count=count)])
        for count in (plan.bands[0].sensor_count, 0)
    )
    assert errors(found, true).max() < 0.3e-7


@pytest.mark.parametrize("asked", [1e-3, 1e-6])
@pytest.mark.parametrize("change", [{}, {"main_lens__aberrations": COMA}], ids=["real", "complex"])
def test_few_functions_on_a_lenslet_bring_what_all_the_kernel_s_nodes_do(
    change, asked, monkeypatch
):
    camera = fast_camera(1.5, lenslet_array__fill_factor=0.8, **change)
    counted = []
    functions = interval_pairs.Interval._functions

    def counting(self, *where):
        onto, values = functions(self, *where)
        counted.append((len(onto), onto.shape[1]))
        return onto, values

    monkeypatch.setattr(interval_pairs.Interval, "_functions", counting)
    found = columns(camera, range(12), asked=asked)
    few, counted[:] = counted.copy(), []
    monkeypatch.setattr(interval_pairs, "SHARE", 0)
    monkeypatch.setattr(interval_pairs, "psf_nodes", lambda *_: 10**6)
    true = columns(camera, range(12), asked=asked)
    assert errors(found, true).max() < 0.05 * asked
    assert all(count == nodes for nodes, count in counted)
    assert all(count < 0.8 * nodes for nodes, count in few)


@pytest.mark.parametrize("place", [(0, 1), (-1, 1)], ids=str)
def test_oblique_light_of_isolated_lenslets(place):
    """The main lens so near that a lenslet's light comes to its superpixel at an angle as
    large as it has itself.
    """
    camera = fast_camera(
        3.0,
        lenslet_array__pitch=42e-6,
        sensor__pixels_per_lenslet=(21, 21),
        lenslet_array__focal_length=126e-6,
        sensor__distance=126e-6,
        main_lens__focal_length=0.5e-3,
        object__distance=5e-3,
        lenslet_array__distance=0.5e-3 / 0.9,
        main_lens__aperture_diameter=0.5e-3 / 3,
    )
    pitch, rows, points = geometry(camera, WAVELENGTH).superpixel_pitch, [2, 11], [0, 7, 27]
    truth = column_energies(
        camera,
        WAVELENGTH,
        image_points(camera, points),
        [place],
        tuple(pitch * n for n in place),
        pixel_nodes=13,
        rows=rows,
    )
    own = column_energies(
        camera, WAVELENGTH, image_points(camera, points), ISOLATED, (0, 0), pixel_nodes=9
    )
    for asked in (1e-2, 1e-4, 1e-6):
        (y, x), superpixels = place, (3, 3)
        plan = accuracy.plan_pif(
            camera, model="exact", accuracy=asked, superpixels=superpixels, coherent_ring=0
        )
        assert plan.bands[0].sensor_count or asked > 1e-4
        found = columns(
            camera, points, superpixel=3 * (y + 1) + x + 1, superpixels=superpixels, asked=asked
        )
        missed = np.sqrt(
            ((found[:, rows] - truth) ** 2).sum(axis=(1, 2)) / (own**2).sum(axis=(1, 2))
        )
        assert missed.max() <= asked


@pytest.mark.parametrize(
    "shape, f_number, fill", [("square", 2.5, 0.6), ("circle", 2.5, 0.6), ("square", 4.0, 0.8)]
)
def test_points_between_lenslets_hold_in_their_own_columns(shape, f_number, fill):
    """The faintest column has 1e-4 to 2e-2 of the brightest one's light, and is
    as accurate as that.
    """
    camera = fast_camera(
        f_number,
        lenslet_array__pitch=30e-6,
        sensor__pixels_per_lenslet=(15, 15),
        lenslet_array__focal_length=30e-6 * f_number,
        sensor__distance=30e-6 * f_number,
        main_lens__aperture_shape=shape,
        lenslet_array__fill_factor=fill,
    )
    points, rows = [0, 3, 27], [0, 6, 7, 11]
    truth = column_energies(
        camera,
        WAVELENGTH,
        image_points(camera, points),
        ISOLATED,
        (0, 0),
        pixel_nodes=11,
        rows=rows,
    )
    light = truth.sum(axis=(1, 2))
    assert light[0] < 0.04 * light[2]
    for asked in (1e-1, 1e-2, 1e-3, 1e-4, 1e-6):
        assert errors(columns(camera, points, asked=asked)[:, rows], truth).max() <= asked


@pytest.mark.parametrize("profile", PROFILES)
def test_neighbours_add_before_the_square(profile):
    camera, points = fast_camera(lenslet_array__profile=profile), [0, 4, 27]
    truth = column_energies(
        camera,
        WAVELENGTH,
        image_points(camera, points),
        NEIGHBOURS,
        (0, 0),
        pixel_nodes=11,
        rows=ROWS,
    )
    for asked in (1e-2, 1e-4, 1e-6, 1e-7):
        assert errors(columns(camera, points, ring=1, asked=asked)[:, ROWS], truth).max() <= asked
    # the isolated lenslet is far off at the corner, so the sum of fields is what was tested
    assert errors(columns(camera, points)[:, ROWS], truth)[0] > 0.05


def test_superpixels_beside_the_own_one():
    """Light of 25 lenslets; the accuracy asked for is the whole column's, of which the
    superpixels beside hold a small part.
    """
    camera, points, rows = fast_camera(4.0), [0, 7, 58], [1, 6]
    pitch = geometry(camera, WAVELENGTH).superpixel_pitch
    lenslets = [(r, c) for r in range(-2, 3) for c in range(-2, 3)]
    truth = {
        place: column_energies(
            camera,
            WAVELENGTH,
            image_points(camera, points),
            lenslets,
            tuple(pitch * n for n in place),
            pixel_nodes=9,
            rows=rows,
            field=main_lens_field(camera, 3 * camera.lenslet_array.pitch),
        )
        for place in [(-1, 1), (-1, 0), (0, 0)]
    }
    whole = np.linalg.norm(
        columns(camera, points, superpixels=(1, 1), ring=1, asked=1e-3), axis=(1, 2)
    )
    for asked in (1e-2, 1e-4, 1e-6):
        found = columns(
            camera, points, superpixel=slice(None), superpixels=(3, 3), ring=1, asked=asked
        )
        for place, energies in truth.items():
            own = found[4 + 3 * place[0] + place[1]][:, rows]
            assert (np.linalg.norm(own - energies, axis=(1, 2)) <= asked * whole).all(), place


def test_symmetry_changes_nothing(monkeypatch):
    camera, points = fast_camera(object__samples_per_lenslet=(5, 5)), np.arange(25)
    used = columns(camera, points, asked=1e-6)
    field = exact.separable_field
    monkeypatch.setattr(
        exact,
        "separable_field",
        lambda *args: replace(field(*args), symmetry=(False, False, False), signs=None),
    )
    assert errors(columns(camera, points, asked=1e-6), used).max() < 1e-6
    plan = accuracy.plan_pif(
        camera, model="exact", accuracy=1e-6, superpixels=(1, 1), coherent_ring=0
    )
    assert PifBuilder(camera, WAVELENGTH, plan).symmetry == (False, False, False)


def test_no_light_is_made_and_only_the_far_field_is_lost():
    """What a window of pixels misses of the light that enters the lenslet is the edges'
    diffraction, which falls as one over its width.
    """
    missed, points, directions = [], [0, 27], pupil_directions(fast_camera(4.0))
    t, w = np.polynomial.legendre.leggauss(70)
    enters = np.array(
        [
            np.abs(
                field_on_array(fast_camera(4.0), WAVELENGTH, point, 9e-6 * t, 9e-6 * t, directions)
            )
            ** 2
            @ w
            @ w
            * 9e-6**2
            for point in image_points(fast_camera(4.0), points)
        ]
    )
    for pixels in (27, 55):
        seen = columns(fast_camera(4.0, sensor__pixels_per_lenslet=(pixels, pixels)), points).sum(
            axis=(1, 2)
        )
        missed.append(enters - seen)
    assert (np.array(missed) > 0).all() and (missed[1] < 0.03 * enters).all()
    assert np.allclose(missed[0] / missed[1], 55 / 27, rtol=0.15)


def test_slow_lenses_are_paraxial():
    """The paraxial model's error falls a little faster than the square of the f-number."""
    found = []
    for f_number in (4, 8, 16):
        camera = fast_camera(f_number)
        both = [
            accuracy.system_matrix(
                camera, model=model, accuracy=1e-7, superpixels=(1, 1), coherent_ring=0
            ).A[0, 0]
            for model in ("fresnel", "exact")
        ]
        found.append(np.linalg.norm(both[0] - both[1]) / np.linalg.norm(both[1]))
    assert found[-1] < 2e-3
    assert all(4 < a / b < 6 for a, b in zip(found, found[1:]))


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"f_number": 8, "lenslet_array__profile": "parabolic"},
        {"f_number": 4, "sensor__pixels_per_lenslet": (3, 3), "sensor__pixel_pitch": 6e-6},
    ],
    ids=str,
)
def test_law_of_the_paraxial_error(change):
    camera = fast_camera(**change)
    both = [
        accuracy.system_matrix(
            camera, model=model, accuracy=3e-4, superpixels=(1, 1), coherent_ring=0
        ).A[0, 0]
        for model in ("fresnel", "exact")
    ]
    worst = (np.linalg.norm(both[0] - both[1], axis=0) / np.linalg.norm(both[1], axis=0)).max()
    law = paraxial_error(geometry(camera, WAVELENGTH), camera.lenslet_array.profile == "parabolic")
    assert 0.8 * worst < law < 3 * worst


def test_main_lens_against_spherical_waves():
    """Point by point over an evenly lit exit pupil, distances exact: the direction cosines are
    the right coordinates.
    """
    camera = fast_camera(4.0, main_lens__apodisation="uniform-pupil")
    y = np.linspace(-9e-6, 9e-6, 9)
    point = (3e-6, -4e-6)
    whole = field_of_spheres(camera, WAVELENGTH, point, y, y)
    debye = field_on_array(camera, WAVELENGTH, point, y, y, pupil_directions(camera))
    whole = whole * np.vdot(whole, debye) / abs(np.vdot(whole, debye))
    assert np.linalg.norm(whole - debye) < 1e-3 * np.linalg.norm(whole)


@pytest.mark.parametrize("place", [(0, 0), (1, 0), (-1, 1), (2, 2)], ids=str)
def test_residual_functions_reproduce_the_kernel(place):
    k, z, half = 2 * np.pi / WAVELENGTH, 65e-6, 13e-6
    centre = tuple(26e-6 * n for n in place)
    residual = Residual(centre, half, half, z, k, z, 1e-7, symmetric=place[0] == place[1])
    rng = np.random.default_rng(3)
    u, x, v, y = rng.uniform(-half, half, (4, 30))
    left, right = residual.functions(0, v, y), residual.functions(1, u, x)
    found = np.tensordot(np.tensordot(left, residual.core, (0, 0)), right, 1)
    d, e = centre[0] + v[:, None] - y, centre[1] + u[:, None] - x
    true = kappa(d[:, :, None, None], e, z, k, centre) * ell(
        y[None, :, None, None], x[None, None, None, :], z, k
    )
    assert np.abs(found - true).max() < 1e-5


@pytest.mark.parametrize("centre", [(0.0, 0.0), (2e-5, 0.0), (-3e-5, 4e-5)], ids=str)
def test_residual_is_what_the_paths_leave(centre):
    k, z = 2 * np.pi / WAVELENGTH, 65e-6
    dy, dx = np.random.default_rng(4).uniform(-4e-5, 4e-5, (2, 50))
    side = np.sqrt(z * z + dy**2 + dx**2)
    kernel = z / (1j * WAVELENGTH * side**2) * (1 + 1j / (k * side)) * np.exp(1j * k * (side - z))
    separable = np.exp(1j * k * (path(dy, z, *centre) + path(dx, z, *centre[::-1]))) / (
        1j * WAVELENGTH * z
    )
    assert np.allclose(kernel, separable * kappa(dy, dx, z, k, centre), rtol=1e-9)
    # nothing is left along the lines through the centre but the amplitude
    assert np.allclose(
        np.angle(
            kappa(dy, centre[1], z, k, centre)
            / (1 + 1j / (k * np.sqrt(z * z + dy**2 + centre[1] ** 2)))
        ),
        0,
        atol=1e-9,
    )
    lens = np.exp(-1j * k * (np.sqrt(z * z + dy**2 + dx**2) - z))
    axes = np.exp(-1j * k * (np.sqrt(z * z + dy**2) - z + np.sqrt(z * z + dx**2) - z))
    assert np.allclose(lens, axes * ell(dy, dx, z, k), rtol=1e-9)


@pytest.mark.parametrize("symmetric", [True, False])
def test_a_matrix_split_into_its_strong_parts(symmetric):
    rng = np.random.default_rng(8)
    matrix = (rng.normal(size=(20, 20)) + 1j * rng.normal(size=(20, 20))) * np.exp(
        -0.7 * np.add.outer(np.arange(20), np.arange(20))
    )
    matrix = matrix + matrix.T if symmetric else matrix
    left, core, right = split(matrix, 1e-3, symmetric)
    assert np.linalg.norm(left @ core @ right.T - matrix) < 1.5e-3 and len(core) < 15
    assert np.allclose(left.conj().T @ left, np.eye(len(core))) and (not symmetric or right is left)


def _random_product(rng, rows, terms, decay):
    weights = np.exp(-decay * np.arange(terms))
    left, right = (
        rng.normal(size=(rows, terms)) + 1j * rng.normal(size=(rows, terms)) for _ in range(2)
    )
    return left, right, np.diag(weights).astype(complex)


def test_compression_keeps_what_was_asked():
    rng = np.random.default_rng(5)
    left, right, core = _random_product(rng, 90, 60, 0.3)
    high, wide = product.Product(left, right, {(0, 0): core}, False).factors(1e-2, 10)
    full = left @ core @ right.T
    assert np.linalg.norm(high @ wide.T - full) < 1.5e-2
    singular = np.linalg.svd(full, compute_uv=False)
    assert (
        high.shape[1] <= np.count_nonzero(np.sqrt(np.cumsum(singular[::-1] ** 2))[::-1] > 1e-2) + 1
    )


@pytest.mark.parametrize("begun", [10, 250, 400])
@pytest.mark.parametrize("symmetric", [False, True])
@pytest.mark.parametrize("three", [1, 10_000])
def test_a_spanned_product_keeps_what_was_asked(symmetric, begun, three, monkeypatch):
    """A sketch that grows, one that serves, and one as large as the product; by three real
    products, a part of the rows at a time, and by complex ones.
    """
    monkeypatch.setattr(product, "THREE_SERVE", three)
    monkeypatch.setattr(product, "ROWS", 150)
    left, right, core = _random_product(np.random.default_rng(15), 400, 300, 0.06)
    right = left if symmetric else right
    full = left @ core @ right.T
    cut = 1e-3 * np.linalg.norm(full)
    high, wide = product.Product(left, right, {(0, 0): core}, symmetric).spanned(cut, begun)
    assert np.linalg.norm(high @ wide.T - full) < 1.1 * cut
    assert np.allclose(high.conj().T @ high, np.eye(high.shape[1]))
    singular = np.linalg.svd(full, compute_uv=False)
    least = np.count_nonzero(np.sqrt(np.cumsum(singular[::-1] ** 2))[::-1] > cut)
    assert least <= high.shape[1] <= 1.35 * least + 2


@pytest.mark.parametrize("signed", [False, True])
def test_fields_of_many_terms_are_sums_of_products(signed):
    """Three real products in single precision against the sum itself."""
    rng = np.random.default_rng(17)
    (rows, columns), nodes, points, terms = (3, 5), 2, 4, separable_fields.THREE_SERVE
    high, wide = (
        rng.normal(size=(1, points, nodes * n, terms))
        + 1j * rng.normal(size=(1, points, nodes * n, terms))
        for n in (rows, columns)
    )
    signs = rng.choice([-1.0, 1.0], terms) if signed else None
    at = np.array([3, 0, 1, 2, 2]), np.array([1, 0, 1, 3, 1])
    found = np.empty((5, rows, columns), np.float32)
    few = [x.astype(np.complex64) for x in (high, wide)]
    Factors(*few, (rows, columns), nodes, signs).superpixel(0, 0, *at, found)
    other = wide if signs is None else wide * signs
    field = np.einsum("pvj,puj->pvu", high[0, at[0]], other[0, at[1]])
    energy = (np.abs(field) ** 2).reshape(5, nodes, rows, nodes, columns).sum(axis=(1, 3))
    np.testing.assert_allclose(found, energy, rtol=1e-5)


def test_fields_shown_on_nodes_afterwards_are_those_multiplied_there():
    rng = np.random.default_rng(16)
    (rows, columns), nodes, lines, terms = (3, 5), 2, (4, 7), 6
    high, wide = (
        rng.normal(size=(1, 3, n, terms)) + 1j * rng.normal(size=(1, 3, n, terms)) for n in lines
    )
    shown = rng.normal(size=(nodes * rows, lines[0])), rng.normal(size=(nodes * columns, lines[1]))
    at_once = Factors(shown[0] @ high, shown[1] @ wide, (rows, columns), nodes)
    after = Factors(high, wide, (rows, columns), nodes, shown=shown)
    points = np.repeat(np.arange(3), 3), np.tile(np.arange(3), 3)
    for one, other, shape in (
        (at_once, after, (rows, columns)),
        (at_once.turned, after.turned, (columns, rows)),
    ):
        found = [np.empty((9, *shape)) for _ in range(2)]
        one.superpixel(0, 0, *points, found[0])
        other.superpixel(0, 0, *points, found[1])
        np.testing.assert_allclose(found[1], found[0], rtol=1e-12)
    with pytest.raises(ValueError, match="do not fit"):
        Factors(high, wide, (columns, rows), nodes, shown=shown)


@pytest.mark.parametrize("symmetric", [False, True])
def test_a_product_of_few_terms_is_narrowed_in_single_precision(symmetric):
    rng = np.random.default_rng(7)
    left, right, core = _random_product(rng, 900, 400, 0.15)
    left, right, core = (
        x.astype(np.complex64) for x in (left / np.sqrt(900), right / np.sqrt(900), core)
    )
    right = left if symmetric else right
    cut = 1e-5 * np.linalg.norm(core)
    x, y, k = product.Product(left, right, {(0, 0): core}, symmetric).narrowed(cut)
    full = left.astype(complex) @ core @ right.T.astype(complex)
    terms = np.count_nonzero(
        np.sqrt(np.cumsum(np.linalg.svd(full, compute_uv=False)[::-1] ** 2))[::-1] > cut
    )
    # single precision has 1e-7 of the whole; squares of what is small would be lost in it
    assert np.linalg.norm(x.astype(complex) @ k @ y.T - full) < 1.5 * cut
    assert terms <= x.shape[1] < 1.4 * terms + 10 and np.allclose(
        x.conj().T @ x, np.eye(x.shape[1]), atol=1e-5
    )
    assert (y is x) == symmetric


def test_a_product_of_many_terms_is_left_as_it_is():
    left, right, core = _random_product(np.random.default_rng(8), 900, 300, 0.01)
    assert (
        product.Product(left, right, {(0, 0): core}, False).narrowed(1e-3 * np.linalg.norm(core))
        is None
    )


def test_too_many_terms_are_refused(monkeypatch):
    monkeypatch.setattr(product, "MAX_SKETCH", 20)
    left, right, core = _random_product(np.random.default_rng(6), 90, 60, 0.01)
    with pytest.raises(NumericsError, match="separable terms"):
        product.Product(left, right, {(0, 0): core}, False).factors(1e-3, 10)
    with pytest.raises(NumericsError, match="separable terms"):
        product.Product(left, right, {(0, 0): core}, False).spanned(1e-3, 10)


def test_refusals():
    with pytest.raises(NumericsError, match="circle lenslets .* not separable"):
        accuracy.plan_pif(
            fast_camera(lenslet_array__aperture_shape="circle"), model="exact", accuracy=1e-3
        )


def full_camera(name, profile):
    """52x52 pixels and 40x40 points: f/4.4 and f/8 with 250 um lenslets, f/8 with 104 um ones."""
    f_number, pitch, pixel = {
        "f/4.4": (4.4, 250e-6, 4.808e-6),
        "f/8": (8, 250e-6, 4.808e-6),
        "f/8, 104 um": (8, 104e-6, 2e-6),
        "f/2.2": (2.2, 250e-6, 4.808e-6),
        "f/1.5": (1.5, 250e-6, 4.808e-6),
    }[name]
    return fast_camera(
        main_lens__focal_length=0.1,
        main_lens__aperture_diameter=0.11 / f_number,
        object__distance=1.1,
        lenslet_array__distance=0.11,
        lenslet_array__pitch=pitch,
        lenslet_array__focal_length=pitch * f_number,
        lenslet_array__profile=profile,
        sensor__distance=pitch * f_number,
        sensor__pixel_pitch=pixel,
        sensor__pixels_per_lenslet=(52, 52),
        object__samples_per_lenslet=(40, 40),
    )


def energies_by_products(camera, image_points, window, centre, lines, nodes=10):
    """column_energies of all lenslets up to `window` beside the own one on `lines` of pixels, by
    the sum as products.
    """
    k, array, sensor = 2 * np.pi / WAVELENGTH, camera.lenslet_array, camera.sensor
    (v, wv), (u, wu) = sensor_nodes(
        centre, sensor.pixels_per_lenslet, sensor.pixel_pitch, sensor.pixel_pitch, nodes
    )
    some = (np.array(lines)[:, None] * nodes + np.arange(nodes)).ravel()
    half, reach, total = array.pitch / 2, np.abs(centre).max() + (window + 1) * array.pitch, 0
    slope = (
        reach / np.hypot(reach, sensor.distance)
        + array.pitch / (2 * array.focal_length)
        + camera.main_lens.aperture_diameter / (2 * array.distance)
    )
    (y, w), wave = (
        rayleigh_nodes(-half, half, k * slope),
        main_lens_field(camera, (window + 1.5) * array.pitch),
    )
    lens = lens_phase(array.profile, array.focal_length, y, y, k) * np.outer(w, w)
    for row in range(-window, window + 1):
        for column in range(-window, window + 1):
            down, right = y + row * array.pitch, y + column * array.pitch
            fields = np.array([wave(point, down, right) for point in image_points])
            sums = [
                rayleigh_products(fields * lens, down, right, line, u, sensor.distance, k)
                for line in np.split(v[some], len(lines))
            ]
            total = total + np.concatenate(sums, axis=1)
    energy = np.abs(total) ** 2 * wv[some, None] * wu
    return energy.reshape(len(image_points), len(lines), nodes, -1, nodes).sum(axis=(2, 4))


@pytest.mark.slow
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("name", ["f/4.4", "f/8", "f/8, 104 um"])
def test_full_size(name, profile):
    """On every sixth row of pixels: 1e-4 in single and 1e-6 in double precision, the
    corner's column as well.
    """
    camera, points, rows = full_camera(name, profile), [0, 19, 137, 412, 551, 820], range(0, 52, 6)
    nodes = {"f/4.4": 8, "f/8": 6, "f/8, 104 um": 5}[name]
    truth = energies_by_products(camera, image_points(camera, points), 0, (0, 0), rows, nodes)
    for asked in (1e-2, 1e-4, 1e-6):
        assert errors(columns(camera, points, asked=asked)[:, rows], truth).max() <= asked


@pytest.mark.slow
def test_full_size_with_neighbours():
    """3x3 superpixels at f/4.4 and 1e-3, as the dial has it: the corner's column and one inside,
    the light of 25 lenslets on lines of pixels of the three kinds of superpixels. Each kind's error
    is scaled to all of its pixels; those left out mirror them.
    """
    camera, points, lines = full_camera("f/4.4", "hyperbolic"), [0, 410], [3, 20, 37]
    plan = accuracy.plan_pif(camera, accuracy=1e-3, superpixels=(3, 3))
    assert plan.model == "exact" and plan.bands[0].window == 2
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    found, pitch = (
        builder.columns(points).transpose(2, 0, 1).reshape(2, 9, 52, 52),
        geometry(camera, WAVELENGTH).superpixel_pitch,
    )
    missed = np.zeros(2)
    for place, times in (((0, 0), 1), ((-1, 0), 2), ((-1, -1), 1)):
        own = found[:, 3 * (place[0] + 1) + place[1] + 1]
        truth = energies_by_products(
            camera, image_points(camera, points), 2, tuple(pitch * n for n in place), lines
        )
        missed += times * (errors(own[:, lines], truth) * np.linalg.norm(own, axis=(1, 2))) ** 2
    assert (np.sqrt(missed) <= 1e-3 * np.sqrt((found**2).sum(axis=(1, 2, 3)))).all()


@pytest.mark.parametrize(
    "name, wavelength, coarse",
    [
        ("f/8", 550e-9, 5e-2),
        pytest.param("f/4.4", 400e-9, 1e-2, marks=pytest.mark.slow),
        pytest.param("f/4.4", 550e-9, 3e-2, marks=pytest.mark.slow),
    ],
)
def test_whole_columns_hold_at_coarse_accuracies(name, wavelength, coarse):
    """All pixels of all superpixels near a lenslet's corner, whose light is on four of them,
    each with its error, against the matrix at a fifth.
    """
    camera = full_camera(name, "hyperbolic").replace(
        **{"light.wavelengths": (wavelength,), "light.design_wavelength": wavelength}
    )
    plans = [
        accuracy.plan_pif(
            camera, model="exact", accuracy=asked, superpixels=(3, 3), coherent_ring=1
        )
        for asked in (coarse, coarse / 5)
    ]
    found, fine = (
        PifBuilder(camera, wavelength, plan, dtype=np.float64).columns(slice(0, 8))
        for plan in plans
    )
    assert (
        np.linalg.norm(found - fine, axis=(0, 1)) <= coarse * np.linalg.norm(fine, axis=(0, 1))
    ).all()


def test_too_many_terms_on_superpixels_beside_are_refused_in_the_plan():
    with pytest.raises(NumericsError, match="separable terms, more than 2125"):
        accuracy.plan_pif(full_camera("f/2.2", "hyperbolic"), accuracy=3e-5, superpixels=(3, 3))


@pytest.mark.slow
def test_full_size_at_f_2_2():
    camera, points, rows = full_camera("f/2.2", "parabolic"), [0, 137, 820], [3, 26]
    truth = energies_by_products(camera, image_points(camera, points), 0, (0, 0), rows, 12)
    assert errors(columns(camera, points, asked=2e-4)[:, rows], truth).max() <= 2e-4


@pytest.mark.slow
def test_pixels_that_hold_eight_fringes_of_a_lenslet_of_412_cells():
    """f/1.5 at 400 nm, beyond what the rule of the pixels' nodes was fitted to."""
    camera, wavelength, points = (
        full_camera("f/1.5", "hyperbolic").replace(**{"light.wavelengths": (400e-9,)}),
        400e-9,
        [0, 820, 137, 20],
    )
    found = []
    for asked in (1e-5, 1e-2, 1e-3):
        plan = accuracy.plan_pif(
            camera, model="fresnel", accuracy=asked, superpixels=(1, 1), coherent_ring=0
        )
        found.append(PifBuilder(camera, wavelength, plan, dtype=np.float64).columns(points)[0])
    for asked, other in zip((1e-2, 1e-3), found[1:]):
        assert (
            np.linalg.norm(other - found[0], axis=0) <= asked * np.linalg.norm(found[0], axis=0)
        ).all()


@pytest.mark.parametrize("superpixels", [(1, 1), (3, 3)])
def test_a_shut_filter_lets_no_light_through(superpixels):
    camera = small_camera(
        filter_array={"layout": (1, 1), "filters": [{"center": 300e-9, "fwhm": 1e-9}]}
    )
    assert not columns(camera, [0, 5], superpixels=superpixels, model="exact").any()


def test_a_field_of_too_many_terms_is_refused_before_it_is_computed(monkeypatch):
    monkeypatch.setattr(term_counts, "MAX_SKETCH", 9)
    with pytest.raises(NumericsError, match="about .* separable terms, more than"):
        exact.exact_band(
            small_camera(), geometry(small_camera(), WAVELENGTH), (1, 1), 0, 1e-4, 1e-4
        )


def test_superpixels_are_set_up_on_threads_with_the_same_bytes():
    camera = small_camera()
    plan = accuracy.plan_pif(
        camera, model="exact", accuracy=1e-3, superpixels=(3, 3), coherent_ring=1
    )
    found = []
    for threads in (1, 3):
        with within(replace(budget(), threads=threads)):
            found.append(PifBuilder(camera, WAVELENGTH, plan, dtype=np.float32).whole())
    assert len(PifBuilder(camera, WAVELENGTH, plan).lenslets._tables) == 3
    np.testing.assert_array_equal(*found)


def test_memory_of_large_matrices_is_used_again_where_it_is_large_enough():
    places, kind = exact._Places(), np.dtype(np.complex64)
    first = places.take((30, 20), kind)
    beside = places.take((30, 20), kind)
    assert first.shape == (30, 20) and not np.shares_memory(first, beside)
    places.give(first[3:].T)
    again = places.take((5, 100), np.dtype(complex))
    assert not np.shares_memory(again, first) and again.dtype == complex
    places.give(beside)
    smaller = places.take((7, 3), kind)
    assert np.shares_memory(smaller, beside) and not np.shares_memory(smaller, again)


@pytest.mark.parametrize("nearer", [1.0, 0.97, 0.9])
def test_errors_of_dim_light_count_no_less_than_it_shows(nearer):
    """Weights of points on superpixels, from the light that enters each lenslet, against the light
    that a fine matrix has there; in focus and out of it.
    """
    camera = small_camera()
    camera = camera.replace(**{"object.distance": nearer * camera.object.distance})
    plan = accuracy.plan_pif(
        camera, model="exact", accuracy=1e-5, superpixels=(3, 3), coherent_ring=1
    )
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    light = builder.whole().sum(axis=1).reshape(3, 3, *builder.object_shape)
    share = light.sum(axis=1).mean(axis=2)
    share = share / share.sum(axis=0)
    shown = np.minimum(1, np.sqrt(share / (share**2).sum(axis=0)))
    assert (builder.lenslets._counted[0] >= 0.9 * shown).all()


@pytest.mark.parametrize("nearer", [1.0, 0.95])
def test_grids_that_are_no_squares_hold_parts_of_a_fine_one(nearer):
    camera = small_camera()
    camera = camera.replace(**{"object.distance": nearer * camera.object.distance})

    def matrix(superpixels, asked):
        plan = accuracy.plan_pif(
            camera, model="exact", accuracy=asked, superpixels=superpixels, coherent_ring=1
        )
        found = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64).whole()
        return found.reshape(*superpixels, *found.shape[1:])

    fine = matrix((5, 5), 1e-5)
    for superpixels in ((3, 1), (1, 3), (5, 3)):
        rows, columns = (slice(2 - n // 2, 3 + n // 2) for n in superpixels)
        part = fine[rows, columns]
        missed = np.sqrt(((matrix(superpixels, 1e-3) - part) ** 2).sum(axis=(0, 1, 2)))
        assert (missed <= 1e-3 * np.sqrt((part**2).sum(axis=(0, 1, 2)))).all()


def test_fewer_numbers_than_nodes_carry_the_light_of_pixels():
    """Fields of few waves on 9 nodes a pixel, pixel by pixel against all nodes."""
    rng, pixels, nodes, points = np.random.default_rng(7), 6, 9, 4
    t, w = gauss(nodes)
    u = (t[:, None] / 2 + np.arange(pixels)).ravel()
    waves = np.exp(1j * np.linspace(-2, 2, 15) * u[:, None])
    waves *= np.sqrt(np.repeat(w, pixels) / 2)[:, None]
    high, wide = (
        np.stack([waves @ (a + 1j * b) for a, b in rng.normal(size=(points, 2, 15, 5))])
        for _ in range(2)
    )

    def seen(down, across):
        field = np.einsum("avt,but->abvu", down, across)
        parts = field.reshape(points, points, -1, pixels, across.shape[1] // pixels, pixels)
        return (abs(parts) ** 2).sum(axis=(2, 4))

    whole = seen(high, wide)
    light = whole.sum(axis=(2, 3))
    for most, fewest, many in ((1e-3, 3, 5), (1e-9, 5, 8)):
        modes = pixel_modes(high, wide, pixels, light, most)
        assert fewest <= modes.shape[2] <= many
        lost = whole - seen(on_modes(high, modes), wide)
        assert (lost > -1e-12 * whole.max()).all()
        assert (np.linalg.norm(lost, axis=(2, 3)) < 2 * most * light / pixels).all()
    assert pixel_modes(high, wide, pixels, light, 0).shape[2] == nodes


@pytest.mark.parametrize(
    "f_number, fill, asked",
    [(1.5, 0.6, 1e-4), (1.5, 0.9, 1e-4), (2.5, 0.6, 1e-5), (1.5, 0.9, 1e-5)],
)
def test_dim_points_between_lenslets_and_steep_corners_hold(f_number, fill, asked):
    """All columns of 3x3 superpixels, against those at a tenth: points that few lenslets light and
    corners are the first that what all lenslets together may lose is too much for.
    """
    camera = fast_camera(f_number, lenslet_array__fill_factor=fill)
    found, fine = (
        columns_of(camera, one, superpixels=(3, 3), coherent_ring=1) for one in (asked, asked / 10)
    )
    off = np.linalg.norm(found - fine, axis=0) / np.linalg.norm(fine, axis=0)
    assert off.max() < asked


def columns_of(camera, asked, **request):
    """All columns of a matrix by the exact model, (pixel, point)."""
    plan = accuracy.plan_pif(camera, model="exact", accuracy=asked, **request)
    builder = PifBuilder(camera, WAVELENGTH, plan, dtype=np.float64)
    found = builder.columns(list(range(math.prod(builder.object_shape))))
    return found.reshape(-1, found.shape[2])
