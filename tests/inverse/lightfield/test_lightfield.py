"""Refocusing and depth against captures of flat scenes traced ray by ray, at known distances."""

import numpy as np
import pytest

from plenocli.inverse.lightfield import depth as depth_module
from plenocli.inverse.lightfield import samples as samples_module
from plenocli.inverse.lightfield.depth import depth
from plenocli.inverse.lightfield.light_field import refocused, usual_slopes
from plenocli.inverse.lightfield.planes import distance_of, slope_of
from plenocli.inverse.lightfield.refocus import STEP, refocus, views
from plenocli.inverse.lightfield.samples import SampleBands, collect

FOCAL, IMAGE, GAP, PITCH_PX, COUNT = 0.05, 0.055, 0.5e-3, 11, 25
PITCH = 55e-6  # of the lenslets, m
PIXEL = PITCH * (1 + GAP / IMAGE) / PITCH_PX


def scene(x, y):
    """Radiance on the plane of the lenslets' images, x and y in lenslet pitches:
    stripes and a blob.
    """
    return (
        0.5
        + 0.3 * np.sin(2 * np.pi * (0.11 * x + 0.07 * y)) * np.cos(2 * np.pi * 0.09 * y)
        + 0.2 * np.exp(-((x - 2) ** 2 + (y + 3) ** 2) / 8)
    )


def capture(distance, split=None, scene=scene):
    """Mosaic of a flat scene at `distance` (m) by rays: pixel -> lenslet centre -> main
    lens -> object plane;

    split: another distance for the right half of the object, or None. Written in
        lengths, not in slopes.
    scene: radiance at x and y in lenslet pitches.
    """
    side = COUNT * PITCH_PX
    place = (np.arange(side) - (side - 1) / 2) * PIXEL
    lenslet = (np.arange(side) // PITCH_PX - (COUNT - 1) / 2) * PITCH

    def on_object(z):
        """Where the rays of a line of pixels meet the plane at z, m, as its image would
        stand on the array.
        """
        lens = lenslet - (place - lenslet) * IMAGE / GAP  # on the main lens
        # thin lens: direction on the object's side for the ray that goes from `lens` to the lenslet
        image_side = (lenslet - lens) / IMAGE
        object_side = image_side + lens / FOCAL
        return -(lens - object_side * z) * IMAGE / z / PITCH

    def picture(z):
        at = on_object(z)
        y, x = np.meshgrid(at, at, indexing="ij")
        return scene(x, y), x

    far, x = picture(distance)
    if split is None:
        return far
    near, x = picture(split)
    return np.where(x > 0, near, far)


def samples(mosaic, noise=0.0):
    centres = np.stack(
        np.meshgrid(*[(np.arange(COUNT) + 0.5) * PITCH_PX - 0.5] * 2, indexing="ij"), axis=-1
    )
    rows, columns = np.indices(mosaic.shape)
    inside = ((rows % PITCH_PX - 5) ** 2 + (columns % PITCH_PX - 5) ** 2 <= 25).astype(float)
    noisy = mosaic + noise * np.random.default_rng(0).normal(size=mosaic.shape)
    return collect(noisy * inside, inside, centres, np.ones((COUNT, COUNT), bool), PITCH_PX)


def slope(distance):
    return slope_of(distance, FOCAL, IMAGE, GAP)


@pytest.mark.parametrize("distance", [0.45, 0.52, 0.55, 0.58, 0.75, np.inf])
def test_slopes_and_distances_are_each_others_inverse(distance):
    assert distance_of(slope(distance), FOCAL, IMAGE, GAP) == pytest.approx(distance, rel=1e-9)
    assert (slope(distance) > 0) == (distance < 0.55 - 1e-9)


@pytest.mark.parametrize("distance", [0.46, 0.52, 0.55, 0.58, 0.65])
def test_a_plane_is_sharpest_and_right_at_its_own_slope(distance):
    made = samples(capture(distance))
    own = slope(distance)
    step, edge = STEP, 5 * STEP
    at = ((np.arange(COUNT * step) / step * PITCH_PX) - (COUNT * PITCH_PX - 1) / 2) / PITCH_PX
    true = scene(*np.meshgrid(at, at, indexing="ij")[::-1])
    inner = (slice(edge, -edge), slice(edge, -edge))
    errors = {}
    for offset in (-1.6, -0.5, 0.0, 0.5, 1.6):
        picture, spread = refocus(made, own + offset, (COUNT, COUNT))
        errors[offset] = (
            float(np.sqrt(np.mean((picture - true)[inner] ** 2))),
            float(np.mean(spread[inner])),
        )
    assert (
        min(errors, key=lambda o: errors[o][0]) == 0
        and min(errors, key=lambda o: errors[o][1]) == 0
    )
    assert (
        errors[0.0][0] < 0.02
        and errors[1.6][0] > 1.4 * errors[0.0][0]
        and errors[1.6][1] > 1.5 * errors[0.0][1]
    )


def _parts(found):
    return found.slope, found.confidence


@pytest.mark.parametrize("far, near", [(0.556, 0.541), (0.6, 0.5), (0.75, 0.6)])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_depth_of_two_halves_is_found_within_a_fraction_of_the_geometric_limit(noise, far, near):
    """The limit: a lenslet of parallax across the pupil is a slope of one."""
    made = samples(capture(far, near), noise)
    found, confidence = _parts(depth(SampleBands.of(made, (COUNT, COUNT)), np.linspace(-4, 4, 33)))
    inner = confidence[4:-4, 4:-4] > 0.5
    left, right = found[4:-4, 4:10], found[4:-4, 15:-4]
    sure_left, sure_right = inner[:, :6], inner[:, 11:]
    assert sure_left.mean() > 0.4 and sure_right.mean() > 0.4
    assert (
        abs(np.median(left[sure_left]) - slope(far)) < 0.1
        and abs(np.median(right[sure_right]) - slope(near)) < 0.1
    )
    distances = distance_of(right[sure_right], FOCAL, IMAGE, GAP)
    limit = abs(
        distance_of(slope(near) + 0.5, FOCAL, IMAGE, GAP)
        - distance_of(slope(near) - 0.5, FOCAL, IMAGE, GAP)
    )
    assert abs(np.median(distances) - near) < 0.2 * limit


def test_a_scene_without_texture_has_no_depth_and_no_confidence():
    made = samples(np.full((COUNT * PITCH_PX,) * 2, 0.4))
    found, confidence = _parts(depth(SampleBands.of(made, (COUNT, COUNT)), np.linspace(-2, 2, 9)))
    assert confidence.max() == 0 and np.isnan(found).all()
    picture, spread = refocus(made, 1.3, (COUNT, COUNT))
    assert np.nanmax(np.abs(picture - 0.4)) < 1e-7 and np.nanmax(spread) < 1e-12


@pytest.mark.parametrize("distance", [0.42, 0.45, 0.7, 0.8])
def test_a_plane_beyond_the_usual_range_is_found_and_no_lenslet_is_sure_at_an_edge(distance):
    made = samples(capture(distance), 0.01)
    field = refocused(SampleBands.of(made, (COUNT, COUNT)), usual_slopes(7), views=0, grow=True)
    found, confidence = _parts(field.depth)
    off = np.abs(found - slope(distance))
    sure = confidence >= 0.4
    assert abs(np.nanmedian(found) - slope(distance)) < 0.3
    assert sure.mean() > 0.5 and np.mean(off[sure] < 1) > 0.9
    assert len(field.slopes) == len(field.pictures) and np.ptp(np.diff(field.slopes)) < 1e-9
    assert not np.isin(found, field.slopes[[0, -1]]).any()


def test_both_halves_of_a_scene_are_sharp_in_the_picture_by_its_depths():
    made = samples(capture(0.65, 0.48))
    field = refocused(SampleBands.of(made, (COUNT, COUNT)), usual_slopes(13), views=0, grow=True)
    at = (np.arange(COUNT * STEP) / STEP * PITCH_PX - (COUNT * PITCH_PX - 1) / 2) / PITCH_PX
    true = scene(*np.meshgrid(at, at, indexing="ij")[::-1])
    inner = slice(5 * STEP, -5 * STEP)

    def error(picture):
        return float(np.sqrt(np.nanmean((picture - true)[inner, inner] ** 2)))

    assert error(field.sharp) < 0.7 * min(error(p) for p in field.pictures)


def test_beyond_slopes_that_do_not_grow_nothing_is_known():
    """The plane stands at a slope of 3.4."""
    found = depth(SampleBands.of(samples(capture(0.42)), (COUNT, COUNT)), np.linspace(-2, 2, 9))
    assert found.beyond > 0.9 and np.isnan(found.slope).mean() > 0.9
    assert (found.confidence[np.isnan(found.slope)] == 0).all()


def test_views_see_the_parallax_of_their_part_of_the_pupil():
    near = samples(capture(0.541))
    seen = views(near, 3, (COUNT, COUNT))
    inner = slice(6, -6)
    left, right = seen[1, 0][inner, inner], seen[1, 2][inner, inner]
    from scipy.ndimage import shift

    def mismatch(move):
        return np.sum((shift(seen[1, 2], (0, move), order=1)[inner, inner] - left) ** 2)

    moves = np.linspace(-3, 3, 61)
    best = moves[np.argmin([mismatch(m) for m in moves])]
    reach = near.reach() * np.sqrt(0.5)
    assert np.isfinite(left).all() and np.isfinite(right).all()
    assert best == pytest.approx(slope(0.541) * (4 / 3 * reach) / PITCH_PX, abs=0.25)


def test_holes_dead_pixels_and_lenslets_off_the_sensor_are_left_out():
    mosaic = capture(0.55)
    mosaic[20:25, 30:33] = np.nan
    made = samples(np.nan_to_num(mosaic, nan=np.nan))
    assert np.isfinite(made.value).all()
    picture, _ = refocus(made, 0.0, (COUNT + 3, COUNT))
    assert np.isnan(picture[-4:]).all() and np.isfinite(picture[8:-20, 8:-8]).all()


def test_confidence_is_how_often_the_slope_is_right_and_sigma_how_far_it_is_off():
    """Two flat things, the near one hiding part of the far one, of three photographs of other
    scenes than confidence was fitted on, with noise of 0.3 to 3 %, at slopes from -4 to 6.
    """
    import skimage.data
    from scipy.ndimage import map_coordinates

    sure, right, away, edges, near_edge = [], [], [], [], []
    for name, far, near, noise in (
        ("astronaut", -2.0, 0.5, 0.003),
        ("chelsea", 1.0, 3.4, 0.01),
        ("coffee", -3.6, -1.2, 0.03),
        ("rocket", 2.2, 4.6, 0.01),
    ):
        photo = getattr(skimage.data, name)().mean(axis=-1) / 255

        def texture(x, y):
            return map_coordinates(photo, [200 + 3 * y, 250 + 3 * x], order=1, mode="mirror")

        distances = distance_of(np.array([far, near]), FOCAL, IMAGE, GAP)
        made = samples(capture(distances[0], distances[1], texture), noise)
        field = refocused(
            SampleBands.of(made, (COUNT, COUNT)), usual_slopes(13), views=0, grow=True
        )
        column = np.arange(COUNT) - (COUNT - 1) / 2
        true = np.where(column > 0, near, far) * np.ones((COUNT, 1))
        inner = (slice(2, -2), slice(2, -2))
        found, off = field.depth, np.abs(field.depth.slope - true)
        sure.append(found.confidence[inner].ravel())
        right.append((off < 1)[inner].ravel())
        away.append((off / found.sigma)[inner].ravel())
        edges.append(found.edge[inner].ravel())
        near_edge.append((np.abs(column) <= 4)[None].repeat(COUNT, axis=0)[inner].ravel())
    sure, right, away, edges, near_edge = map(np.concatenate, (sure, right, away, edges, near_edge))
    known = sure > 0
    assert known.mean() > 0.7 and (sure >= 0.9).mean() > 0.5
    assert right[sure >= 0.9].mean() > 0.9
    assert abs(right[known].mean() - sure[known].mean()) < 0.07
    assert np.quantile(away[known], 0.68) < 1 and np.quantile(away[known], 0.95) < 3.5
    # edges are where the near thing ends, not all over
    assert edges[near_edge & known].mean() > 0.25 > 10 * edges[~near_edge & known].mean()


def test_how_many_samples_are_worked_on_together_changes_nothing(monkeypatch):
    mosaic = capture(0.62, 0.5)
    whole = samples(mosaic)
    map_of_all = depth(SampleBands.of(whole, (COUNT, COUNT)), usual_slopes(7).tolist())
    for module in (depth_module, samples_module):
        monkeypatch.setattr(module, "AT_ONCE", 3001)
    parts = samples(mosaic)
    for name in ("centre", "offset", "value"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    found = depth(SampleBands.of(parts, (COUNT, COUNT)), usual_slopes(7).tolist())
    np.testing.assert_allclose(found.slope, map_of_all.slope, atol=1e-5)
