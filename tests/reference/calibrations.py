"""Calibrations built from arrays alone, for tests that need no captures."""

import numpy as np

from plenocli.inverse.calibration.calibration import Calibration, Response, Sensor, White, Windows
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
