"""Bands in two states of polarisation: a response that tells them apart has a column for each, and
what is found of the two makes the Stokes parameters s0 (all light) and s1 (along 0 degrees less
along 90). docs/model.md, section 9, "Polarisation".
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.inverse.calibration.calibration import there

if TYPE_CHECKING:
    from plenocli.inverse.calibration.calibration import Calibration, Response
    from plenocli.inverse.spectra.spectra import Spectra

LEAST_ANGLE = 2.0
"""Degrees between the responses to both states, below which a band is one of all light."""
SPREAD = 0.3
"""Standard deviation of degrees of polarisation, as far as a prior knows."""


def by_state(calibration: Calibration) -> Calibration:
    """The calibration with two bands, of light along 0 and along 90 degrees, for each that it tells
    apart; a radiance of 1 in both is one of 1 that is not polarised.
    """
    response = calibration.response
    if response is None or response.polarised is None:
        return calibration
    apart = _told_apart(response)
    if not apart.any():
        return calibration
    f, p = response.matrix, response.polarised
    variance = response.variance
    columns = [((f + p) / 2)[..., apart], ((f - p) / 2)[..., apart], f[..., ~apart]]
    parts = [apart, apart, ~apart]
    return replace(
        calibration,
        response=replace(
            response,
            matrix=np.concatenate(columns, axis=-1),
            polarised=None,
            variance=None
            if variance is None
            else np.concatenate(
                [variance[:, part] * share for part, share in zip(parts, (0.5, 0.5, 1))], axis=-1
            ),
            wavelengths=np.concatenate([response.wavelengths[part] for part in parts]),
            states=np.repeat([0.0, 90.0, np.nan], [part.sum() for part in parts]),
            energy=None,
            quality=None,
        ),
    )


def _told_apart(response: Response) -> np.ndarray:
    """(band,) whether the responses to both states are more than LEAST_ANGLE apart."""
    bands = len(response.wavelengths)
    f, p = (
        np.nan_to_num(part).reshape(-1, bands)
        for part in (response.matrix, there(response.polarised))
    )
    one, two = f + p, f - p
    with np.errstate(invalid="ignore"):
        cosine = (one * two).sum(axis=0) / np.sqrt((one**2).sum(axis=0) * (two**2).sum(axis=0))
    return cosine < np.cos(np.radians(LEAST_ANGLE))


def stokes(spectra: Spectra) -> Spectra:
    """Spectra of all light, with s1 beside them where bands come in both states.

    sigma is that of both states as independent of each other.
    """
    if spectra.states is None:
        return spectra
    one, two, rest = (
        np.flatnonzero(np.isnan(spectra.states) if state is None else spectra.states == state)
        for state in (0.0, 90.0, None)
    )
    order = np.argsort(np.concatenate([spectra.wavelength[one], spectra.wavelength[rest]]))
    unknown = np.full_like(spectra.value[rest], np.nan)
    value, sigma = spectra.value, spectra.sigma
    both = np.hypot(sigma[one], sigma[two]) / 2

    def bands(first: np.ndarray, second: np.ndarray) -> np.ndarray:
        return np.concatenate([first, second])[order]

    return replace(
        spectra,
        value=bands((value[one] + value[two]) / 2, value[rest]),
        sigma=bands(both, sigma[rest]),
        wavelength=bands(spectra.wavelength[one], spectra.wavelength[rest]),
        states=None,
        s1=bands((value[one] - value[two]) / 2, unknown),
        s1_sigma=bands(both, unknown),
    )


def with_polarisation(covariance: np.ndarray, mean: np.ndarray, states: np.ndarray) -> np.ndarray:
    """Covariance (band, band) of reflectances of bands in two states, where degrees of polarisation
    have a spread of their own, alike in all bands.

    covariance, mean: of reflectance without it.
    states: (band,) degrees, NaN where light is not told apart.
    """
    sign = np.where(np.isnan(states), 0.0, np.where(states == 0, 1.0, -1.0))
    return covariance + SPREAD**2 * np.outer(sign, sign) * (covariance + np.outer(mean, mean))
