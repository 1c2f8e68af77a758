"""Spectral quadrature: which wavelengths carry the light of a source, and with what weight
in photo-electrons.

A source of spectral radiance E(l) gives photo-electrons in proportion to E(l) l dl (energy over the
photon's h c / l). See docs/model.md, "From radiance to electrons".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

VISIBLE = (400e-9, 700e-9)
COARSEST = 20e-9
"""Width (m) of the finest band of a camera whose filters have none."""
GAUSSIAN = math.sqrt(math.pi / (4 * math.log(2)))
"""Area of a Gaussian band over its peak and full width at half maximum."""
LUMENS_PER_WATT = 683.0
"""K_m of the photopic eye, lm/W."""
PHOTON = 6.62607015e-34 * 299792458.0
"""Energy of a photon times its wavelength, J m."""


@dataclass(frozen=True)
class Quadrature:
    """Nodes of a source.

    wavelengths: (node,) m, ascending.
    photons: (node,) relative photon radiance, summing to 1.
    width: radiance of all nodes over the spectral radiance at the camera's design wavelength (in a
        band: at its centre), m; None where the source is of lines.
    """

    wavelengths: np.ndarray
    photons: np.ndarray
    width: float | None = None


def broadband(
    camera: Camera, power: Callable[[np.ndarray], np.ndarray], step: float | None = None
) -> Quadrature:
    """Nodes of white light as a camera must sample it.

    A camera with colour (filters in the pupil or on the sensor) is sampled uniformly over 400 to
    700 nm. Without colour the camera sees the lines of [light] wavelengths, equally strong.

    camera: whose filters and light count.
    power: relative spectral power of the illuminant at wavelengths (n,) m.
    step: m between nodes; by default half of the narrowest filter width: the trapezoidal rule on a
        Gaussian band of FWHM w with step w/2 is exact to 1e-6.

    Returns the nodes, weighted by power times wavelength.
    Raises UsageError where the step does not resolve the range, or the light has no power in it.
    """
    if not has_colour(camera):
        lines = np.array(camera.light.wavelengths)
        band = camera.light.band
        width = None if band is None else band.fwhm * (GAUSSIAN if band.shape == "gaussian" else 1)
        return Quadrature(lines, np.full(len(lines), 1 / len(lines)), width)
    if step is None:
        step = _finest(camera) / 2
    low = min(VISIBLE[0], *camera.light.wavelengths)
    high = max(VISIBLE[1], *camera.light.wavelengths)
    if not 0 < step <= (high - low) / 2:
        raise UsageError(
            (
                f"a spectral step of {step * 1e9:g} nm does not resolve {low * 1e9:g} "
                f"to {high * 1e9:g} nm"
            ),
            fix="choose about half of the narrowest filter width",
        )
    nodes = np.linspace(low, high, int(round((high - low) / step)) + 1)
    weights = np.ones(len(nodes))
    weights[[0, -1]] = 0.5
    power_at = weights * power(nodes)
    design = float(power(np.array([camera.light.design_wavelength]))[0])
    width = float(power_at.sum()) * (nodes[1] - nodes[0]) / design if design > 0 else None
    return _normalised(nodes, power_at * nodes, width)


def narrow_band(centre: float, fwhm: float = 0.0, nodes: int = 5) -> Quadrature:
    """Nodes of a narrow band of light.

    centre: m.
    fwhm: m; 0 is one line, else a Gaussian band by Gauss-Hermite nodes.
    nodes: number of nodes of the Gaussian band.
    """
    if fwhm == 0:
        return Quadrature(np.array([centre]), np.ones(1))
    x, weights = np.polynomial.hermite_e.hermegauss(nodes)
    wavelengths = centre + x * fwhm / np.sqrt(8 * np.log(2))
    return _normalised(wavelengths, weights * wavelengths, GAUSSIAN * fwhm)


def broadened(lines: Iterable[float], fwhm: float) -> Quadrature:
    """Several lines, each widened to a Gaussian band: the union of their narrow_band() nodes.

    lines: centres, m; they are equally strong.
    fwhm: m.
    """
    bands = [narrow_band(line, fwhm) for line in lines]
    order = np.argsort(np.concatenate([b.wavelengths for b in bands]))
    wavelengths = np.concatenate([b.wavelengths for b in bands])[order]
    photons = np.concatenate([b.photons for b in bands])[order]
    return _normalised(wavelengths, photons, len(bands) * GAUSSIAN * fwhm)


def band_weights(
    camera: Camera, wavelengths: ArrayLike, power: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """What monochromatic system matrices A_k make of a capture in white light.

    The capture is y = sum_b (sum_k weights[b, k] A_k) x_b, in units where a mono sensor's
    efficiency is 1. A camera without filters in its pupil has one band, its lines equally strong.
    Otherwise, where the wavelengths are nodes of `broadband` no wider apart than a filter, bands
    are the [light] wavelengths, x is linear between them and constant beyond; where they are not,
    each wavelength is a band and stands for all that its filter lets through.

    camera: whose filters and light count.
    wavelengths: (k,) m, ascending, of the matrices.
    power: relative spectral power of the light at wavelengths (n,) m.

    Returns (bands (band,) m, weights (band, k)).
    Raises UsageError where no filter passes one of the wavelengths.
    """
    from plenocli.forward.camera.pupil import filter_transmittance

    wavelengths = np.asarray(wavelengths, float)
    if camera.filter_array is None:
        return np.array([wavelengths.mean()]), np.full((1, len(wavelengths)), 1 / len(wavelengths))
    filters = camera.filter_array.filters
    step = np.diff(wavelengths).min() if len(wavelengths) > 1 else np.inf
    if step <= _finest(camera):
        light = broadband(camera, power, step)
        near = np.abs(light.wavelengths[None] - wavelengths[:, None]).argmin(axis=1)
        if np.abs(light.wavelengths[near] - wavelengths).max() < 1e-12:
            bands = np.array(sorted(camera.light.wavelengths))
            hats = np.stack([np.interp(wavelengths, bands, one) for one in np.eye(len(bands))])
            return bands, hats * light.photons[near]
    if any(f.middle is None for f in filters):
        raise UsageError(
            "the camera has a clear or neutral cell, which passes all wavelengths, so that single "
            "ones of its system matrix do not stand for bands",
            fix="simulate-pif with --spectral-step auto",
        )
    light = broadband(camera, power)
    passed = np.array([[filter_transmittance(f, w) for w in wavelengths] for f in filters])
    behind = passed.argmax(axis=0)
    blocked = [
        w
        for w, t, k in zip(wavelengths, passed.max(axis=0), behind)
        if t < filter_transmittance(filters[k], filters[k].brightest) / 10
    ]
    if blocked:
        raise UsageError(
            (
                f"no filter of the camera passes {blocked[0] * 1e9:.4g} nm, one of the wavelengths "
                "of its system matrix"
            ),
            fix="simulate-pif at the filters' wavelengths, or --spectral-step auto",
        )
    through = np.array(
        [
            sum(n * filter_transmittance(f, w) for w, n in zip(light.wavelengths, light.photons))
            for f in filters
        ]
    )
    return wavelengths, np.diag(through[behind] / passed.max(axis=0) / np.bincount(behind)[behind])


def _finest(camera: Camera) -> float:
    """Width (m) of the finest band of the camera's filters."""
    filters = camera.filter_array.filters if camera.filter_array else ()
    finest = min((f.detail for f in filters), default=np.inf)
    return COARSEST if np.isinf(finest) else finest


def has_colour(camera: Camera) -> bool:
    """Whether the camera tells wavelengths apart: filters in the pupil, or on the sensor."""
    return camera.filter_array is not None or camera.sensor.cfa != "mono"


def photon_radiance(camera: Camera, source: Quadrature) -> float:
    """Photons of all wavelengths that a perfect white sends, 1/(s m^2 sr).

    camera: whose [light] says how strong it is; a Lambertian white of `illuminance` E has the
        luminance E/pi.
    source: its wavelengths and their shares.

    Raises ConfigError where the light's strength is one that its wavelengths do not have.
    CIE 1931 standard observer, K_m = 683 lm/W. docs/model.md, "From radiance to electrons".
    """
    from plenocli.forward.scene.tables import observer

    light = camera.light
    energy = source.photons / source.wavelengths
    if light.radiance is not None:
        radiance = light.radiance
    elif light.spectral_radiance is not None:
        if source.width is None:
            raise ConfigError(
                "a line of light has no width that a spectral radiance could be multiplied with",
                "light.spectral_radiance",
                "give radiance, or [light] band, or --bandwidth",
            )
        radiance = light.spectral_radiance * source.width
    else:
        seen = float(observer(source.wavelengths)[1][1] @ energy)
        if not seen > 1e-6 * energy.sum():
            raise ConfigError(
                "the light has no wavelengths that the eye sees, so lux and cd/m2 do not say how "
                "strong it is",
                f"light.{light.strength}",
                "give radiance in W/m2/sr",
            )
        luminance = light.luminance or (light.illuminance or 0.0) / np.pi
        radiance = luminance / LUMENS_PER_WATT * energy.sum() / seen
    return float(radiance / energy.sum() / PHOTON)


def _normalised(
    wavelengths: np.ndarray, photons: np.ndarray, width: float | None = None
) -> Quadrature:
    total = photons.sum()
    if not (np.isfinite(total) and total > 0):
        raise UsageError(
            (
                f"the light has no power between {wavelengths[0] * 1e9:g} and "
                f"{wavelengths[-1] * 1e9:g} nm"
            ),
            fix="choose another illuminant or other wavelengths",
        )
    return Quadrature(wavelengths, photons / total, width)
