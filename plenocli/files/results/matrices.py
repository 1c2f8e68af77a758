"""System matrices as they are looked at: with what simulate-pif says of them."""

import os
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
    rank, condition, resolution: (band,) as simulate-pif says them, each None where it does not.
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
    condition: np.ndarray | None
    resolution: np.ndarray | None
    facts: dict[str, object]
    accuracy: AccuracyRecord | None

    @property
    def own(self) -> np.ndarray:
        """A (pixel, point) of the object's own superpixel in the first band."""
        place = np.flatnonzero((np.asarray(self.offsets) == 0).all(axis=1))
        return self.blocks[0, place[0] if place.size else 0]

    def told_apart(self) -> list[str]:
        """Rank and condition of each band in words, the parts that are known."""
        return [self._told_apart(band) for band in range(len(self.wavelengths))]

    def _told_apart(self, band: int) -> str:
        from plenocli.forward.propagation.diagnosis import is_bound

        words = []
        if self.rank is not None:
            words.append(f"rank {int(self.rank[band])} of {int(np.prod(self.object_shape))}")
        if self.condition is not None:
            condition = self.condition[band]
            bound = self.resolution is not None and is_bound(condition, self.resolution[band])
            words.append(f"condition {'at least ' if bound else ''}{condition:.1e}")
        return ", ".join(words)


def _numbers(value: object, bands: int) -> np.ndarray | None:
    return None if value is None else np.broadcast_to(np.ravel(np.asarray(value, float)), bands)


def matrix_of(artefact: "Artefact", path: str | os.PathLike | None = None) -> StoredMatrix:
    """The matrix that a pif artefact holds, of the file `path`. Raises InputError as shapes_of."""
    from plenocli.files.artefacts.shards import shapes_of

    pixel_shape, object_shape = shapes_of(artefact, path)
    data, attrs = artefact.data, artefact.attrs.get("pif", {})
    bands = len(data["pif/wavelength"])
    return StoredMatrix(
        blocks=data["pif/A"],
        offsets=data["pif/lenslet_offset"],
        wavelengths=data["pif/wavelength"],
        pixel_shape=pixel_shape,
        object_shape=object_shape,
        column_energy=data["pif/column_energy"],
        singular_values=data.get("pif/singular_values"),
        rank=_numbers(attrs.get("rank"), bands),
        condition=_numbers(attrs.get("condition"), bands),
        resolution=_numbers(attrs.get("resolution"), bands),
        facts=dict(attrs),
        accuracy=AccuracyRecord.from_json(artefact.provenance.accuracy),
    )
