"""Singular values through pieces and symmetry, against LAPACK on the whole matrix."""

import numpy as np
import pytest

from plenocli.forward.accuracy.dial import system_matrix
from plenocli.forward.propagation import diagnosis as diagnose
from plenocli.forward.propagation.diagnosis import PiecewiseDiagnosis, Spectrum, describe
from plenocli.forward.propagation.symmetry import superpixel_orbits
from tests.forward.propagation.cameras import small_camera


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"object__samples_per_lenslet": (7, 6)},
        {"main_lens__aberrations": (dict(noll=7, coefficient=50e-9),)},
        {"main_lens__aberrations": (dict(noll=5, coefficient=50e-9),)},
        {"object__samples_per_lenslet": (7, 7)},
    ],
    ids=str,
)
def test_orbits_and_parities_give_the_values_of_the_whole(change, monkeypatch):
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
    assert (
        np.abs(values - exact).max() < 1e-7 * exact[0]
        and np.abs(values / exact - 1)[exact > 1e-3 * exact[0]].max() < 1e-9
    )
    monkeypatch.setattr(diagnose, "_DIRECT", 3)
    assert np.abs(describe(pif).singular_values[0] - exact).max() < 1e-7 * exact[0]


def test_without_symmetry_the_gram_matrix_is_whole():
    rng = np.random.default_rng(2)
    matrix = rng.normal(size=(3000, 30))
    spectrum = Spectrum((5, 6))
    spectrum.add(matrix[:1000])
    spectrum.add(matrix[1000:])
    assert spectrum.values() == pytest.approx(np.linalg.svd(matrix, compute_uv=False), rel=1e-10)


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
