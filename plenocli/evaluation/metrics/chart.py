"""A measured ColorChecker against a spectrometer's: what a band of light sees of a spectrum,
errors by band and patch.
"""

import numpy as np

from plenocli.evaluation.metrics.spectral import spectral_angle

# m: a filter's band is what lies this near to its peak; floors and side lobes beyond are left out
LOBE = 20e-9
NEAR = 40e-9  # m: how far a filter's peak may lie from its label


def lobe_reflectance(wavelengths, filters, labels, reflectance):
    """Reflectance (patch, band) seen through filters: mean over LOBE about each filter's peak,
    weighted with the filter.

    wavelengths (n,) m; filters (band, n); labels (band,) m, their nominal centres;
    reflectance (patch, n).
    """
    out = []
    for passed, label in zip(filters, labels, strict=True):
        near = np.abs(wavelengths - label) <= NEAR
        peak = wavelengths[near][np.argmax(passed[near])]
        lobe = np.abs(wavelengths - peak) <= LOBE
        out.append(reflectance[:, lobe] @ passed[lobe] / passed[lobe].sum())
    return np.stack(out, axis=1)


def nominal_reflectance(wavelengths, labels, reflectance, fwhm=10e-9):
    """Reflectance (patch, band) through Gaussian bands of `fwhm` m at the labels (band,) m."""
    weight = np.exp(-4 * np.log(2) * ((wavelengths - np.asarray(labels)[:, None]) / fwhm) ** 2)
    return reflectance @ weight.T / weight.sum(axis=1)


def against_white(values, truth, white):
    """Values (patch, band) as reflectances: over those of patch index `white`, times
    its true reflectance.
    """
    return values / values[white] * truth[white]


def compare_chart(found, truth, six, inner):
    """Errors of reflectances (patch, band): dict of RMSE by band over all patches and over the
    indices `six`, their means and the mean spectral angle (degrees) over the bands of the mask
    `inner` (band,), and the largest error.
    """
    error = found - truth
    every, few = (np.sqrt(np.mean(part**2, axis=0)) for part in (error, error[list(six)]))
    angle = np.degrees(spectral_angle(found[:, inner], truth[:, inner]))
    return {
        "rmse_24_per_band": every.tolist(),
        "rmse_six_per_band": few.tolist(),
        "rmse_24": float(every[inner].mean()),
        "rmse_six": float(few[inner].mean()),
        "spectral_angle_deg": float(angle.mean()),
        "spectral_angle_worst_deg": float(angle.max()),
        "worst_error": float(np.abs(error[:, inner]).max()),
    }
