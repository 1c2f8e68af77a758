"""A measured ColorChecker against a spectrometer's: what a band of light sees of a spectrum,
errors by band and patch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.evaluation.metrics.spectral import spectral_angle

LOBE = 20e-9
"""A filter's band is what lies this near to its peak, m; floors and side lobes beyond are left
out.
"""
NEAR = 40e-9
"""How far a filter's peak may lie from its label, m."""


@dataclass(frozen=True, kw_only=True)
class ChartScore:
    """Errors of reflectances over all 24 patches and over the paper's six: root mean squares by
    band, and their means, angles (degrees) and the largest error over the inner bands.
    """

    rmse_24_per_band: list[float]
    rmse_six_per_band: list[float]
    rmse_24: float
    rmse_six: float
    spectral_angle_deg: float
    spectral_angle_worst_deg: float
    worst_error: float


def lobe_reflectance(
    wavelengths: np.ndarray,
    filters: Sequence[np.ndarray],
    labels: np.ndarray,
    reflectance: np.ndarray,
) -> np.ndarray:
    """Reflectance seen through filters: mean over LOBE about each peak, weighted with the filter.

    wavelengths: (n,) m.
    filters: (band, n) transmission.
    labels: (band,) nominal centres, m.
    reflectance: (patch, n).

    Returns (patch, band).
    """
    out = []
    for passed, label in zip(filters, labels, strict=True):
        near = np.abs(wavelengths - label) <= NEAR
        peak = wavelengths[near][np.argmax(passed[near])]
        lobe = np.abs(wavelengths - peak) <= LOBE
        out.append(reflectance[:, lobe] @ passed[lobe] / passed[lobe].sum())
    return np.stack(out, axis=1)


def nominal_reflectance(
    wavelengths: np.ndarray, labels: np.ndarray, reflectance: np.ndarray, fwhm: float = 10e-9
) -> np.ndarray:
    """Reflectance seen through Gaussian bands at the labels.

    wavelengths: (n,) m.
    labels: (band,) centres, m.
    reflectance: (patch, n).
    fwhm: full width at half maximum of the bands, m.

    Returns (patch, band).
    """
    weight = np.exp(-4 * np.log(2) * ((wavelengths - np.asarray(labels)[:, None]) / fwhm) ** 2)
    return reflectance @ weight.T / weight.sum(axis=1)


def against_white(values: np.ndarray, truth: np.ndarray, white: int) -> np.ndarray:
    """Values (patch, band) as reflectances: over those of the patch of index `white`, times its
    true reflectance.
    """
    return values / values[white] * truth[white]


def compare_chart(
    found: np.ndarray, truth: np.ndarray, six: Sequence[int], inner: np.ndarray
) -> ChartScore:
    """Errors of reflectances.

    found, truth: (patch, band).
    six: indices of the paper's six patches.
    inner: (band,) bool, the bands over which means are taken.
    """
    error = found - truth
    every, few = (np.sqrt(np.mean(part**2, axis=0)) for part in (error, error[list(six)]))
    angle = np.degrees(spectral_angle(found[:, inner], truth[:, inner]))
    return ChartScore(
        rmse_24_per_band=every.tolist(),
        rmse_six_per_band=few.tolist(),
        rmse_24=float(every[inner].mean()),
        rmse_six=float(few[inner].mean()),
        spectral_angle_deg=float(angle.mean()),
        spectral_angle_worst_deg=float(angle.max()),
        worst_error=float(np.abs(error[:, inner]).max()),
    )
