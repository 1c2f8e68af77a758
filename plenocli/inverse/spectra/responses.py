"""The responses of all lenslets as one capture meets them: as calibrated, moved since then, or with
stray light as further bands.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.tiling import bands
from plenocli.inverse.calibration.calibration import Calibration, MadeResponses, there

if TYPE_CHECKING:
    from plenocli.forward.sensor.frames import Dark
    from plenocli.forward.sensor.readout import DarkWindows
    from plenocli.inverse.registration.reference import Reference
    from plenocli.inverse.spectra.factored import FactoredResponses

LIT = 1024
"""Lenslets whose white tells the light."""
SAMPLE = 256
"""Lenslets on which methods are compared."""
BATCH_NUMBERS = 1_000_000
"""Numbers of responses that are made at a time."""


@dataclass(frozen=True, kw_only=True)
class LensletResponses:
    """Responses of the lenslets, and what follows from them once for all captures.

    calibration: of the camera, with windows, dark and response.
    response: F, (lenslet_row, lenslet_column, pixel, band), or (pixel, band) for all lenslets.
    variance: (pixel, band) of its entries; None: unknown.
    origin: (lenslet_row, lenslet_column, 2), first pixels of the windows that F belongs to.
    threads: for factoring it.
    several: whether many captures follow, for which factors, and dark levels cut out, are kept.
    """

    calibration: Calibration
    response: np.ndarray | MadeResponses
    variance: np.ndarray | None
    origin: np.ndarray
    threads: int = 1
    several: bool = True

    @classmethod
    def of(
        cls, calibration: Calibration, threads: int = 1, several: bool = True
    ) -> LensletResponses:
        """The responses as they were calibrated."""
        response = there(calibration.response)
        return cls(
            calibration=calibration,
            response=response.matrix,
            variance=response.variance,
            origin=there(calibration.windows).origin,
            threads=threads,
            several=several,
        )

    @property
    def wavelengths(self) -> np.ndarray:
        """Of the bands, (band,) m."""
        return there(self.calibration.response).wavelengths

    @property
    def states(self) -> np.ndarray | None:
        """Polarisation of the light of the bands, (band,) degrees, as Response has it."""
        return there(self.calibration.response).states

    @property
    def window(self) -> tuple[int, int]:
        """Rows and columns of a superpixel, px."""
        return there(self.calibration.windows).shape

    @property
    def centres(self) -> np.ndarray:
        """Of the superpixels when they were calibrated, (lenslet_row, lenslet_column, 2) px."""
        return self.calibration.grid.centres

    @property
    def valid(self) -> np.ndarray:
        """Which lenslets can be used, (lenslet_row, lenslet_column)."""
        return self.calibration.grid.valid

    @property
    def dark(self) -> Dark:
        """What the sensor reports without light."""
        return there(self.calibration.dark)

    @property
    def cfa(self) -> str:
        """ "mono" or the four letters of the colour filter array."""
        return self.calibration.sensor.cfa

    @property
    def predicted(self) -> bool:
        """Whether F comes from a description of the camera, not from captures."""
        return there(self.calibration.response).predicted

    @property
    def shared(self) -> bool:
        """Whether one F serves all lenslets."""
        return self.response.ndim == 2

    @property
    def common(self) -> np.ndarray:
        """The one F (pixel, band) of all lenslets.

        Raises ValueError where each has its own, which is a mistake of the caller.
        """
        if not isinstance(self.response, np.ndarray) or not self.shared:
            raise ValueError("every lenslet has responses of its own")
        return self.response

    def at(self, places: tuple[np.ndarray, ...]) -> np.ndarray:
        """F (lenslet, pixel, band) of lenslets by their rows and columns; (pixel, band) where one
        serves all.
        """
        if self.shared:
            return self.common
        if isinstance(self.response, np.ndarray):
            return self.response[places]
        found = np.empty((len(places[0]), *self.response.shape[-2:]), np.float32)
        for part in bands(len(found), BATCH_NUMBERS // math.prod(found.shape[1:])):
            found[part] = self.response[tuple(place[part] for place in places)]
        return found

    @property
    def passing(self) -> bool:
        """Whether the factors of F are made tile by tile, for one capture, and not kept."""
        return not isinstance(self.response, np.ndarray) or not (self.several or self.shared)

    @cached_property
    def sites(self) -> tuple[np.ndarray, ...]:
        """Row and column indices of the valid lenslets, which results below are ordered by."""
        return np.nonzero(self.valid)

    @cached_property
    def corners(self) -> np.ndarray:
        """First pixels (lenslet, 2) of the valid lenslets' windows."""
        return self.origin[self.sites]

    @cached_property
    def levels(self) -> DarkWindows | None:
        """Dark levels under the windows, None where they are black levels alone, some window is
        not on the sensor, or one capture alone would use them.
        """
        from plenocli.forward.sensor.readout import DarkWindows
        from plenocli.forward.sensor.superpixel import inside

        if not self.several or not isinstance(self.dark.mean, np.ndarray) or self.dark.flat:
            return None
        if not inside(self.corners, self.window, self.dark.mean.shape).all():
            return None
        return DarkWindows(self.dark, self.corners, self.window).keep()

    @cached_property
    def factored(self) -> FactoredResponses:
        """F = Q R of the valid lenslets."""
        from plenocli.inverse.spectra.factored import factor

        return factor(self.response, None if self.shared else self.sites, self.threads)

    @cached_property
    def reference(self) -> Reference:
        """What registration needs of these responses."""
        from plenocli.inverse.registration.reference import Reference

        origin = np.where(self.valid[..., None], self.origin, -(2**20))
        return Reference(
            self.response,
            origin,
            self.window,
            self.centres,
            self.cfa,
            self.dark.mean.shape,
            self.variance,
        )

    @cached_property
    def sample(self) -> np.ndarray:
        """Indices of lenslets all over the array, enough to compare methods on."""
        return np.unique(
            np.linspace(0, len(self.sites[0]) - 1, min(len(self.sites[0]), SAMPLE)).astype(int)
        )

    def some(self, which: np.ndarray | slice) -> FactoredResponses:
        """F = Q R of lenslets by their index among the valid ones."""
        from plenocli.inverse.spectra.factored import factor

        if not self.passing:
            return self.factored.some(which)
        return factor(self.at(tuple(site[which] for site in self.sites)))

    @cached_property
    def sampled(self) -> FactoredResponses:
        """`some` of the sample."""
        from plenocli.inverse.spectra.factored import factor

        return factor(self.sampled_response) if self.passing else self.some(self.sample)

    @cached_property
    def sampled_response(self) -> np.ndarray:
        """`at` of the sample."""
        return self.at(tuple(site[self.sample] for site in self.sites))

    @cached_property
    def typical(self) -> np.ndarray:
        """F (pixel, band) of all lenslets, or the mean of the sample's own."""
        from plenocli.inverse.calibration.quality import mean_of_known

        return self.common if self.shared else mean_of_known(self.sampled_response)

    @cached_property
    def brightest(self) -> float:
        """What the brightest pixel of a typical superpixel shows of a white of radiance 1."""
        return float(np.nansum(np.clip(self.typical, 0, None), axis=1).max())

    @cached_property
    def sampled_pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """`pixels` of the sample."""
        return _pixels(self.sampled_response[None] if self.shared else self.sampled_response)

    @property
    def white_light(self) -> np.ndarray | None:
        """Radiance (band,) of the calibration's white, None where it has no light in some band."""
        from plenocli.inverse.spectra.demultiplex import demultiplex

        white = there(there(self.calibration.white).superpixels)
        some = tuple(part[:: max(1, len(part) // LIT)] for part in self.sites)
        if white.ndim > 1:
            white = white[some]
        light: np.ndarray = demultiplex(self.at(some), white, "pinv")[0]
        light = light.reshape(-1, len(self.wavelengths))
        light = light[np.isfinite(light).all(axis=1)]
        light = np.median(light, axis=0) if len(light) else np.zeros(1)
        return light if (light > 0).all() else None

    def pixels(self, which: np.ndarray | slice) -> tuple[np.ndarray, np.ndarray]:
        """What single-pixel extraction takes.

        which: lenslets, by their index among the valid ones.

        Returns the pixel of each band (lenslet or 1, band), and F there (lenslet or 1, pixel's
        band, band).
        """
        if self.shared:
            return _pixels(self.common[None])
        places = tuple(site[which] for site in self.sites)
        step = max(1, BATCH_NUMBERS // int(np.prod(self.response.shape[-2:])))
        found = [
            _pixels(self.at(tuple(p[part] for p in places))) for part in bands(len(places[0]), step)
        ]
        chosen, there = zip(*found)
        return np.concatenate(chosen), np.concatenate(there)

    def prepare(self) -> LensletResponses:
        """Make now what all captures need and several threads would make at
        once; returns itself.
        """
        _ = self.levels, self.reference.gains
        return self


def _pixels(f: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """LensletResponses.pixels of F (lenslet, pixel, band)."""
    from plenocli.inverse.spectra.demultiplex import choose_pixels

    pixels = choose_pixels(f)
    return pixels, np.take_along_axis(f, pixels[..., None], axis=-2).astype(float)
