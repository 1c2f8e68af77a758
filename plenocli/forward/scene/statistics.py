"""Mean and covariance of radiance over a population of surfaces, as LMMSE needs them."""

import numpy as np
from numpy.typing import ArrayLike


def reflectance_statistics(reflectance: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Mean and population covariance (divided by n) of a set of surfaces.

    reflectance: (surface, band).

    Returns (mean (band,), covariance (band, band)).
    """
    reflectance = np.asarray(reflectance, dtype=np.float64)
    mean = reflectance.mean(axis=0)
    centred = reflectance - mean
    return mean, centred.T @ centred / len(reflectance)


def radiance_statistics(
    mean: np.ndarray, covariance: ArrayLike, light: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Statistics of radiance b = diag(E) r from those of reflectance r.

    mean: (band,) of r.
    covariance: (band, band) of r.
    light: (band,) power E of the light in each band, any unit, which the result inherits.

    Returns (mu_b = E mu_r, C_b = diag(E) C_r diag(E)).
    Berkner et al. 2013, spectral model; docs/model.md, "Spectral response: calibration and
    demultiplexing".
    """
    light = np.asarray(light, dtype=np.float64)
    return light * mean, light[:, None] * np.asarray(covariance) * light[None, :]
