"""Glasses, quadrature, pupil and the coherent spread function against closed forms."""

import numpy as np
import pytest
from scipy.special import j0, j1

from plenocli.base.errors import ConfigError
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.glass import focal_length, refractive_index
from plenocli.forward.camera.pupil import (
    filter_cells,
    filter_transmittance,
    zernike,
)
from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import cell_rows, disc_rows
from plenocli.forward.camera.sections.main_lens import noll_indices
from plenocli.forward.propagation.fresnel.spread_function import sampled_field, separable_field
from tests.forward.propagation.cameras import WAVELENGTH, small_camera


@pytest.mark.parametrize(
    "glass, index",
    [
        ("N-BK7", 1.51680),
        ("N-BAK4", 1.56883),
        ("N-F2", 1.62005),
        ("N-SF11", 1.78472),
        ("fused silica", 1.45846),
    ],
)
def test_index_at_the_helium_d_line(glass, index):
    assert refractive_index(glass, 587.5618e-9) == pytest.approx(index, abs=2e-5)


def test_singlet_focal_shift():
    """n = 1.52532 at 450 nm and 1.51452 at 650 nm make a BK7 singlet 2.1 % longer in the red."""
    blue, red = (focal_length(50e-3, "N-BK7", 550e-9, w) for w in (450e-9, 650e-9))
    assert red / blue == pytest.approx(0.52532 / 0.51452, abs=2e-5)
    assert focal_length(50e-3, "none", 550e-9, 450e-9) == 50e-3
    assert focal_length(50e-3, "N-BK7", 550e-9, 550e-9) == pytest.approx(50e-3)


def test_unknown_glass_and_range():
    with pytest.raises(ConfigError, match="N-BK7"):
        refractive_index("window pane", 550e-9)
    with pytest.raises(ConfigError, match="0.3 to 2.5"):
        refractive_index("N-BK7", 10e-6)


def test_wavelength_moves_both_focal_lengths():
    camera = small_camera(
        main_lens__glass="N-BK7",
        lenslet_array__glass="fused silica",
        light__design_wavelength=550e-9,
    )
    view = geometry(camera, 650e-9)
    assert (
        view.f1 > 50e-3
        and view.f2 > 208e-6
        and view.eps > 0
        and geometry(camera, 550e-9).eps == pytest.approx(0, abs=1e-12)
    )
    assert view.kappa == pytest.approx(1 / view.z2 + 1 / view.z3 - 1 / view.f2)


@pytest.mark.parametrize("lattice, shape", [("hexagonal", "square"), ("square", "hexagon")])
def test_lenslets_that_overlap_are_refused(lattice, shape):
    with pytest.raises(ValueError, match="overlap"):
        small_camera(lenslet_array__lattice=lattice, lenslet_array__aperture_shape=shape)
    small_camera(
        lenslet_array__lattice=lattice,
        lenslet_array__aperture_shape=shape,
        lenslet_array__fill_factor=0.86,
    )


def test_disc_rows_give_the_airy_amplitude():
    rows, k = disc_rows(1.0, 40.0), 39.0
    value = np.sum(rows.weight * np.exp(1j * k * (0.6 * rows.x + 0.8 * rows.y[:, None])))
    assert value == pytest.approx(2 * np.pi * j1(k) / k, abs=1e-12)


def test_cells_that_cover_a_disc_add_up_to_it():
    cells = [(y, y + 1.1, x, x + 1.1) for y in (-1.1, 0.0) for x in (-1.3, -0.2, 0.9)]
    parts = [rows for cell in cells for rows in cell_rows(cell, [(0.0, 0.0, 1.0)], 20.0)]
    assert sum(rows.weight.sum() for rows in parts) == pytest.approx(np.pi, abs=1e-9)
    wave = sum(np.sum(r.weight * np.exp(1j * (12 * r.x - 9 * r.y[:, None]))) for r in parts)
    assert wave == pytest.approx(2 * np.pi * j1(15) / 15, abs=1e-9)


def test_noll_order_and_orthonormality():
    assert [noll_indices(j) for j in range(1, 12)] == [
        (0, 0),
        (1, 1),
        (1, -1),
        (2, 0),
        (2, -2),
        (2, 2),
        (3, -1),
        (3, 1),
        (3, -3),
        (3, 3),
        (4, 0),
    ]
    rows = disc_rows(1.0, 60.0)
    values = np.array([zernike(j, rows.y[:, None], rows.x) for j in range(1, 23)])
    gram = np.einsum("amn,bmn,mn->ab", values, values, rows.weight) / np.pi
    assert np.abs(gram - np.eye(22)).max() < 1e-12


def camera_with_filters(**changes):
    cells = [
        dict(center=c, fwhm=20e-9, peak=0.8, blocking=1e-3)
        for c in (450e-9, 540e-9, 570e-9, 650e-9)
    ]
    return small_camera(filter_array={"layout": (2, 2), "gap": 0.2e-3, "filters": cells}, **changes)


def test_filters_pass_intensity_and_gaps_nothing():
    camera = camera_with_filters()
    (box, t), *others = filter_cells(camera, 450e-9)
    assert box[0] < 0 and box[2] < 0 and t == pytest.approx(0.801)
    assert filter_transmittance(camera.filter_array.filters[0], 460e-9) == pytest.approx(0.4 + 1e-3)
    side = (camera.filter_array.size - 0.2e-3) / 2
    view = geometry(camera, 450e-9)
    passed = sum(
        np.sum(np.abs(r.weight) ** 2 / np.abs(r.weight / np.sqrt(0.801)))
        for r in pupil_rows(camera, view, 1.0)[:1]
    )
    assert passed == pytest.approx(side**2 * 0.801**0.5 * 0.801**0.5, rel=1e-9)


def test_airy_pattern_and_encircled_energy():
    camera = small_camera()
    view = geometry(camera, WAVELENGTH)
    d = np.linspace(-80e-6, 80e-6, 321)
    h = np.abs(sampled_field(camera, view, np.zeros(1), d)[0]) ** 2
    r = np.pi * view.D1 * d / (view.wavelength * view.z2)
    airy = np.ones_like(r)
    airy[r != 0] = (2 * j1(r[r != 0]) / r[r != 0]) ** 2
    assert np.abs(h / h.max() - airy).max() < 1e-9
    edge = 1.2196699 * view.wavelength * view.z2 / view.D1
    t, w = np.polynomial.legendre.leggauss(60)
    radius = edge * (t + 1) / 2
    ring = np.abs(sampled_field(camera, view, np.zeros(1), radius)[0]) ** 2
    assert np.sum(w * edge / 2 * ring * 2 * np.pi * radius) == pytest.approx(
        1 - j0(3.8317060) ** 2 - j1(3.8317060) ** 2, abs=1e-9
    )


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"main_lens__aperture_shape": "square"},
        {"main_lens__aperture_shape": "annulus", "main_lens__obscuration": 0.5},
    ],
    ids=str,
)
def test_parseval(change):
    """All light of the aperture reaches the plane of the array, but for the diffraction tail
    beyond three blur widths.
    """
    camera = small_camera(object__distance=0.5, **change)
    view = geometry(camera, WAVELENGTH)
    field = separable_field(camera, view, 3 * view.blur, 1e-3)
    t, w = np.polynomial.legendre.leggauss(300)
    a, b = (field.evaluate(3 * view.blur * t, axis) for axis in (0, 1))
    gy, gx = ((m.conj().T * (w * 3 * view.blur)) @ m for m in (a, b))
    energy = np.sum(gy * gx).real
    assert 0.99 < energy < 1 + 1e-6


def test_filters_reduce_the_light_and_nothing_else_does():
    camera = camera_with_filters(object__distance=0.5)
    view = geometry(camera, 540e-9)
    field = separable_field(camera, view, 3 * view.blur, 1e-3)
    t, w = np.polynomial.legendre.leggauss(300)
    a, b = (field.evaluate(3 * view.blur * t, axis) for axis in (0, 1))
    energy = np.sum(
        ((a.conj().T * (w * 3 * view.blur)) @ a) * ((b.conj().T * (w * 3 * view.blur)) @ b)
    ).real
    side = (camera.filter_array.size - 0.2e-3) / 2
    passed = (
        side**2
        * sum(t for _, t in filter_cells(camera, 540e-9))
        / (np.pi * camera.main_lens.aperture_diameter**2 / 4)
    )
    assert energy == pytest.approx(passed, rel=0.02) and energy < passed * (1 + 1e-6)


def test_tilt_moves_the_image_by_z2_times_its_slope():
    """Noll 2 is 2 x over the unit disc: coefficient c has slope 2 c / radius and moves
    the image towards +x.
    """
    slope = 2e-4
    camera = small_camera(main_lens__aberrations=(dict(noll=2, coefficient=slope * 6.875e-3 / 4),))
    view = geometry(camera, WAVELENGTH)
    y, x = np.linspace(-15e-6, 15e-6, 31), np.linspace(-15e-6, 15e-6, 37)
    tilted = sampled_field(camera, view, y, x + slope * view.z2)
    plain = sampled_field(small_camera(), view, y, x)
    assert np.abs(np.abs(tilted) - np.abs(plain)).max() < 1e-9 * np.abs(plain).max()


def test_defocus_as_wavefront_is_defocus_of_the_lens():
    """W = a2 r^2 equals eps -> eps + 2 a2 exactly; Noll 4 is sqrt(3)(2 r^2/R^2 - 1)."""
    extra, radius = 0.05, 6.875e-3 / 2
    shifted = small_camera(object__distance=1 / (1 / 0.55 + extra))
    coefficient = extra / 2 * radius**2 / (2 * np.sqrt(3))
    aberrated = small_camera(main_lens__aberrations=(dict(noll=4, coefficient=coefficient),))
    y = np.linspace(-60e-6, 60e-6, 25)
    first = sampled_field(shifted, geometry(shifted, WAVELENGTH), y, y)
    second = sampled_field(aberrated, geometry(aberrated, WAVELENGTH), y, y)
    phase = first[3, 4] / second[3, 4]
    assert abs(phase) == pytest.approx(1, abs=1e-9)
    assert np.abs(first - phase * second).max() < 1e-9 * np.abs(first).max()


@pytest.mark.parametrize(
    "change, symmetry",
    [
        ({}, (True, True, True)),
        ({"main_lens__aberrations": (dict(noll=7, coefficient=50e-9),)}, (False, True, False)),
        ({"main_lens__aberrations": (dict(noll=8, coefficient=50e-9),)}, (True, False, False)),
        ({"main_lens__aberrations": (dict(noll=5, coefficient=50e-9),)}, (False, False, True)),
        (
            {
                "main_lens__aberrations": (
                    dict(noll=9, coefficient=50e-9),
                    dict(noll=4, coefficient=80e-9),
                )
            },
            (False, True, False),
        ),
    ],
    ids=str,
)
@pytest.mark.parametrize("tolerance", [1e-2, 1e-4, 1e-7])
def test_separable_terms_reach_the_tolerance(change, symmetry, tolerance):
    camera = small_camera(**change)
    view = geometry(camera, WAVELENGTH)
    half = 2 * view.D2
    field = separable_field(camera, view, half, tolerance)
    t, w = np.polynomial.legendre.leggauss(150)
    truth = sampled_field(camera, view, half * t, half * t)
    error = np.abs(field.evaluate(half * t, 0) @ field.evaluate(half * t, 1).T - truth) ** 2
    assert np.sqrt(np.sum(error * np.outer(w, w)) * half**2) == pytest.approx(
        field.tail, rel=1e-3, abs=1e-9
    )
    assert field.tail <= tolerance and field.symmetry == symmetry


def test_fully_blocked_light_is_zero_not_an_error():
    camera = camera_with_filters()
    dark = [
        f.model_dump() | {"peak": 1e-300, "blocking": 0.0, "center": 100e-6}
        for f in camera.filter_array.filters
    ]
    camera = small_camera(filter_array={"layout": (2, 2), "gap": 0.2e-3, "filters": dark})
    field = separable_field(camera, geometry(camera, WAVELENGTH), 1e-4, 1e-4)
    assert not field.evaluate(np.array([0.0, 1e-5]), 0).any()
