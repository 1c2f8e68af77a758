"""Kernels of a volume, into their artefact and out of it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.volume.stack import Stack

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance


def stack_artefact(stack: Stack, provenance: "Provenance") -> "Artefact":
    """The artefact of kind pif-stack."""
    from plenocli.files.artefacts.container import Artefact

    data = {
        "stack/A": stack.A,
        "stack/plane": stack.plane.astype(np.int32),
        "stack/lenslet_offset": stack.lenslet_offset.astype(np.int32),
        "stack/depth": stack.depth,
        "stack/spacing": stack.spacing,
        "stack/wavelength": np.array([stack.wavelength]),
        "stack/pixel_shape": np.array(stack.pixel_shape),
        "stack/point_shape": np.array(stack.point_shape),
        "stack/column_energy": stack.column_energy,
    }
    return Artefact("pif-stack", data, {"stack": {"lattice": stack.lattice}}, provenance)


def read_stack(path: Path | str) -> Stack:
    """The kernels in a file of kind pif-stack.

    Raises InputError for another file, or one whose parts do not fit together.
    """
    from plenocli.files.artefacts.reading import read_artefact

    return stack_of(read_artefact(path, "pif-stack"), path)


def stack_of(artefact: "Artefact", path: Path | str) -> Stack:
    """The kernels that an artefact holds; `path`: its file, for messages.

    Raises InputError where its parts do not fit together.
    """
    from plenocli.base.errors import InputError

    data = artefact.data
    pixels, points = (tuple(data[f"stack/{n}_shape"].tolist()) for n in ("pixel", "point"))
    plane = data["stack/plane"]
    numbers = np.arange(len(data["stack/depth"]))
    lattice = str(artefact.attrs.get("stack", {}).get("lattice", "square"))
    whole = data["stack/A"].shape[1:] == (int(np.prod(pixels)), int(np.prod(points)))
    # a hexagonal cell has two lenslets, one below the other
    whole &= lattice == "square" or pixels[0] % 2 == points[0] % 2 == 0
    if not whole or not np.array_equal(np.unique(plane), numbers) or (np.diff(plane) < 0).any():
        raise InputError(
            "holds kernels that do not fit their planes, pixels or voxels",
            path,
            "make it again with simulate-pif",
        )
    return Stack(
        A=data["stack/A"],
        plane=plane,
        lenslet_offset=data["stack/lenslet_offset"],
        depth=data["stack/depth"],
        spacing=data["stack/spacing"],
        pixel_shape=pixels,
        point_shape=points,
        wavelength=float(data["stack/wavelength"][0]),
        column_energy=data["stack/column_energy"],
        accuracy=AccuracyRecord.from_json(artefact.provenance.accuracy) or AccuracyRecord(),
        lattice=lattice,
    )
