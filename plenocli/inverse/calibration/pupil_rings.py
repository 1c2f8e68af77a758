"""The pupil of an objective as its white image shows it behind lenslets.

Even light over the specimen fills every direction that the objective takes; what one sees behind a
lenslet is the pupil's intensity, as wide as diffraction at the lenslet makes it. Rings of intensity
are fitted, none below zero. docs/model.md, "Volumes".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import InputError
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.volume.optics import VolumeOptics

RINGS = 16
"""Rings that are fitted."""
FINE = 6
"""Directions across a pixel."""
SMOOTH = 0.5
"""Weight of the rings' second differences, over that of the white image."""
FAINT = 0.02
"""Intensity over the largest below which the pupil's edge is over."""
LEAST_ALIKE = 0.9
"""Correlation of the white image with the fitted one, below which it shows no such pupil."""


@dataclass(frozen=True)
class PupilRings:
    """A measured pupil.

    intensity: at equal steps of s from 0 to `aperture`, relative to the largest.
    aperture: largest direction.
    alike: correlation of the white image with that of these rings.
    described: the same with that of the objective as described.
    """

    intensity: tuple[float, ...]
    aperture: float
    alike: float
    described: float


def pupil_rings(white: np.ndarray, optics: VolumeOptics) -> PupilRings:
    """Fit the pupil's intensity to a white superpixel.

    white: (row, column) of a superpixel's pixels, dark level taken off, mean over many lenslets.
    optics: of the microscope as described.

    Raises InputError where the white image is no picture of such a pupil.
    """
    from scipy.optimize import nnls

    radii = np.linspace(0, optics.aperture, RINGS)
    patterns = _patterns(optics, radii)
    # neighbouring rings look alike behind lenslets: of all that fit, those that bend least
    bend = np.diff(np.eye(len(radii)), 2, axis=0)
    bend *= SMOOTH * np.linalg.norm(patterns) / np.linalg.norm(bend)
    system = np.concatenate([patterns.reshape(len(radii), -1).T, bend])
    weights, _ = nnls(system, np.concatenate([white.ravel(), np.zeros(len(bend))]))
    if not weights.max() > 0:
        raise InputError("is dark behind its lenslets", "white image", "check dark level and grid")
    fitted = np.tensordot(weights, patterns, 1)
    alike = _alike(white, fitted)
    if alike < LEAST_ALIKE:
        raise InputError(
            f"is unlike any pupil of NA {optics.aperture:g} behind these lenslets (correlation "
            f"{alike:.2f})",
            "white image",
            "check magnification, lenslet focal length and sensor distance",
        )
    # light in steep directions goes far: none is kept where there is none to speak of
    last = min(int(np.flatnonzero(weights > FAINT * weights.max())[-1]) + 1, len(radii) - 1)
    as_described = optics.amplitude(radii) ** 2
    return PupilRings(
        intensity=tuple((weights / weights.max())[: last + 1].tolist()),
        aperture=float(radii[last]),
        alike=alike,
        described=_alike(white, np.tensordot(as_described, patterns, 1)),
    )


def _alike(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def _patterns(optics: VolumeOptics, radii: np.ndarray) -> np.ndarray:
    """(ring, row, column) white superpixel that a ring of intensity 1 makes; between rings
    intensity is linear.
    """
    to_pixels = [_from_directions(optics, axis, radii[-1]) for axis in (0, 1)]
    y, x = (directions for directions, _ in to_pixels)
    s = np.hypot(y[:, None], x)
    found = []
    for ring in range(len(radii)):
        hat = np.interp(s, radii, np.arange(len(radii)) == ring, right=0.0)
        found.append(to_pixels[0][1] @ hat @ to_pixels[1][1].T)
    return np.array(found)


def _from_directions(
    optics: VolumeOptics, axis: int, aperture: float
) -> tuple[np.ndarray, np.ndarray]:
    """Directions along an axis and what each puts on the pixels (pixel, direction) of all
    superpixels, one on another.
    """
    pixels = optics.pixels[axis]
    steps = FINE * pixels
    directions = ((np.arange(steps) + 0.5) / steps * 2 - 1) * aperture
    size = optics.pitch * optics.widening / pixels
    nodes, _ = optics.pixel_nodes(3, axis)
    # what falls on the neighbours' pixels comes from them likewise
    several = np.arange(-2, 3) * pixels * size
    t = several[:, None, None] + nodes
    u, w = gauss(64)
    half = optics.open_width / 2
    left = 1 / optics.sensor_distance + 1 / optics.pupil_distance - 1 / optics.focal_length
    lens = w * np.exp(0.5j * optics.k * left * (half * u) ** 2)
    to_middle = optics.sensor_distance * directions / optics.magnification
    light = np.zeros((pixels, steps))
    for place in t:
        away = place.reshape(-1, 1) - to_middle
        field = np.exp(-1j * optics.k / optics.sensor_distance * half * away[..., None] * u) @ lens
        light += (np.abs(field) ** 2).reshape(pixels, -1, steps).mean(axis=1)
    return directions, light
