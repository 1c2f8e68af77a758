"""The pupil of an objective as its white image shows it behind lenslets.

Even light over the specimen fills every direction that the objective takes; what one sees behind a
lenslet is the pupil's intensity, as wide as diffraction at the lenslet makes it. Rings of intensity
are fitted, none below zero. docs/model.md, "Volumes".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import InputError
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.shaped import Grating

RINGS = 16
"""Rings that are fitted."""
FINE = 6
"""Directions across a pixel."""
PLACES = 3
"""Places across a pixel, at which light is followed."""
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

    Light from one direction is a plane wave, and the array a grating: its orders go on in
    directions of their own, and interfere on the pixels.
    """
    from scipy.fft import ifft2

    array = Grating(optics, PLACES)
    series = array.through[0].astype(np.complex64)
    down, right = (
        ((np.arange(FINE * n) + 0.5) / (FINE * n) * 2 - 1) * radii[-1] for n in optics.pixels
    )
    to_rows, to_columns = (
        array.propagation(array.orders(axis) + optics.k / optics.magnification * s[:, None])
        for axis, s in enumerate((down, right))
    )
    found = np.zeros((len(radii), *series.shape))
    for s, rows in zip(down, to_rows):
        inside = np.hypot(s, right) < radii[-1]
        field = ifft2(series * rows[:, None] * to_columns[inside, None], axes=(1, 2))
        hats = [
            np.interp(np.hypot(s, right[inside]), radii, np.arange(len(radii)) == ring)
            for ring in range(len(radii))
        ]
        found += np.tensordot(hats, field.real**2 + field.imag**2, 1)
    whole = np.array([array.on_pixels(one)[0, :, 0] for one in found])
    return whole[:, : optics.pixels[0]]
