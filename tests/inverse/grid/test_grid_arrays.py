"""The grid of rendered arrays whose centres are known: pitch within 1e-5, centres within 0.005
px (0.015 px from 40 px of pitch on).
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from plenocli.inverse.grid.detect import find_grid
from plenocli.inverse.grid.distortion import share_between
from tests.reference.arrays import Array, render, true_centres, whole

PITCHES = (6.0, 8.3, 11.7, 16.4, 24.0, 37.3, 61.9, 200.0)
ANGLES = (0.0, 0.4, 3.7, 9.0, 14.0, 20.0, 25.5, 30.0)


def arrays():
    """48: both lattices, eight pitches, three kinds of trouble each; angles in turn."""
    out = []
    for k, kind in enumerate(("square", "hexagonal")):
        for i, pitch in enumerate(PITCHES):
            base = dict(
                kind=kind,
                pitch=pitch,
                sites=9 if pitch >= 200 else max(14, min(60, int(480 / pitch))),
            )
            angle = [ANGLES[(i + 3 * j + k) % 8] for j in range(3)]
            seed = 100 * k + 10 * i
            out.append(Array(**base, angle=angle[0], vignetting=0.5, dead=1e-3, dust=2, seed=seed))
            out.append(
                Array(
                    **base,
                    angle=angle[1],
                    vignetting=0.5,
                    falloff="lenslet",
                    cubic=0.004 * (-1) ** i,
                    perspective=0.003,
                    dust=3,
                    electrons=8000,
                    read=0.004,
                    seed=seed + 1,
                )
            )
            out.append(
                Array(
                    **base,
                    angle=angle[2],
                    vignetting=0.3,
                    perspective=0.01,
                    gains=(0.45, 1.0, 0.9, 0.3),
                    dead=1e-3,
                    dust=2,
                    spot="bell" if pitch < 12 else "disc",
                    seed=seed + 2,
                )
            )
    return out


def mean_pitch(index, centres):
    """Lengths (2,), px, of the lattice vectors of the affine map nearest to all centres."""
    design = np.column_stack([np.ones(len(index)), index])
    return np.hypot(*np.linalg.lstsq(design, centres, rcond=None)[0][1:].T)


QUICK = [6, 10, 14, 15, 33, 37, 41, 45]


def name(array):
    return (
        f"{array.kind}-{array.pitch:g}px-{array.angle:g}"
        f"deg-{'cfa' if array.gains else array.falloff}"
    )


@pytest.mark.parametrize(
    "array",
    [
        pytest.param(a, id=name(a), marks=() if n in QUICK else pytest.mark.slow)
        for n, a in enumerate(arrays())
    ],
)
def test_every_lenslet_is_found_where_it_is(array):
    white, _ = render(array)
    index, centres = true_centres(array)
    inside = whole(centres, array)
    index, centres = index[inside], centres[inside]
    grid = find_grid(white, cfa="RGGB" if array.gains else "mono", dark=400)
    found = grid.centres[grid.valid]
    miss, which = cKDTree(found).query(centres)
    assert grid.lattice == array.kind
    assert len(set(which)) == len(centres), "every whole lenslet once"
    assert np.sqrt(np.mean(miss**2)) <= (0.005 if array.pitch < 40 else 0.015)
    np.testing.assert_allclose(
        mean_pitch(index, found[which]), mean_pitch(index, centres), rtol=1e-5
    )
    if not (array.perspective or array.cubic):
        np.testing.assert_allclose(grid.pitch, array.pitch, rtol=1e-5)


@pytest.mark.parametrize("falloff", ["lenslet", "sensor"])
@pytest.mark.parametrize("pitch, angle", [(16.4, 14.0), (24.0, 9.0)])
def test_bells_dimmed_as_a_whole_are_not_drawn_inwards(pitch, angle, falloff):
    """A bell under light that falls off within it is moved by its variance times the relative
    slope, 0.1 px here, one of a lenslet that is dimmed as a whole is not; both look alike.
    """
    array = Array(
        "hexagonal", pitch, angle, sites=18, spot="bell", vignetting=0.56, falloff=falloff, seed=7
    )
    white, _ = render(array)
    centres = true_centres(array)[1]
    centres = centres[whole(centres, array)]
    grid = find_grid(white, dark=400)
    miss, which = cKDTree(grid.centres[grid.valid]).query(centres)
    assert len(set(which)) == len(centres)
    assert np.sqrt(np.mean(miss**2)) <= 0.015


def test_the_lattice_tells_a_share_only_by_what_a_homography_does_not_take_up():
    index = np.stack(np.meshgrid(np.arange(15), np.arange(15), indexing="ij"), -1).reshape(-1, 2)
    away = (index - 7.0) / 7
    rng = np.random.default_rng(4)
    bend = 0.1 * (away**2).sum(axis=1, keepdims=True) * away
    true = 20.0 * index + 3 + 0.004 * rng.normal(size=index.shape)
    alike = np.ones(len(index))
    for share in (0.0, 0.4, 1.0):
        found = share_between(index, true - share * bend, true + (1 - share) * bend, alike)
        assert found == pytest.approx(share, abs=0.03)
    stretched = true + 0.1 * away
    assert share_between(index, true, stretched, alike) < 0.05


def test_the_rendering_itself():
    """The light of one disc is its area; its centroid is its centre; a pixel is the
    mean over its area.
    """
    array = Array("square", 30.0, sites=8, phase=(0.13, 0.21), electrons=1e9, read=0.0)
    white, centres = render(array)
    light = (white.astype(float) - 400) / 12000
    for centre in centres[whole(centres, array)][::7]:
        low, high = np.rint(centre - 15).astype(int), np.rint(centre + 15).astype(int) + 1
        y, x = np.mgrid[low[0] : high[0], low[1] : high[1]]
        near = np.hypot(y - centre[0], x - centre[1]) < 15
        part = light[low[0] : high[0], low[1] : high[1]] * near
        edge = 0.03 * 30.0
        assert part.sum() == pytest.approx(np.pi * ((0.42 * 30.0) ** 2 + edge**2), rel=4e-3)
        np.testing.assert_allclose(
            [(part * y).sum() / part.sum(), (part * x).sum() / part.sum()], centre, atol=0.02
        )
