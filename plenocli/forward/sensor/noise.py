"""Noise of a signal, and white noise of a given signal-to-noise ratio."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import NumericsError


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


def white_noise(signals: Iterable[np.ndarray], snr_db: float) -> Noise:
    """White Gaussian noise of one sigma for the whole of a signal.

    sigma^2 = mean(signal^2) 10^(-snr_db/10): the mean of the squares, not the variance, is the
    signal.
    signals: all superpixels of a capture, in one part or several.
    snr_db: decibel.

    Raises NumericsError for a signal that is zero everywhere.
    """
    squares = [(float(np.mean(part**2)), part.size) for part in signals]
    power = sum(mean * size for mean, size in squares) / sum(size for _, size in squares)
    power = squares[0][0] if len(squares) == 1 else power
    if not power > 0:
        raise NumericsError(
            "a signal-to-noise ratio means nothing for a dark image",
            fix="give more light or no SNR",
        )
    return Noise.of_sigma(float(np.sqrt(power * 10 ** (-snr_db / 10))))
