"""The ColorChecker as a flat spectral scene: which object sample sees which patch,
and its reflectance.
"""

import numpy as np
from numpy.typing import ArrayLike

from plenocli.forward.scene.tables import colorchecker

PATCH_ROWS, PATCH_COLS = 4, 6
FRAME_REFLECTANCE = 0.03  # the chart's black frame, spectrally flat


def patch_of(count: int, patches: int, gap: float, whole: bool) -> np.ndarray:
    """Which patch of a row or column of patches each cell sees.

    count: cells that tile the edge of the chart.
    patches: patches along that edge.
    gap: share of a patch's pitch that its frame takes.
    whole: False asks at the cell's centre, True whether the cell lies in one patch from end to end.

    Returns (count,) int, 0..patches-1, or -1 in a gap.
    """
    edges = np.arange(count + 1) * patches / count
    low, high = (edges[:-1], edges[1:]) if whole else ((edges[:-1] + edges[1:]) / 2,) * 2
    number = np.floor((low + high) / 2).astype(int)
    slack = 1e-9 * patches
    inside = (low - number >= gap / 2 - slack) & (high - number <= 1 - gap / 2 + slack)
    return np.where(inside, number, -1)


def chart_labels(rows: int, cols: int, gap: float = 0.1, whole_cells: bool = False) -> np.ndarray:
    """Which patch of the ColorChecker each cell of a grid sees.

    The chart's 4 x 6 patches fill the grid (dark skin at the top left).

    rows, cols: cells of the grid.
    gap: share 0..<1 of a patch's pitch taken by the frame around it.
    whole_cells: a cell gets the label of the patch at its centre; with True only if it lies in the
        patch entirely, as a lenslet must to measure one patch alone.

    Returns (rows, cols) uint8: 0 on the frame, 1..24 on the patches of colorchecker(), row by row.
    Raises ValueError where gap is out of range.
    """
    if not 0 <= gap < 1:
        raise ValueError(f"gap is a share of the patch pitch, 0 to below 1, not {gap}")
    row, col = (
        patch_of(rows, PATCH_ROWS, gap, whole_cells),
        patch_of(cols, PATCH_COLS, gap, whole_cells),
    )
    label = row[:, None] * PATCH_COLS + col[None, :] + 1
    return np.where((row[:, None] < 0) | (col[None, :] < 0), 0, label).astype(np.uint8)


def chart_scene(
    rows: int, cols: int, wavelengths: ArrayLike, gap: float = 0.1, frame: float = FRAME_REFLECTANCE
) -> tuple[np.ndarray, np.ndarray]:
    """The ColorChecker over a grid of object samples.

    rows, cols: samples of the grid.
    wavelengths: (band,) m.
    gap: share 0..<1 of a patch's pitch taken by the frame around it.
    frame: reflectance of the black frame.

    Returns (reflectance (band, rows, cols) float32, labels (rows, cols) as of chart_labels).
    Raises ValueError where gap is out of range.
    """
    labels = chart_labels(rows, cols, gap)
    reflectance = colorchecker(wavelengths)[2]
    palette = np.vstack([np.full((1, reflectance.shape[1]), frame), reflectance]).astype(np.float32)
    return np.ascontiguousarray(np.moveaxis(palette[labels], -1, 0)), labels
