"""Colour from spectra: CIE XYZ, CIELAB, linear sRGB, colour difference.

Tristimulus values are scaled so that the perfect diffuser under the light in question has Y = 1. A
spectrum known at a few wavelengths is taken as piecewise linear between them and constant beyond
the outermost: every result is then a fixed linear map of the samples, exact for spectrally flat
surfaces, usable from one band upwards, and the closer to the truth the more bands there are.
"""

import numpy as np
from numpy.typing import ArrayLike

from plenocli.forward.scene.tables import illuminant, observer

# IEC 61966-2-1: linear sRGB from XYZ relative to D65, and the Bradford cone matrix (Lam 1985).
_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)


def xyz_weights(wavelengths: ArrayLike, light: str = "D65") -> np.ndarray:
    """The linear map from reflectances to XYZ, integrated over the CIE 1931 observer's 1 nm table.

    wavelengths: (band,) m, ascending.
    light: name of an illuminant, see tables.

    Returns (3, band); the rows sum to the XYZ of the light itself (Y = 1).
    Raises ValueError where the wavelengths do not ascend, ConfigError for an unknown light.
    """
    wavelengths = np.asarray(wavelengths, dtype=np.float64)
    if wavelengths.ndim != 1 or not wavelengths.size or np.any(np.diff(wavelengths) <= 0):
        raise ValueError("wavelengths must ascend")
    fine, matching = observer()
    hats = np.array([np.interp(fine, wavelengths, row) for row in np.eye(wavelengths.size)])
    weighted = matching * illuminant(light, fine)
    return weighted @ hats.T / weighted[1].sum()


def xyz(wavelengths: ArrayLike, spectra: ArrayLike, light: str = "D65") -> np.ndarray:
    """XYZ of reflectances.

    wavelengths: (band,) m, ascending.
    spectra: (..., band) reflectance.
    light: name of an illuminant, see tables.

    Returns (..., 3), Y = 1 for the perfect diffuser.
    Raises as xyz_weights.
    """
    return np.asarray(spectra, dtype=np.float64) @ xyz_weights(wavelengths, light).T


def white_point(light: str = "D65") -> np.ndarray:
    """XYZ (3,) of the perfect diffuser under the illuminant `light`, Y = 1."""
    return xyz_weights([560e-9], light)[:, 0]


def adapt(values: ArrayLike, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """XYZ as seen by an eye adapted to one white, moved to another; Bradford transform.

    values: (..., 3) XYZ.
    source: (3,) XYZ of the white the eye is adapted to.
    target: (3,) XYZ of the white to move to.

    Returns (..., 3) XYZ.
    """
    gain = (_BRADFORD @ target) / (_BRADFORD @ source)
    return np.asarray(values) @ (np.linalg.inv(_BRADFORD) @ (gain[:, None] * _BRADFORD)).T


def linear_srgb(values: ArrayLike, white: np.ndarray | None = None) -> np.ndarray:
    """Linear sRGB of XYZ, unclipped; (1, 1, 1) is the white exactly.

    values: (..., 3) XYZ.
    white: (3,) XYZ of the white that the values are relative to; None where it is D65 already.

    Returns (..., 3).
    IEC 61966-2-1.
    """
    d65 = white_point("D65")
    if white is not None:
        values = adapt(values, white, d65)
    rgb = np.asarray(values) @ _SRGB.T
    return rgb / (_SRGB @ d65)  # the published matrix is rounded: make white exactly (1, 1, 1)


def xyz_of_linear_srgb() -> np.ndarray:
    """(3, 3) XYZ (D65) of linear sRGB, the inverse of `linear_srgb`."""
    return np.linalg.inv(linear_srgb(np.eye(3)).T)


def encode_srgb(linear: ArrayLike) -> np.ndarray:
    """Display values 0..1 of linear sRGB, clipped; IEC 61966-2-1."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )


def preview_rgb(wavelengths: ArrayLike, cube: ArrayLike, light: str = "D65") -> np.ndarray:
    """A picture of a reflectance cube. White surfaces look white whatever the light.

    wavelengths: (band,) m, ascending.
    cube: (band, row, column) reflectance; of radiance, pass the quotient by a white surface's.
    light: name of an illuminant, see tables.

    Returns (3, row, column) float32, linear sRGB, unclipped.
    Raises as xyz_weights.
    """
    matrix = linear_srgb(xyz_weights(wavelengths, light).T, white_point(light)).T
    return np.tensordot(matrix, np.asarray(cube, dtype=np.float64), axes=1).astype(np.float32)


def lab(values: ArrayLike, white: np.ndarray) -> np.ndarray:
    """CIELAB of XYZ.

    values: (..., 3) XYZ.
    white: (3,) XYZ of the white that they are relative to.

    Returns (..., 3): L*, a*, b*.
    CIE 15:2004.
    """
    ratio = np.asarray(values, dtype=np.float64) / white
    f = np.where(ratio > (6 / 29) ** 3, np.cbrt(ratio), ratio * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.stack(
        [116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])],
        axis=-1,
    )


def delta_e_2000(first: ArrayLike, second: ArrayLike) -> np.ndarray:
    """CIEDE2000 colour difference with kL = kC = kH = 1.

    first, second: (..., 3) CIELAB.

    Returns (...).
    Sharma, Wu and Dalal, Color Research & Application 30 (2005) 21-30.
    """
    (l1, a1, b1), (l2, a2, b2) = (
        np.moveaxis(np.asarray(v, dtype=np.float64), -1, 0) for v in (first, second)
    )
    c7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    a1, a2 = (a * (1.5 - 0.5 * np.sqrt(c7 / (c7 + 25.0**7))) for a in (a1, a2))
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    grey = c1 * c2 == 0
    turn = np.where(grey, 0.0, (h2 - h1 + 180) % 360 - 180)
    turn = np.where(~grey & (h2 - h1 == 180), 180.0, turn)
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn) / 2)
    lm, cm = (l1 + l2) / 2, (c1 + c2) / 2
    far = np.abs(h1 - h2) > 180
    hm = np.where(
        grey, h1 + h2, np.where(far, h1 + h2 + np.where(h1 + h2 < 360, 360, -360), h1 + h2) / 2
    )
    t = (
        1
        - 0.17 * _cos(hm - 30)
        + 0.24 * _cos(2 * hm)
        + 0.32 * _cos(3 * hm + 6)
        - 0.20 * _cos(4 * hm - 63)
    )
    sl = 1 + 0.015 * (lm - 50) ** 2 / np.sqrt(20 + (lm - 50) ** 2)
    sc, sh = 1 + 0.045 * cm, 1 + 0.015 * cm * t
    rotation = 60 * np.exp(-(((hm - 275) / 25) ** 2))
    rt = -2 * np.sqrt(cm**7 / (cm**7 + 25.0**7)) * np.sin(np.radians(rotation))
    return np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rt * (dc / sc) * (dh / sh))


def _cos(degrees: np.ndarray) -> np.ndarray:
    return np.cos(np.radians(degrees))
