"""reconstruct, tile by tile: finished tiles lie beside the result until that is written, so that a
run that was killed goes on from them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import OutputError, PlenoError
from plenocli.base.progress import bar
from plenocli.base.tiling import InParts, bands, to_plane
from plenocli.execution.pool import Pool, run_all
from plenocli.files.bench import Bench
from plenocli.inverse.picture.reconstruction import Entry, Stats
from plenocli.inverse.picture.tiles import Tile, counts


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


@dataclass(frozen=True, kw_only=True)
class PlaneOfTiles:
    """The rows of a picture whose tiles are finished; see InParts.

    bench: where they are.
    tiles: all of them, row by row.
    which: of the arrays of a tile.
    shape: points (rows, columns) of an object in one band.
    bands: of the picture.
    """

    bench: Bench
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


def solve_all(
    pool: Pool,
    task: Callable[[tuple[int, Tile]], SolvedTile],
    tiles: Sequence[Tile],
    bench: Bench,
    finish: Callable[[np.ndarray], np.ndarray],
) -> Stats | None:
    """Solve the tiles that are not finished; the first PlenoError is raised.

    task: found by its name in a module, for other processes.
    finish: what becomes of a value before it is kept.

    Returns what the method tells of one of them, None where none was left to be solved.
    """
    stats: Stats | None = None
    todo = [(n, tile) for n, tile in enumerate(tiles) if bench.get(n) is None]
    with bar(None, len(tiles), "tiles of lenslets") as progress:
        progress.update(len(tiles) - len(todo))
        for number, found in run_all(pool, ((job[0], task, job) for job in todo)):
            if isinstance(found, PlenoError):
                raise found
            values = [finish(found.value), *([] if found.sigma is None else [found.sigma])]
            # what is negative is counted before it is clipped
            counted = [np.count_nonzero(found.value < 0), *counts(found.trace)]
            bench.put(number, [*values, np.array(counted, float)])
            stats = found.stats
            progress.update()
    return stats


def picture(
    bench: Bench, tiles: Sequence[Tile], shape: tuple[int, int], bands: int
) -> tuple[InParts, InParts | None, np.ndarray]:
    """(value, sigma or None, how many values are negative and the sum of the tiles' `counts`) of a
    picture whose tiles are finished.
    """
    first = bench.get(0)
    assert first is not None
    rows, columns = (n * max(tile.own[axis].stop for tile in tiles) for axis, n in enumerate(shape))
    size = (rows, columns) if bands == 1 else (bands, rows, columns)
    found = [
        InParts(
            shape=size,
            dtype=np.float64,
            parts=PlaneOfTiles(
                bench=bench, tiles=tuple(tiles), which=which, shape=shape, bands=bands
            ),
        )
        for which in range(len(first) - 1)
    ]
    read = map(bench.get, range(len(tiles)))
    counted = sum(arrays[-1] for arrays in read if arrays is not None)
    return found[0], found[1] if len(found) > 1 else None, np.asarray(counted)
