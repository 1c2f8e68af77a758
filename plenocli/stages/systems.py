"""The system matrix as learn-dict and reconstruct use it: one matrix (superpixel, pixel, point) in float64."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from plenocli.errors import InputError
from plenocli.stages.progress import note


@dataclass(frozen=True)
class System:
    """blocks (offset, pixel, point); offsets (offset, 2); shapes (rows, columns) of a superpixel and an object block; accuracy: the
    record that simulate-pif left."""

    path: Path
    blocks: np.ndarray
    offsets: np.ndarray
    pixel_shape: tuple
    object_shape: tuple
    accuracy: dict = field(default_factory=dict)

    @property
    def own(self):
        return self.blocks[np.flatnonzero(np.all(self.offsets == 0, axis=1))[0]]


def read_system(path, mem_limit=None):
    """System of a pif artefact; several bands are averaged, as equal shares of the light. InputError where it lacks (0, 0) or
    belongs to a hexagonal lattice."""
    from plenocli.artefacts import read_pif

    artefact = read_pif(path, mem_limit)
    if artefact.attrs.get("pif", {}).get("lattice", "square") != "square":
        raise InputError("belongs to a hexagonal lattice, whose object blocks do not tile a picture in rows and columns", path,
                         "use the pif of a camera with a square lattice")
    matrices = artefact.data["pif/A"]
    if len(matrices) > 1:
        note(f"{Path(path).name} holds {len(matrices)} bands; they are averaged, as equal shares of the light")
    offsets = np.asarray(artefact.data["pif/lenslet_offset"], int)
    if not np.any(np.all(offsets == 0, axis=1)):
        raise InputError("lacks the object's own superpixel, offset (0, 0)", path, "run simulate-pif again")
    blocks = np.mean(matrices, axis=0, dtype=np.float64)
    shapes = [tuple(int(n) for n in artefact.data[f"pif/{name}_shape"]) for name in ("pixel", "object")]
    if blocks.shape[1:] != (np.prod(shapes[0]), np.prod(shapes[1])):
        raise InputError(f"has matrices of {blocks.shape[1:]} for superpixels {shapes[0]} and object blocks {shapes[1]}", path, "run simulate-pif again")
    return System(Path(path), blocks, offsets, *shapes, artefact.provenance.accuracy)
