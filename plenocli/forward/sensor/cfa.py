"""Colour filter array: which colour a pixel has, and what it makes of light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import ConfigError

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

MONO = "Y"


@dataclass(frozen=True, kw_only=True)
class ColourProfile:
    """What the colours of a camera are.

    to_rgb: (3, 3) linear sRGB of its R, G and B, each over that of white; white is (1, 1, 1).
    neutral: (3,) its R, G and B of white, the largest is 1; None where nobody says.
    """

    to_rgb: np.ndarray
    neutral: np.ndarray | None = None

    @classmethod
    def of_matrix(
        cls, from_xyz: np.ndarray, neutral: np.ndarray | None = None
    ) -> ColourProfile | None:
        """Of the matrix (3, 3) that makes a camera's colours of XYZ (D65), in any scale; None where
        it cannot be turned round.
        """
        from plenocli.forward.scene.colour import xyz_of_linear_srgb

        of_rgb = np.asarray(from_xyz, float) @ xyz_of_linear_srgb()
        white = of_rgb.sum(axis=1, keepdims=True)
        if not (np.isfinite(of_rgb).all() and (white > 0).all()):
            return None
        of_rgb = of_rgb / white
        if np.linalg.cond(of_rgb) > 1e3:
            return None
        return cls(to_rgb=np.linalg.inv(of_rgb), neutral=neutral)

    def from_xyz(self) -> np.ndarray:
        """(3, 3) the camera's colours over those of white of XYZ (D65): a DNG's ColorMatrix."""
        from plenocli.forward.scene.colour import xyz_of_linear_srgb

        return np.linalg.inv(xyz_of_linear_srgb() @ self.to_rgb)


def colour_profile(camera: Camera) -> ColourProfile | None:
    """The profile of a camera's sensor under its illuminant: the matrix that comes closest to the
    colours of many surfaces in least squares and keeps white; None of a mono sensor.
    """
    if camera.sensor.cfa == "mono" or set("RGB") - set(camera.sensor.cfa):
        return None
    from plenocli.forward.scene.colour import linear_srgb, white_point, xyz
    from plenocli.forward.scene.tables import camera_sensitivity, illuminant, surfaces

    fine, light = np.arange(400e-9, 701e-9, 5e-9), camera.light.illuminant
    assert camera.sensor.camera is not None  # a description with colours has one
    curves = camera_sensitivity(camera.sensor.camera, fine)
    seen = np.stack([curves[letter] for letter in "RGB"]) * illuminant(light, fine)
    white = seen.sum(axis=1)
    reflectance = surfaces(fine)
    own = reflectance @ (seen / white[:, None]).T
    true = linear_srgb(xyz(fine, reflectance, light), white_point(light))
    # white stays: rows of the matrix have the sum 1
    part, *_ = np.linalg.lstsq(own[:, :2] - own[:, 2:], true - own[:, 2:], rcond=None)
    return ColourProfile(
        to_rgb=np.column_stack([part.T, 1 - part.sum(axis=0)]), neutral=white / white.max()
    )


def preview(signal: np.ndarray, cfa: str, profile: ColourProfile | None) -> np.ndarray:
    """A picture of a mosaic of colours, half as large.

    signal: (row, column) above black.
    cfa: four letters.
    profile: None: R, G and B are taken for those of the screen. Where it does not tell white, the
        picture is grey on the whole.

    Returns (row // 2, column // 2, 3) linear sRGB, unclipped; the brightest hundredth is above 1.
    """
    rows, columns = (n // 2 * 2 for n in signal.shape)
    colour = cfa_map((2, 2), cfa)
    quads = signal[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).transpose(1, 3, 0, 2)
    planes = np.stack(
        [quads[colour == c].mean(axis=0) if c in cfa else quads.mean(axis=(0, 1)) for c in "RGB"]
    )
    neutral = None if profile is None else profile.neutral
    neutral = planes.mean(axis=(1, 2)) if neutral is None else neutral
    planes = planes / np.maximum(neutral, 1e-6 * max(float(neutral.max()), 1e-30))[:, None, None]
    if profile is not None:
        planes = np.tensordot(profile.to_rgb, planes, axes=1)
    return np.moveaxis(planes / max(float(np.percentile(planes, 99)), 1e-30), 0, -1)


def cfa_map(shape: tuple[int, int], cfa: str, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Colour letter of every pixel.

    shape: (rows, columns).
    cfa: "mono" or the four letters of the top left 2x2 pixels, row by row.
    origin: sensor position (row, column) of the first pixel, for windows cut out of a sensor.

    Returns (row, column) of one-letter strings, MONO everywhere for "mono".
    Raises ConfigError where `cfa` is neither.
    """
    if cfa == "mono":
        return np.full(shape, MONO)
    if len(cfa) != 4:
        raise ConfigError(f"a colour filter array is mono or four letters, not {cfa!r}")
    tile = np.array(list(cfa)).reshape(2, 2)
    rows, columns = ((np.arange(n) + first) % 2 for n, first in zip(shape, origin))
    return tile[np.ix_(rows, columns)]


def sensitivity(camera: Camera, wavelengths: ArrayLike) -> tuple[tuple[str, ...], np.ndarray]:
    """Quantum efficiency by colour.

    A mono sensor has one colour MONO with [sensor] quantum_efficiency at every wavelength; another
    one has the measured relative sensitivities of [sensor] camera (peak 1) times
    quantum_efficiency.
    wavelengths: (wavelength,) m.

    Returns the colours' letters and (colour, wavelength).
    """
    wavelengths = np.atleast_1d(np.asarray(wavelengths, float))
    efficiency = camera.sensor.quantum_efficiency
    efficiency = 1.0 if efficiency is None else efficiency
    if camera.sensor.cfa == "mono":
        return (MONO,), np.full((1, len(wavelengths)), efficiency)
    from plenocli.forward.scene.tables import camera_sensitivity

    assert camera.sensor.camera is not None  # a description with colours has one
    curves = camera_sensitivity(camera.sensor.camera, wavelengths)
    letters = tuple(dict.fromkeys(camera.sensor.cfa))
    return letters, efficiency * np.stack([curves[letter] for letter in letters])
