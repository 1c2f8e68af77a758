"""Grids from captures of scenes: light fields painted here, of lenslets whose places are known, lit
by textures at depths, gradients, periodic patterns and black parts.
"""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from skimage import data

from plenocli.base.errors import InputError, NumericsError
from plenocli.inverse.grid.detect import find_grid
from plenocli.inverse.grid.scenes import find_scene_grid, moved_grid


def texture(rng, shape, blur=3.0):
    """A picture of values 0 to 1 with detail down to `blur` px."""
    sum_of = sum(
        scale * gaussian_filter(rng.normal(size=shape), blur * scale, mode="wrap") * scale
        for scale in (1, 2, 4, 8)
    )
    return (sum_of - sum_of.min()) / np.ptp(sum_of)


def capture(
    rng, scene, *, pitch=13.3, turn=0.4, lattice="square", slope=0.7, shape=(270, 270), disc=0.46
):
    """(light field of `scene` (row, column: a third of a lenslet a sample), true centres (N, 2)
    px): round pupil images of radius `disc` pitches with soft edges, in which the scene is seen
    `slope` lenslets further from one edge of the pupil to the other; photon noise.
    """
    size = 7
    fine = np.stack(np.indices((shape[0], shape[1])), axis=-1).astype(float)
    angle = np.deg2rad(turn)
    right = pitch * np.array([np.sin(angle), np.cos(angle)])
    down = pitch * np.array([np.cos(angle), -np.sin(angle)])
    if lattice == "hexagonal":
        down = down * np.sqrt(0.75) + right / 2
    basis, origin = np.array([down, right]), rng.uniform(0, pitch, 2)
    steps = np.stack(np.meshgrid(*[np.arange(-60, 60)] * 2, indexing="ij"), -1).reshape(-1, 2)
    centres = steps @ basis + origin
    inside = ((centres > -size) & (centres < np.array(shape) + size)).all(axis=1)
    centres = centres[inside]
    from scipy.spatial import cKDTree

    _, own = cKDTree(centres).query(fine)
    away = fine - centres[own]
    pupil = 1 / (1 + np.exp((np.hypot(*np.moveaxis(away, -1, 0)) - disc * pitch) / 0.6))
    seen = (centres[own] + slope * away) / pitch * 3 + 20
    light = map_coordinates(scene, np.moveaxis(seen, -1, 0), order=1, mode="reflect")
    mean = 2000 * (light * pupil + 0.01)
    return rng.poisson(mean).astype(np.float32), centres


def miss(grid, centres):
    """px rms of a grid's lenslets from the nearest true ones."""
    from scipy.spatial import cKDTree

    away, _ = cKDTree(centres).query(grid.centres[grid.valid])
    return np.sqrt(np.mean(away**2))


def scenes(rng, kind):
    """A scene (150, 150) of a `kind` that is hard in its own way."""
    picture = 0.05 + texture(rng, (150, 150))
    y, x = np.indices(picture.shape) / 150
    return {
        "texture": picture,
        "gradient": picture * 10 ** (1.3 * (x - y)),
        # 1.07 lenslets: beats with the lattice
        "period": picture * (1.1 + np.cos(2 * np.pi * x * 150 / 3.2)),
        "half": picture * (1.1 + np.cos(np.pi * (x + y) * 150 / 3)),
        "border": picture * ((x > 0.25) & (y < 0.8)),
        "spots": 0.02 + (picture > np.quantile(picture, 0.9)),
    }[kind]


KINDS = ["texture", "gradient", "border", "spots", "period", "half"]


def check_a_grid(kind, lattice, seed, slope):
    """A scene of the texture of photographs gives a grid, others may be refused; none is worse than
    it says.
    """
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    image, centres = capture(rng, scenes(rng, kind), lattice=lattice, slope=slope)
    try:
        grid = find_scene_grid([image])
    except NumericsError:
        assert kind in ("period", "half", "spots")
        return
    assert grid.lattice == lattice
    assert miss(grid, centres) < 2.5 * grid.expected_error + 0.03, (slope, grid.expected_error)


@pytest.mark.parametrize(("number", "kind"), list(enumerate(KINDS)))
def test_grids_of_scenes_are_as_sure_as_they_say(number, kind):
    check_a_grid(kind, ("square", "hexagonal")[number % 2], 0, 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("lattice", ["square", "hexagonal"])
@pytest.mark.parametrize("kind", KINDS)
def test_grids_of_many_scenes(kind, lattice):
    for seed in range(1, 6):
        check_a_grid(kind, lattice, seed, (0.0, 0.4, 0.8, 1.2, -0.8)[seed - 1])


def test_black_parts_of_a_plain_scene_hide_no_lattice():
    """One brightness a lenslet, four parts of a superpixel, a third of it black: lags from one
    bright part to another went for the lattice. Captures of nothing beside it change nothing.
    """
    rng = np.random.default_rng(7)
    side = np.repeat([0, 1, 0.4, 1, 0], [1, 8, 2, 8, 1])
    cell = np.minimum.outer(side, side)
    lenslets = data.camera()[16:496, :480].reshape(20, 24, 16, 30).mean(axis=(1, 3)) / 255
    mean = 1600 * np.kron(np.clip(lenslets - 0.08, 0, None), cell) + 4
    shots = [rng.poisson(one).astype(np.float32) for one in (mean, 0 * mean + 4, 0 * mean + 4)]
    centres = 20 * np.stack(np.indices(lenslets.shape), -1).reshape(-1, 2) + 9.5
    for captures in (shots[:1], shots):
        grid = find_scene_grid(captures, parts=True)
        assert grid.valid.sum() > 0.9 * lenslets.size
        assert miss(grid, centres) < 2.5 * grid.expected_error + 0.03


def test_a_chessboard_before_the_lenslets_is_no_lattice():
    """Every other lenslet 20 times brighter: what repeats are the bright ones, sqrt(2) pitches
    apart, and a grid of these was taken with an error of 0.08 px, off by 1.8.
    """
    rng = np.random.default_rng([3, KINDS.index("half")])
    image, _ = capture(rng, scenes(rng, "half"), slope=0.8)
    with pytest.raises(NumericsError, match="dark lines run across"):
        find_scene_grid([image])


@pytest.mark.parametrize("gains", [[[0.4, 1], [1, 0.3]], [[1, 0.2], [0.3, 0.5]]])
def test_filters_that_make_a_chessboard_are_told_by_the_lines_between_superpixels(gains):
    """Parts that alternate as a chessboard's squares do, which nobody has told of."""
    rng = np.random.default_rng(7)
    side = np.repeat([0, 1, 0.5, 1, 0], [1, 8, 2, 8, 1])
    cell = np.minimum.outer(side, side) * np.kron(gains, np.ones((10, 10)))
    image = rng.poisson(1600 * np.kron(rng.uniform(0.2, 1, (20, 24)), cell) + 4)
    grid = find_scene_grid([image.astype(np.float32)])
    np.testing.assert_allclose(grid.pitch, 20, rtol=1e-3)
    assert abs(grid.angle) < 0.1


def test_what_is_slow_in_a_scene_does_not_pass_for_parts_of_small_superpixels():
    """Lines within them were taken for their borders: 0.18 px off, 0.012 expected."""
    rng = np.random.default_rng([0, 0, 5])
    scene = scenes(rng, "texture")
    image, centres = capture(rng, scene, slope=0.0, pitch=5.5, turn=0, shape=(200, 200))
    grid = find_scene_grid([image])
    assert miss(grid, centres) < 2.5 * grid.expected_error + 0.03


def test_several_captures_are_surer_than_one():
    rng = np.random.default_rng(3)
    images, centres = [], None
    for _ in range(5):
        seed = np.random.default_rng(1)  # the same lenslets
        image, centres = capture(seed, scenes(rng, "texture"), slope=1.2)
        images.append(image)
    one, all_of = find_scene_grid(images[:1]), find_scene_grid(images)
    assert all_of.expected_error < one.expected_error
    assert miss(all_of, centres) < max(0.05, 2.5 * all_of.expected_error)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("level", [1e30, -1e30])
def test_light_of_no_sensor_is_refused_before_squares_overflow(level):
    image, _ = capture(np.random.default_rng(1), np.ones((150, 150)))
    for find in (find_grid, lambda one: find_scene_grid([one])):
        with pytest.raises(InputError, match="no sensor counts so far"):
            find(image * np.float32(level))


def test_what_is_no_light_field_is_refused():
    rng = np.random.default_rng(5)
    with pytest.raises(NumericsError, match="no lenslet lattice"):
        find_scene_grid([1000 * texture(rng, (400, 400))])
    chart = np.kron(rng.uniform(0.2, 1, (4, 6)), np.pad(np.ones((40, 40)), 5))
    with pytest.raises(NumericsError, match="too few|no lenslet lattice"):
        find_scene_grid([rng.poisson(1000 * chart + 20).astype(np.float32)])


@pytest.mark.parametrize("step", [(0.0, 0.0), (0.6, -0.35)])
def test_a_white_image_of_another_day_is_moved_where_lenslets_moved(step):
    plain = np.ones((150, 150))
    white, centres = capture(np.random.default_rng(1), plain)
    rng = np.random.default_rng(2)
    image, _ = capture(np.random.default_rng(1), scenes(rng, "texture"))
    image = gaussian_filter(image, 0.3)
    from scipy.ndimage import shift

    found = moved_grid(find_grid(white), white, [shift(image, step, order=3, mode="nearest")])
    assert found.moved == any(step)
    assert miss(found.grid, centres + step) < 0.1
