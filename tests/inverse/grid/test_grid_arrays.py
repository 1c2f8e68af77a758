"""The grid of rendered arrays whose centres are known: pitch within 1e-5, centres within 0.005
px (0.015 px from 40 px of pitch on).
"""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from plenocli.inverse.grid.detect import find_grid
from plenocli.inverse.grid.distortion import share_between
from tests.reference.arrays import Array, filled, render, true_centres, whole

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


QUICK = [6, 10, 14, 15, 33, 37, 41]


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
@pytest.mark.parametrize(
    "pitch, angle", [(16.4, 14.0), pytest.param(24.0, 9.0, marks=pytest.mark.slow)]
)
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


def cells(layout, degrees, gap, pitch=23.3, count=(14, 16), fine=4):
    """(image, centres): superpixels of square parts that are alike, with dark lines, `gap` of the
    pitch, between these and between superpixels; in a frame that is a little larger.
    """
    turn = np.deg2rad(degrees)
    vectors = pitch * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    count, shape = np.array(count), np.array(count) * 24 + 24
    places = (np.indices(shape * fine) + 0.5) / fine - 0.5
    middle = (shape - 1) / 2 + (0.3, -0.2)
    at = np.einsum("ars,ab->brs", places - middle[:, None, None], np.linalg.inv(vectors))
    at += count[:, None, None] / 2
    lit = ((at > 0) & (at < count[:, None, None])).all(axis=0)
    for axis, parts in enumerate(layout):
        lit &= np.abs(at[axis] * parts % 1 - 0.5) < 0.5 - gap * parts / 2
    light = lit.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    image = np.random.default_rng(5).poisson(3000 * light + 15).astype(float)
    index = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in count), indexing="ij"), axis=-1)
    return image, middle + (index - count / 2) @ vectors


@pytest.mark.parametrize(
    "layout, degrees",
    [
        ((1, 2), -2.3),
        ((2, 2), 0.0),
        ((2, 3), -2.3),
        pytest.param((1, 2), 0.0, marks=pytest.mark.slow),
        pytest.param((2, 2), -2.3, marks=pytest.mark.slow),
        pytest.param((2, 3), 0.0, marks=pytest.mark.slow),
    ],
)
def test_superpixels_whose_parts_look_alike_are_found_by_the_pitch_that_is_known(layout, degrees):
    """Filters that pass as much of white light each: what repeats is a part, and dark lines are
    the same between parts and between superpixels. The pitch is known to 4 %.
    """
    image, centres = cells(layout, degrees, 0.08)
    known = {"parts": True, "count": centres.shape[:2], "pitch": 1.04 * 23.3}
    found = find_grid(image, "mono", 15.0, "square", **known)
    assert found.centres.shape == centres.shape and found.valid.all()
    assert np.abs(found.centres - centres).max() < 0.05


def test_a_pitch_that_is_twice_too_large_puts_no_superpixels_together():
    """Where their number is known; without it the pitch is believed."""
    image, centres = cells((1, 1), 0.7, 0.2)
    known = {"parts": True, "count": centres.shape[:2], "pitch": 2 * 23.3}
    found = find_grid(image, "mono", 15.0, "square", **known)
    assert found.centres.shape == centres.shape and found.valid.all()
    assert np.abs(found.centres - centres).max() < 0.05


@pytest.mark.parametrize(
    "gap, degrees, around, count",
    [(0.04, 2.3, 0, (14, 16)), (0.08, 12, 300, (14, 16)), (0.15, 0, 200, (11, 11))],
)
def test_thin_lines_are_seen_in_an_array_that_is_smaller_than_its_sensor(
    gap, degrees, around, count
):
    image, centres = cells((1, 1), degrees, gap, count=count)
    dark = np.random.default_rng(6).poisson(15.0, np.array(image.shape) + 2 * around)
    dark[around : around + image.shape[0], around : around + image.shape[1]] = image
    found = find_grid(dark.astype(float), "mono", 15.0, "square")
    assert found.centres.shape == centres.shape and found.valid.all()
    assert np.abs(found.centres - centres - around).max() < 0.05


@pytest.mark.parametrize("pitch", [6.0, 37.3])
def test_dark_surroundings_hold_no_lenslets(pitch):
    array = next(a for a in arrays() if a.pitch == pitch)
    image, truth = render(array)
    around = 300
    dark = np.random.default_rng(7).normal(400, 60, np.array(image.shape) + 2 * around)
    dark[around : around + image.shape[0], around : around + image.shape[1]] = image
    found = find_grid(dark, "mono", 400.0)
    away = cKDTree(truth + around).query(found.centres[found.valid])[0]
    assert away.max() < 0.1 * pitch
    assert whole(truth, array).sum() <= found.valid.sum() <= len(truth)


@pytest.mark.parametrize("kind", ["square", "hexagonal"])
@pytest.mark.parametrize("degrees", [0, pytest.param(30, marks=pytest.mark.slow), 44])
def test_thin_lines_of_small_lenslets_are_no_coarser_lattice(kind, degrees):
    """Half a pixel of darkness between cells of nine: every other lattice point alone was seen to
    repeat where these fall on the raster alike.
    """
    pitch = 9.13 if degrees == 0 else 9.0  # of nine, no image tells where in a pixel lines lie
    white, centres = filled(kind, pitch, degrees, 0.06, 30)
    _all_are_found(find_grid(white, "mono", 15.0), kind, pitch, centres, len(white))


def _all_are_found(found, kind, pitch, centres, size, around=0):
    """Those that are not at the border, within 2 % of the pitch, or 0.15 px."""
    assert found.lattice == kind
    low, high = around + 1.2 * pitch, around + size - 1.2 * pitch
    inner = centres[((centres > low) & (centres < high)).all(axis=1)]
    away = cKDTree(found.centres[found.valid]).query(inner)[0]
    assert np.quantile(away, 0.95) < max(0.15, 0.02 * pitch)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_filled_arrays_of_any_kind_are_found(seed):
    rng = np.random.default_rng(seed)
    kind, pitch = ("square", "hexagonal")[rng.integers(2)], float(np.exp(rng.uniform(1.8, 4.1)))
    degrees = float(rng.uniform(-45, 45) if rng.uniform() < 0.5 else rng.uniform(-3, 3))
    gap, around = float(rng.uniform(0.04, 0.4)), int(rng.choice([0, 0, 60, 250]))
    lenslets = int(rng.uniform(12, min(30, max(12.5, 420 / pitch))))
    falloff = float(rng.uniform(0, 0.5))
    white, centres = filled(kind, pitch, degrees, gap, lenslets, around, falloff, seed)
    cfa = "RGGB" if rng.uniform() < 0.4 else "mono"
    if cfa == "RGGB":
        gains = np.tile(rng.uniform(0.3, 1, (2, 2)), np.array(white.shape) // 2 + 1)
        white = rng.poisson(white * gains[: white.shape[0], : white.shape[1]]).astype(float)
    size = white.shape[0] - 2 * around
    _all_are_found(find_grid(white, cfa, 15.0), kind, pitch, centres, size, around)
