"""System matrices as they are looked at: with what simulate-pif says of them."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.accuracy_record import AccuracyRecord

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact


@dataclass(frozen=True, kw_only=True)
class StoredMatrix:
    """A system matrix artefact.

    blocks: A (band, superpixel, pixel, point).
    offsets: (superpixel, 2) rows and columns from the object's own.
    wavelengths: (band,) m.
    pixel_shape, object_shape: (rows, columns) of a superpixel and of an object block.
    column_energy: (band, point) share of the light on the superpixels kept.
    singular_values: (band, value) or (value,), or None.
    rank: (band,) numerical rank, or None.
    facts: name of an attribute -> its value, such as condition or kappa.
    accuracy: what it was planned for, or None.
    """

    blocks: np.ndarray
    offsets: np.ndarray
    wavelengths: np.ndarray
    pixel_shape: tuple[int, int]
    object_shape: tuple[int, int]
    column_energy: np.ndarray
    singular_values: np.ndarray | None
    rank: np.ndarray | None
    facts: dict[str, object]
    accuracy: AccuracyRecord | None

    @property
    def own(self) -> np.ndarray:
        """A (pixel, point) of the object's own superpixel in the first band."""
        place = np.flatnonzero((np.asarray(self.offsets) == 0).all(axis=1))
        return self.blocks[0, place[0] if place.size else 0]


def _pair(values: np.ndarray) -> tuple[int, int]:
    rows, columns = (int(n) for n in values)
    return rows, columns


def matrix_of(artefact: "Artefact") -> StoredMatrix:
    """The matrix that a pif artefact holds."""
    data, attrs = artefact.data, artefact.attrs.get("pif", {})
    return StoredMatrix(
        blocks=data["pif/A"],
        offsets=data["pif/lenslet_offset"],
        wavelengths=data["pif/wavelength"],
        pixel_shape=_pair(data["pif/pixel_shape"]),
        object_shape=_pair(data["pif/object_shape"]),
        column_energy=data["pif/column_energy"],
        singular_values=data.get("pif/singular_values"),
        rank=attrs.get("rank"),
        facts=dict(attrs),
        accuracy=AccuracyRecord.from_json(artefact.provenance.accuracy),
    )
