"""Where scenes come from: photographs, spectral EXR files, image artefacts, the
ColorChecker, uniform targets.

A scene answers one question: its reflectance at a wavelength on a grid of object points, in
image orientation.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Protocol

import numpy as np

from plenocli.base.errors import UsageError

EMBEDDED = "skimage:"
_RGB_CENTRES = np.array([450e-9, 545e-9, 630e-9])
"""Where the blue, green and red channels of a photograph stand in the spectrum; linear in
between, constant outside.
"""


class Scene(Protocol):
    """What is in front of the camera.

    spectral: whether its reflectance depends on the wavelength.
    """

    spectral: bool

    def at(self, wavelength: float, rows: int, columns: int) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m) on rows x columns object points."""
        ...


class Uniform:
    """The same reflectance everywhere, beyond the array's edge too."""

    spectral = False

    def __init__(self, level: float) -> None:
        self.level = level

    def at(self, wavelength: float, rows: int, columns: int) -> np.ndarray:
        """Reflectance (row, column), the level everywhere."""
        return np.full((rows, columns), self.level, dtype=np.float32)


class Photograph:
    """A linear picture (row, column, channel); in colour its reflectance is interpolated
    between B, G and R.
    """

    def __init__(self, values: np.ndarray, sampling: str, spectral: bool) -> None:
        self.values, self.sampling = values, sampling
        self.spectral = spectral and values.shape[2] >= 3

    def at(self, wavelength: float, rows: int, columns: int) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m), of a grey picture its luminance."""
        from plenocli.forward.scene.sample import luminance, sample_picture

        if not self.spectral:
            return sample_picture(luminance(self.values), rows, columns, self.sampling)
        weights = [np.interp(wavelength, _RGB_CENTRES, one) for one in np.eye(3)]
        picture = sum(w * self.values[:, :, 2 - band] for band, w in enumerate(weights) if w)
        return sample_picture(picture, rows, columns, self.sampling)


class Cube:
    """A spectral picture (band, row, column); linear between its bands, constant outside them."""

    spectral = True

    def __init__(self, wavelengths: np.ndarray, values: np.ndarray, sampling: str) -> None:
        self.wavelengths, self.values, self.sampling = np.asarray(wavelengths), values, sampling

    def at(self, wavelength: float, rows: int, columns: int) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m), linear between the bands."""
        from plenocli.forward.scene.sample import sample_picture

        position = np.interp(wavelength, self.wavelengths, np.arange(len(self.wavelengths)))
        low = min(int(position), len(self.wavelengths) - 1)
        high = min(low + 1, len(self.wavelengths) - 1)
        part = position - low
        return sample_picture(
            (1 - part) * self.values[low] + part * self.values[high], rows, columns, self.sampling
        )


class Chart:
    """The ColorChecker over the whole array."""

    spectral = True

    def at(self, wavelength: float, rows: int, columns: int) -> np.ndarray:
        """Reflectance (row, column) of the chart at a wavelength (m)."""
        from plenocli.forward.scene.chart import chart_scene

        return chart_scene(rows, columns, np.array([wavelength]))[0][0]


def read_scene(
    name: str | Path, *, sampling: str = "fit", spectral: bool = False
) -> Photograph | Cube | Chart:
    """The scene called `name`.

    name: "colorchecker", "skimage:astronaut", or the path of a photograph, a spectral EXR or an
        image artefact.
    sampling: "fit" a photograph to the object points by area averages, or "crop" it.
    spectral: whether the camera tells wavelengths apart; if not, a colour photograph counts by its
        luminance.

    Raises InputError or UsageError where it cannot be had.
    """
    if str(name) == "colorchecker":
        return Chart()
    if str(name).startswith(EMBEDDED):
        return Photograph(embedded_photograph(str(name).removeprefix(EMBEDDED)), sampling, spectral)
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.files.images.pictures import read_picture

    path = Path(name)
    if path.suffix == ".h5":
        artefact = read_artefact(path, "image")
        values = artefact.data["image/value"]
        if values.ndim == 2:
            return Photograph(values[:, :, None], sampling, False)
        return Cube(artefact.data["image/wavelength"], values, sampling)
    picture = read_picture(path)
    if picture.is_spectral:
        return Cube(picture.wavelengths, np.moveaxis(picture.values, -1, 0), sampling)
    return Photograph(picture.values, sampling, spectral)


@lru_cache(maxsize=16)
def embedded_photograph(name: str) -> np.ndarray:
    """A photograph that ships inside scikit-image, linear float32 (row, column, channel).

    Raises UsageError for unknown names.
    """
    from importlib.util import find_spec

    from plenocli.files.images.pictures import read_picture

    folder = Path(find_spec("skimage").submodule_search_locations[0]) / "data"
    for suffix in (".png", ".jpg"):
        if (folder / f"{name}{suffix}").is_file():
            return read_picture(folder / f"{name}{suffix}").values
    known = ", ".join(sorted(p.stem for p in folder.iterdir() if p.suffix in (".png", ".jpg")))
    raise UsageError(
        f"scikit-image ships no photograph {name!r}", EMBEDDED + name, f"choose one of {known}"
    )
