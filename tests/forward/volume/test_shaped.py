"""Kernels behind lenslets that are no squares, or on a hexagonal lattice, against brute force."""

from dataclasses import replace

import numpy as np
import pytest

from plenocli.base.errors import UsageError
from plenocli.forward.volume.optics import Term
from plenocli.forward.volume.plan import plan_volume
from plenocli.forward.volume.shaped import ShapedPlane
from plenocli.forward.volume.stack import build_stack, plane_kernels
from plenocli.forward.volume.waves import WavePlane, WaveSettings
from tests.forward.volume.test_waves import DEPTHS, OPTICS, PLACE, elsewhere
from tests.reference.volume import shaped_column

HEXAGONS = replace(OPTICS, lattice="hexagonal", opening="hexagon", pixels=(6, 7))
CIRCLES = replace(HEXAGONS, opening="circle", open_width=28e-6)
APART = replace(OPTICS, opening="circle", open_width=28e-6)


def inner(optics, column, reach=2.5):
    """Superpixels (rows, columns in pitches) within `reach` pitches, and what a column puts on
    them.
    """
    rows, _, columns, _ = column.shape
    high = len(optics.sites) * (np.sqrt(0.75) if optics.lattice == "hexagonal" else 1.0)
    n = optics.pixels[0]
    middles, light = [], []
    for i in range(rows):
        for site, (y, x) in enumerate(optics.sites):
            for j in range(columns):
                middle = (i - rows // 2) * high + y, j - columns // 2 + x
                if max(np.abs(middle)) < reach:
                    middles.append(middle)
                    light.append(column[i, site * n : (site + 1) * n, j])
    return middles, np.array(light)


@pytest.mark.parametrize("optics", [HEXAGONS, CIRCLES, APART], ids=["hexagons", "circles", "apart"])
def test_columns_are_those_of_a_fine_grid_to_the_accuracy_asked_for(optics):
    depth = DEPTHS[2]
    one = replace(optics, depths=(depth,), places=(depth,), scales=(1.0,))
    truth, rungs = None, []
    for accuracy in (1e-2, 2e-3):
        plan = plan_volume(one, (3, 3), accuracy=accuracy)
        rungs.append(plan.pixel_nodes)
        found, entered = ShapedPlane(optics, depth, 4, plan.pixel_nodes).column(*PLACE)
        middles, light = inner(optics, found)
        if truth is None:
            truth = shaped_column(
                PLACE, depth, optics=optics, lenslets=4, step=0.4e-6, superpixels=middles
            )
        assert elsewhere(light, truth) < accuracy
        assert found.sum() == pytest.approx(entered, abs=0.03)
    assert truth.sum() > 0.6 and rungs[0] < rungs[1]


def test_squares_by_their_orders_are_squares_by_their_polynomials():
    found, entered = ShapedPlane(OPTICS, 3e-6, 6, 6).column(*PLACE)
    settings = WaveSettings(neighbours=6, pixel_nodes=6, terms=24, reach=6)
    expected, in_lenslets = WavePlane(OPTICS, 3e-6, settings).column(*PLACE)
    assert elsewhere(found[2:-2, :, 2:-2], expected[2:-2, :, 2:-2]) < 3e-4
    assert entered == pytest.approx(in_lenslets, abs=1e-4)
    round_ones, _ = ShapedPlane(replace(OPTICS, opening="circle"), 3e-6, 6, 6).column(*PLACE)
    assert elsewhere(round_ones, expected) > 0.05


def test_a_point_one_lenslet_of_the_lattice_on_lights_the_same_pixels_there():
    """The other lenslet of the cell is to the next rows what the first one is to it."""
    plane = ShapedPlane(HEXAGONS, 3e-6, 4, 3)
    pitch = HEXAGONS.object_pitch
    here, _ = plane.column(*PLACE)
    there, _ = plane.column(PLACE[0] + np.sqrt(0.75) * pitch, PLACE[1] + pitch / 2)
    n = HEXAGONS.pixels[0]
    assert elsewhere(there[1:-1, n:, 1:-1], here[1:-1, :n, 1:-1]) < 2e-3
    # from the second lenslet of a cell to the first of the one below, half a pitch on
    assert elsewhere(there[2:-1, :n, 2:-1], here[1:-2, n:, 1:-2]) < 2e-3


@pytest.mark.parametrize("optics", [HEXAGONS, APART], ids=["hexagons", "apart"])
def test_voxels_by_symmetry_are_those_computed_one_by_one(optics):
    optics = replace(optics, depths=(3e-6,), places=(3e-6,), scales=(1.0,))
    # a path of 1e-17 m bends nothing, and takes all symmetry away
    bent = replace(optics, terms=(Term(noll=3, coefficient=1e-17),))
    stacks = [
        build_stack(each, plan_volume(each, (2, 2), accuracy=2e-2)) for each in (optics, bent)
    ]
    # what lies beyond the torus is cut off half a cell nearer on one side
    assert np.abs(stacks[0].A - stacks[1].A).max() < 1e-3 * stacks[0].A.max()
    assert stacks[0].A.shape[2] == (8 if optics.lattice == "hexagonal" else 4)
    assert stacks[0].lenslets == len(optics.sites)


def test_an_even_plane_is_even_behind_all_lenslets():
    optics = replace(HEXAGONS, depths=(3e-6,), places=(3e-6,), scales=(1.0,))
    kernels, _ = plane_kernels(optics, plan_volume(optics, (3, 4), accuracy=5e-3), 0)
    first, second = kernels.sum((0, 2), dtype=float).reshape(2, 6, 7)
    assert np.abs(first - second).max() < 5e-3 * first.max()
    assert np.abs(first - first[::-1, ::-1]).max() < 5e-3 * first.max()


def test_rays_are_followed_behind_squares_alone():
    with pytest.raises(UsageError, match="not hexagons on a hexagonal one"):
        plan_volume(HEXAGONS, (2, 2), model="ray")
