"""reconstruct, tile by tile: finished tiles lie beside the result until that is written, so that a
run that was killed goes on from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.errors import OutputError, PlenoError
from plenocli.base.progress import bar, note
from plenocli.base.tiling import InParts, bands, to_plane
from plenocli.execution.pool import Pool, run_all
from plenocli.files.bench import Bench
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.reconstruction import Entry, Reconstruction, Stats
from plenocli.inverse.picture.tiles import NUISANCES, Tile, counts, joined
from plenocli.stages.inverse.reconstruct.recipe import Recipe
from plenocli.stages.inverse.reconstruct.solved import Solved


@dataclass(frozen=True, kw_only=True)
class SolvedTile:
    """What a tile's own lenslets show.

    value, sigma: (lenslet_row, lenslet_column, point), sigma None where the method knows none.
    trace: what was found in it.
    stats: of the method.
    """

    value: np.ndarray
    sigma: np.ndarray | None
    trace: tuple[Entry, ...]
    stats: Stats | None

    @classmethod
    def of(cls, found: Reconstruction, tile: Tile) -> SolvedTile:
        """Of the picture of a tile and what is around it."""
        sigma = None if found.sigma is None else found.sigma[tile.within]
        value = found.value[tile.within]
        return cls(value=value, sigma=sigma, trace=found.trace, stats=found.stats)


@dataclass(frozen=True, kw_only=True)
class PlaneOfTiles:
    """The rows of a picture whose tiles are finished; see InParts.

    bench: where they are.
    tiles: all of them, row by row.
    which: of the arrays of a tile.
    shape: points (rows, columns) of an object in one band.
    bands: of the picture.
    """

    bench: Bench | HeldTiles
    tiles: tuple[Tile, ...]
    which: int
    shape: tuple[int, int]
    bands: int

    def __call__(self) -> Iterator[np.ndarray]:
        rows: dict[int, list[int]] = {}
        for number, tile in enumerate(self.tiles):
            rows.setdefault(tile.own[0].start, []).append(number)
        size = self.shape[0] * self.shape[1]
        for band in range(self.bands):
            points = slice(band * size, (band + 1) * size)
            for numbers in rows.values():
                planes = [to_plane(self._read(n)[:, :, points], self.shape) for n in numbers]
                for part in bands(len(planes[0]), self.shape[0]):
                    yield np.concatenate([plane[part] for plane in planes], axis=1)

    def _read(self, number: int) -> np.ndarray:
        arrays = self.bench.get(number)
        if arrays is None:
            raise OutputError("a finished tile is gone or damaged", self.bench.folder, "run again")
        return arrays[self.which]


@dataclass(frozen=True)
class HeldTiles:
    """A Bench in memory, of a result of which nobody knows here where it will lie."""

    folder: None = None
    tiles: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict)

    def get(self, tile: int) -> tuple[np.ndarray, ...] | None:
        """As of Bench."""
        return self.tiles.get(tile)

    def put(self, tile: int, arrays: Sequence[np.ndarray]) -> None:
        """As of Bench."""
        self.tiles[tile] = tuple(arrays)


def bench_of(
    target: Path | None, recipe: Recipe, capture: dict[str, Any], tiles: Sequence[Tile]
) -> Bench | HeldTiles:
    """Where the tiles of a result are kept until it is written.

    target: the result; None where that is elsewhere.
    capture: as in Solved.
    """
    if target is None:
        return HeldTiles()
    return Bench.beside(
        target, (replace(recipe.settings, workers=1), recipe.digests, capture, tiles)
    )


def solve_all(
    pool: Pool,
    task: Callable[[tuple[int, Tile]], SolvedTile],
    tiles: Sequence[Tile],
    bench: Bench | HeldTiles,
    *,
    clip: bool,
) -> Stats | None:
    """Solve the tiles that are not finished; the first PlenoError is raised.

    task: found by its name in a module, for other processes.
    clip: as of `keep`.

    Returns what the method tells of one of them, None where none was left to be solved.
    """
    stats: Stats | None = None
    todo = [(n, tile) for n, tile in enumerate(tiles) if bench.get(n) is None]
    with bar(None, len(tiles), "tiles of lenslets") as progress:
        progress.update(len(tiles) - len(todo))
        for number, found in run_all(pool, ((job[0], task, job) for job in todo)):
            if isinstance(found, PlenoError):
                raise found
            keep(bench, number, found, clip=clip)
            stats = found.stats
            progress.update()
    return stats


def keep(bench: Bench | HeldTiles, number: int, found: SolvedTile, *, clip: bool) -> None:
    """Keep a finished tile; clip: its negative values set to zero."""
    # what is negative is counted before
    counted = [np.count_nonzero(found.value < 0), *counts(found.trace)]
    values = [np.maximum(found.value, 0) if clip else found.value]
    values += [] if found.sigma is None else [found.sigma]
    bench.put(number, [*values, np.array(counted, float)])


def put_together(
    sample: Reconstruction,
    bench: Bench | HeldTiles,
    tiles: Sequence[Tile],
    system: LensletMatrix,
    *,
    declared: bool,
    **told: Any,
) -> Solved:
    """The picture of a capture whose tiles are finished.

    sample: of the piece that stands for it, with the stats of the method.
    system: the matrix of its lenslets.
    declared: whether the capture says where its sensor saturates.
    told: what else there is to tell of it, as in Solved.
    """
    first, bands = bench.get(0), max(1, len(system.bands))
    assert first is not None
    count = [max(tile.own[axis].stop for tile in tiles) for axis in (0, 1)]
    rows, columns = (n * points for n, points in zip(count, system.object_shape))
    size = (rows, columns) if bands == 1 else (bands, rows, columns)
    parts = [
        InParts(
            shape=size,
            dtype=np.float64,
            parts=PlaneOfTiles(
                bench=bench,
                tiles=tuple(tiles),
                which=which,
                shape=system.object_shape,
                bands=bands,
            ),
        )
        for which in range(len(first) - 1)
    ]
    read = map(bench.get, range(len(tiles)))
    counted = np.asarray(sum(arrays[-1] for arrays in read if arrays is not None))
    pixels = count[0] * count[1] * system.own.shape[0]
    trace = joined(sample, counted[1:], pixels, declared=declared)
    for entry in trace:
        if isinstance(entry, NUISANCES) and entry.found:
            note(entry.sentence)
    made: dict[str, Any] = {"value": parts[0], "sigma": parts[1] if len(parts) > 1 else None}
    return Solved(
        found=replace(sample, trace=trace, **made),
        negative_share=float(counted[0]) / np.prod(size),
        block=system.object_shape,
        bands=system.bands,
        **told,
    )
