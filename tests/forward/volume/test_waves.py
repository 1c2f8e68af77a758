"""Kernels of volumes against brute force, symmetry and energy."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockToeplitz
from plenocli.forward.volume.optics import Term, VolumeOptics
from plenocli.forward.volume.phantoms import PHANTOMS, Region, phantom
from plenocli.forward.volume.plan import between_planes, plan_volume
from plenocli.forward.volume.rays import RayPlane
from plenocli.forward.volume.recording import finer, record
from plenocli.forward.volume.stack import build_stack
from plenocli.forward.volume.waves import WavePlane, WaveSettings
from tests.reference.volume import column as brute

CAMERA = dict(
    wavelength=0.5e-6,
    aperture=0.5,
    index=1.33,
    magnification=20.0,
    pitch=30e-6,
    focal_length=500e-6,
    sensor_distance=500e-6,
)
DEPTHS = (-4e-6, 0.0, 3e-6)
OPTICS = VolumeOptics(
    **CAMERA,
    open_width=30e-6,
    pupil_distance=float("inf"),
    pixels=(7, 7),
    pixel_width=1.0,
    depths=DEPTHS,
    places=DEPTHS,
    scales=(1.0, 1.0, 1.0),
    apodised=True,
)
PLACE = (0.4e-6, -0.25e-6)


def elsewhere(found, truth):
    """Share of a column's light that is elsewhere."""
    return 0.5 * np.abs(found - truth).sum()


@cache
def brute_force(optics, depth, place, phase=None, nodes=72, lenslets=9):
    """The column by brute force over 4 lenslets on each side."""
    camera = CAMERA | {
        "index": optics.index,
        "pixels": optics.pixels[0],
        "sensor_distance": optics.sensor_distance,
        "focal_length": optics.focal_length,
    }
    return brute(
        place,
        depth,
        camera=camera,
        lenslets=lenslets,
        reach=4,
        lenslet_nodes=nodes,
        pixel_nodes=9,
        phase=phase,
        rows=110,
    )


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("accuracy", [3e-2, 1e-3])
def test_columns_are_those_of_brute_force_to_the_accuracy_asked_for(depth, accuracy):
    plan = plan_volume(OPTICS, (3, 3), accuracy=accuracy, model="fresnel")
    settings = replace(plan.settings(0), reach=4)
    found, entered = WavePlane(OPTICS, depth, settings).column(*PLACE)
    truth = brute_force(OPTICS, depth, PLACE)
    assert elsewhere(found, truth) < accuracy
    assert found.sum() == pytest.approx(truth.sum(), abs=2 * accuracy)
    assert 0.97 < entered <= 1.0


def test_the_cheaper_rung_is_no_better_than_it_says():
    """The bounds above would hold for a plan that always took the finest rung."""
    cheap, fine = (plan_volume(OPTICS, (3, 3), accuracy=a) for a in (3e-2, 1e-3))
    assert cheap.neighbours < fine.neighbours and cheap.seconds < fine.seconds
    settings = replace(cheap.settings(0), reach=4)
    found, _ = WavePlane(OPTICS, DEPTHS[0], settings).column(*PLACE)
    assert elsewhere(found, brute_force(OPTICS, DEPTHS[0], PLACE)) > 2e-3


def test_a_sensor_out_of_the_lenslets_focus_is_followed_too():
    optics = replace(OPTICS, sensor_distance=450e-6)
    settings = WaveSettings(neighbours=6, pixel_nodes=6, terms=26, reach=6)
    found, _ = WavePlane(optics, 3e-6, settings).column(*PLACE)
    truth = brute_force(optics, 3e-6, PLACE, nodes=110)
    assert elsewhere(found[2:-2, :, 2:-2], truth) < 3e-4


def test_coma_is_that_of_brute_force():
    """Noll 8, sqrt(8) (3 r^3 - 2 r) cos t, in directions over the aperture."""
    optics = replace(OPTICS, terms=(Term(noll=8, coefficient=60e-9),))

    def phase(sy, sx):
        y, x = sy / 0.5, sx / 0.5
        return 60e-9 * np.sqrt(8) * (3 * (x**2 + y**2) - 2) * x

    settings = WaveSettings(neighbours=6, pixel_nodes=6, terms=24, reach=4)
    found, _ = WavePlane(optics, 3e-6, settings).column(*PLACE)
    truth = brute_force(optics, 3e-6, PLACE, phase)
    assert elsewhere(found, truth) < 1e-3
    plain, _ = WavePlane(OPTICS, 3e-6, settings).column(*PLACE)
    assert elsewhere(plain, truth) > 0.1


def test_a_specimen_of_another_index_bends_light_by_the_difference_of_the_paths():
    """h (sqrt(n^2 - s^2) - n - sqrt(m^2 - s^2) + m), n of the specimen, m of the design."""
    specimen, design, below = 1.45, 1.33, 40e-6
    optics = replace(OPTICS, index=specimen, mismatch=(design, below))

    def phase(sy, sx):
        square = sy**2 + sx**2
        inside, outside = np.sqrt(specimen**2 - square), np.sqrt(design**2 - square)
        return below * (inside - specimen - outside + design)

    settings = WaveSettings(neighbours=6, pixel_nodes=6, terms=24, reach=4)
    found, _ = WavePlane(optics, 3e-6, settings).column(*PLACE)
    truth = brute_force(optics, 3e-6, PLACE, phase)
    # amplitudes are those of the design: 0.7 % of the pupil's edge
    assert elsewhere(found, truth) < 4e-3
    even, _ = WavePlane(replace(optics, mismatch=None), 3e-6, settings).column(*PLACE)
    assert elsewhere(even, truth) > 0.1


def test_a_tilted_pupil_moves_the_point():
    """Noll 2, 2 r cos t: the field of a point 2 c / NA aside."""
    optics = replace(OPTICS, terms=(Term(noll=2, coefficient=0.1e-6),))
    settings = WaveSettings(neighbours=4, pixel_nodes=4, terms=24, reach=4)
    tilted, _ = WavePlane(optics, 3e-6, settings).column(*PLACE)
    moved, _ = WavePlane(OPTICS, 3e-6, settings).column(PLACE[0], PLACE[1] - 0.4e-6)
    assert elsewhere(tilted, moved) < 1e-4


def test_a_point_one_lenslet_on_lights_the_same_pixels_one_superpixel_on():
    settings = WaveSettings(neighbours=3, pixel_nodes=4, terms=22, reach=5)
    plane = WavePlane(OPTICS, 3e-6, settings)
    here, _ = plane.column(*PLACE)
    there, _ = plane.column(PLACE[0] + 1.5e-6, PLACE[1])
    assert elsewhere(there[2:-1], here[1:-2]) < 1e-3


def test_voxels_by_symmetry_are_those_computed_one_by_one():
    optics = replace(OPTICS, depths=(3e-6,), places=(3e-6,), scales=(1.0,))
    # a path of 1e-17 m bends nothing, and takes all symmetry away
    bent = replace(optics, terms=(Term(noll=3, coefficient=1e-17),))
    stacks = []
    for each in (optics, bent):
        plan = plan_volume(each, (3, 2), accuracy=2e-2)
        stacks.append(build_stack(each, plan))
    assert np.abs(stacks[0].A - stacks[1].A).max() < 1e-6 * stacks[0].A.max()
    assert stacks[0].A.shape[2] == 6


def test_light_of_a_band_lands_where_its_lines_do():
    optics = replace(OPTICS, depths=(3e-6,), places=(3e-6,), scales=(1.0,))
    lines = [replace(optics, wavelength=w) for w in (0.45e-6, 0.55e-6)]
    band = replace(optics, band=(0.45e-6, 0.55e-6))
    plan = plan_volume(band, (2, 2), accuracy=5e-2)
    assert plan.terms >= plan_volume(optics, (2, 2), accuracy=5e-2).terms
    whole, *parts = (build_stack(each, plan).A for each in (band, *lines))
    assert np.allclose(whole, (parts[0] + parts[1]) / 2, atol=1e-6 * whole.max())
    assert np.abs(parts[0] - parts[1]).max() > 0.1 * whole.max()


def test_too_few_terms_are_refused_by_the_light_that_they_make_or_lose():
    plan = replace(plan_volume(OPTICS, (3, 3), accuracy=2e-2), terms=3)
    with pytest.raises(NumericsError, match="enters the lenslets"):
        build_stack(OPTICS, plan)


def test_all_light_is_on_the_superpixels_or_said_to_be_lost():
    plan = plan_volume(OPTICS, (2, 2), accuracy=5e-3)
    stack = build_stack(OPTICS, plan)
    for energy, lost in zip(stack.column_energy, plan.lost):
        assert energy.max() <= 1 + 1e-3
        assert 1 - energy.min() < 1.2 * lost + 5e-3


def test_what_is_halfway_between_planes_is_as_far_from_their_mean_as_brute_force_says():
    said = between_planes(OPTICS, plan_volume(OPTICS, (3, 3), accuracy=1e-3, model="fresnel"))
    place = 0.31 * OPTICS.object_pitch, 0.17 * OPTICS.object_pitch
    low, middle, high = (
        brute_force(OPTICS, depth, place, nodes=48, lenslets=5) for depth in (0.0, 1.5e-6, 3e-6)
    )
    assert said == pytest.approx(elsewhere(middle, (low + high) / 2), rel=0.03)
    assert said > 0.05
    one = replace(OPTICS, depths=(0.0,), places=(0.0,), scales=(1.0,))
    assert between_planes(one, plan_volume(one, (3, 3), accuracy=3e-2)) == 0


def test_a_point_on_the_diagonal_lights_what_one_beside_it_does():
    """Half of its light is computed, the rest is that transposed."""
    settings = WaveSettings(neighbours=3, pixel_nodes=4, terms=22, reach=5)
    plane = WavePlane(OPTICS, 3e-6, settings)
    on, _ = plane.column(0.4e-6, 0.4e-6)
    beside, _ = plane.column(0.4e-6, 0.4e-6 + 1e-16)
    assert np.abs(on - beside).max() < 1e-5 * on.max()


def test_rays_put_light_where_waves_do_but_for_diffraction():
    found, entered = RayPlane(OPTICS, -4e-6, 5, 10).column(*PLACE)
    settings = WaveSettings(neighbours=4, pixel_nodes=4, terms=22, reach=5)
    waves, _ = WavePlane(OPTICS, -4e-6, settings).column(*PLACE)
    assert entered == pytest.approx(1, abs=1e-6) and found.sum() == pytest.approx(1, abs=1e-6)
    assert elsewhere(found.sum((1, 3)), waves.sum((1, 3))) < 0.15
    assert elsewhere(found[::-1, :, ::-1].sum((1, 3)), waves.sum((1, 3))) > 0.3


def test_a_recording_is_the_kernels_product_with_the_volume():
    optics, plan = finer(OPTICS, (2, 2), 1, 2e-2, "auto")
    stack = build_stack(optics, plan)
    rng = np.random.default_rng(5)
    count, points = (6, 5), rng.random((3, 12, 10))
    pictures = dict(zip(DEPTHS, points))
    found = record(optics, plan, count, lambda z, rows, columns: pictures[z], 1)
    expected = 0
    for (kernels, offsets), picture in zip(stack.parts(), points):
        x = picture.reshape(6, 2, 5, 2).transpose(0, 2, 1, 3).reshape(6, 5, 4)
        expected = expected + BlockToeplitz(kernels, offsets, count).forward(x)
    assert np.allclose(found.light, expected, atol=1e-5 * expected.max())
    assert np.array_equal(found.volume, points)


@pytest.mark.parametrize("name", PHANTOMS)
def test_phantoms_are_light_within_their_region(name):
    region = Region(half=(6e-6, 12e-6, 10e-6), middle=1e-6, unit=1.5e-6)
    specimen = phantom(name, region, 3)
    places = np.linspace(-12e-6, 12e-6, 60), np.linspace(-10e-6, 10e-6, 50)
    planes = np.stack([specimen(z, *places) for z in np.linspace(-5e-6, 7e-6, 25)])
    assert planes.shape == (25, 60, 50) and planes.min() >= 0 and planes.max() > 0.5
    assert planes.std() > 0.01
