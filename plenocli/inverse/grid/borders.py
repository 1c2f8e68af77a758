"""Dark lines between superpixels that hold several bright parts: which of them are borders."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from plenocli.base.progress import note
from plenocli.inverse.grid.distortion import GridModel
from plenocli.inverse.grid.sites import typical_light
from plenocli.inverse.grid.white_image import in_frame

LINE = 0.1
"""Of the darkest line's depth, by which a line must stand out of what surrounds it."""
BOTTOM = 0.02
"""Of the darkest line's depth, within which a line is at its bottom."""
EDGE = 0.15
"""Of a cell: what is looked at on either side of a line's flat bottom."""
ALIKE = 0.7
"""Of the chosen lines' depth, from which on others might as well be the superpixels' borders."""
AROUND = 2
"""Sites beyond those that were measured which may be of the array, too."""


def to_dark_borders(
    image: np.ndarray,
    model: GridModel,
    index: np.ndarray,
    pitch: float,
    *,
    near: Sequence[float] | None,
    count: Sequence[int] | None,
) -> GridModel:
    """The map moved so that cell borders lie on dark lines between superpixels.

    The brightness of several parts draws a centroid towards the brightest; dark lines, seen in
    profiles along both lattice directions of all cells folded into one, do not care. Lines between
    the parts may be as dark as those between superpixels: of several candidates the one nearest to
    `near`, that of the known `count`, or the best filled frame, decides.
    """
    lines = [_dark_lines(image, model, index, pitch, axis) for axis in (0, 1)]
    found = []
    for down, depth_down in lines[0]:
        for right, depth_right in lines[1]:
            moved = replace(model, shift=model.shift - np.array([down, right]))
            whole = in_frame(moved.at(_block(index)), image.shape, 0.5 * pitch)
            hint = 0.0
            if near is not None:
                hint = -float(np.hypot(*(moved.at(np.rint(index_at(moved, near))) - near)))
            elif count is not None:
                lit = lit_cells(image, moved, index)
                shape = np.ptp(lit, axis=0) + 1 if len(lit) else (0, 0)
                hint = -float(np.abs(np.subtract(shape, count)).sum())
            found.append(((hint, int(whole.sum())), depth_down + depth_right, moved))
    if not found:
        return model
    merit, depth, chosen = max(found, key=lambda one: one[:2])
    others = [m for m in found if m[2] is not chosen and m[0] == merit and m[1] > ALIKE * depth]
    if others:
        centre = chosen.at(np.rint(index_at(chosen, np.array(image.shape) / 2)))
        note(
            "warning: lines within superpixels are nearly as dark as those between them, and "
            f"{len(others) + 1} grids fill the frame alike; the darkest lines are taken, which "
            f"puts a centre at row {centre[0]:.1f}, column {centre[1]:.1f}: if no superpixel has "
            "its middle there, say where one has"
        )
    return chosen


def _dark_lines(
    image: np.ndarray, model: GridModel, index: np.ndarray, pitch: float, axis: int
) -> list[tuple[float, float]]:
    """Dark lines across one lattice direction: [(distance of the line from the cell's
    border, cells; depth)].
    """
    from scipy.signal import find_peaks

    chosen = index[:: max(1, len(index) // 300)]
    bins = max(24, int(4 * pitch))
    along = (np.arange(bins) + 0.5) / bins
    across = (np.arange(16) + 0.5) / 16 - 0.5
    grid = np.stack(np.meshgrid(along, across, indexing="ij"), axis=-1)[
        ..., :: 1 if axis == 0 else -1
    ]
    vectors = np.stack(
        [model.at(chosen + step / 2) - model.at(chosen - step / 2) for step in np.eye(2)], axis=1
    )
    where = model.at(chosen)[:, None, None] + np.einsum("abk,nkd->nabd", grid, vectors)
    profile = _between(image, where).mean(axis=(0, 2), dtype=float)
    kernel = np.ones(max(1, bins // 24)) / max(1, bins // 24)
    smooth = np.convolve(np.tile(profile, 3), kernel, "same")[bins : 2 * bins]
    depth = smooth.max() - smooth
    # a dark band is one line, however its bottom is ruffled; folded thrice, no line is cut
    folded = np.tile(depth, 3)
    bottom = BOTTOM * depth.max()
    peaks, _ = find_peaks(folded, height=0.35 * depth.max(), prominence=LINE * depth.max())
    left = np.array([np.flatnonzero(folded[:p] < folded[p] - bottom)[-1] for p in peaks])
    right = np.array([p + np.flatnonzero(folded[p:] < folded[p] - bottom)[0] for p in peaks])
    middle = (left + right + 1) / 2 / bins - 1
    once = (middle >= 0) & (middle < 1)
    lines = []
    for peak, start, flat in zip(peaks[once], middle[once], (right - left)[once] / bins):
        others = np.abs((middle[once] - start + 0.5) % 1 - 0.5)
        reach = min(flat / 2 + EDGE, others[others > 1e-9].min(initial=0.8) / 2)
        for _ in range(2):  # the second time with the line in the middle of what is looked at
            start = start + _line(along, profile, start, reach)
        lines.append((start - 0.5, float(folded[peak])))
    return lines


def _between(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values of `image` at places (..., 2) px by linear interpolation, those
    outside at the border.
    """
    where = np.clip(where, 0, np.array(image.shape) - 1)
    low = np.minimum(where.astype(int), np.array(image.shape) - 2)
    down, right = np.moveaxis((where - low).astype(np.float32), -1, 0)
    i, j = np.moveaxis(low, -1, 0)
    above = image[i, j] * (1 - right) + image[i, j + 1] * right
    return above * (1 - down) + (image[i + 1, j] * (1 - right) + image[i + 1, j + 1] * right) * down


def _line(along: np.ndarray, profile: np.ndarray, start: float, reach: float) -> float:
    """Middle of the dark line at `start` less `start`, cells: midway between two blurred edges,
    each of its own side's brightness.

    The darkest place itself, or the centre of the darkness, lies nearer to the dimmer side: a
    quarter of a pixel between a filter that passes much and one that passes little.
    """
    from scipy.optimize import least_squares
    from scipy.special import erf

    away = (along - start + 0.5) % 1 - 0.5
    close = np.abs(away) < reach
    x, y = away[close], profile[close]
    sides = [y[side] for side in (x < -0.5 * reach, x > 0.5 * reach)]
    if min(map(len, sides)) == 0:  # lines lie so near to each other that nothing is between
        return 0.0
    levels = [max(float(side.mean()), 0.0) for side in sides]
    scale = max(*levels, 1e-30)

    def miss(p):
        middle, half, blur, left, right = p
        return (
            left * (1 - erf((x - middle + half) / blur))
            + right * (1 + erf((x - middle - half) / blur))
        ) / 2 - y / scale

    found = least_squares(
        miss,
        [0.0, 0.25 * reach, 0.25 * reach, levels[0] / scale, levels[1] / scale],
        bounds=([-reach / 2, 0, 0.02 * reach, 0, 0], [reach / 2, reach, reach, 3, 3]),
        x_scale=[reach, reach, reach, 1, 1],
    )
    return float(found.x[0])


def index_at(model: GridModel, position: Sequence[float] | np.ndarray) -> np.ndarray:
    """Index (2,), not whole, that the map takes to `position`: Newton steps
    from the affine part.
    """
    site = np.zeros(2)
    for _ in range(20):
        here = model.at(site)
        slope = np.stack([model.at(site + step) - here for step in np.eye(2)], axis=1)
        site = site + np.linalg.solve(slope, np.asarray(position, float) - here)
    return site


def _block(index: np.ndarray) -> np.ndarray:
    """Indices (M, N, 2) of a block of sites around `index` (N, 2) and AROUND more: further out no
    map is to be trusted.
    """
    low, high = index.min(axis=0) - AROUND, index.max(axis=0) + AROUND
    return np.stack(
        np.meshgrid(*(np.arange(a, b + 1) for a, b in zip(low, high)), indexing="ij"), axis=-1
    )


def lit_cells(image: np.ndarray, model: GridModel, index: np.ndarray) -> np.ndarray:
    """Indices (N, 2) of the sites in the `_block` of `index` whose cell holds at least 0.3 of the
    typical light.
    """
    cells = _block(index)
    inner = np.stack(np.meshgrid(*[np.linspace(-0.4, 0.4, 9)] * 2, indexing="ij"), axis=-1)
    near = np.rint(model.at(cells[:, :, None, None] + inner)).astype(int)
    frame = np.array(image.shape) - 1
    inside = ((near >= 0) & (near <= frame)).all(axis=(-1, 2, 3))
    near = np.clip(near, 0, frame)
    light = image[near[..., 0], near[..., 1]].mean(axis=(2, 3))
    return cells[inside & (light > 0.3 * typical_light(light[inside]))]
