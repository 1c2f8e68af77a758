"""Superpixels of a hexagonal array, drawn here by formula, in the cells that kernels have."""

import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from plenocli.base.errors import InputError, UsageError
from plenocli.base.tiling import Plane
from plenocli.files.scratch import Scratch
from plenocli.forward.sensor.capture import Capture, Levels, SuperpixelGrid
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.picture import real_light
from plenocli.inverse.volume import superpixels
from plenocli.inverse.volume.superpixels import measured
from tests.reference.calibrations import drawn_calibration, lenslet_grid

COUNT, PITCH, ROWS = (6, 7), 14.0, 13.0
"""Lenslets, px between columns, px between rows: more than 14 sqrt(3)/2, as of long pixels."""


def drawn(centres, shape, values):
    """Discs about the centres, each of its own brightness, evenly blurred at the rim."""
    y, x = np.indices(shape)
    out = np.zeros(shape)
    for (row, column), value in zip(centres.reshape(-1, 2), np.ravel(values)):
        out += value / (1 + np.exp((np.hypot(y - row, x - column) - 5.0) / 0.5))
    return out


@pytest.mark.parametrize("aside", [0, 1], ids=["first row", "first row aside"])
def test_lenslets_come_into_the_cells_of_the_kernels(aside):
    """A row to the right of the one above it is the lower lenslet of a cell."""
    index = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    centres = np.array([12.0, 12.0]) + index * np.array([ROWS, PITCH])
    centres[1 - aside :: 2, :, 1] += PITCH / 2
    shape = (96, 126)
    grid = lenslet_grid(centres, np.array([[ROWS, PITCH / 2], [0.0, PITCH]]), "hexagonal")
    known = drawn_calibration(grid, 200.0 * drawn(centres, shape, np.ones(COUNT)))
    values = np.random.default_rng(3).uniform(0.2, 1, COUNT)
    stack = SimpleNamespace(
        lattice="hexagonal",
        lenslets=2,
        pixel_shape=(26, 14),
        even=lambda: np.ones(26 * 14),
    )
    shot = Capture(mosaic=200.0 * drawn(centres, shape, values))
    found = measured(shot, stack, known)
    assert found.signal.shape == (3 + aside, 7, 26 * 14)
    halves = found.signal.reshape(3 + aside, 7, 2, 13, 14)
    usable = np.isfinite(halves)
    expected = np.pad(values, [(aside, aside), (0, 0)]).reshape(3 + aside, 2, 7)
    for lower in (0, 1):
        seen = halves[:, :, lower, 5:8, 6:8].mean(axis=(2, 3))
        there = expected[:, lower] > 0
        assert np.array_equal(usable[:, :, lower, 6, 7], there)
        assert np.corrcoef(seen[there], expected[:, lower][there])[0, 1] > 0.999
    # the discs stand in the middle of their superpixels
    disc = np.nan_to_num(halves[1, 3, 0])
    assert abs(disc - disc[::-1]).max() < 0.02 * disc.max()


COLOURS = {"R": 0.4, "G": 1.0, "B": 0.6}
"""What pixels of a colour make of white light."""


@pytest.fixture(scope="module")
def in_colour():
    """A colour sensor behind 6x7 lenslets, and lenslets' values of three colours."""
    index = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    centres = np.array([12.3, 12.6]) + index * np.array([13.3, 14.4])
    shape = (96, 126)
    colours = np.tile([["R", "G"], ["G", "B"]], (shape[0] // 2, shape[1] // 2))
    gain = np.vectorize(COLOURS.get)(colours)
    white = 200.0 * drawn(centres, shape, np.ones(COUNT)) * gain
    known = drawn_calibration(lenslet_grid(centres, np.diag([13.3, 14.4])), white, "RGGB")
    rng = np.random.default_rng(3)
    values = {letter: rng.uniform(0.2, 1, COUNT) for letter in COLOURS}
    parts = [drawn(centres, shape, values[c]) * gain * (colours == c) for c in COLOURS]
    shot = Capture(mosaic=200.0 * sum(parts), cfa="RGGB")
    stack = SimpleNamespace(
        lattice="square", lenslets=1, pixel_shape=(13, 14), even=lambda: np.ones(13 * 14)
    )
    return shot, stack, known, values


@pytest.mark.parametrize("letter", COLOURS)
def test_a_colours_pixels_alone_tell_its_light_in_units_of_white(in_colour, letter):
    shot, stack, known, values = in_colour
    found = measured(shot, stack, known, channel=letter)
    whole = measured(replace(shot, cfa="mono"), stack, known)
    share = np.isfinite(found.signal).mean() / np.isfinite(whole.signal).mean()
    assert share == pytest.approx(0.5 if letter == "G" else 0.25, abs=0.03)
    middle = np.zeros((13, 14), bool)
    middle[4:9, 5:9] = True
    seen = np.where(middle.ravel(), found.signal, np.nan)
    assert np.allclose(np.nanmean(seen, axis=2) / values[letter], 0.5, rtol=0.06)
    white = Capture(mosaic=known.white.flat * 200.0 * COLOURS["G"], cfa="RGGB")
    level = [
        np.nanmean(m.signal) for m in (measured(white, stack, known, channel=c) for c in COLOURS)
    ]
    assert np.ptp(level) < 0.02 * level[0]


def test_light_that_no_sensor_reports_is_refused_before_its_squares_overflow(in_colour):
    shot, stack, known, _ = in_colour
    bright = measured(replace(shot, cfa="mono", mosaic=1e6 * shot.mosaic), stack, known)
    assert np.isfinite(bright.signal).any()
    for factor in (1e20, -1e20):
        with pytest.raises(InputError, match="times the light of white"):
            measured(replace(shot, cfa="mono", mosaic=factor * shot.mosaic), stack, known)


def test_channels_that_a_sensor_does_not_have_are_refused(in_colour):
    shot, stack, known, _ = in_colour
    with pytest.raises(UsageError, match="B, G, R"):
        measured(shot, stack, known)
    with pytest.raises(UsageError, match="none"):
        measured(replace(shot, cfa="mono"), stack, known, channel="R")


def test_kernels_of_a_whole_part_of_the_pixels_see_the_means_of_as_many():
    """Lenslets 28 x 42 px apart, in the middle between pixels, kernels of 14 x 14: blocks of 2 x 3
    pixels, averaged here; noise falls with their number.
    """
    index = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    centres = 20.5 + index * np.array([28.0, 42.0])
    centres[..., 1] += 6
    shape = (20 + 28 * COUNT[0], 26 + 42 * COUNT[1])
    grid = lenslet_grid(centres, np.diag([28.0, 42.0]))
    values = np.random.default_rng(3).uniform(0.2, 1, COUNT)
    even = drawn_calibration(grid, np.full(shape, 200.0))
    shot = Capture(
        mosaic=200.0 * drawn(centres, shape, values), noise=Noise(gain=0.5, read_variance=9.0)
    )

    def stack(rows, columns):
        return SimpleNamespace(
            lattice="square",
            lenslets=1,
            pixel_shape=(rows, columns),
            even=lambda: np.ones(rows * columns),
        )

    fine, found = measured(shot, stack(28, 42), even), measured(shot, stack(14, 14), even)
    blocks = fine.signal.reshape(*COUNT, 14, 2, 14, 3).mean(axis=(3, 5))
    assert np.isfinite(found.signal).all()
    assert np.allclose(found.signal.reshape(blocks.shape), blocks, atol=1e-9)
    assert found.gain == pytest.approx(fine.gain / 6)
    assert found.read_variance == pytest.approx(fine.read_variance / 6)
    with pytest.raises(InputError, match="a whole part of it"):
        measured(shot, stack(14, 17), even)


def test_one_colours_pixels_are_taken_as_they_are(in_colour):
    shot, stack, known, _ = in_colour
    half = SimpleNamespace(**{**vars(stack), "pixel_shape": (7, 7), "even": lambda: np.ones(49)})
    with pytest.raises(InputError, match="to the nearest pixel$"):
        measured(shot, half, known, channel="G")


def test_dust_of_the_white_image_is_taken_off_or_left_out():
    """Two spots over lenslets of even light, one lets a fifth through, the other 70 %; the specimen
    lights each lenslet alike.
    """
    index = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    centres, shape = 12.0 + index * np.array([13.0, 13.0]), (90, 103)
    dust = np.ones(shape)
    dust[22:29, 22:29], dust[48:55, 61:68] = 0.2, 0.7
    grid = lenslet_grid(centres, np.diag([13.0, 13.0]))
    stack = SimpleNamespace(
        lattice="square", lenslets=1, pixel_shape=(13, 13), even=lambda: np.ones(169)
    )
    light = drawn(centres, shape, np.ones(COUNT)) + 0.2
    lenslets = light * np.linspace(0.8, 1, shape[1])
    found, clean = (
        measured(
            Capture(mosaic=200 * light * d), stack, drawn_calibration(grid, 200 * lenslets * d)
        )
        for d in (dust, 1.0)
    )
    usable = np.isfinite(found.signal).reshape(*COUNT, 13, 13)
    assert not usable[1, 1, 4:9, 4:9].any() and usable[1, 1, 0].all()
    assert usable[3, 4, 4:9, 4:9].all() and np.isfinite(clean.signal).all()
    rim = np.ones((13, 13), bool)
    rim[2:11, 2:11] = False  # about the spots values between pixels are mixed
    inner = np.zeros((13, 13), bool)
    inner[5:8, 5:8] = True
    ratio = (found.signal / clean.signal).reshape(*COUNT, 13, 13)
    # what all lenslets show together is evened, two spots of 42 lenslets by a fortieth as well
    assert np.allclose(ratio[4, 5], 1, atol=0.04)
    for lenslet, at in (((1, 1), rim), ((3, 4), rim), ((3, 4), inner)):
        assert np.allclose(ratio[lenslet][at], ratio[4, 5][at], rtol=0.04)


def test_pixels_whose_white_is_below_the_dark_level_are_no_dust():
    index = np.stack(np.meshgrid(*map(np.arange, COUNT), indexing="ij"), axis=-1)
    centres = 12.0 + index * np.array([13.0, 13.0])
    light = drawn(centres, (90, 103), np.ones(COUNT))
    known = drawn_calibration(lenslet_grid(centres, np.diag([13.0, 13.0])), 200 * light - 0.5)
    stack = SimpleNamespace(
        lattice="square", lenslets=1, pixel_shape=(13, 13), even=lambda: np.ones(169)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = measured(Capture(mosaic=200 * light), stack, known)
    usable = np.isfinite(found.signal).reshape(*COUNT, 13, 13)
    assert usable[..., 6, 6].all() and not usable[..., 0, 0].any()


@pytest.mark.parametrize("kind", ["square", "tells its noise", "hexagonal", "tiles"])
@pytest.mark.parametrize("channel", [None, "G"])
def test_superpixels_in_bands_are_those_of_all_at_once(kind, channel, monkeypatch, tmp_path):
    """A few lenslets at a time, of a mosaic, a white and a dark image that are read in windows, put
    into a file; with dust, a lenslet that does not count, and pixels that are saturated.
    """
    rng, count = np.random.default_rng(8), (20, 8)
    hexagonal, tiles = kind == "hexagonal", kind == "tiles"
    index = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    centres = np.array([12.3, 12.6]) + index * np.array([13.0, 14.0] if hexagonal else [14.2, 14.4])
    centres[::2, :, 1] += 7.0 * hexagonal  # the first row aside
    shape = (280, 112) if tiles else (310, 146)
    light = drawn(centres, shape, rng.uniform(0.2, 1, count)) + rng.normal(0, 0.01, shape)
    white = 200 * drawn(centres, shape, np.ones(count)) + rng.normal(0, 0.5, shape)
    white[200:207, 60:66] *= 0.3
    mosaic = np.rint(200 * light + 20).astype(np.float32)
    mosaic[100:104, 40:44] = 999
    colour = "mono" if channel is None else "RGGB"
    shot = Capture(
        mosaic=mosaic,
        cfa=colour,
        levels=Levels(black=np.array([[20.0, 21.0], [19.0, 20.0]]), white=900.0),
        noise=Noise(gain=0.5, read_variance=9.0) if kind == "tells its noise" else None,
        grid=SuperpixelGrid(shape=(14, 14), count=count) if tiles else None,
    )
    basis = [[13.0, 7.0], [0.0, 14.0]] if hexagonal else np.diag([14.2, 14.4])
    grid = lenslet_grid(centres, np.array(basis), "hexagonal" if hexagonal else "square")
    known = None if tiles else drawn_calibration(grid, white, colour)
    grid.valid[3, 5] = False
    stack = SimpleNamespace(
        lattice="hexagonal" if hexagonal else "square",
        lenslets=1 + hexagonal,
        pixel_shape=(26 if hexagonal else 14, 14),
        even=lambda: np.ones(14 * (26 if hexagonal else 14)),
    )
    whole = measured(shot, stack, known, channel=channel)
    monkeypatch.setattr(superpixels, "AT_ONCE", 3500)
    monkeypatch.setattr(real_light, "MARGIN", 40)
    monkeypatch.setattr(real_light, "MEDIANS", 3000)
    monkeypatch.setattr("plenocli.base.tiling.BAND", 3500)
    reads = []

    def in_file(image):
        def read(rows, columns):
            reads.append(image[rows].shape[0])
            return image[rows, columns]

        return Plane(image.shape, read)

    if known is not None:
        flat, dark = in_file(known.white.flat), replace(known.dark, mean=in_file(known.dark.mean))
        known = replace(known, white=replace(known.white, flat=flat), dark=dark)
    stored = replace(shot, mosaic=in_file(mosaic))
    found = measured(stored, stack, known, channel=channel, room=Scratch(tmp_path / "v.h5"))
    assert max(reads) < shape[0] / 2
    signal = found.signal.whole()
    assert np.isfinite(whole.signal).mean() > (0.15 if channel else 0.4)
    np.testing.assert_allclose(signal, whole.signal, atol=2e-6, rtol=2e-6)
    assert found.gain == pytest.approx(whole.gain, rel=1e-6)
    assert found.read_variance == pytest.approx(whole.read_variance, rel=1e-6)
