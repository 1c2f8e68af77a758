"""Sensor noise: the linear EMVA 1288 model, and white noise of a given signal-to-noise ratio."""

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError


@dataclass(frozen=True)
class SensorModel:
    """Electrons to digital numbers (EMVA Standard 1288, release 4.0, linear model).

    gain K in DN per electron, read_noise sigma_d and full_well in electrons, bits of the converter,
    black_level in DN. Then mean(DN) = black + K mu and var(DN) = K^2 sigma_d^2 + 1/12 + K
    (mean(DN) - black) below saturation.
    """

    gain: float
    read_noise: float
    full_well: float
    bits: int
    black_level: float = 0.0

    @classmethod
    def from_camera(cls, camera):
        """The model of a camera description's [sensor]."""
        s = camera.sensor
        return cls(s.gain, s.read_noise, s.full_well, s.bits, s.black_level)

    @property
    def white_level(self):
        """Largest digital number a pixel can report: the converter's or the full well's,
        whichever comes first.
        """
        return int(
            min(2**self.bits - 1, np.floor(self.black_level + self.gain * self.full_well + 0.5))
        )

    def expose(self, electrons, rng):
        """Digital numbers (uint16, same shape) for mean photo-electron numbers `electrons` (quantum
        efficiency included).

        Shot noise is Poisson, the full well clips the electrons before read noise (Gaussian) is
        added; then gain, black level, rounding to whole numbers and clipping to the converter's
        range. A mean below zero is a programming error, except for rounding of the optics (up to
        1e-6 of the peak), which counts as zero.
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

    def variance(self, electrons):
        """Predicted variance of the digital numbers, DN^2, for mean
        `electrons` below saturation.
        """
        return self.gain**2 * (self.read_noise**2 + np.clip(electrons, 0, None)) + 1 / 12


def add_white_noise(signal, snr_db, rng):
    """Add white Gaussian noise of one sigma to the whole of `signal`: (noisy, sigma).

    sigma^2 = mean(signal^2) 10^(-snr_db/10): the mean of the squares, not the variance, is the
    signal. One sigma for all superpixels of a capture; nothing is clipped.
    """
    signal = np.asarray(signal, float)
    power = float(np.mean(signal**2))
    if not power > 0:
        raise NumericsError(
            "a signal-to-noise ratio means nothing for a dark image",
            fix="give more light or no SNR",
        )
    sigma = float(np.sqrt(power * 10 ** (-snr_db / 10)))
    return signal + rng.normal(0.0, sigma, signal.shape), sigma
