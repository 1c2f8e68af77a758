"""Light from a whole scene onto a whole sensor through one system matrix that
serves every lenslet.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from plenocli.base.tiling import to_blocks


def superpixel_light(
    blocks: Iterable[tuple[np.ndarray, np.ndarray]],
    offsets: np.ndarray,
    around: np.ndarray | None,
    samples: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Carry a scene to the sensor; object points add incoherently.

    blocks: pairs (object points, A_o (lenslet offset, pixel, point)) that cover every point once,
        so that a fine matrix streams through memory.
    offsets: (lenslet offset, 2).
    around: (row, column) reflectance of the object points of some lenslets, and of as many lenslets
        on each side of them as the offsets reach. None: no picture, and no light.
    samples: object points (rows, columns) of a lenslet.

    Returns light (lenslet_row, lenslet_column, pixel), 0 without a picture, and white (pixel,), the
    superpixel of a uniform white object that goes on beyond the array: a lenslet's own light and
    all of its neighbours'; float64.
    docs/model.md, "The system matrix".
    """
    reach = reach_of(offsets)
    light: np.ndarray = np.zeros(())
    white: np.ndarray = np.zeros(())
    points = None if around is None else to_blocks(around, samples)
    for part, block in blocks:
        if points is not None:
            light = light + _carried(block, offsets, points[:, :, part], reach)
        white = white + block.sum(axis=(0, 2), dtype=np.float64)
    return light, white


def reach_of(offsets: np.ndarray) -> tuple[int, int]:
    """Lenslets (rows, columns) beside its own that one object's light reaches."""
    rows, columns = np.abs(offsets).max(axis=0).tolist()
    return rows, columns


def _carried(
    block: np.ndarray, offsets: np.ndarray, points: np.ndarray, reach: tuple[int, int]
) -> np.ndarray:
    """sum_o A_o x[l - o] for the lenslets that have all their neighbours, float64.

    points: (lenslet_row, lenslet_column, point) of them and of those within `reach`.
    """
    rows, columns = (n - 2 * r for n, r in zip(points.shape, reach))
    light = np.zeros((rows, columns, block.shape[1]), np.result_type(block, points))
    for one, (down, right) in zip(block, offsets):
        row, column = reach[0] - down, reach[1] - right
        light += points[row : row + rows, column : column + columns] @ one.T
    return light.astype(np.float64)
