"""Dispersion of optical glasses and what it does to the focal length of a thin lens."""

import math

from plenocli.errors import ConfigError

# Sellmeier terms n^2 - 1 = sum B l^2/(l^2 - C), l in micrometres, and the range they were fitted on (um).
# Schott data sheets (N-*), Malitson 1965 (fused silica), Sultanova, Kasarova and Nikolov 2009 (plastics).
_SELLMEIER = {
    "N-BK7": (((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653)), (0.3, 2.5)),
    "N-BAK4": (((1.28834642, 0.00779980626), (0.132817724, 0.0315631177), (0.945395373, 105.965875)), (0.33, 2.5)),
    "N-F2": (((1.39757037, 0.00995906143), (0.159201403, 0.0546931752), (1.2686543, 119.248346)), (0.365, 2.5)),
    "N-SF11": (((1.73759695, 0.013188707), (0.313747346, 0.0623068142), (1.89878101, 155.23629)), (0.37, 2.5)),
    "fused silica": (((0.6961663, 0.0684043**2), (0.4079426, 0.1162414**2), (0.8974794, 9.896161**2)), (0.21, 3.71)),
    "PMMA": (((1.1819, 0.011313),), (0.43, 1.06)),
    "polycarbonate": (((1.4182, 0.021304),), (0.43, 1.06)),
    "polystyrene": (((1.4435, 0.020216),), (0.43, 1.06)),
}
_ALIASES = {"BK7": "N-BK7", "F2": "N-F2", "SF11": "N-SF11", "BAK4": "N-BAK4", "SILICA": "fused silica", "FUSED-SILICA": "fused silica"}

GLASSES = tuple(_SELLMEIER)
"""Names that `refractive_index` knows, beside "none" (no dispersion)."""


def refractive_index(name, wavelength):
    """Index of refraction of glass `name` at `wavelength` (m), in air to the accuracy of the Sellmeier fit.

    ConfigError for a name that is not known or a wavelength outside the fitted range.
    """
    key = next((g for g in GLASSES if g.upper() == name.upper()), _ALIASES.get(name.upper()))
    if key is None:
        raise ConfigError(f"{name!r} is not a known glass", "glass", f"use one of none, {', '.join(GLASSES)}")
    terms, (low, high) = _SELLMEIER[key]
    microns = wavelength * 1e6
    if not low <= microns <= high:
        raise ConfigError(f"{key} is described from {low} to {high} um, not at {microns:.4g} um", "glass",
                          'use glass = "none" or another wavelength')
    square = microns * microns
    return math.sqrt(1 + sum(b * square / (square - c) for b, c in terms))


def focal_length(f0, glass, design_wavelength, wavelength):
    """Focal length (m) at `wavelength` of a thin singlet that has `f0` at `design_wavelength`.

    f(l) = f0 (n(l0) - 1)/(n(l) - 1), the lensmaker's equation for fixed curvatures; `glass` = "none" keeps f0.
    """
    if glass.lower() == "none":
        return f0
    return f0 * (refractive_index(glass, design_wavelength) - 1) / (refractive_index(glass, wavelength) - 1)
