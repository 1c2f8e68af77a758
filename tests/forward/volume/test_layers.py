"""Opaque layers against closed forms, rays without layers, and layers that hide nothing or all."""

import math

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.forward.volume.layers import RAYS, Layer, record_layers
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.plan import VolumePlan
from plenocli.forward.volume.recording import places_along, plane_light

DEPTHS = (-1.5e-3, 2e-3)
OPTICS = VolumeOptics(
    wavelength=550e-9,
    aperture=3.1e-3 / 55e-3,
    index=math.inf,
    magnification=1.0,
    pitch=100e-6,
    open_width=100e-6,
    focal_length=0.8e-3,
    sensor_distance=0.8e-3,
    pupil_distance=55e-3,
    pixels=(14, 14),
    pixel_width=1.0,
    depths=DEPTHS,
    places=(0.48, 0.64),
    scales=(0.48 / 0.055, 0.64 / 0.055),
    apodised=False,
)
COUNT, POINTS = (10, 9), (4, 4)
SHAPE = 40, 36


PLAN = VolumePlan(
    model="ray",
    neighbours=0,
    pixel_nodes=RAYS,
    terms=0,
    reach=(2, 2),
    lost=(0.0, 0.0),
    error=0.0,
    asked=1.0,
    samples=POINTS,
    box=1,
    seconds=0.0,
    nominal_seconds=0.0,
    bytes=0,
    considered=(),
)


def layers(opacity):
    """A near layer of some opacity before a far one, both textured."""
    rng = np.random.default_rng(3)
    near, far = rng.random((2, *SHAPE))
    return [Layer(near, np.broadcast_to(opacity, SHAPE).astype(float)), Layer(far, np.ones(SHAPE))]


def recorded(both):
    return record_layers(OPTICS, PLAN, COUNT, both, 1)


def test_what_is_wholly_hidden_sends_no_light_and_what_is_clear_all_of_it():
    near, far = layers(1.0)
    hidden = recorded([near, far])
    alone = plane_light(OPTICS, PLAN, 0, COUNT, near.light)
    assert np.allclose(hidden.light, alone, atol=1e-6 * alone.max())
    assert not hidden.volume[1].any() and np.array_equal(hidden.volume[0], near.light)
    clear = recorded(layers(0.0))
    behind = plane_light(OPTICS, PLAN, 1, COUNT, far.light)
    assert np.allclose(clear.light, behind, atol=1e-6 * behind.max())
    assert not clear.volume[0].any() and np.array_equal(clear.volume[1], far.light)


def test_behind_a_straight_edge_one_sees_a_segment_of_the_pupil():
    """Share of a disc on one side of a chord, (arccos h - h sqrt(1 - h^2)) / pi."""
    x = places_along(COUNT[1], POINTS[1], OPTICS.object_pitch)
    edge = x[17] + OPTICS.object_pitch / 8
    found = recorded(layers((x < edge)[None, :])).volume[1] / layers(0.0)[1].light
    apart = OPTICS.aperture * (DEPTHS[1] - DEPTHS[0])
    h = np.clip((edge - x) / apart, -1, 1)
    expected = (np.arccos(h) - h * np.sqrt(1 - h**2)) / np.pi
    # opacity falls over a voxel, which is a fifth of the blur
    assert np.abs(found - expected).max() < 0.03
    assert np.ptp(found, axis=0).max() < 1e-9


def test_the_side_of_the_pupil_that_is_hidden_is_the_one_that_rays_say():
    """A point half hidden lights one half of what it lights whole: that of the rays which cross
    the near layer where it is clear, by their directions alone.
    """
    x = places_along(COUNT[1], POINTS[1], OPTICS.object_pitch)
    point = np.zeros(SHAPE)
    point[20, 18] = 1.0
    opacity = np.broadcast_to((x <= x[18] + 1e-9)[None, :], SHAPE).astype(float)
    both = [Layer(np.zeros(SHAPE), opacity), Layer(point, np.ones(SHAPE))]
    found = recorded(both).light.sum((0, 2))
    whole = plane_light(OPTICS, PLAN, 1, COUNT, point).sum((0, 2))
    # rays to the right, s > 0, cross the near layer and the lenslets on the right; the point is
    # before the right half of lenslet 4
    assert found[:4].sum() < 0.01 * whole[:4].sum()
    assert found[5:].sum() == pytest.approx(whole[5:].sum(), rel=0.1)
    assert found.sum() == pytest.approx(0.5 * whole.sum(), abs=0.06)


def test_points_followed_by_rays_put_light_where_kernels_of_rays_do():
    """A layer that hides next to nothing makes every point one that is followed."""
    near, far = layers(1e-9)
    found = recorded([near, far])
    expected = plane_light(OPTICS, PLAN, 1, COUNT, far.light)
    assert 0.5 * np.abs(found.light - expected).sum() < 1e-4 * expected.sum()


def test_layers_need_a_plane_each():
    with pytest.raises(NumericsError, match="planes"):
        recorded(layers(1.0)[:1])
