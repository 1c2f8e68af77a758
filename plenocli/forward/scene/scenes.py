"""What is in front of the camera: a photograph, a spectral picture, a chart or an even target.

A scene answers one question: its reflectance at a wavelength on a grid of object points, in
image orientation.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from plenocli.forward.scene.sample import ALL

_RGB_CENTRES = np.array([450e-9, 545e-9, 630e-9])
"""Where the blue, green and red channels of a photograph stand in the spectrum; linear in
between, constant outside.
"""


class Scene(Protocol):
    """What is in front of the camera.

    spectral: whether its reflectance depends on the wavelength.
    """

    spectral: bool

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m) on rows x columns object points, of the
        rows `part`, a slice without a step.
        """
        ...


class Uniform:
    """The same reflectance everywhere, beyond the array's edge too."""

    spectral = False

    def __init__(self, level: float) -> None:
        self.level = level

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column), the level everywhere."""
        first, last, _ = part.indices(rows)
        return np.full((last - first, columns), self.level, dtype=np.float32)


class Photograph:
    """A linear picture (row, column, channel); in colour its reflectance is interpolated
    between B, G and R.
    """

    def __init__(self, values: np.ndarray, sampling: str, spectral: bool) -> None:
        self.values, self.sampling = values, sampling
        self.spectral = spectral and values.shape[2] >= 3

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m), of a grey picture its luminance."""
        from plenocli.forward.scene.sample import luminance, sample_picture

        if not self.spectral:
            return sample_picture(luminance(self.values), rows, columns, self.sampling, part)
        weights = [np.interp(wavelength, _RGB_CENTRES, one) for one in np.eye(3)]
        picture = sum(w * self.values[:, :, 2 - band] for band, w in enumerate(weights) if w)
        return sample_picture(picture, rows, columns, self.sampling, part)


class Cube:
    """A spectral picture (band, row, column); linear between its bands, constant outside them."""

    spectral = True

    def __init__(self, wavelengths: np.ndarray, values: np.ndarray, sampling: str) -> None:
        self.wavelengths, self.values, self.sampling = np.asarray(wavelengths), values, sampling

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m), linear between the bands."""
        from plenocli.forward.scene.sample import sample_picture

        position = np.interp(wavelength, self.wavelengths, np.arange(len(self.wavelengths)))
        low = min(int(position), len(self.wavelengths) - 1)
        high = min(low + 1, len(self.wavelengths) - 1)
        share = position - low
        picture = (1 - share) * self.values[low] + share * self.values[high]
        return sample_picture(picture, rows, columns, self.sampling, part)


class Polarised:
    """A scene whose light is linearly polarised in part, alike at all wavelengths.

    scene: its reflectance, of both states together.
    degree: (row, column, 1) or (1, 1), the degree of linear polarisation s1/s0 from -1 (all along
        90 degrees) to 1 (all along 0).
    """

    def __init__(self, scene: Scene, degree: np.ndarray, sampling: str) -> None:
        self.scene, self.degree, self.sampling = scene, degree, sampling
        self.spectral = scene.spectral

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m), of both states together."""
        return self.scene.at(wavelength, rows, columns, part)

    def degree_at(self, rows: int, columns: int) -> np.ndarray:
        """Degree of polarisation (row, column)."""
        from plenocli.forward.scene.sample import sample_picture

        if self.degree.size == 1:
            return np.full((rows, columns), self.degree.item(), np.float32)
        return sample_picture(self.degree, rows, columns, self.sampling).reshape(rows, columns)


class Chart:
    """The ColorChecker over the whole array."""

    spectral = True

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) of the chart at a wavelength (m)."""
        from plenocli.forward.scene.chart import chart_scene

        return chart_scene(rows, columns, np.array([wavelength]))[0][0][part]
