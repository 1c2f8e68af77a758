"""Singular values through pieces and symmetry, against LAPACK on the whole matrix."""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.forward.accuracy.dial import plan_pif, system_matrix
from plenocli.forward.propagation import diagnosis as diagnose
from plenocli.forward.propagation.diagnosis import PiecewiseDiagnosis, Spectrum, describe
from plenocli.forward.propagation.symmetry import superpixel_orbits
from plenocli.forward.propagation.system_matrix import build_pif
from tests.forward.propagation.cameras import small_camera

ISOLATED = dict(superpixels=(1, 1), coherent_ring=0)


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"object__samples_per_lenslet": (7, 6)},
        {"main_lens__aberrations": (dict(noll=7, coefficient=50e-9),)},
        {"main_lens__aberrations": (dict(noll=5, coefficient=50e-9),)},
        {"object__samples_per_lenslet": (7, 7)},
        {"sensor__pixels_per_lenslet": (12, 12)},
    ],
    ids=str,
)
def test_orbits_and_parities_give_the_values_of_the_whole(change):
    pif = system_matrix(
        small_camera(**change),
        superpixels=(3, 3),
        coherent_ring=0,
        model="fresnel",
        accuracy=1e-4,
        dtype=np.float64,
    )
    exact = np.linalg.svd(pif.A[0].reshape(-1, pif.A.shape[3]), compute_uv=False)
    found = PiecewiseDiagnosis(
        1, pif.lenslet_offset, pif.pixel_shape, pif.object_shape, pif.notes.symmetry
    )
    for superpixel, slab in enumerate(pif.A[0]):
        found.add(0, superpixel, slab)
    values = found.result(pif.column_energy).singular_values[0]
    assert np.abs(values - exact).max() < 1e-14 * exact[0]
    assert np.abs(values / exact - 1)[exact > 1e-12 * exact[0]].max() < 1e-3


@pytest.mark.parametrize("shape", [(4, 4), (5, 5), (5, 4)])
@pytest.mark.parametrize("offset", [(0, 0), (0, 1), (1, 1)])
def test_pixels_that_tell_all_of_a_superpixel(shape, offset):
    """Sums over them, times how many each stands for, are sums over all of an even picture."""
    turns = shape[0] == shape[1]
    picture = np.random.default_rng(4).normal(size=shape)
    for axis in (0, 1):
        if offset[axis] == 0:
            picture = picture + np.flip(picture, axis)
    if turns and offset[0] == offset[1]:
        picture = picture + picture.T
    own = diagnose._own_pixels(np.array(offset), (True, True, turns), shape)
    assert picture.ravel()[own.pixels] @ own.times == pytest.approx(picture.sum())
    assert len(own.pixels) == len(np.unique(picture.round(9)))
    if turns and offset[0] == offset[1]:
        assert (picture.ravel()[own.pixels] == picture.T.ravel()[own.pixels]).all()
        assert (own.exchanged == np.arange(picture.size).reshape(shape).T.ravel()[own.pixels]).all()


def test_pieces_without_symmetry_give_the_values_of_the_whole():
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(3000, 30))
    spectrum = Spectrum((5, 6))
    spectrum.add(matrix[:1000])
    spectrum.add(matrix[1000:])
    assert spectrum.values() == pytest.approx(np.linalg.svd(matrix, compute_uv=False), rel=1e-12)


def test_values_are_resolved_to_double_precision():
    """Thirteen decades, of which A^T A would keep seven and a half."""
    rng = np.random.default_rng(1)
    told = np.logspace(0, -13, 60)
    matrix = np.linalg.qr(rng.normal(size=(300, 60)))[0] * told
    matrix = matrix @ np.linalg.qr(rng.normal(size=(60, 60)))[0]
    spectrum = Spectrum((1, 60))
    spectrum.add(matrix)
    assert spectrum.values() == pytest.approx(told, rel=5e-2)
    assert spectrum.values()[:40] == pytest.approx(told[:40], rel=1e-5)


def test_fewer_pixels_than_points_have_as_many_values_as_pixels():
    matrix = np.random.default_rng(3).random((20, 30))
    spectrum = Spectrum((5, 6))
    spectrum.add(matrix)
    exact = np.linalg.svd(matrix, compute_uv=False)
    assert spectrum.values() == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_rank_and_condition_are_those_of_the_file(dtype):
    """Against numpy on the stored numbers, and single precision against the same matrix in double:
    no singular value changes by more than the resolution, and the resolution is not ten times what
    some do.
    """
    camera = small_camera(object__samples_per_lenslet=(16, 16))
    fine = system_matrix(camera, dtype=np.float64, accuracy=1e-8, **ISOLATED)
    matrix = replace(fine, A=fine.A.astype(dtype))
    found = describe(matrix)
    values = np.linalg.svd(matrix.A[0, 0].astype(float), compute_uv=False)
    floor = found.resolution[0] * values[0]
    assert np.abs(found.singular_values[0] - values).max() < 1e-14 * values[0]
    assert found.rank == [int((values > floor).sum())]
    if dtype == "float64":
        assert found.rank == [np.linalg.matrix_rank(fine.A[0, 0])]
    else:
        changed = np.abs(values - np.linalg.svd(fine.A[0, 0], compute_uv=False)).max()
        assert floor / 10 < changed < floor
    assert found.condition_is_bound == [bool(values[-1] <= floor)]
    assert found.condition[0] == pytest.approx(values[0] / max(values[-1], floor), rel=1e-6)


def test_orbits_of_superpixels():
    offsets = np.array([(r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)])
    assert [len(members) for _, members in superpixel_orbits(offsets, (True, True, True))] == [
        4,
        4,
        1,
    ]
    assert (
        len(superpixel_orbits(offsets, (True, True, False))) == 4
        and len(superpixel_orbits(offsets, (False, False, False))) == 9
    )
    assert len(superpixel_orbits(offsets, (False, False, True))) == 6
    assert len(superpixel_orbits(offsets, (True, False, True))) == 6


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"object__samples_per_lenslet": (8, 6)},
        {
            "main_lens__aberrations": (
                dict(noll=8, coefficient=50e-9),
                dict(noll=7, coefficient=3e-8),
            )
        },
        {"sensor__pixels_per_lenslet": (12, 12)},
    ],
    ids=str,
)
def test_what_the_diagnosis_costs_is_counted_as_it_is_done(change, monkeypatch):
    camera = small_camera(**change)
    plan = plan_pif(camera, superpixels=(3, 3), model="fresnel", accuracy=1e-2, coherent_ring=1)
    operations = []

    def counting(reduced):
        def counted(*blocks):
            rows = blocks[-1]
            operations.append(2 * rows.shape[0] * rows.shape[1] ** 2)
            return reduced(*blocks)

        return counted

    for name in ("_triangle", "_reduced"):
        monkeypatch.setattr(diagnose, name, counting(vars(diagnose)[name]))
    found = describe(build_pif(camera, plan))
    assert sum(operations) == pytest.approx(diagnose.features(camera, plan)["reduced"], rel=0.05)
    assert found.rank is not None and diagnose.seconds(camera, plan) > 0
