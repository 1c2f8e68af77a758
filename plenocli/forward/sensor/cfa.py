"""Colour filter array: which colour a pixel has, and what it makes of light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import ConfigError
from plenocli.forward.sensor.frames import shifted_neighbours

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

MONO = "Y"
FLAT = 0.05
"""Change over two pixels, of the light, in the mean of all sides, up to which white is flat enough
to compare neighbours.
"""
STEEP = 0.3
"""The same to one side: beyond it there is an edge."""
UNLIKE = 0.1
"""Difference of two pixels in white (median of its logarithm) that are not of one colour."""
CLEAR = 5.0
"""Times by which one diagonal of the 2x2 pixels must differ more than the other, so that it is
colour and not noise.
"""
FEWEST = 1000
"""Pixels of a diagonal that tell."""
LOOKED_AT = 1024
"""px, side of the part of a white image that tells of its colours."""
GREENS = (("GBRG", "GRBG"), ("BGGR", "RGGB"))
"""Arrays whose greens lie along the falling diagonal, and those with them along the other."""


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


def colour_planes(signal: np.ndarray, cfa: str) -> np.ndarray:
    """Mean R, G and B of every two by two pixels of a mosaic of colours.

    signal: (row, column) above black.
    cfa: four letters.

    Returns (3, row // 2, column // 2).
    """
    rows, columns = (n // 2 * 2 for n in signal.shape)
    colour = cfa_map((2, 2), cfa)
    quads = signal[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).transpose(1, 3, 0, 2)
    return np.stack(
        [quads[colour == c].mean(axis=0) if c in cfa else quads.mean(axis=(0, 1)) for c in "RGB"]
    )


def preview(planes: np.ndarray, profile: ColourProfile | None) -> np.ndarray:
    """A picture of the colours of a mosaic.

    planes: (3, row, column) R, G and B, as colour_planes makes them.
    profile: None: R, G and B are taken for those of the screen. Where it does not tell white, the
        picture is grey on the whole.

    Returns (row, column, 3) linear sRGB, unclipped; the brightest hundredth is above 1.
    """
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


def doubted_array(white: np.ndarray, cfa: str) -> str | None:
    """Why a white image cannot be of a colour filter array, in words; None where it can.

    The two greens are alike in any light, red and blue in hardly any: of the two diagonals of 2x2
    pixels the greens' is the one that differs less.
    white: (row, column) even light, without the dark; its middle is looked at.
    cfa: what the array is said to be: "mono" or four letters.
    """
    first = [max(0, (n - LOOKED_AT) // 4 * 2) for n in white.shape]
    image = white[first[0] :, first[1] :][:LOOKED_AT, :LOOKED_AT]
    image = np.where(image > 0, image, np.nan)
    inside = image[2:-2, 2:-2]
    two_off = [moved[2:-2, 2:-2] for moved in shifted_neighbours(image, 2)]
    diagonal = (image[1:-3, 1:-3] + image[1:-3, 3:-1] + image[3:-1, 1:-3] + image[3:-1, 3:-1]) / 4
    flat = np.abs(sum(two_off) / (4 * inside) - 1) < FLAT
    flat &= np.all([np.abs(pixel / inside - 1) < STEEP for pixel in two_off], axis=0)
    contrast = np.where(flat, np.abs(np.log(inside / diagonal)), np.nan)
    falling = np.add.outer(*(np.arange(n) % 2 for n in inside.shape)) % 2 == 0
    sides = [side[np.isfinite(side)] for side in (contrast[falling], contrast[~falling])]
    if min(side.size for side in sides) < FEWEST:
        return None
    (alike, where), (unlike, _) = sorted(
        (float(np.median(side)), pair) for side, pair in zip(sides, GREENS)
    )
    others = next(pair for pair in GREENS if pair != where)
    if unlike < max(UNLIKE, CLEAR * alike) or cfa not in ("mono", *others):
        return None
    return (
        f"neighbours along one diagonal differ by {np.expm1(unlike):.0%}, along the other by "
        f"{np.expm1(alike):.1%}, as pixels of {' or '.join(where)} do and those of {cfa} do not"
    )


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
