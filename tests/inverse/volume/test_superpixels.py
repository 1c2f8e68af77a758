"""Superpixels of a hexagonal array, drawn here by formula, in the cells that kernels have."""

from types import SimpleNamespace

import numpy as np
import pytest

from plenocli.forward.sensor.capture import Capture
from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import Calibration, Sensor, White, windows_on
from plenocli.inverse.grid.lenslet_grid import LensletGrid
from plenocli.inverse.volume.superpixels import measured

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
    grid = LensletGrid(
        lattice="hexagonal",
        pitch=np.array([np.hypot(ROWS, PITCH / 2), PITCH]),
        angle=0.0,
        basis=np.array([[ROWS, PITCH / 2], [0.0, PITCH]]),
        model="affine",
        centres=centres,
        valid=np.ones(COUNT, bool),
        residual=None,
        rms=0.0,
    )
    windows, valid = windows_on(grid, shape)
    known = Calibration(
        grid=grid,
        sensor=Sensor(read_noise=0.1),
        windows=windows,
        white=White.measured(200.0 * drawn(centres, shape, np.ones(COUNT)), windows, valid),
        dark=Dark(mean=np.zeros(shape), black=np.zeros((2, 2)), exposure=None, sigma=0.1),
    )
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
    usable = found.usable.reshape(halves.shape)
    expected = np.pad(values, [(aside, aside), (0, 0)]).reshape(3 + aside, 2, 7)
    for lower in (0, 1):
        seen = halves[:, :, lower, 5:8, 6:8].mean(axis=(2, 3))
        there = expected[:, lower] > 0
        assert np.array_equal(usable[:, :, lower, 6, 7], there)
        assert np.corrcoef(seen[there], expected[:, lower][there])[0, 1] > 0.999
    # the discs stand in the middle of their superpixels
    disc = halves[1, 3, 0]
    assert abs(disc - disc[::-1]).max() < 0.02 * disc.max()
