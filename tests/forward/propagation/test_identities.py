"""Identities that hold for every camera, over cameras that hypothesis draws (derandomised: the
same ones every time).
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from plenocli.forward.accuracy.dial import pif_builder
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.fresnel.shaped import ShapedLenslets
from plenocli.forward.propagation.fresnel.square import SquareLenslets
from tests.forward.propagation.cameras import WAVELENGTH, small_camera
from tests.reference.window import column_energies

FEW = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=24,
    suppress_health_check=list(HealthCheck),
)
RADIUS = 6.875e-3 / 2
ISOLATED = dict(superpixels=(1, 1), coherent_ring=0)


def distance_of(eps):
    """Object distance (m) that gives the test camera a defocus of eps (1/m)."""
    return 1 / (1 / 50e-3 - 1 / 55e-3 + eps)


@st.composite
def cameras(draw, pupils=("circle", "square", "annulus"), most=3):
    """A small camera with anything its description can hold, and up to `most` Zernike terms;
    keys of small_camera.
    """
    nano = st.integers(-60, 60).map(lambda n: n * 1e-9)
    shape = draw(st.sampled_from(pupils))
    keys = dict(
        main_lens__aperture_shape=shape,
        object__distance=distance_of(draw(st.integers(-6, 6)) * 0.01),
        sensor__distance=draw(st.integers(180, 240)) * 1e-6,
        lenslet_array__fill_factor=draw(st.sampled_from([1.0, 0.9, 0.8])),
        sensor__pixel_fill_factor=draw(st.sampled_from([1.0, 0.7])),
        object__samples_per_lenslet=(draw(st.integers(3, 6)), draw(st.integers(3, 6))),
        sensor__pixels_per_lenslet=(draw(st.integers(7, 13)), draw(st.integers(7, 13))),
    )
    if shape == "annulus":
        keys["main_lens__obscuration"] = draw(st.sampled_from([0.2, 0.5]))
    terms = draw(st.lists(st.sampled_from((4, 5, 6, 7, 8, 11)), max_size=most, unique=True))
    keys["main_lens__aberrations"] = tuple(dict(noll=j, coefficient=draw(nano)) for j in terms)
    return keys


def matrix(keys, **request):
    """All columns (superpixel, pixel, point) in double precision."""
    request = ISOLATED | dict(accuracy=1e-7, dtype=np.float64, model="fresnel") | request
    return pif_builder(small_camera(**keys), WAVELENGTH, **request).columns(slice(None))


def unit(keys):
    return RADIUS * (np.sqrt(2) if keys["main_lens__aperture_shape"] == "square" else 1)


def with_term(keys, noll, coefficient):
    return keys | {
        "main_lens__aberrations": (
            *keys.get("main_lens__aberrations", ()),
            dict(noll=noll, coefficient=coefficient),
        )
    }


def apart(a, b):
    """Largest relative L2 difference of two matrices over their columns."""
    return (np.linalg.norm(a - b, axis=(0, 1)) / np.linalg.norm(b, axis=(0, 1))).max()


@FEW
@given(cameras(), st.integers(-30, 30))
def test_defocus_in_the_wavefront_is_another_distance(keys, steps):
    """W = a2 r^2 is eps -> eps + 2 a2: the same A from two descriptions."""
    change = steps * 1e-3
    start = 1 / keys["object__distance"] + 1 / 55e-3 - 1 / 50e-3
    coefficient = change / 2 * unit(keys) ** 2 / (2 * np.sqrt(3))
    assert (
        apart(
            matrix(with_term(keys, 4, coefficient)),
            matrix(keys | {"object__distance": distance_of(start + change)}),
        )
        < 3e-7
    )


@FEW
@given(cameras(pupils=("circle", "square")), st.sampled_from([(3, 0), (2, 1)]))
def test_tilt_of_the_wavefront_moves_the_image(keys, where):
    """W = g x moves the image by z2 g: by one step of the object grid, columns are those
    of the next point.
    """
    noll, axis = where
    rows, columns = keys["object__samples_per_lenslet"]
    camera = small_camera(**keys)
    step = camera.lenslet_array.pitch / (rows, columns)[axis]
    moved, still = (
        matrix(k).reshape(-1, rows, columns)
        for k in (with_term(keys, noll, step / 55e-3 * unit(keys) / 2), keys)
    )
    moved, still = (np.moveaxis(a, axis + 1, 0) for a in (moved, still))
    assert np.abs(moved[:-1] - still[1:]).max() < 1e-6 * still.max()


@settings(FEW, max_examples=12)
@given(cameras(most=0), st.sampled_from([(0, 1), (1, 0), (-1, 0)]))
def test_a_scene_moved_by_a_lenslet_moves_its_image_by_a_superpixel(keys, offset):
    """Against brute force, which knows neither local coordinates nor superpixel pitch."""
    camera = small_camera(**keys)
    view = geometry(camera, WAVELENGTH)
    column = matrix(keys)[0, :, 0].reshape(view.pixel_shape)
    point = [view.points(axis)[0] + n * view.D2 for axis, n in enumerate(offset)]
    moved = column_energies(camera, WAVELENGTH, point, None, [offset], pixel_nodes=9)[offset]
    assert np.linalg.norm(moved - column) < 3e-7 * np.linalg.norm(column)


@settings(FEW, max_examples=12)
@given(st.integers(-4, 4), st.integers(190, 225), st.sampled_from(["circle", "square"]))
def test_five_by_five_superpixels_keep_the_light(defocus, distance, shape):
    """Full fill, little aberration: what leaves is the spread function's tail, 2/(pi v) at two
    and a half lenslets.
    """
    keys = dict(
        object__distance=distance_of(defocus * 0.01),
        sensor__distance=distance * 1e-6,
        main_lens__aperture_shape=shape,
        object__samples_per_lenslet=(3, 3),
    )
    pitch = small_camera(**keys).superpixel_pitch
    shares = matrix(
        keys | {"sensor__pixel_pitch": pitch / 13},
        superpixels=(5, 5),
        coherent_ring=1,
        accuracy=1e-4,
    ).sum(axis=(0, 1))
    tail = 2 * WAVELENGTH * 55e-3 / (np.pi**2 * 1.5 * 26e-6 * 6.875e-3)
    assert np.all(shares < 1 + 1e-6) and np.all(shares > 1 - 2.5 * tail)


@FEW
@given(cameras(), st.integers(0, 2**31))
def test_images_of_scenes_add_and_are_never_negative(keys, seed):
    """Incoherent points: A is linear in the scene by definition; its entries are energies of at
    most all the light.
    """
    a = matrix(keys)[0]
    one, other = np.random.default_rng(seed).random((2, a.shape[1]))
    assert np.allclose(
        a @ (2 * one + 3 * other), 2 * (a @ one) + 3 * (a @ other), rtol=1e-13, atol=0
    )
    assert a.min() >= 0 and a.sum(axis=0).max() <= 1 + 1e-7 and a.max() > 0


@FEW
@given(st.one_of(cameras(most=0), cameras()), st.sampled_from([0, 1]))
def test_three_routes_agree(keys, ring):
    """Low rank, triple product along chords, and brute force (of cameras without aberrations,
    which it leaves out).
    """
    keys = keys | {"object__samples_per_lenslet": (4, 4)}
    camera = small_camera(**keys)
    builder = pif_builder(
        camera,
        WAVELENGTH,
        superpixels=(1, 1),
        coherent_ring=ring,
        accuracy=1e-7,
        dtype=np.float64,
        model="fresnel",
    )
    view, plan, band = builder.geometry, builder.plan, builder.plan.bands[0]
    rows, columns = np.divmod(np.arange(16), 4)
    found = []
    for maker in (SquareLenslets, ShapedLenslets):
        out = np.empty((16, 1, 1, *view.pixel_shape))
        maker(camera, view, plan, band).columns(rows, columns, out)
        found.append(out[:, 0, 0])
    assert np.linalg.norm(found[0] - found[1]) < 3e-7 * np.linalg.norm(found[0])
    if not keys["main_lens__aberrations"]:
        for q in (0, 6):
            point = (view.points(0)[rows[q]], view.points(1)[columns[q]])
            truth = column_energies(
                camera, WAVELENGTH, point, band.window, [(0, 0)], pixel_nodes=9
            )[0, 0]
            assert np.linalg.norm(found[0][q] - truth) < 3e-7 * np.linalg.norm(truth)


def test_the_tilt_test_would_notice_the_wrong_sign():
    keys = dict(main_lens__aperture_shape="circle", object__samples_per_lenslet=(4, 4))
    step = small_camera().lenslet_array.pitch / 4
    moved, still = (
        matrix(k).reshape(-1, 4, 4) for k in (with_term(keys, 2, -step / 55e-3 * RADIUS / 2), keys)
    )
    assert np.abs(moved[:, :, :-1] - still[:, :, 1:]).max() > 0.01 * still.max()
    assert moved[:, :, 1:] == pytest.approx(still[:, :, :-1], abs=1e-6 * still.max())
