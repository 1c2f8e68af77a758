"""Light from a whole scene onto a whole sensor through one system matrix that
serves every lenslet.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from plenocli.base.linear_maps import BlockToeplitz
from plenocli.base.tiling import to_blocks


def superpixel_light(
    blocks: Iterable[tuple[np.ndarray, np.ndarray]],
    offsets: np.ndarray,
    picture: np.ndarray | None,
    samples: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Carry a scene to the sensor; object points add incoherently.

    blocks: pairs (object points, A_o (lenslet offset, pixel, point)) that cover every point once,
        so that a fine matrix streams through memory.
    offsets: (lenslet offset, 2).
    picture: (row, column) reflectance of the object points of the whole array; beyond it the scene
        goes on mirrored, as far as the offsets reach. None: no picture, and no light.
    samples: object points (rows, columns) of a lenslet.

    Returns light (lenslet_row, lenslet_column, pixel), 0 without a picture, and white (pixel,), the
    superpixel of a uniform white object that goes on beyond the array: a lenslet's own light and
    all of its neighbours'; float64.
    docs/model.md, "The system matrix".
    """
    reach = np.abs(offsets).max(axis=0)
    if picture is not None:
        margins = [(int(n) * k, int(n) * k) for n, k in zip(reach, samples)]
        points = to_blocks(np.pad(picture, margins, mode="symmetric"), samples)
    light: np.ndarray = np.zeros(())
    white: np.ndarray = np.zeros(())
    for part, block in blocks:
        if picture is not None:
            light = light + BlockToeplitz(block, offsets, points.shape[:2]).forward(
                points[:, :, part]
            ).astype(np.float64)
        white = white + block.sum(axis=(0, 2), dtype=np.float64)
    if picture is not None:
        light = light[reach[0] : light.shape[0] - reach[0], reach[1] : light.shape[1] - reach[1]]
    return light, white
