"""Where scenes come from: photographs, spectral EXR files, image artefacts, the
ColorChecker, labelled spectra, uniform targets.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.progress import note
from plenocli.files.read.class_table import read_labelled
from plenocli.forward.scene.labelled import SpectraChart
from plenocli.forward.scene.scenes import Chart, Cube, Photograph, Polarised, Scene

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

EMBEDDED = "skimage:"


def read_scene(
    name: str | Path, *, sampling: str = "fit", spectral: bool = False
) -> Photograph | Cube | Chart | SpectraChart:
    """The scene called `name`.

    name: "colorchecker", "skimage:astronaut", or the path of a photograph, a spectral EXR or an
        image artefact; or of labelled spectra (a .csv or a folder), which make a chart.
    sampling: "fit" a photograph to the object points by area averages, or "crop" it.
    spectral: whether the camera tells wavelengths apart; if not, a colour photograph counts by its
        luminance.

    Raises InputError or UsageError where it cannot be had.
    """
    if str(name) == "colorchecker":
        return Chart()
    if str(name).startswith(EMBEDDED):
        return Photograph(embedded_photograph(str(name).removeprefix(EMBEDDED)), sampling, spectral)
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.images.pictures import read_picture

    path = Path(name)
    if path.suffix.lower() == ".csv" or path.is_dir():
        return SpectraChart(read_labelled(path))
    if path.suffix == ".h5":
        artefact = read_artefact(path, "image")
        values = artefact.data["image/value"]
        if values.ndim == 2:
            return Photograph(values[:, :, None], sampling, False)
        return Cube(artefact.data["image/wavelength"], values, sampling)
    picture = read_picture(path)
    if picture.wavelengths is not None:
        return Cube(picture.wavelengths, np.moveaxis(picture.values, -1, 0), sampling)
    return Photograph(picture.values, sampling, spectral)


def read_polarised(scene: Scene, degree: str, camera: Camera, sampling: str = "fit") -> Polarised:
    """A scene whose light is polarised in part.

    degree: of linear polarisation, -1 to 1: a number, or the path of a grey PNG or an EXR of one
        channel.
    camera: that looks at it, whose light must be that of both polarisations.
    sampling: as read_scene's, of the picture.

    Raises InputError for a picture, UsageError for a number, that no light has.
    """
    from plenocli.files.images.maps import read_transmittance
    from plenocli.forward.camera.pupil import tells_polarisation

    if camera.light.polarisation is not None:
        raise UsageError(
            f"the camera's light is polarised at {camera.light.polarisation} already",
            "--polarisation",
            "leave one of the two out",
        )
    if not tells_polarisation(camera):
        note("the camera has no polarisers: it does not tell how the light is polarised")
    try:
        values = np.array([[float(degree)]])
    except ValueError:
        values = read_transmittance(degree)
        if not (np.isfinite(values).all() and np.abs(values).max() <= 1):
            raise InputError(
                "holds values that are no degree of polarisation", degree, "use -1 to 1"
            ) from None
    if not np.abs(values).max() <= 1:
        raise UsageError(f"{degree} is no degree of polarisation", "--polarisation", "use -1 to 1")
    return Polarised(scene, values[:, :, None] if values.size > 1 else values, sampling)


@lru_cache(maxsize=16)
def embedded_photograph(name: str) -> np.ndarray:
    """A photograph that ships inside scikit-image, linear float32 (row, column, channel).

    Raises UsageError for unknown names.
    """
    from importlib.util import find_spec

    from plenocli.files.images.pictures import read_picture

    package = find_spec("skimage")
    assert package is not None and package.submodule_search_locations is not None
    folder = Path(package.submodule_search_locations[0]) / "data"
    for suffix in (".png", ".jpg"):
        if (folder / f"{name}{suffix}").is_file():
            return read_picture(folder / f"{name}{suffix}").values
    known = ", ".join(sorted(p.stem for p in folder.iterdir() if p.suffix in (".png", ".jpg")))
    raise UsageError(
        f"scikit-image ships no photograph {name!r}", EMBEDDED + name, f"choose one of {known}"
    )
