"""Noise of a signal, and the sensor that makes it: the linear EMVA 1288 model, and white noise of a
given signal-to-noise ratio.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

ROUNDING = 1 / 12
"""Variance that rounding to whole numbers adds, DN^2."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """How far a pixel's value may lie from its mean, in the units of the signal.

    gain: variance per unit of signal (shot noise), for DN the DN of one electron.
    read_variance: of a pixel without light, with that of the rounding, units^2.
    white: a further variance that does not depend on the signal, units^2, such as that of a given
        signal-to-noise ratio.
    model: error of the model of the signal, as a share of the signal.
    """

    gain: float = 0.0
    read_variance: float = 0.0
    white: float = 0.0
    model: float = 0.0

    @classmethod
    def of_sigma(cls, sigma: float) -> Noise:
        """White noise of the standard deviation `sigma`, which the property gives back exactly."""
        return cls(white=float(sigma) ** 2)

    @property
    def without_signal(self) -> float:
        """Variance of a pixel without signal, units^2."""
        return self.read_variance + self.white

    @property
    def sigma(self) -> float:
        """Standard deviation of a pixel without signal, units."""
        return math.sqrt(self.without_signal)

    @property
    def is_white(self) -> bool:
        """Whether the noise is the same for every signal."""
        return self.gain == 0 and self.model == 0

    def variance(self, signal: np.ndarray | float) -> np.ndarray | float:
        """Variance of values whose mean is `signal`, units^2; negative means count as zero."""
        mean = np.clip(signal, 0, None)
        variance = self.gain * mean + self.without_signal
        return variance if self.model == 0 else variance + (self.model * mean) ** 2

    def scaled(self, factor: float) -> Noise:
        """The noise of `factor` times the signal."""
        return Noise(
            gain=self.gain * factor,
            read_variance=self.read_variance * factor**2,
            # by the standard deviation, which a white noise is given by
            white=(math.sqrt(self.white) * factor) ** 2,
            model=self.model,
        )


@dataclass(frozen=True, kw_only=True)
class SensorModel:
    """Electrons to digital numbers: mean(DN) = black_level + gain * electrons below saturation.

    gain: K, DN per electron.
    read_noise: sigma_d, electrons.
    full_well: electrons.
    bits: of the converter.
    black_level: DN.
    EMVA Standard 1288, release 4.0, linear model.
    """

    gain: float
    read_noise: float
    full_well: float
    bits: int
    black_level: float = 0.0

    @classmethod
    def from_camera(cls, camera: Camera) -> SensorModel:
        """The model of a camera description's [sensor]."""
        s = camera.sensor
        return cls(
            gain=s.gain,
            read_noise=s.read_noise,
            full_well=s.full_well,
            bits=s.bits,
            black_level=s.black_level,
        )

    @property
    def noise(self) -> Noise:
        """Noise of the digital numbers below saturation, of a signal in DN above the black level:
        var(DN) = K^2 sigma_d^2 + 1/12 + K (mean(DN) - black).
        """
        return Noise(gain=self.gain, read_variance=(self.gain * self.read_noise) ** 2 + ROUNDING)

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

    def expose(self, electrons: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Digital numbers of one exposure.

        Shot noise is Poisson, the full well clips the electrons before read noise (Gaussian) is
        added; then gain, black level, rounding to whole numbers and clipping to the converter's
        range.
        electrons: mean numbers of photo-electrons (quantum efficiency included). A mean below zero
            is a programming error, except for rounding of the optics (up to 1e-6 of the peak),
            which counts as zero.
        rng: source of the noise.

        Returns uint16 of the same shape, DN.
        Raises ValueError where a mean is not finite, or below zero.
        """
        mean = np.asarray(electrons, float)
        if not np.isfinite(mean).all() or (
            mean.size and mean.min() < -1e-6 * max(1.0, np.abs(mean).max())
        ):
            raise ValueError("mean electron numbers must be finite and not negative")
        charge = np.minimum(
            rng.poisson(np.minimum(np.clip(mean, 0, None), 1e15)), self.full_well
        ).astype(float)
        charge += rng.normal(0.0, self.read_noise, mean.shape) if self.read_noise > 0 else 0.0
        value = np.floor(self.gain * charge + self.black_level + 0.5)
        return np.clip(value, 0, 2**self.bits - 1).astype(np.uint16)


def add_white_noise(
    signal: np.ndarray, snr_db: float, rng: np.random.Generator
) -> tuple[np.ndarray, Noise]:
    """Add white Gaussian noise of one sigma to the whole of `signal`; nothing is clipped.

    sigma^2 = mean(signal^2) 10^(-snr_db/10): the mean of the squares, not the variance, is the
    signal.
    signal: all superpixels of a capture.
    snr_db: decibel.
    rng: source of the noise.

    Returns the noisy signal and its noise.
    Raises NumericsError for a signal that is zero everywhere.
    """
    signal = np.asarray(signal, float)
    power = float(np.mean(signal**2))
    if not power > 0:
        raise NumericsError(
            "a signal-to-noise ratio means nothing for a dark image",
            fix="give more light or no SNR",
        )
    sigma = float(np.sqrt(power * 10 ** (-snr_db / 10)))
    return signal + rng.normal(0.0, sigma, signal.shape), Noise.of_sigma(sigma)
