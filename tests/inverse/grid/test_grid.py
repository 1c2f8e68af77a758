"""Lenslet grids: synthetic arrays with known centres, published test pictures, real cameras, and
pictures without a lattice.
"""

import time

import numpy as np
import pytest
from scipy.spatial import cKDTree

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.progress import collected_notes
from plenocli.inverse.grid import distortion, lattice
from plenocli.inverse.grid.detect import find_grid
from tests.reference.prototype import superpixels


def make_white(
    kind,
    pitch,
    angle,
    shape,
    *,
    seed=0,
    vignetting=0.0,
    falloff=0.0,
    noise=0.0,
    spot="disc",
    bend=0.0,
    phase=(0.31, -0.17),
):
    """White image and true centres (N, 2): soft discs or bells at exact lattice points, 14 bit,
    optional cubic distortion.

    vignetting dims whole superpixels towards the corners, falloff dims the sensor continuously.
    """
    rng = np.random.default_rng(seed)
    turn = np.radians(angle)
    right = pitch * np.array([np.sin(turn), np.cos(turn)])
    steep = turn + (np.pi / 3 if kind == "hexagonal" else np.pi / 2)
    down = pitch * np.array([np.sin(steep), np.cos(steep)])
    reach = int(1.5 * np.hypot(*shape) / pitch) + 2
    m, n = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1), indexing="ij")
    middle = (np.array(shape) - 1) / 2
    offset = m[..., None] * down + n[..., None] * right + np.array(phase) * pitch
    radius = np.hypot(*shape) / 2
    offset = offset * (1 + bend * (offset**2).sum(axis=-1, keepdims=True) / radius**2)
    centres = (middle + offset).reshape(-1, 2)
    centres = centres[((centres > -pitch) & (centres < np.array(shape) + pitch)).all(axis=1)]
    image = np.zeros(shape)
    half = int(np.ceil(0.75 * pitch)) + 2
    for centre in centres:
        low = np.maximum(np.rint(centre).astype(int) - half, 0)
        high = np.minimum(np.rint(centre).astype(int) + half + 1, shape)
        if (high <= low).any():
            continue
        y, x = np.ogrid[low[0] : high[0], low[1] : high[1]]
        far = np.hypot(y - centre[0], x - centre[1])
        soft = max(0.06 * pitch, 0.45)
        value = (
            0.5 - 0.5 * np.tanh((far - 0.38 * pitch) / soft)
            if spot == "disc"
            else np.exp(-0.5 * (far / (0.2 * pitch)) ** 2)
        )
        fall = 1 - vignetting * (((centre - middle) / radius) ** 2).sum()
        image[low[0] : high[0], low[1] : high[1]] += value * fall
    y, x = np.ogrid[: shape[0], : shape[1]]
    image *= 1 - falloff * ((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / radius**2
    image = 12000 * image + rng.normal(size=shape) * noise * 12000
    return np.clip(np.rint(image + 400), 0, 16383).astype(np.uint16), centres


def compare(grid, centres, shape, pitch):
    """Root mean square distance, px, of the fitted centres from the truth over whole lenslets;
    each found exactly once.
    """
    whole = ((centres >= pitch / 2 - 0.5) & (centres <= np.array(shape) - 0.5 - pitch / 2)).all(
        axis=1
    )
    inner = ((centres >= pitch / 2 + 0.5) & (centres <= np.array(shape) - 1.5 - pitch / 2)).all(
        axis=1
    )
    found = grid.centres[grid.valid]
    miss, which = cKDTree(found).query(centres[inner])
    assert (
        len(set(which))
        == inner.sum()
        <= grid.valid.sum()
        <= whole.sum() + 2 * (whole.sum() - inner.sum()) + 1
    )
    return np.sqrt(np.mean(miss**2))


CASES = [
    # kind, pitch, angle, shape, options, bound of the centre error in px
    ("square", 6.3, 3.0, (300, 340), dict(spot="bell"), 0.005),
    ("square", 14.31, -1.7, (400, 500), dict(vignetting=0.5, noise=0.02), 0.01),
    ("square", 33.7, 30.0, (700, 800), dict(vignetting=0.5, noise=0.02), 0.02),
    ("square", 52.0, 0.0, (580, 580), dict(noise=0.01), 0.02),
    ("square", 120.4, 7.0, (900, 1000), dict(noise=0.02), 0.06),
    ("hexagonal", 5.2, 12.0, (240, 260), dict(spot="bell"), 0.005),
    ("hexagonal", 14.31, 0.37, (420, 470), dict(vignetting=0.5, noise=0.02), 0.01),
    ("hexagonal", 27.9, 19.0, (600, 500), dict(vignetting=0.3, noise=0.02), 0.02),
    ("square", 27.9, 11.0, (600, 600), dict(falloff=0.5, noise=0.02), 0.02),
    ("hexagonal", 14.31, 0.37, (420, 470), dict(falloff=0.5, noise=0.02, spot="bell"), 0.01),
    ("hexagonal", 66.7, 30.0, (800, 800), dict(noise=0.02), 0.05),
]


@pytest.mark.parametrize("kind, pitch, angle, shape, options, bound", CASES)
def test_synthetic_arrays(kind, pitch, angle, shape, options, bound):
    white, centres = make_white(kind, pitch, angle, shape, **options)
    grid = find_grid(white)
    assert grid.lattice == kind
    np.testing.assert_allclose(grid.pitch, pitch, rtol=1e-4 if pitch < 100 else 3e-4)
    period = 60 if kind == "hexagonal" else 90
    assert abs((grid.angle - angle + period / 2) % period - period / 2) < 0.02
    assert compare(grid, centres, shape, pitch) < bound
    assert grid.rms < 0.02 * pitch


def test_bayer_gains_dead_pixels_and_dust_do_not_move_the_grid():
    shape = (500, 600)
    white, centres = make_white("square", 24.6, 2.0, shape, noise=0.01, vignetting=0.4)
    white = white.astype(float) - 400
    gains = np.tile([[0.45, 1.0], [0.9, 0.3]], (shape[0] // 2, shape[1] // 2))
    rng = np.random.default_rng(4)
    mosaic = 400 + white * gains
    mosaic[tuple(rng.integers(0, 500, (2, 200)))] = 0
    mosaic[tuple(rng.integers(0, 500, (2, 60)))] = 16383
    y, x = np.indices(shape)
    mosaic[np.hypot(y - 250, x - 300) < 9] *= 0.2
    grid = find_grid(np.rint(mosaic), cfa="RGGB", dark=400)
    np.testing.assert_allclose(grid.pitch, 24.6, rtol=1e-4)
    assert compare(grid, centres, shape, 24.6) < 0.02


def test_cubic_distortion_is_followed_and_a_straight_grid_is_not_bent():
    shape = (600, 700)
    white, centres = make_white("square", 20.0, 1.0, shape, noise=0.01, bend=0.01)
    grid = find_grid(white)
    assert grid.model == "radial"
    assert compare(grid, centres, shape, 20.0) < 0.02
    straight, _ = make_white("square", 20.0, 1.0, shape, noise=0.03)
    assert find_grid(straight).model == "affine"


def test_array_order_rows_down_columns_right():
    white, _ = make_white("hexagonal", 21.0, 2.0, (300, 360))
    centres = find_grid(white).centres
    assert (np.diff(centres[..., 0], axis=0) > 0.7 * 21 * 0.8).all() and (
        np.diff(centres[..., 1], axis=1) > 0.9 * 21
    ).all()
    # offset rows: two rows down is straight down but for the rotation of 2 degrees
    step = centres[2:] - centres[:-2]
    np.testing.assert_allclose(step[..., 1], -21 * np.sqrt(3) * np.sin(np.radians(2.0)), atol=0.05)


def test_the_light_may_cover_a_part_of_the_sensor():
    white, _ = make_white("square", 18.0, 0.5, (400, 400))
    y, x = np.indices(white.shape)
    lit = np.hypot(y - 250, x - 140) < 120
    grid = find_grid(np.where(lit, white, 400))
    np.testing.assert_allclose(grid.pitch, 18.0, rtol=5e-4)
    assert 100 < grid.valid.sum() < 175


def photograph(name):
    import skimage.data

    image = getattr(skimage.data, name)()
    return image if image.ndim == 2 else image[..., 1]


@pytest.mark.parametrize(
    "image",
    [
        np.random.default_rng(0).normal(100, 10, (500, 600)),
        np.random.default_rng(1).poisson(3.0, (80, 90)),
        np.add.outer(np.arange(300.0), np.arange(400.0)),
        *map(photograph, ("camera", "astronaut", "coins", "brick", "grass", "coffee")),
    ],
    ids=[
        "noise",
        "few photons",
        "ramp",
        "camera",
        "astronaut",
        "coins",
        "brick",
        "grass",
        "coffee",
    ],
)
def test_pictures_without_a_lattice_are_refused_with_what_was_seen(image):
    with pytest.raises(NumericsError, match="no lenslet lattice in the image: .+") as error:
        find_grid(image)
    assert error.value.fix and len(str(error.value)) > 60


@pytest.mark.parametrize("seed", range(6))
def test_a_chart_of_patches_is_no_white_image(seed):
    patches = np.random.default_rng(seed).uniform(0.05, 1, (8, 12))
    chart = np.pad(np.kron(patches, np.pad(np.ones((40, 40)), 6)), 30)
    with pytest.raises(NumericsError, match="no lenslet lattice in the image: .+"):
        find_grid(chart * 1000)


def coded_white(gap, border, levels=(1.0, 0.8, 0.9, 0.6), pitch=24, count=(12, 15)):
    """Superpixels of four quadrants (filters in a square pupil) that tile the frame;

    gap and border: brightness of the dark lines.
    """
    cell = np.kron(np.array(levels).reshape(2, 2), np.ones((pitch // 2, pitch // 2)))
    middle = slice(pitch // 2 - 1, pitch // 2 + 1)
    cell[middle] *= gap
    cell[:, middle] *= gap
    for edge in (0, -1):
        cell[edge] *= border
        cell[:, edge] *= border
    return np.random.default_rng(0).poisson(2000 * np.tile(cell, count)) + 50


@pytest.mark.parametrize("gap, border", [(0.6, 0.3), (0.4, 0.6)])
def test_filters_in_the_pupil_do_not_split_superpixels(gap, border):
    grid = find_grid(coded_white(gap, border))
    np.testing.assert_allclose(grid.pitch, 24, rtol=1e-3)
    assert grid.valid.all() and grid.centres.shape == (12, 15, 2)
    index = np.stack(np.meshgrid(np.arange(12), np.arange(15), indexing="ij"), axis=-1)
    np.testing.assert_allclose(grid.centres, 24 * index + 11.5, atol=0.8)


@pytest.mark.parametrize(
    "pitch, side, blur", [(15.0, 13.1, 0.6), (24.3, 21.0, 0.9), (52.0, 45.4, 2.0)]
)
@pytest.mark.parametrize("light", [(0.4, 0.6, 1.0, 0.45), (1.0, 0.3, 0.5, 0.8)])
def test_filters_of_unlike_brightness_do_not_draw_the_grid_to_the_dimmer(pitch, side, blur, light):
    count, window = (5, 7), int(pitch) + 8
    mean = np.zeros([int(n * pitch) + 12 for n in count])
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    centres = (index + 0.5) * pitch + 5.3
    for centre in centres.reshape(-1, 2):
        first = (
            np.rint(centre - (window - 1) / 2).astype(int).clip(0, np.array(mean.shape) - window)
        )
        cells = superpixels(
            centre - first - (window - 1) / 2,
            pixels=window,
            side=side,
            gap=0.05 * pitch,
            blur=blur,
            fall=0.1,
            pitch=pitch,
        )
        mean[first[0] : first[0] + window, first[1] : first[1] + window] += (
            3000 * cells @ light
        ).reshape(window, window)
    grid = find_grid(np.random.default_rng(1).poisson(mean))
    assert grid.valid.all() and grid.centres.shape == (*count, 2)
    np.testing.assert_allclose(grid.centres.mean(axis=(0, 1)), centres.mean(axis=(0, 1)), atol=0.06)
    np.testing.assert_allclose(grid.centres, centres, atol=0.1)


def test_a_hint_settles_what_the_picture_cannot():
    white = coded_white(0.5, 0.5)[5:-7, 3:-9]  # no frame to tell gaps from borders
    for near in ((30.5, 32.5), (18.5, 20.5)):
        grid = find_grid(white, near=near)
        assert np.hypot(*(grid.centres.reshape(-1, 2) - near).T).min() < 1


def framed_white(count=(7, 10), pitch=52, seed=3):
    """Superpixels of four unlike filters, each with a broad dark frame whose bottom only noise
    ruffles and a narrow dark gap; they fill the frame. Centres: pitch (k + 1/2) - 1/2.
    """
    side = np.abs(np.arange(pitch) - (pitch - 1) / 2)
    part = np.clip(19.5 - side, 0, 1) * np.clip(side - 0.5, 0, 1)
    cell = np.kron([[1.0, 0.7], [0.35, 0.2]], np.ones((pitch // 2,) * 2)) * np.outer(part, part)
    return np.random.default_rng(seed).poisson(4000 * np.tile(cell, count) + 5)


@pytest.mark.parametrize("seed", range(3))
def test_noise_on_the_bottom_of_a_broad_dark_frame_costs_no_row(seed):
    grid = find_grid(framed_white(seed=seed))
    assert grid.valid.all() and grid.valid.shape == (7, 10)
    index = np.stack(np.meshgrid(np.arange(7), np.arange(10), indexing="ij"), axis=-1)
    np.testing.assert_allclose(grid.centres, 52 * index + 25.5, atol=0.1)


def test_lines_that_nothing_tells_from_borders_are_said_and_a_hint_or_a_count_binds():
    white = coded_white(0.5, 0.5)
    with collected_notes() as said:
        find_grid(white[18:277, 18:325])
    assert len(said) == 1 and "4 grids fill the frame alike" in said[0]
    with collected_notes() as said:
        known = find_grid(white[12:-12], count=(10, 15))
    assert not said and known.valid.shape == (10, 15)
    np.testing.assert_allclose(known.centres[0, 0], (23.5, 11.5), atol=0.5)
    with collected_notes() as said:
        find_grid(white, count=(13, 15))
    assert len(said) == 1 and "12 x 15 lenslets are found where 13 x 15 are known" in said[0]
    with pytest.raises(NumericsError, match="no superpixel has its centre near row 31"):
        find_grid(spots_white(), near=(31, 31))


def spots_white():
    """Bright bells 24 px apart, centres at 12 + 24 k."""
    bell = np.exp(-(((np.arange(24) - 12) / 6.0) ** 2))
    return np.random.default_rng(1).poisson(3000 * np.tile(np.outer(bell, bell), (10, 10)))


def test_constant_small_and_broken_images_are_refused():
    with pytest.raises(NumericsError, match="every pixel has the value 7"):
        find_grid(np.full((100, 100), 7))
    with pytest.raises(InputError, match="at least 24"):
        find_grid(np.ones((10, 500)))
    with pytest.raises(InputError, match="finite"):
        find_grid(np.where(np.eye(60) > 0, np.nan, 1.0))


def read(path):
    from skimage import io

    image = io.imread(path)
    return image if image.ndim == 2 else image[..., 0]


def seconds(call):
    """Processor seconds of a call, and its result."""
    start = time.process_time()
    result = call()
    return time.process_time() - start, result


@pytest.mark.parametrize(
    "name, kind, bound, centred",
    [("a", "square", 0.75, True), ("b", "hexagonal", 0.030, False), ("d", "square", 0.010, False)],
)
def test_published_spot_pictures(shared_data, name, kind, bound, centred):
    took, grid = seconds(lambda: find_grid(read(shared_data / f"grid/{name}.png")))
    truth = np.loadtxt(shared_data / f"grid/{name}.txt")
    margin = grid.pitch.max() / 2
    truth = truth[((truth >= margin - 0.5) & (truth <= 719.5 - margin)).all(axis=1)]
    distance, which = cKDTree(grid.centres.reshape(-1, 2)).query(truth)
    miss = grid.centres.reshape(-1, 2)[which] - truth
    assert (
        grid.lattice == kind and len(set(which)) == len(truth) and grid.valid.ravel()[which].all()
    )
    assert (
        np.sqrt(((miss - (miss.mean(axis=0) if centred else 0)) ** 2).sum(axis=1).mean()) <= bound
    )
    if name == "a":  # its first row and column are drawn a pixel off the lattice of the rest
        np.testing.assert_allclose(grid.pitch, 142.857143, rtol=5e-4)
    assert took < 4  # 2 s on an idle core


REAL = {
    "letters": (
        "plenoptic/letters/letters_ULF_M1_white.png",
        "plenoptic/letters/letters_ULF_M1_dark.png",
        (48.2, 48.2273),
        0.05,
        450,
        0.06,
        ("affine",),
    ),
    "guv": (
        "plenoptic/lfm_guv/Radiometry_GUVExperim1.tif",
        "plenoptic/lfm_guv/DarkFrame_GUVExperim1.tif",
        (15.4, 15.4),
        0.03,
        784,
        0.03,
        ("radial", "poly2", "poly3"),
    ),
    "antleg": (
        "plenoptic/lfm_antleg/radiometry_frame.png",
        "plenoptic/lfm_antleg/dark_frame.tif",
        (27.56, 27.55),
        0.02,
        7180,
        0.12,
        ("radial", "poly2", "poly3"),
    ),
}


@pytest.mark.parametrize("name", REAL)
def test_real_cameras(shared_data, name):
    """Residuals over all whole lenslets, none trimmed."""
    white, dark, pitch, bound, least, residual, models = REAL[name]
    white, dark = read(shared_data / white), read(shared_data / dark)
    took, grid = seconds(lambda: find_grid(white, dark=dark))
    assert grid.lattice == "square" and grid.valid.sum() >= least and grid.model in models
    np.testing.assert_allclose(grid.pitch, pitch, atol=bound)
    assert np.isfinite(grid.residual[grid.valid]).all()
    assert np.sqrt(np.mean(grid.residual[grid.valid] ** 2)) <= residual
    assert took < 8  # 4 s on an idle core


def test_a_real_chart_is_refused(shared_data):
    with pytest.raises(NumericsError, match="no lenslet lattice in the image: .+"):
        find_grid(
            read(
                shared_data
                / (
                    "spectra/colorchecker_filtered/multispectral_images/d2_"
                    "colorChecker30cm_dHyper_550nm.tif"
                )
            )
        )


def test_reduction_and_kind():
    basis = np.array([[10.0, 0.3], [-0.3, 10.0]])
    mixed = np.array([[3, 1], [5, 2]]) @ basis
    np.testing.assert_allclose(sorted(np.hypot(*lattice.reduced(mixed).T)), [np.hypot(10, 0.3)] * 2)
    assert lattice.kind_of(mixed) == "square"
    hexagonal = np.array([[0, 7.0], [7 * np.sqrt(3) / 2, 3.5]])
    assert lattice.kind_of(np.array([[2, 1], [1, 1]]) @ hexagonal) == "hexagonal"


def test_array_indices_round_trip():
    index = np.stack(np.meshgrid(np.arange(-5, 6), np.arange(-7, 8), indexing="ij"), axis=-1)
    for kind in ("square", "hexagonal"):
        np.testing.assert_array_equal(
            lattice.from_array(lattice.to_array(index, kind), kind), index
        )


def test_maps_recover_exact_data_and_the_simplest_is_chosen():
    rng = np.random.default_rng(0)
    index = np.stack(np.meshgrid(np.arange(20), np.arange(25), indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    affine = index @ np.array([[10.0, 0.2], [-0.3, 9.8]]) + 40
    perspective = affine / (1 + index @ np.array([1e-4, -2e-4]))[:, None]
    np.testing.assert_allclose(
        distortion.fit_model("homography", index, perspective).at(index), perspective, atol=1e-7
    )
    spoilt = affine.copy()
    spoilt[::17] += 3.0
    np.testing.assert_allclose(
        distortion.fit_model("affine", index, spoilt).at(index), affine, atol=1e-6
    )
    noisy = rng.normal(0, 0.02, affine.shape)
    assert distortion.choose_model(index, affine + noisy)[0].kind == "affine"
    assert distortion.choose_model(index, perspective + noisy)[0].kind == "homography"
    away = perspective - perspective.mean(axis=0) - (5, -8)
    barrel = perspective + 1e-6 * (away**2).sum(axis=1, keepdims=True) * away
    np.testing.assert_allclose(
        distortion.fit_model("radial", index, barrel).at(index), barrel, atol=2e-3
    )
    assert distortion.choose_model(index, barrel + noisy)[0].kind == "radial"


def test_a_border_row_off_the_lattice_does_not_bend_the_map():
    index = np.stack(np.meshgrid(np.arange(9), np.arange(11), indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    true = index @ np.array([[60.0, 1.0], [-1.0, 60.0]]) + 40
    seen = true + np.random.default_rng(0).normal(0, 0.02, true.shape)
    seen[index[:, 0] == 0] += (0.3, 0.0)
    weight = np.where(lattice.surrounded(index, "square"), 1.0, 0.1)
    model = distortion.choose_model(index, seen, weight)[0]
    assert model.kind == "affine"
    np.testing.assert_allclose(model.at(index), true, atol=0.03)
