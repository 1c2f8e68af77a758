"""The detector: photo-electrons to digital numbers, by the linear model of EMVA Standard 1288."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.random_streams import stream
from plenocli.forward.sensor.noise import Noise

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.sensor import Sensor

ROUNDING = 1 / 12
"""Variance that rounding to whole numbers adds, DN^2."""
REFERENCE_TEMPERATURE = 298.15
"""K at which a description gives the dark current."""
DOUBLING = 7.0
"""K by which silicon's dark current doubles where a description does not say."""
HOT_CURRENT = 1000.0
"""Dark current of hot pixels where a description does not say, electrons a second."""


@dataclass(frozen=True, kw_only=True)
class PixelPattern:
    """What is fixed about the pixels of one sensor.

    response: (row, column) sensitivity, 1 in the mean (PRNU).
    offset: (row, column) electrons without light and time, 0 in the mean (DSNU).
    dark_current: (row, column) electrons a second, of hot pixels too.
    """

    response: np.ndarray
    offset: np.ndarray
    dark_current: np.ndarray


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Electrons to digital numbers: mean(DN) = black_level + gain * electrons below saturation.

    gain: K, DN per electron.
    read_noise: sigma_d, electrons.
    full_well: electrons.
    bits: of the converter.
    black_level: DN.
    dark_current: electrons a second and pixel at the sensor's temperature, in the mean.
    dsnu: standard deviation over the pixels of the electrons without light and time.
    prnu: standard deviation over the pixels of their sensitivity, relative.
    hot_pixels: share of the pixels.
    hot_current: their dark current, electrons a second in the mean; it is spread exponentially.
    crosstalk: share of a pixel's electrons that its four neighbours collect together.
    black_drift: standard deviation from frame to frame of the black level, DN.
    serial: which sensor of this kind: the seed of what is fixed about its pixels.
    EMVA Standard 1288, release 4.0, linear model.
    """

    gain: float
    read_noise: float
    full_well: float
    bits: int
    black_level: float = 0.0
    dark_current: float = 0.0
    dsnu: float = 0.0
    prnu: float = 0.0
    hot_pixels: float = 0.0
    hot_current: float = 0.0
    crosstalk: float = 0.0
    black_drift: float = 0.0
    serial: int = 0

    @classmethod
    def from_camera(cls, camera: Camera) -> SensorModel:
        """The model of a camera description's [sensor]."""
        return cls.of(camera.sensor)

    @classmethod
    def of(cls, s: Sensor) -> SensorModel:
        """The model of a sensor's description."""
        warmer = 0.0 if s.temperature is None else s.temperature - REFERENCE_TEMPERATURE
        growth = 2.0 ** (warmer / (s.dark_current_doubling or DOUBLING))
        return cls(
            gain=s.gain,
            read_noise=s.read_noise,
            full_well=s.full_well,
            bits=s.bits,
            black_level=s.black_level,
            dark_current=(s.dark_current or 0.0) * growth,
            dsnu=s.dsnu or 0.0,
            prnu=s.prnu or 0.0,
            hot_pixels=s.hot_pixels or 0.0,
            hot_current=(HOT_CURRENT if s.hot_pixel_current is None else s.hot_pixel_current)
            * growth,
            crosstalk=s.crosstalk or 0.0,
            black_drift=s.black_drift or 0.0,
            serial=s.serial or 0,
        )

    def temporal_noise(self, seconds: float = 0.0) -> Noise:
        """Noise from frame to frame of the digital numbers below saturation, of a signal in DN
        above the black level: var(DN) = K^2 (sigma_d^2 + dark current) + 1/12 + K (mean(DN) -
        black).

        seconds: of the exposure.
        """
        electrons = self.read_noise**2 + self.dark_current * seconds
        return Noise(gain=self.gain, read_variance=self.gain**2 * electrons + ROUNDING)

    def noise(self, seconds: float = 0.0) -> Noise:
        """Noise of one frame that neither a dark frame nor a white image corrects: the temporal
        noise and the spread of what is fixed about the pixels.

        seconds: of the exposure.
        """
        temporal = self.temporal_noise(seconds)
        fixed = (self.gain * self.dsnu) ** 2 + self.black_drift**2
        return replace(temporal, read_variance=temporal.read_variance + fixed, model=self.prnu)

    @property
    def noise_at_full_well(self) -> float:
        """Shot and read noise of a pixel at full well, as a share of its signal."""
        electrons = Noise(gain=1.0, read_variance=self.read_noise**2)
        return math.sqrt(electrons.variance(self.full_well)) / self.full_well

    @property
    def white_level(self) -> int:
        """Largest digital number a pixel can report: the converter's or the full well's,
        whichever comes first.
        """
        return int(
            min(2**self.bits - 1, np.floor(self.black_level + self.gain * self.full_well + 0.5))
        )

    def pattern(self, shape: tuple[int, ...], band: int = 0) -> PixelPattern:
        """What is fixed about the pixels of the sensor `serial`, the same in every frame.

        shape: (rows, columns).
        band: number of the band of rows, where a sensor is worked on in several.
        """
        rng = stream(self.serial, "sensor", band)
        response = 1 + self.prnu * rng.standard_normal(shape)
        offset = self.dsnu * rng.standard_normal(shape)
        hot = rng.random(shape) < self.hot_pixels
        glow = hot * rng.exponential(self.hot_current, shape) if hot.any() else 0.0
        return PixelPattern(
            response=np.clip(response, 0, None),
            offset=offset,
            dark_current=np.broadcast_to(self.dark_current + glow, shape),
        )

    def expose(
        self,
        electrons: np.ndarray,
        rng: np.random.Generator,
        seconds: float = 0.0,
        band: int = 0,
    ) -> np.ndarray:
        """Digital numbers of one exposure.

        Neighbours take their share of the electrons, the pixels' sensitivity and dark current
        count, shot noise is Poisson, the full well clips the electrons before offsets and read
        noise (Gaussian) are added; then gain, black level, rounding to whole numbers and clipping
        to the converter's range.
        electrons: (row, column) mean numbers of photo-electrons (quantum efficiency included). A
            mean below zero is a programming error, except for rounding of the optics (up to 1e-6
            of the peak), which counts as zero.
        rng: source of the noise.
        seconds: of the exposure, for the dark current.
        band: as of `pattern`; the rows of other bands are not looked at.

        Returns uint16 of the same shape, DN.
        Raises ValueError where a mean is not finite, or below zero.
        """
        mean = np.asarray(electrons, float)
        if not np.isfinite(mean).all() or (
            mean.size and mean.min() < -1e-6 * max(1.0, np.abs(mean).max())
        ):
            raise ValueError("mean electron numbers must be finite and not negative")
        offset: np.ndarray | float = 0.0
        if self.crosstalk:
            mean = spread_to_neighbours(mean, self.crosstalk)
        if self.dark_current or self.dsnu or self.prnu or self.hot_pixels:
            pattern = self.pattern(mean.shape, band)
            mean = mean * pattern.response + pattern.dark_current * seconds
            offset = pattern.offset
        charge = np.minimum(
            rng.poisson(np.minimum(np.clip(mean, 0, None), 1e15)), self.full_well
        ).astype(float)
        charge += rng.normal(0.0, self.read_noise, mean.shape) if self.read_noise > 0 else 0.0
        black = self.black_level
        if self.black_drift:
            black += rng.normal(0.0, self.black_drift)
        value = np.floor(self.gain * (charge + offset) + black + 0.5)
        return np.clip(value, 0, 2**self.bits - 1).astype(np.uint16)


def spread_to_neighbours(electrons: np.ndarray, share: float) -> np.ndarray:
    """Electrons of which each pixel loses a share to its four neighbours, evenly; what would leave
    the sensor stays.

    electrons: (row, column).
    share: of a pixel's electrons that its neighbours collect together.
    """
    from scipy.ndimage import convolve

    quarter = share / 4
    kernel = [[0.0, quarter, 0.0], [quarter, 1 - share, quarter], [0.0, quarter, 0.0]]
    return convolve(electrons, np.array(kernel), mode="nearest")
