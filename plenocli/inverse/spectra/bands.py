"""Bands that are solved for, from those that were calibrated. In two states of polarisation: a
response that tells them apart has a column for each, and what is found of the two makes the Stokes
parameters s0 (all light) and s1 (along 0 degrees less along 90). As filters see them: a response is
calibrated in light of one wavelength a band, of which overlapping filters pass some each; solved
for such light, bands come out sharper than any filter. docs/model.md, section 9, "Polarisation" and
"Overlapping filters".
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.forward.camera.pupil import filter_cells, filter_transmittance
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.registration.moved_response import mixed
from plenocli.inverse.spectra.responses import LensletResponses

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.inverse.calibration.calibration import Calibration, Response
    from plenocli.inverse.spectra.spectra import Spectra

LEAST_ANGLE = 2.0
"""Degrees between the responses to both states, below which a band is one of all light."""
SPREAD = 0.3
"""Standard deviation of degrees of polarisation, as far as a prior knows."""
LEAST_OVERLAP = 1e-5
"""Of a filter's light, from another band's wavelength, below which it counts as blocked."""
MOST_ALIKE = 100.0
"""Condition of the filters at the bands' wavelengths from which they are not told apart."""


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


def by_filter(calibration: Calibration, camera: Camera | None) -> Calibration:
    """The calibration with a column for the light of each filter instead of each wavelength, a
    white as bright as before; as it is where filters do not overlap, or bands are not theirs.

    camera: its description.
    """
    response = there(calibration.response)
    if camera is None or response.states is not None or response.polarised is not None:
        return calibration
    passed = _passed(camera, response.wavelengths)
    if passed is None:
        return calibration
    lit = [
        sum(
            (y1 - y0) * (x1 - x0) * t
            for (y0, y1, x0, x1), t in filter_cells(camera, float(w)) or ()
        )
        for w in response.wavelengths
    ]
    lenslets = LensletResponses.of(calibration)
    column = lenslets.typical
    light = lenslets.white_light
    if light is None or not min(lit) > 0:
        return calibration
    # what comes through a filter at the wavelength of each band, where lamps differ
    amount = passed * np.nansum(column, axis=0) / lit
    amount *= (light / (amount @ light))[:, None]
    shares = amount * light / light[:, None]
    others = shares - np.diag(np.diagonal(shares))
    if others.max() < LEAST_OVERLAP or np.linalg.cond(shares) > MOST_ALIKE:
        return calibration
    mixture = np.linalg.inv(amount)
    variance = None if response.variance is None else response.variance @ mixture**2
    matrix: Any = mixed(response.matrix, mixture)
    return replace(
        calibration,
        response=replace(
            response,
            matrix=matrix,
            variance=variance,
            mixture=mixture,
            energy=None,
            quality=None,
        ),
    )


def _passed(camera: Camera, bands: np.ndarray) -> np.ndarray | None:
    """Transmittance (filter, band) of the one filter of each band at the bands' wavelengths; None
    where filters are not those of bands.
    """
    filters = () if camera.filter_array is None else camera.filter_array.filters
    middles = np.array([np.nan if one.middle is None else one.middle for one in filters])
    if len(filters) != len(bands) or not np.isfinite(middles).all():
        return None
    own = [filters[k] for k in np.argsort(middles)]
    order = np.argsort(bands)
    if any(abs(f.middle - bands[k]) > f.width for f, k in zip(own, order)):
        return None
    out = np.empty((len(bands), len(bands)))
    for one, k in zip(own, order):
        out[k] = [filter_transmittance(one, float(w)) for w in bands]
    return out
