"""Spectra behind lenslets, with their errors and how they came about."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plenocli.inverse.registration.alignment import Registration


@dataclass(frozen=True, kw_only=True)
class Trace:
    """What was tried and why.

    asked: the method asked for.
    reason: why the method that was used was taken, in words.
    registration: what stood between capture and calibration; None: nobody looked.
    warning: that the calibration does not describe the capture, in words, or None.
    """

    asked: str
    reason: str
    registration: Registration | None = None
    warning: str | None = None


@dataclass(frozen=True, kw_only=True)
class Spectra:
    """Spectra of one capture.

    value: (band, lenslet_row, lenslet_column), radiance relative to the calibration's source, or
        reflectance; NaN where it cannot be told.
    sigma: likewise, standard deviations predicted for them.
    wavelength: (band,) m.
    quantity: "radiance" or "reflectance".
    method: that was used (plenocli.inverse.spectra.demultiplex.METHODS).
    trace: what was tried and why.
    residual: (lenslet_row, lenslet_column), mean square of x - F b over its expected one, 1 is
        noise alone; None where the noise is not known.
    reference_reflectance: of the white reference that reflectances are relative to, or None.
    states: (band,) polarisation of the light of each band, degrees, NaN where it is all light;
        None: all light in every band.
    s1, s1_sigma: like value, the light along 0 degrees less that along 90, where value is that of
        both; NaN where it cannot be told; None: in no band.
    """

    value: np.ndarray
    sigma: np.ndarray
    wavelength: np.ndarray
    quantity: str
    method: str
    trace: Trace
    residual: np.ndarray | None = None
    reference_reflectance: float | None = None
    states: np.ndarray | None = None
    s1: np.ndarray | None = None
    s1_sigma: np.ndarray | None = None

    def relative_to(self, white: Spectra, reflectance: float) -> Spectra:
        """Reflectances: the ratio to the white reference times its reflectance, with both relative
        errors.

        white: radiances of the reference.
        reflectance: its reflectance.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            known = np.where(white.value > 0, white.value, np.nan)
            ratio = reflectance * self.value / known
            spread = (
                reflectance
                / known
                * np.sqrt(self.sigma**2 + (self.value / known * white.sigma) ** 2)
            )
        return replace(
            self,
            value=ratio,
            sigma=spread,
            quantity="reflectance",
            reference_reflectance=reflectance,
        )
