"""The system matrix against brute-force Fresnel quadrature, for each feature of a camera."""

from functools import cache

import numpy as np
import pytest

from tests.forward.propagation.cameras import WAVELENGTH, pif_builder, small_camera
from tests.reference.fresnel import disc_nodes, pixel_energies, rectangle_nodes

ISOLATED = [(0, 0)]
NEIGHBOURS = [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)]


def image_point(camera, index):
    rows, columns = camera.object.samples_per_lenslet
    pitch = camera.lenslet_array.pitch
    return (
        (index // columns - (rows - 1) / 2) * pitch / rows,
        (index % columns - (columns - 1) / 2) * pitch / columns,
    )


@cache
def known(changes):
    """The oracle's column of the first point of a small camera, once for all accuracies."""
    camera = small_camera(**dict(changes))
    return pixel_energies(camera, WAVELENGTH, image_point(camera, 0), ISOLATED, (0, 0))


def compare(camera, index, *, ring=0, accuracy=1e-6, lenslets=None, truth=None, **oracle):
    """Relative L2 error of one column of A for the object's own superpixel."""
    builder = pif_builder(
        camera,
        WAVELENGTH,
        superpixels=(1, 1),
        coherent_ring=ring,
        accuracy=accuracy,
        dtype=np.float64,
    )
    column = builder.columns([index])[0, :, 0].reshape(camera.sensor.pixels_per_lenslet)
    if truth is None:
        truth = pixel_energies(
            camera,
            WAVELENGTH,
            image_point(camera, index),
            lenslets or (NEIGHBOURS if ring else ISOLATED),
            (0, 0),
            **oracle,
        )
    return np.linalg.norm(column - truth) / np.linalg.norm(truth)


@pytest.mark.parametrize("index", [0, 11, 27, 36])
def test_isolated_lenslet(index):
    assert compare(small_camera(), index) < 1e-6


def test_coherent_neighbours():
    assert compare(small_camera(), 8, ring=1, lenslet_nodes=40) < 1e-6


def test_fields_of_neighbours_add_before_the_square():
    """At a corner of the lenslet the incoherent sum is far off, so the agreement above
    does test coherence.
    """
    camera = small_camera()
    alone = compare(camera, 0, ring=1, lenslets=ISOLATED)
    assert alone > 0.1


@pytest.mark.parametrize(
    "change",
    [
        {"main_lens__aperture_shape": "square"},
        {"lenslet_array__aperture_shape": "circle"},
        {"lenslet_array__fill_factor": 0.8},
        {
            "lenslet_array__aperture_shape": "circle",
            "main_lens__aperture_shape": "square",
            "lenslet_array__fill_factor": 0.9,
        },
        {"object__distance": 0.5},
        {"object__distance": 0.62, "sensor__distance": 230e-6},
        {"sensor__distance": 180e-6, "lenslet_array__focal_length": 215e-6},
        {"sensor__pixel_fill_factor": 0.64},
        {"object__samples_per_lenslet": (6, 9)},
    ],
    ids=str,
)
def test_every_kind_of_camera(change):
    round_lenslet = change.get("lenslet_array__aperture_shape") == "circle"
    assert (
        compare(
            small_camera(**change),
            10,
            **dict(lenslet_nodes=26, pupil_nodes=(24, 56))
            if round_lenslet
            else dict(pupil_nodes=(48, 104)),
        )
        < 1e-6
    )


def test_neighbours_of_round_lenslets():
    assert (
        compare(
            small_camera(lenslet_array__aperture_shape="circle"),
            3,
            ring=1,
            lenslet_nodes=34,
            pupil_nodes=(24, 56),
        )
        < 1e-6
    )


def test_annulus():
    camera = small_camera(main_lens__aperture_shape="annulus", main_lens__obscuration=0.4)
    radius = camera.main_lens.aperture_diameter / 2
    assert compare(camera, 10, pupil=disc_nodes(radius, 40, 96, inner=0.4 * radius)) < 1e-6


def test_aberrations_in_metres_with_their_sign():
    """Coma along y (Noll 7), astigmatism along 45 degrees (5) and defocus (4), written
    out as polynomials.
    """
    terms = ((4, 60e-9), (5, 35e-9), (7, 45e-9))
    camera = small_camera(
        main_lens__aberrations=tuple(dict(noll=j, coefficient=c) for j, c in terms)
    )
    radius = camera.main_lens.aperture_diameter / 2

    def amplitude(y, x):
        y, x = y / radius, x / radius
        r2 = y * y + x * x
        w = (
            60e-9 * np.sqrt(3) * (2 * r2 - 1)
            + 35e-9 * np.sqrt(6) * 2 * x * y
            + 45e-9 * np.sqrt(8) * (3 * r2 - 2) * y
        )
        return np.exp(2j * np.pi / WAVELENGTH * w)

    assert compare(camera, 10, amplitude=amplitude) < 1e-6


def filters(size, gap, peaks):
    cells = [
        dict(center=c, fwhm=20e-9, peak=p, blocking=1e-3)
        for c, p in zip((540e-9, 550e-9, 560e-9, 650e-9), peaks)
    ]
    return {"layout": (2, 2), "gap": gap, "size": size, "filters": cells}


def test_filter_array_row_by_row_as_intensity_transmittance():
    camera = small_camera(filter_array=filters(4.4e-3, 0.3e-3, (0.9, 0.5, 0.8, 0.7)))
    quarter = np.exp(-4 * np.log(2) * 0.25)
    passed = (0.9 * quarter + 1e-3, 0.5 + 1e-3, 0.8 * quarter + 1e-3, 1e-3)
    low, high = (-2.2e-3, -0.15e-3), (0.15e-3, 2.2e-3)
    cells = [(low, low), (low, high), (high, low), (high, high)]
    parts = []
    for (ys, xs), t in zip(cells, passed):
        y, x, w = rectangle_nodes(*ys, *xs, 40)
        parts.append((y, x, w * np.sqrt(t)))
    assert compare(camera, 10, pupil=tuple(np.concatenate(p) for p in zip(*parts))) < 1e-6


@pytest.mark.parametrize("aperture", ["square", "circle"])
def test_whole_grid_of_superpixels_shifts_with_the_true_pitch(aperture):
    """A point one lenslet further right gives the same column one superpixel pitch D2 (1 +
    z3/z2) further right, not D2.
    """
    camera = small_camera(lenslet_array__aperture_shape=aperture)
    oracle = dict(lenslet_nodes=32, pupil_nodes=(24, 56))
    pitch, index = camera.lenslet_array.pitch, 12
    y, x = image_point(camera, index)
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(3, 3), coherent_ring=0, accuracy=1e-6, dtype=np.float64
    )
    images = builder.columns([index])[..., 0].reshape(3, 3, 13, 13)
    moved = pixel_energies(
        camera, WAVELENGTH, (y, x + pitch), [(0, 1)], (0, camera.superpixel_pitch), **oracle
    )
    assert np.linalg.norm(moved - images[1, 1]) < 1e-6 * np.linalg.norm(moved)
    naive = pixel_energies(camera, WAVELENGTH, (y, x + pitch), [(0, 1)], (0, pitch), **oracle)
    assert np.linalg.norm(naive - images[1, 1]) > 1e-4 * np.linalg.norm(moved)
    # and offset (row, column) = (-1, +1) is the lenslet above and to the right
    other = pixel_energies(
        camera,
        WAVELENGTH,
        (y, x),
        [(-1, 1)],
        (-camera.superpixel_pitch, camera.superpixel_pitch),
        **oracle,
    )
    assert builder.offsets[2].tolist() == [-1, 1]
    assert np.linalg.norm(other - images[0, 2]) < 1e-5 * np.linalg.norm(other)


def test_neighbouring_superpixels_out_of_focus_with_all_lenslets_of_the_window():
    camera = small_camera(object__distance=0.52)
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(3, 3), coherent_ring=1, accuracy=1e-6, dtype=np.float64
    )
    assert builder.geometry.blur > 0.3 * camera.lenslet_array.pitch
    window = range(-builder.plan.bands[0].window, builder.plan.bands[0].window + 1)
    images = builder.columns([1])[..., 0].reshape(3, 3, 13, 13)
    for sy, sx in ((0, 0), (-1, 0), (1, -1)):
        truth = pixel_energies(
            camera,
            WAVELENGTH,
            image_point(camera, 1),
            [(r, c) for r in window for c in window],
            (sy * camera.superpixel_pitch, sx * camera.superpixel_pitch),
            lenslet_nodes=90,
            pupil_nodes=(48, 128),
            pixel_nodes=9,
        )
        assert np.linalg.norm(images[sy + 1, sx + 1] - truth) < 1e-6 * np.linalg.norm(images)


@pytest.mark.parametrize("accuracy", [1e-2, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize(
    "change", [{}, {"lenslet_array__aperture_shape": "circle"}, {"object__distance": 0.52}], ids=str
)
def test_accuracy_is_kept(accuracy, change):
    truth = known(tuple(change.items()))
    assert compare(small_camera(**change), 0, accuracy=accuracy, truth=truth) < accuracy
