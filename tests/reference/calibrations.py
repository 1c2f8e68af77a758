"""Calibrations built from arrays alone, for tests that need no captures."""

import numpy as np

from plenocli.forward.sensor.frames import Dark
from plenocli.inverse.calibration.calibration import (
    Calibration,
    Response,
    Sensor,
    White,
    Windows,
    windows_on,
)
from plenocli.inverse.grid.lenslet_grid import LensletGrid
from plenocli.inverse.spectra.responses import LensletResponses


def lenslet_responses(response, wavelengths, valid, **known):
    """LensletResponses of F; known: centres, origin, window, white, dark, cfa, gain and
    read_variance.
    """
    grid = LensletGrid(
        lattice="square",
        pitch=np.full(2, np.nan),
        angle=0.0,
        basis=np.full((2, 2), np.nan),
        model="",
        centres=known.get("centres"),
        valid=valid,
        residual=None,
        rms=np.nan,
    )
    return LensletResponses.of(
        Calibration(
            grid=grid,
            sensor=Sensor(
                cfa=known.get("cfa", "mono"),
                gain_e_per_dn=1 / known.get("gain", 0.25),
                read_noise=np.sqrt(known.get("read_variance", 1.0)),
            ),
            windows=Windows(known.get("origin"), known.get("window")),
            white=White(known.get("white")),
            dark=known.get("dark"),
            response=Response(matrix=response, variance=None, wavelengths=wavelengths),
        )
    )


def lenslet_grid(centres, basis, lattice="square"):
    """An affine grid whose lenslets are all there: centres (row, column, 2), basis vectors as
    columns, px.
    """
    return LensletGrid(
        lattice=lattice,
        pitch=np.linalg.norm(basis, axis=1),
        angle=0.0,
        basis=basis,
        model="affine",
        centres=centres,
        valid=np.ones(centres.shape[:2], bool),
        residual=None,
        rms=0.0,
    )


def drawn_calibration(grid, white, cfa="mono"):
    """Of a white image (row, column) that was drawn, without a dark level."""
    windows, valid = windows_on(grid, white.shape)
    assert valid.all()
    return Calibration(
        grid=grid,
        sensor=Sensor(read_noise=0.1, cfa=cfa),
        windows=windows,
        white=White.measured(white, windows, valid),
        dark=Dark(mean=np.zeros(white.shape), black=np.zeros((2, 2)), exposure=None, sigma=0.1),
    )
