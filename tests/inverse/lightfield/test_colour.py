"""Light fields in colour, against three monochrome captures through the filters, traced ray by ray,
and against spectra whose bands are views.
"""

import numpy as np
import pytest

from plenocli.base.errors import InputError
from plenocli.forward.sensor.capture import Capture, SuperpixelGrid
from plenocli.forward.sensor.cfa import ColourProfile, cfa_map, colour_planes, preview
from plenocli.inverse.calibration.calibration import Calibration, Response, Sensor, White, Windows
from plenocli.inverse.lightfield.depth import depth
from plenocli.inverse.lightfield.gather import bands_of, samples_of, samples_of_spectra
from plenocli.inverse.lightfield.light_field import refocused
from plenocli.inverse.lightfield.planes import slope_of
from plenocli.inverse.lightfield.refocus import STEP
from plenocli.inverse.lightfield.samples import SampleBands
from tests.reference.calibrations import lenslet_grid

FOCAL, IMAGE, GAP, COUNT = 0.05, 0.055, 0.5e-3, 25
PITCH = 55e-6  # of the lenslets, m
INK, PAPER = (0.75, 0.2, 0.1), (0.1, 0.5, 0.8)  # of the two sides of the edge, in R, G, B


def edge(x, y, angle=8.0):
    """(row, column, 3) a slanted edge between two colours, x and y in lenslet pitches."""
    turned = np.deg2rad(angle)
    inked = (x * np.cos(turned) + y * np.sin(turned) > 0.3)[..., None]
    return np.where(inked, INK, PAPER)


def seen(distance, scene, pixels, fine=3):
    """What each pixel would see through each of three filters (row, column, 3): rays through the
    lenslets' centres to the object, `fine` x `fine` to a pixel, of which a mosaic keeps one.
    """
    pixel = PITCH * (1 + GAP / IMAGE) / pixels
    side = COUNT * pixels * fine
    place = ((np.arange(side) + 0.5) / fine - COUNT * pixels / 2) * pixel
    lenslet = (np.arange(side) // (pixels * fine) - (COUNT - 1) / 2) * PITCH
    lens = lenslet - (place - lenslet) * IMAGE / GAP
    direction = (lenslet - lens) / IMAGE + lens / FOCAL
    at = -(lens - direction * distance) * IMAGE / distance / PITCH
    y, x = np.meshgrid(at, at, indexing="ij")
    return scene(x, y).reshape(COUNT * pixels, fine, COUNT * pixels, fine, -1).mean(axis=(1, 3))


def known_camera(pixels, cfa, white, **more):
    """Its calibration: the grid and a round white image (row, column)."""
    places = (np.arange(COUNT) + 0.5) * pixels - 0.5
    centres = np.stack(np.meshgrid(places, places, indexing="ij"), axis=-1)
    grid = lenslet_grid(centres, pixels * np.eye(2))
    white = White(level=np.ones((COUNT, COUNT)), flat=white.astype(np.float32))
    return Calibration(grid=grid, sensor=Sensor(cfa=cfa), white=white, **more)


def chain(mosaic, pixels, cfa, white, slopes):
    camera = known_camera(pixels, cfa, white)
    return refocused(bands_of(Capture(mosaic=mosaic, cfa=cfa), camera), slopes, views=3)


@pytest.mark.parametrize("pixels, cfa", [(11, "RGGB"), (12, "GBRG"), (14, "BGGR")])
@pytest.mark.parametrize("distance", [0.55, 0.5, 0.62])
def test_a_slanted_edge_has_the_colours_of_three_monochrome_captures(pixels, cfa, distance):
    """In its own plane; gains of the colours differ by six, as those of sensors do."""
    gains, slope = np.array([0.4, 1.0, 0.17]), slope_of(distance, FOCAL, IMAGE, GAP)
    light = seen(distance, edge, pixels)
    rows, columns = np.indices(light.shape[:2])
    middle = (pixels - 1) / 2
    round_ = np.hypot(rows % pixels - middle, columns % pixels - middle) <= 0.45 * pixels
    colour = cfa_map(light.shape[:2], cfa)
    own = np.stack([colour == letter for letter in "RGB"], axis=-1)
    mosaic = (light * gains * own).sum(-1) * round_
    found = chain(mosaic, pixels, cfa, (own * gains).sum(-1) * round_, np.array([slope]))
    alone = [
        chain(light[..., k] * round_, pixels, "mono", round_, np.array([slope])).pictures[0]
        for k in range(3)
    ]
    inner = slice(5 * STEP, -5 * STEP)
    off = (found.colours.pictures[0] - np.stack(alone))[:, inner, inner]
    assert np.sqrt(np.mean(off**2)) < 0.02 * np.mean(alone)
    assert np.abs(off).max() < 0.1
    # both sides have their colours, and the grey picture is their mean
    left, right = found.colours.pictures[0][:, 50, [24, 76]].T
    assert np.abs(left - PAPER).max() < 0.005 and np.abs(right - INK).max() < 0.005
    assert np.allclose(found.pictures[0], found.colours.pictures[0].mean(axis=0), equal_nan=True)


def waves(x, y, seed=5):
    """(row, column, 3) a picture of waves, whose colours are not alike."""
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-0.13, 0.13, (5, 2))
    tints = rng.uniform(0.03, 0.12, (5, 1, 1, 3))
    phase = rng.uniform(0, 7, 5)
    parts = [
        t * np.sin(2 * np.pi * (a * x + b * y) + p)[..., None]
        for (a, b), t, p in zip(turns, tints, phase)
    ]
    return 0.45 + sum(parts)


@pytest.mark.parametrize("distance", [0.5, 0.6])
def test_depth_of_a_colour_mosaic_is_that_of_the_plane(distance):
    gains, slope, pixels = np.array([0.4, 1.0, 0.17]), slope_of(distance, FOCAL, IMAGE, GAP), 12
    light = seen(distance, waves, pixels, fine=2)
    own = np.stack([cfa_map(light.shape[:2], "RGGB") == c for c in "RGB"], axis=-1)
    mosaic = (light * gains * own).sum(-1)
    mosaic = mosaic + 0.003 * np.random.default_rng(1).normal(size=mosaic.shape)
    source = bands_of(
        Capture(mosaic=mosaic, cfa="RGGB"), known_camera(pixels, "RGGB", (own * gains).sum(-1))
    )
    found = depth(source, np.linspace(-4, 4, 17)).slope[4:-4, 4:-4]
    assert np.isfinite(found).mean() > 0.8
    assert np.nanpercentile(np.abs(found - slope), 90) < 0.3


@pytest.mark.parametrize("slope", [-1.2, 0.8, 2.1])
def test_bands_of_spectra_meet_in_their_plane_and_tell_its_depth(slope):
    """Each band of a lenslet at c is what stands at c + slope q, q the middle of its filter."""
    pixels, count = 12, 4
    bands = np.array([450e-9, 540e-9, 570e-9, 650e-9])
    quarter = np.kron(np.arange(4).reshape(2, 2), np.ones((6, 6))).ravel()
    response = (quarter[:, None] == np.arange(count)) * np.array([0.3, 1.0, 0.9, 0.5])
    corner = np.stack(np.meshgrid(*2 * [np.arange(COUNT) * pixels], indexing="ij"), axis=-1)
    camera = known_camera(
        pixels,
        "mono",
        np.ones((COUNT * pixels, COUNT * pixels)),
        windows=Windows(corner, (pixels, pixels)),
        response=Response(matrix=response, variance=None, wavelengths=bands),
    )
    middle = np.array([[-3, -3], [-3, 3], [3, -3], [3, 3]]) / pixels  # pitches
    at = np.arange(COUNT, dtype=float)
    own = []
    for band, (down, right) in enumerate(middle):
        y, x = np.meshgrid(at + slope * down, at + slope * right, indexing="ij")
        picture = waves(x, y)
        own.append((1 - band / 3) * picture[..., 2] + band / 3 * picture[..., 0])
    values = np.array(own) + 0.002 * np.random.default_rng(2).normal(size=(count, COUNT, COUNT))
    samples, shape = samples_of_spectra(values, bands, camera)
    field = refocused(SampleBands.of(samples, shape), np.linspace(-4, 4, 17), views=2)
    assert field.colours.channels.names == ("450 nm", "540 nm", "570 nm", "650 nm")
    inner, sure = field.depth.slope[4:-4, 4:-4], field.depth.confidence[4:-4, 4:-4] > 0.5
    assert sure.mean() > 0.5 and np.abs(np.median(inner[sure]) - slope) < 0.15
    # each view has one band only, where the pupil has its filter
    known = np.isfinite(field.colours.views[..., 12, 12])
    assert known.sum() == 4 and known.any(axis=(0, 1)).all()


def test_a_preview_has_the_colours_of_the_screen():
    """Camera colours that are known mixtures of sRGB come back, white white."""
    mix = np.array([[0.8, 0.15, 0.05], [0.2, 0.7, 0.1], [0.02, 0.18, 0.8]])
    neutral = np.array([0.5, 1.0, 0.25])
    true = np.array([[1.0, 1.0, 1.0], [0.8, 0.1, 0.1], [0.1, 0.7, 0.2], [0.2, 0.2, 0.9]])
    patches = np.kron(true.reshape(2, 2, 3), np.ones((8, 8, 1)))
    own = patches @ mix.T * neutral
    colour = cfa_map((16, 16), "GRBG")
    mosaic = sum(np.where(colour == c, own[..., k], 0.0) for k, c in enumerate("RGB"))
    profile = ColourProfile(to_rgb=np.linalg.inv(mix), neutral=neutral)
    found = preview(colour_planes(mosaic, "GRBG"), profile)
    assert found.shape == (8, 8, 3)
    assert np.allclose(found[::4, ::4].reshape(4, 3), true, atol=1e-9)


def test_a_mosaic_without_a_calibration_is_refused_or_grey_on_the_whole():
    """A simulated capture tells its tiles; of odd sides each colour has every place in turn."""
    light = np.array([0.9, 0.5, 0.2])
    colour = cfa_map((55, 55), "RGGB")
    mosaic = sum(np.where(colour == c, light[k], 0.0) for k, c in enumerate("RGB"))
    shot = Capture(mosaic=mosaic, cfa="RGGB", grid=SuperpixelGrid.tiled((5, 5), (11, 11)))
    samples, shape = samples_of(shot)
    assert shape == (5, 5) and np.allclose(samples.value, 1.0)
    assert np.allclose(samples.channels.weights.sum(), 1)
    counts = [some.sum() for some in samples.parts()]
    assert counts[1] > 1.9 * counts[0] and min(counts) > 0


def test_captures_of_another_sensor_or_of_another_unit_are_refused():
    white = np.ones((COUNT * 11, COUNT * 11))
    with pytest.raises(InputError, match="is 20 x 30 px, the calibration 275 x 275"):
        bands_of(Capture(mosaic=np.ones((20, 30))), known_camera(11, "mono", white))
    for far in (1e25, -1e25):
        with pytest.raises(InputError, match="times the light of white"):
            chain(far * white, 11, "mono", white, np.array([0.0]))
