"""The true objects behind a capture, which choose a weight with hindsight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.tiling import Plane, to_blocks
from plenocli.stages.inverse.reconstruct.recipe import Recipe, estimators_of


@dataclass(frozen=True)
class Truth:
    """Objects side by side, which stay in the file of an artefact.

    picture: (band, row, column) points.
    shape: points (rows, columns) of an object in one band.
    """

    picture: Plane
    shape: tuple[int, int]

    def cut(self, rows: slice, columns: slice) -> np.ndarray:
        """Those of some lenslets, (lenslet_row, lenslet_column, point)."""
        points = (
            slice(first * n, last * n)
            for n, length, part in zip(self.shape, self.picture.shape[1:], (rows, columns))
            for first, last, _ in [part.indices(length // n)]
        )
        return to_blocks(self.picture.window(*points), self.shape)


@lru_cache(maxsize=1)
def truth_of(recipe: Recipe, count: tuple[int, int]) -> Truth | None:
    """That which a person gave, a capture that holds its scene, an image .h5 or an EXR; None where
    there is none.

    count: lenslets (rows, columns).

    Raises InputError where it is not that of so many lenslets.
    """
    path, system = recipe.settings.truth, estimators_of(recipe).system
    if path is None:
        return None
    values, bands = _values(Path(path)), max(1, len(system.bands))

    def read(rows: slice, columns: slice) -> np.ndarray:
        part = values.window(rows, columns)
        part = part.reshape(-1, *part.shape[-2:])
        return part.mean(axis=0, keepdims=True) if bands == 1 else part

    given = int(np.prod(values.shape[:-2]))
    shape = 1 if bands == 1 else given, *values.shape[-2:]
    expected = bands, *(n * points for n, points in zip(count, system.object_shape))
    if shape != expected:
        raise InputError(
            (
                f"has {' x '.join(map(str, shape))} bands, rows and columns of points, the "
                f"picture {' x '.join(map(str, expected))}"
            ),
            path,
            "give the object as sampled (capture-sim --scene-out)",
        )
    return Truth(Plane(shape, read), system.object_shape)


def _values(path: Path) -> Plane:
    """(.., row, column) points; those of an artefact stay in its file."""
    if path.suffix != ".h5":
        from plenocli.files.images.pictures import read_picture

        return Plane.of(np.moveaxis(read_picture(path).values, -1, 0))
    from plenocli.files.artefacts.reading import opened_artefact

    apart = "capture/scene", "image/value", "capture/mosaic", "image/sigma"
    with opened_artefact(path, ("capture", "image"), apart) as (_, stored):
        found: Any = stored.get("capture/scene", stored.get("image/value"))
    if found is None:
        raise InputError("holds no scene", path, "give a simulated capture, or an image")
    return Plane(found.shape, found.window)
