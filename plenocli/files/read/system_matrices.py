"""The system matrix as learn-dict and reconstruct use it: one matrix (superpixel, pixel, point)
in float64.
"""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.text import by
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.inverse.picture.lenslet_model import LensletMatrix, MatrixOrigin, gathered

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact


def read_lenslet_matrix(path: Path, *, by_band: bool = False) -> LensletMatrix:
    """The matrix of a pif artefact, its wavelengths averaged, as equal shares of the light.

    path: of the pif.
    by_band: wavelengths of a camera with filters in its pupil make an object with several bands
        instead (plenocli.forward.scene.light.band_weights).

    Raises InputError where the pif lacks offset (0, 0) or belongs to a hexagonal lattice.
    """
    from plenocli.files.artefacts.shards import read_pif

    artefact = read_pif(path)
    if artefact.attrs.get("pif", {}).get("lattice", "square") != "square":
        raise InputError(
            (
                "belongs to a hexagonal lattice, whose object blocks do not tile a "
                "picture in rows and columns"
            ),
            path,
            "use the pif of a camera with a square lattice",
        )
    offsets = np.asarray(artefact.data["pif/lenslet_offset"], int)
    if not np.any(np.all(offsets == 0, axis=1)):
        raise InputError(
            "lacks the object's own superpixel, offset (0, 0)", path, "run simulate-pif again"
        )
    shapes = []
    for name in ("pixel", "object"):
        rows, columns = artefact.data[f"pif/{name}_shape"]
        shapes.append((int(rows), int(columns)))
    matrices = artefact.data["pif/A"]
    if matrices.shape[2:] != (np.prod(shapes[0]), np.prod(shapes[1])):
        raise InputError(
            (
                f"has matrices of {by(matrices.shape[2:])} for superpixels of {by(shapes[0])} "
                f"pixels and blocks of {by(shapes[1])} points"
            ),
            path,
            "run simulate-pif again",
        )
    camera = _camera(artefact, path)
    bands, weights, illuminant = _bands(artefact, camera) if by_band else ((), None, None)
    if weights is None and len(matrices) > 1:
        note(
            f"{Path(path).name} holds {len(matrices)} wavelengths; they are averaged, as "
            "equal shares of the light"
        )
    return LensletMatrix(
        path=Path(path),
        blocks=gathered(matrices, weights),
        offsets=offsets,
        pixel_shape=shapes[0],
        object_shape=shapes[1],
        accuracy=AccuracyRecord.from_json(artefact.provenance.accuracy),
        bands=bands,
        illuminant=illuminant,
        origin=_origin(artefact, camera, weights),
    )


def _camera(artefact: "Artefact", path: Path) -> Camera | None:
    """The camera that a pif was computed for, where it says so."""
    from plenocli.files.config.camera_file import parse_camera

    config = artefact.provenance.config
    return parse_camera(config, path) if config else None


def _origin(
    artefact: "Artefact", camera: Camera | None, weights: np.ndarray | None
) -> MatrixOrigin | None:
    """What a pif was computed from; None where it does not say, or for a lenslet off the axis."""
    about = artefact.attrs.get("pif", {})
    if camera is None or "first_pixel" in (about.get("notes") or {}):
        return None
    return MatrixOrigin(
        camera=camera,
        wavelengths=tuple(float(w) for w in artefact.data["pif/wavelength"]),
        weights=weights,
        coherent_ring=int(about.get("coherent_ring") or 0),
    )


def _bands(
    artefact: "Artefact", camera: Camera | None
) -> tuple[tuple[float, ...], np.ndarray | None, str | None]:
    """(wavelengths of the bands, weights (band, wavelength), illuminant) of a pif whose camera
    has filters; ((), None, None) for others.
    """
    from plenocli.forward.scene.light import band_weights
    from plenocli.forward.scene.tables import illuminant

    if camera is None or camera.filter_array is None:
        return (), None, None
    bands, weights = band_weights(
        camera, artefact.data["pif/wavelength"], lambda w: illuminant(camera.light.illuminant, w)
    )
    return tuple(float(b) for b in bands), weights, camera.light.illuminant
