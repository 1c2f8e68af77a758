"""The ColorChecker as a flat spectral scene: which object sample sees which patch,
and its reflectance.
"""

import numpy as np

from plenocli.forward.scene.tables import colorchecker

PATCH_ROWS, PATCH_COLS = 4, 6
FRAME_REFLECTANCE = 0.03  # the chart's black frame, spectrally flat


def _patch_of(count, patches, gap, whole):
    """Patch number 0..patches-1, or -1 in a gap, for each of `count` cells that tile an edge of
    `patches` patches.

    `gap` is the share of a patch's pitch that its frame takes. whole=False asks at the cell's
    centre, True asks whether the cell lies inside one patch from end to end.
    """
    edges = np.arange(count + 1) * patches / count
    low, high = (edges[:-1], edges[1:]) if whole else ((edges[:-1] + edges[1:]) / 2,) * 2
    number = np.floor((low + high) / 2).astype(int)
    slack = 1e-9 * patches
    inside = (low - number >= gap / 2 - slack) & (high - number <= 1 - gap / 2 + slack)
    return np.where(inside, number, -1)


def chart_labels(rows, cols, gap=0.1, whole_cells=False):
    """Label map (rows, cols) uint8: 0 on the frame, 1..24 on the patches of
    colorchecker(), row by row.

    The chart's 4 x 6 patches fill the grid (dark skin at the top left). A cell gets the label of
    the patch at its centre; with whole_cells=True only if it lies in the patch entirely, as a
    lenslet must to measure one patch alone.
    gap: share 0..<1 of a patch's pitch taken by the frame around it.
    """
    if not 0 <= gap < 1:
        raise ValueError(f"gap is a share of the patch pitch, 0 to below 1, not {gap}")
    row, col = (
        _patch_of(rows, PATCH_ROWS, gap, whole_cells),
        _patch_of(cols, PATCH_COLS, gap, whole_cells),
    )
    label = row[:, None] * PATCH_COLS + col[None, :] + 1
    return np.where((row[:, None] < 0) | (col[None, :] < 0), 0, label).astype(np.uint8)


def chart_scene(rows, cols, wavelengths, gap=0.1, frame=FRAME_REFLECTANCE):
    """The ColorChecker over a grid of object samples: (reflectance (band, rows, cols) float32,
    labels (rows, cols)).

    wavelengths (band,) m; gap as in chart_labels;
    frame: reflectance of the black frame.
    """
    labels = chart_labels(rows, cols, gap)
    reflectance = colorchecker(wavelengths)[2]
    palette = np.vstack([np.full((1, reflectance.shape[1]), frame), reflectance]).astype(np.float32)
    return np.ascontiguousarray(np.moveaxis(palette[labels], -1, 0)), labels
