"""The system matrix in its limits: lenslet as a camera, pupil image, symmetry,
energy, shifts, rays.
"""

import numpy as np
import pytest
from scipy.special import j0, j1, roots_legendre, sici

from plenocli.base.errors import NumericsError, UsageError
from plenocli.forward.accuracy.explain import explain
from plenocli.forward.propagation import system_matrix as pif_module
from plenocli.forward.propagation.diagnosis import describe
from plenocli.forward.propagation.system_matrix import PifBuilder
from tests.forward.propagation.cameras import (
    WAVELENGTH,
    pif_builder,
    plan_pif,
    pupil_conjugate,
    small_camera,
    system_matrix,
)
from tests.reference.window import column_energies

ISOLATED = dict(superpixels=(1, 1), coherent_ring=0)


def seed_camera(**changes):
    """The published sizes: 40x40 points, 52x52 pixels of 2 um, f/8, 550 nm."""
    sizes = dict(
        lenslet_array__pitch=104e-6 / (1 + 832e-6 / 55e-3),
        lenslet_array__focal_length=832e-6,
        sensor__distance=832e-6,
        sensor__pixels_per_lenslet=(52, 52),
        object__samples_per_lenslet=(40, 40),
    )
    return small_camera(**sizes | changes)


def pixel_mean(function, camera, count=12):
    """Integrals of function(t) over the pixels of one axis."""
    n, pitch = camera.sensor.pixels_per_lenslet[0], camera.sensor.pixel_pitch
    t, w = roots_legendre(count)
    positions = ((np.arange(n) - (n - 1) / 2) * pitch)[:, None] + pitch / 2 * t
    return function(positions) @ w * pitch / 2


@pytest.mark.parametrize("shape", ["square", "circle"])
def test_lenslet_as_a_camera(shape, monkeypatch):
    """A pinhole pupil far away lights the lenslet evenly: sinc^2 or the Airy pattern of the
    lenslet at its focus.
    """
    monkeypatch.setattr(
        "plenocli.forward.camera.model.implausible", lambda _: None
    )  # no lens is so
    camera = small_camera(
        lenslet_array__aperture_shape=shape,
        main_lens__aperture_diameter=1e-4,
        lenslet_array__distance=5.0,
        object__distance=5.0,
        main_lens__focal_length=2.5,
        object__samples_per_lenslet=(1, 1),
    )
    matrix = (
        system_matrix(camera, accuracy=1e-7, dtype=np.float64, **ISOLATED)
        .A[0, 0, :, 0]
        .reshape(13, 13)
    )
    width, z3 = camera.lenslet_array.pitch, camera.sensor.distance
    # kappa = 1/z2 is a trace of curvature, 1e-4 rad across the lenslet
    if shape == "square":
        line = pixel_mean(lambda t: np.sinc(width * t / (WAVELENGTH * z3)) ** 2, camera)
        expected = np.outer(line, line)
    else:
        t, w = roots_legendre(12)
        x = ((np.arange(13) - 6) * 2e-6)[:, None] + 1e-6 * t
        r = np.pi * width * np.hypot(x.ravel()[:, None], x.ravel()) / (WAVELENGTH * z3)
        airy = (2 * j1(r) / r) ** 2 * np.outer(np.tile(w, 13), np.tile(w, 13))
        expected = airy.reshape(13, 12, 13, 12).sum((1, 3))
    assert (
        np.abs(matrix / matrix.sum() - expected / expected.sum()).max()
        < 1e-5 * (expected / expected.sum()).max()
    )


def test_square_pupil_image_in_closed_form():
    """kappa = 0, on axis: U(t) = [Si(b(t + tp)) - Si(b(t - tp))]/pi per axis, b = pi D2/(lambda
    z3), tp = D1 z3/(2 z2).
    """
    plain = small_camera(main_lens__aperture_shape="square", object__samples_per_lenslet=(1, 1))
    camera = small_camera(
        main_lens__aperture_shape="square",
        object__samples_per_lenslet=(1, 1),
        sensor__distance=pupil_conjugate(plain),
    )
    matrix = (
        system_matrix(camera, accuracy=1e-8, dtype=np.float64, **ISOLATED)
        .A[0, 0, :, 0]
        .reshape(13, 13)
    )
    z2, z3, D1 = (
        camera.lenslet_array.distance,
        camera.sensor.distance,
        camera.main_lens.aperture_diameter,
    )
    b, tp = np.pi * camera.lenslet_array.pitch / (WAVELENGTH * z3), D1 * z3 / (2 * z2)
    line = (
        pixel_mean(lambda t: ((sici(b * (t + tp))[0] - sici(b * (t - tp))[0]) / np.pi) ** 2, camera)
        * z2
        / (z3 * D1)
    )
    assert np.abs(matrix - np.outer(line, line)).max() < 1e-8 * matrix.max()


def test_pupil_image_is_inverted():
    """Light through the lower right filter lands in the upper left of the superpixel."""
    cells = [
        dict(center=c, fwhm=10e-9, peak=1.0, blocking=0.0) for c in (450e-9, 480e-9, 510e-9, 550e-9)
    ]
    camera = small_camera(
        filter_array={"layout": (2, 2), "gap": 0.0, "filters": cells},
        object__samples_per_lenslet=(1, 1),
    )
    image = system_matrix(camera, wavelengths=(550e-9,), **ISOLATED).A[0, 0, :, 0].reshape(13, 13)
    assert image[:6, :6].sum() > 0.8 * image.sum()
    upper_right = (
        system_matrix(camera, wavelengths=(480e-9,), **ISOLATED).A[0, 0, :, 0].reshape(13, 13)
    )
    assert upper_right[7:, :6].sum() > 0.8 * upper_right.sum()


def test_geometric_pupil_image_as_the_wavelength_shrinks():
    """kappa = 0: the irradiance tends to a uniform disc of diameter D1 z3/z2, in L1 and about as
    fast as the wavelength.
    """
    plain = small_camera()
    z3 = pupil_conjugate(plain)
    radius = plain.main_lens.aperture_diameter * z3 / (2 * 55e-3)
    fine = (np.arange(13 * 64) - (13 * 64 - 1) / 2) * 2e-6 / 64
    disc = (np.hypot(fine[:, None], fine) < radius).reshape(13, 64, 13, 64).mean((1, 3))
    errors = []
    for wavelength in (550e-9, 275e-9, 137.5e-9):
        camera = small_camera(
            sensor__distance=z3,
            object__samples_per_lenslet=(1, 1),
            light__wavelengths=(wavelength,),
        )
        image = system_matrix(camera, accuracy=1e-4, **ISOLATED).A[0, 0, :, 0].reshape(13, 13)
        errors.append(np.abs(image - disc / disc.sum()).sum())
    assert errors[2] < 0.45 * errors[0] and errors[1] < 0.75 * errors[0] and errors[2] < 0.1


def test_half_of_the_object_is_invisible_at_the_pupil_conjugate():
    """eps = kappa = W = 0 and a symmetric pupil: +x and -x give the same superpixel; rank at
    most half, a quarter for squares.
    """
    z3 = pupil_conjugate(small_camera())
    for shape, share in (("circle", 2), ("square", 4)):
        camera = small_camera(sensor__distance=z3, main_lens__aperture_shape=shape)
        found = describe(system_matrix(camera, dtype=np.float64, accuracy=1e-6, **ISOLATED))
        assert found.symmetry_defect[0] < 1e-12 and found.rank[0] <= 64 // share
        assert "half of the object is invisible" in found.warnings[0]
    broken = describe(system_matrix(small_camera(), dtype=np.float64, accuracy=1e-6, **ISOLATED))
    assert broken.symmetry_defect[0] > 0.01 and broken.rank[0] > 48 and not broken.warnings


@pytest.mark.parametrize(
    "change",
    [{"object__distance": 0.545}, {"main_lens__aberrations": (dict(noll=8, coefficient=30e-9),)}],
    ids=str,
)
def test_a_little_defocus_or_coma_makes_it_visible(change):
    camera = small_camera(sensor__distance=pupil_conjugate(small_camera()), **change)
    found = describe(system_matrix(camera, dtype=np.float64, accuracy=1e-6, **ISOLATED))
    assert found.symmetry_defect[0] > 0.01


def test_published_configuration():
    """Columns hold 0.98 of the light at the centre and 0.40 at the corner of the lenslet's
    field; the neighbours get the rest.
    """
    camera = seed_camera()
    pif = system_matrix(camera, dtype=np.float64, **ISOLATED)
    assert pif.A.shape == (1, 1, 2704, 1600) and pif.A.min() >= 0
    energy = pif.column_energy[0].reshape(40, 40)
    assert energy[20, 20] == pytest.approx(0.982, abs=1e-3) and energy[0, 0] == pytest.approx(
        0.402, abs=5e-3
    )
    assert energy.min() == pytest.approx(energy[0, 0], rel=1e-9)
    found = describe(pif)
    # 106 above 60 dB and 1495 above 120 dB at a pupil distance of 52 mm, where one lenslet holds
    # slightly more cells
    values = found.singular_values[0]
    assert found.rank_60db[0] == pytest.approx(105, abs=8)
    assert (values > 1e-6 * values[0]).sum() == pytest.approx(1490, abs=40)
    # double precision resolves the others too
    assert found.rank == [1600] and 1e10 < found.condition[0] < 1e12
    assert found.symmetry_defect[0] == pytest.approx(0.24, abs=0.05)
    builder = pif_builder(camera, WAVELENGTH, superpixels=(3, 3), coherent_ring=1, accuracy=1e-4)
    corner, middle = builder.columns([0, 820]).sum(axis=(0, 1))
    assert 0.95 < corner < 1 and 0.99 < middle < 1


def test_energy_is_bounded_by_what_enters():
    camera = small_camera(object__distance=0.53)
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(5, 5), coherent_ring=1, accuracy=1e-6, dtype=np.float64
    )
    points = np.arange(0, 64, 9)
    sensor, entered = (
        builder.columns(points).sum(axis=(0, 1)),
        builder.lenslets.incident(points // 8, points % 8),
    )
    assert (
        np.all(sensor <= entered * (1 + 1e-9))
        and np.all(sensor > 0.97 * entered)
        and np.all(entered < 1)
    )


def test_too_few_nodes_are_caught(monkeypatch):
    camera = small_camera()
    plan = plan_pif(camera, superpixels=(3, 3), coherent_ring=1)
    bad = plan.bands[0].__class__(**vars(plan.bands[0]) | {"lenslet_nodes": 12})
    broken = plan.__class__(**vars(plan) | {"bands": (bad,)})
    with pytest.raises(NumericsError, match="sampled too coarsely"):
        PifBuilder(camera, WAVELENGTH, broken).columns(slice(None))


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"main_lens__aberrations": (dict(noll=7, coefficient=50e-9),)},
        {"main_lens__aberrations": (dict(noll=5, coefficient=50e-9),)},
        {
            "main_lens__aberrations": (
                dict(noll=7, coefficient=50e-9),
                dict(noll=6, coefficient=50e-9),
                dict(noll=8, coefficient=20e-9),
            )
        },
        {"object__samples_per_lenslet": (5, 8)},
        {"object__samples_per_lenslet": (7, 7), "lenslet_array__aperture_shape": "circle"},
    ],
    ids=str,
)
def test_blocks_by_symmetry_are_the_columns(change):
    camera = small_camera(**change)
    builder = pif_builder(
        camera, WAVELENGTH, superpixels=(3, 3), coherent_ring=0, accuracy=1e-5, dtype=np.float64
    )
    whole, seen = builder.columns(slice(None)), []
    for points, block in builder.blocks(13):
        assert np.abs(block - whole[:, :, points]).max() < 2e-5 * whole.max()
        seen += points.tolist()
    assert sorted(seen) == list(range(builder.points))


def test_object_points_are_numbered_in_image_orientation():
    """Points further down and right send more light to the lenslet below and to the right."""
    pif = system_matrix(small_camera(), superpixels=(3, 3), coherent_ring=1)
    energy = pif.A[0].sum(axis=1).reshape(3, 3, 8, 8)
    assert (
        energy[1, 2, 3, 7] > 5 * energy[1, 2, 3, 0] and energy[2, 1, 7, 3] > 5 * energy[2, 1, 0, 3]
    )


def ray_histogram(view, shape, count=1500):
    """Rays from the on-axis point: share per superpixel (3x3) and pixel.

    Through pupil position a a ray meets the array at u = a z2 eps in lenslet m = round(u/D2), which
    bends it by -(u - m D2)/f2.
    """
    side = (np.arange(count) - (count - 1) / 2) / count * view.D1
    pupil = [
        a[np.hypot(side[:, None], side) < view.D1 / 2]
        for a in np.broadcast_arrays(side[:, None], side[None, :])
    ]
    lenslet, pixel = [], []
    for a in pupil:
        u = a * view.z2 * view.eps
        m = np.round(u / view.D2)
        t = u + view.z3 * ((u - a) / view.z2 - (u - m * view.D2) / view.f2)
        assert np.allclose(
            t, -view.z3 / view.z2 * a + view.z3 * view.kappa * u + m * view.D2 * view.z3 / view.f2
        )
        lenslet.append(m + 1)
        pixel.append(np.floor((t - m * view.superpixel_pitch) / view.pixel_pitch + shape / 2))
    inside = np.all([(p >= 0) & (p < shape) for p in pixel], axis=0)
    rays = np.zeros((3, 3, shape, shape))
    np.add.at(rays, tuple(a[inside].astype(int) for a in (*lenslet, *pixel)), 1 / len(pupil[0]))
    return rays


def test_defocus_disc_against_rays():
    """A pupil image cut into lenslets: total variation between waves and rays falls as
    the wavelength does.
    """
    differences, shares = [], []
    for wavelength in (800e-9, 400e-9, 200e-9):
        camera = seed_camera(
            object__distance=0.46,
            object__samples_per_lenslet=(1, 1),
            light__wavelengths=(wavelength,),
            sensor__pixel_pitch=8e-6,
            sensor__pixels_per_lenslet=(13, 13),
        )
        builder = pif_builder(
            camera, wavelength, superpixels=(3, 3), coherent_ring=1, accuracy=1e-3
        )
        waves = builder.columns([0])[..., 0].reshape(3, 3, 13, 13)
        rays = ray_histogram(builder.geometry, 13)
        differences.append(0.5 * np.abs(waves - rays).sum())
        shares.append(np.abs(waves.sum((2, 3)) - rays.sum((2, 3))).max())
    assert (
        differences[2] < 0.75 * differences[1] < 0.6 * differences[0]
        and differences[2] < 0.1
        and shares[2] < 0.03
    )


def test_each_wavelength_stands_alone():
    camera = small_camera(light__wavelengths=(500e-9, 600e-9), main_lens__glass="N-BK7")
    both = system_matrix(camera, superpixels=(1, 1), coherent_ring=1)
    one = system_matrix(camera, wavelengths=(600e-9,), superpixels=(1, 1), coherent_ring=1)
    assert np.array_equal(both.A[1:], one.A) and both.wavelengths.tolist() == [500e-9, 600e-9]
    assert np.abs(both.A[0] - both.A[1]).max() > 0.05 * both.A.max()


def test_the_matrix_varies_smoothly_with_wavelength():
    """Halving a spectral step changes the band average little: midpoint against the two quarter
    points of a 4 nm band.
    """
    camera = small_camera()
    middle, low, high = (
        system_matrix(camera, wavelengths=(w,), **ISOLATED).A for w in (550e-9, 549e-9, 551e-9)
    )
    assert np.linalg.norm((low + high) / 2 - middle) < 1e-3 * np.linalg.norm(middle)


def test_single_precision_and_slices():
    camera = small_camera()
    double = system_matrix(camera, dtype=np.float64, accuracy=1e-6, **ISOLATED)
    single = system_matrix(
        camera, dtype=np.float32, accuracy=1e-4, points=slice(10, 30), **ISOLATED
    )
    assert single.A.dtype == np.float32 and single.A.shape == (1, 1, 169, 20)
    assert np.linalg.norm(single.A - double.A[..., 10:30]) < 1e-4 * np.linalg.norm(
        double.A[..., 10:30]
    )


def test_plan_says_why_and_refuses_what_cannot_be():
    camera = small_camera()
    text = explain(plan_pif(camera))
    assert "3x3" in text and "nodes across a lenslet" in text
    assert plan_pif(camera, accuracy=0.1).superpixels == (1, 1)
    assert plan_pif(small_camera(object__distance=0.45)).superpixels >= (5, 5)
    with pytest.raises(NumericsError, match="1e-08"):
        plan_pif(camera, accuracy=1e-12)
    with pytest.raises(UsageError, match="odd"):
        plan_pif(camera, superpixels=(2, 3))
    with pytest.raises(UsageError):
        plan_pif(camera, coherent_ring=21)
    fast = plan_pif(
        seed_camera(
            main_lens__aperture_diameter=12.5e-3,
            lenslet_array__focal_length=457e-6,
            sensor__distance=457e-6,
        )
    )
    assert any("fresnel model" in warning for warning in fast.warnings)
    drifting = plan_pif(small_camera(lenslet_array__pitch=26e-6))
    assert any("apart" in warning for warning in drifting.warnings)


def test_progress_counts_every_column():
    calls = []
    system_matrix(
        small_camera(), progress=lambda done, total: calls.append((done, total)), **ISOLATED
    )
    assert calls[-1] == (64, 64)
    assert pif_module.BLOCK_BYTES > 0


def test_superpixels_with_factors_of_their_own_rank():
    """Fewer terms on each superpixel: columns hold against brute force, and weak
    superpixels have their light.
    """
    camera, place = (
        seed_camera(object__samples_per_lenslet=(4, 5)),
        [(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)],
    )
    builder = pif_builder(camera, WAVELENGTH, superpixels=(3, 3), coherent_ring=1)
    lenslets, pitch = builder.lenslets, camera.lenslet_array.pitch
    least = lenslets._least_term(lenslets._cut)
    terms = [lenslets._narrowed(s, 1, least).high.shape[3] for s in range(3)]
    assert max(terms) < 0.9 * lenslets.factors.high.shape[3]
    for i, j in ((0, 0), (1, 3)):
        truth = column_energies(
            camera,
            WAVELENGTH,
            ((i - 1.5) * pitch / 4, (j - 2) * pitch / 5),
            2,
            place,
            pixel_nodes=9,
        )
        truth = np.array([truth[s].ravel() for s in place])
        error = builder.columns([5 * i + j])[:, :, 0] - truth
        assert np.linalg.norm(error) < 1e-4 * np.linalg.norm(truth)
        assert (np.linalg.norm(error, axis=1) < 1e-2 * np.linalg.norm(truth, axis=1)).all()


@pytest.mark.parametrize("edge", [0.5, 30.0, 600.0])
def test_a_hankel_series_is_the_sum_of_bessel_functions(edge):
    from plenocli.forward.propagation.fresnel.radial import hankel_series

    rng = np.random.default_rng(5)
    rates = np.sort(rng.uniform(0, edge, 150))
    weight = rng.normal(size=150) + 1j * rng.normal(size=150)
    t = np.linspace(0, 1, 301)
    found = np.polynomial.chebyshev.chebval(2 * t * t - 1, hankel_series(rates, weight, edge))
    error = np.abs(found - j0(np.outer(t, rates)) @ weight).max()
    assert error < 2e-13 * np.abs(weight).sum()
    assert not np.iscomplexobj(hankel_series(rates, weight.real, edge))
