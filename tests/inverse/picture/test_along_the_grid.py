"""Superpixels along the grid of a calibration, worked out in bands of lenslets that stay in a file:
those of one piece, and what a white object at half its brightness must give.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import plenocli.inverse.picture.superpixels as superpixels
from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane
from plenocli.files.scratch import Scratch
from plenocli.forward.sensor.capture import Capture, Levels
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import Calibration, Sensor, White, Windows
from plenocli.inverse.picture.superpixels import AlongTheGrid, along_the_grid
from tests.reference.calibrations import lenslet_grid

SIDE, ROWS, COLUMNS, FRAME = 9, 31, 22, 5
SHAPE = (ROWS * SIDE + 2 * FRAME, COLUMNS * SIDE + 2 * FRAME)
DEAD, CLIPPED = (3, 4), (20, 6)


@pytest.fixture(scope="module")
def made():
    """(capture of an even object at half of white, calibration, matrix, even light): every lenslet
    has a brightness and a vignetting of its own, and the same dust of 4 % on one pixel.
    """
    rng = np.random.default_rng(3)
    y, x = np.meshgrid(*[np.linspace(-1, 1, SIDE)] * 2, indexing="ij")
    even = np.exp(-0.5 * (x**2 + y**2)).ravel()
    tilt = 0.15 * rng.standard_normal((ROWS, COLUMNS, 2))
    fall = 1 + tilt[..., :1] * y.ravel() + tilt[..., 1:] * x.ravel()
    fall[..., 40] *= 0.96
    white = (rng.uniform(600, 900, (ROWS, COLUMNS, 1)) * even * fall).astype(np.float32)
    corners = FRAME + SIDE * np.stack(np.indices((ROWS, COLUMNS)), axis=-1)
    dark = (100 + rng.uniform(0, 3, SHAPE)).astype(np.float32)
    image = dark.astype(float)
    for place in np.ndindex(ROWS, COLUMNS):
        row, column = corners[place]
        own = white[place].reshape(SIDE, SIDE) / 2
        image[row : row + SIDE, column : column + SIDE] += own
    row, column = corners[CLIPPED]
    image[row + 2, column + 3] = 5000
    grid = lenslet_grid(corners + (SIDE - 1) / 2, SIDE * np.eye(2))
    grid.valid[DEAD] = False
    calibration = Calibration(
        grid=grid,
        sensor=Sensor(white_level=4095.0),
        windows=Windows(corners, (SIDE, SIDE)),
        white=White(white),
        dark=Dark(mean=dark, black=np.full((2, 2), 100.0), exposure=None, sigma=2.0),
    )
    levels = Levels(black=np.array([[100.0, 101.0], [102.0, 103.0]]), white=4095.0)
    blocks = even[None, :, None] * np.ones(4) / 4
    system = SimpleNamespace(own=blocks[0], blocks=blocks, pixel_shape=(SIDE, SIDE))
    return Capture(mosaic=image, levels=levels), calibration, system, even


def test_a_white_object_at_half_its_brightness_is_half_the_even_light(made):
    capture, calibration, system, even = made
    data = AlongTheGrid(capture, system, calibration, None).cut(slice(None), slice(None))
    assert np.isnan(data.y[DEAD]).all() and not data.saturated[DEAD].any()
    assert np.argwhere(data.saturated).tolist() == [[*CLIPPED, 2 * SIDE + 3]]
    known = calibration.grid.valid[..., None] & ~data.saturated
    off = np.where(known, data.y / (even / 2) - 1, 0)
    assert np.isnan(off).mean() < 1e-3 and np.sqrt(np.nanmean(off**2)) < 1e-3
    assert np.nanquantile(np.abs(off), 0.999) < 5e-3


@pytest.mark.parametrize("lenslet_rows", [1, 4, 30])
def test_bands_in_a_file_are_those_of_one_piece(made, tmp_path, monkeypatch, lenslet_rows):
    capture, calibration, system, _ = made
    whole = AlongTheGrid(capture, system, calibration, None).cut(slice(None), slice(None))
    monkeypatch.setattr(superpixels, "AT_ONCE", lenslet_rows * COLUMNS * SIDE**2)
    most = []

    def read(rows, columns):
        most.append(rows.indices(SHAPE[0])[1] - rows.indices(SHAPE[0])[0])
        return capture.mosaic[rows, columns]

    stays = replace(capture, mosaic=Plane(SHAPE, read))
    room = Scratch(tmp_path / "out.h5")
    parts = AlongTheGrid(stays, system, calibration, None, room)
    assert parts.count == (ROWS, COLUMNS) and max(most) <= lenslet_rows * SIDE
    for rows, columns in (
        (slice(None), slice(None)),
        (slice(2, 9), slice(3, 22)),
        (slice(30, 31), slice(0, 1)),
    ):
        cut = parts.cut(rows, columns, (slice(0, 1), slice(0, 1)))
        np.testing.assert_allclose(cut.y, whole.y[rows, columns], rtol=1e-12)
        np.testing.assert_array_equal(cut.saturated, whole.saturated[rows, columns])
        assert cut.own == (slice(0, 1), slice(0, 1))


def test_colours_and_other_windows_are_refused(made):
    capture, calibration, system, _ = made
    with pytest.raises(InputError, match="has the colour filter array RGGB"):
        along_the_grid(replace(capture, cfa="RGGB"), system, calibration)
    small = SimpleNamespace(own=np.ones((25, 4)), blocks=np.ones((1, 25, 4)), pixel_shape=(5, 5))
    with pytest.raises(InputError, match="holds windows of 81 pixels, the system matrix 25"):
        AlongTheGrid(capture, small, calibration, "c.h5")
