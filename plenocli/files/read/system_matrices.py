"""The system matrix as learn-dict and reconstruct use it: one matrix (superpixel, pixel, point)."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import collected_notes, note
from plenocli.forward.accuracy.field_nodes import FieldNodes, Place
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

    return _lenslet_matrix(read_pif(path), path, by_band=by_band)


@dataclass(frozen=True, kw_only=True)
class FieldMatrix:
    """The matrices of a whole array.

    path: of the index of kind pif-field.
    nodes: places of the field.
    parts: their matrices.
    pitch: of the lenslets, m.
    by_band: as for read_lenslet_matrix.
    """

    path: Path
    nodes: FieldNodes
    parts: list["Artefact"]
    pitch: float
    by_band: bool = False

    def at(self, place: Place) -> LensletMatrix:
        """The matrix of a lenslet at a place (rows, columns; m from the axis)."""
        from plenocli.files.artefacts.shards import at_place

        mixed = at_place(self.nodes, self.parts, place)
        with collected_notes():
            return _lenslet_matrix(mixed, self.path, by_band=self.by_band)


def read_field_matrix(path: Path, *, by_band: bool = False) -> FieldMatrix | None:
    """The matrices of an index of kind pif-field; None where it is a pif of another kind.

    Raises InputError as read_lenslet_matrix.
    """
    from plenocli.files.artefacts.reading import opened_artefact, read_artefact
    from plenocli.files.artefacts.shards import PIF_KINDS, read_field

    with opened_artefact(path, PIF_KINDS, ("pif/A",), verify=False) as (artefact, _):
        if artefact.kind != "pif-field":
            return None
    nodes, parts = read_field(path, read_artefact(path, PIF_KINDS))
    camera = _camera(parts[0], path)
    if camera is None:
        raise InputError("does not say for which camera it is", path, "run simulate-pif again")
    return FieldMatrix(
        path=Path(path), nodes=nodes, parts=parts, pitch=camera.lenslet_array.pitch, by_band=by_band
    )


def _lenslet_matrix(artefact: "Artefact", path: Path, *, by_band: bool) -> LensletMatrix:
    """As read_lenslet_matrix, of an artefact of kind pif."""
    from plenocli.files.artefacts.shards import shapes_of

    if artefact.attrs.get("pif", {}).get("lattice", "square") != "square":
        raise InputError(
            "belongs to a hexagonal lattice, whose object blocks do not tile a "
            "picture in rows and columns",
            path,
            "use the pif of a camera with a square lattice",
        )
    offsets = np.asarray(artefact.data["pif/lenslet_offset"], int)
    if not np.any(np.all(offsets == 0, axis=1)):
        raise InputError(
            "lacks the object's own superpixel, offset (0, 0)", path, "run simulate-pif again"
        )
    shapes = shapes_of(artefact, path)
    matrices = artefact.data["pif/A"]
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
    notes = about.get("notes") or {}
    if camera is None or "first_pixel" in notes or any(notes.get("chief", ())):
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
