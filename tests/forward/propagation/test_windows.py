"""Windows larger than the superpixels' spacing: light counts once, by every model."""

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.forward.accuracy.dial import pif_builder
from plenocli.forward.camera.geometry import Geometry, geometry
from tests.forward.propagation.cameras import WAVELENGTH, plan_pif, small_camera, system_matrix

WIDE = small_camera(sensor__pixels_per_lenslet=(15, 15))
"""Superpixels are 13 pixels apart."""


@pytest.mark.parametrize("model", ["ray", "fresnel", "exact"])
def test_light_of_overlapping_windows_counts_once(model):
    request = dict(superpixels=(3, 3), coherent_ring=1, model=model, accuracy=1e-3)
    wide, fitting = (system_matrix(c, **request).A[0] for c in (WIDE, small_camera()))
    wide = wide.reshape(9, 15, 15, -1)
    assert wide.sum(axis=(0, 1, 2)).max() <= 1.0001
    assert np.abs(wide[:, 1:-1, 1:-1].reshape(fitting.shape) - fitting).max() < 1e-3 * fitting.max()
    beyond = np.concatenate([wide[:, [0, -1]].ravel(), wide[:, :, [0, -1]].ravel()])
    assert beyond.max() < 1e-9 * wide.max()


def test_a_pixel_across_the_border_counts_to_it():
    """Rows of a hexagonal lattice are 11.26 pixels apart: 12 hold them, in three windows that
    together are one without gaps.
    """
    camera = small_camera(
        lenslet_array__lattice="hexagonal",
        lenslet_array__aperture_shape="hexagon",
        sensor__pixels_per_lenslet=(12, 13),
        main_lens__aperture_diameter=3e-3,
        object__samples_per_lenslet=(4, 4),
    )
    view = geometry(camera, WAVELENGTH).parted((3, 1))
    low, high = view.pixel_spans(0)
    spacing = view.superpixel_pitch * view.row_spacing
    assert high[-1] == -low[0] == pytest.approx(spacing / 2)
    assert view.parted((1, 3)) is view and np.all(high - low > 0)
    request = dict(superpixels=(3, 1), coherent_ring=1, accuracy=1e-4)
    cut = system_matrix(camera, **request).A[0]
    whole = system_matrix(camera, superpixels=(1, 1), coherent_ring=2, accuracy=1e-4).A[0]
    inner = cut.reshape(3, 12, 13, -1)[1, 1:-1]
    same = whole.reshape(12, 13, -1)[1:-1]
    assert np.linalg.norm(inner - same) < 0.02 * np.linalg.norm(same)
    assert (cut.sum(axis=(0, 1)) <= 1.001).all()


def test_one_superpixel_keeps_its_whole_window():
    found = system_matrix(WIDE, superpixels=(1, 1), coherent_ring=0).A[0].reshape(15, 15, -1)
    assert found[0].max() > 0 and found[:, -1].max() > 0


def test_it_is_said():
    said = plan_pif(WIDE, superpixels=(3, 1)).warnings
    assert any("windows of 15 pixels overlap" in line and "13.000" in line for line in said)
    assert not any("overlap" in line for line in plan_pif(WIDE, superpixels=(1, 1)).warnings)


@pytest.mark.parametrize("model", ["fresnel", "exact"])
def test_superpixels_together_hold_no_more_light_than_enters(model, monkeypatch):
    """The guard of all models, where light counts twice."""
    monkeypatch.setattr(Geometry, "parted", lambda self, grid: self)
    with pytest.raises(NumericsError, match="of its light on the sensor, but only"):
        system_matrix(WIDE, superpixels=(3, 3), coherent_ring=1, model=model, accuracy=1e-3)


@pytest.mark.parametrize("shift", [(0.5, 0.3), (-0.5, 0.5), (0.5, -0.5)])
@pytest.mark.parametrize("stretch", [1, 1.00005])
def test_windows_that_lie_half_a_pixel_aside_still_tile(shift, stretch):
    """Superpixels of whole pixels are a window apart, whichever way halves are rounded: the matrix
    is continuous there, and no light counts twice.
    """
    camera = small_camera(sensor__pixel_pitch=2e-6 / stretch)
    near = tuple(0.999 * s for s in shift)
    at, beside = (
        pif_builder(
            camera.with_fit(s, 0.0), WAVELENGTH, superpixels=(3, 3), model="fresnel"
        ).whole()
        for s in (shift, near)
    )
    assert np.abs(at - beside).max() < 2e-3 * np.abs(at).max()
    assert at.sum(axis=(0, 1)).max() <= 1.001
