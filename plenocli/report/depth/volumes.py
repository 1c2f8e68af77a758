"""Pictures of a volume: projections and slices, and how far to trust them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.units import format_length
from plenocli.report.drawing import Figures, bare, drawing, show_picture

if TYPE_CHECKING:
    from collections.abc import Callable

    from plenocli.files.results.volumes import StoredVolume
    from plenocli.forward.volume.stack import Stack

DEEP, FEW = 3.0, 3
"""Depth over width from which on, and planes up to which, planes alone are shown."""
SLICES = 6
"""Planes drawn, evenly from all."""


def volume_figures(volume: StoredVolume, name: str) -> Figures:
    """[(PNG, caption)] of a volume."""
    slices = (_slices(volume), f"{name}: planes by their depth.")
    width = max(n * d for n, d in zip(volume.value.shape[1:], volume.spacing))
    planes = len(volume.depth)
    if planes <= FEW or planes * volume.step > DEEP * width:
        # a photographic camera's planes are layers far apart
        return [slices]
    figures = [
        (
            _projections(volume.value, volume),
            f"{name}: brightest voxel along the axis, along rows and along columns.",
        )
    ]
    if volume.sigma is not None:
        figures.append(
            (
                _projections(volume.sigma, volume, what=np.mean),
                f"{name}: mean standard deviation along the same directions.",
            )
        )
    return [*figures, slices]


def kernel_figures(stack: Stack, name: str) -> Figures:
    """[(PNG, caption)] of a volume's kernels: what a voxel of some planes lights."""
    chosen = _spread(len(stack.depth))
    parts, (rows, columns) = stack.parts(), stack.pixel_shape
    point = stack.A.shape[2] // 2
    with drawing(3.1 * min(3, len(chosen)), 3.35 * -(-len(chosen) // 3)) as made:
        panels = made.figure.subplots(-(-len(chosen) // 3), min(3, len(chosen)), squeeze=False)
        for axes in panels.ravel()[len(chosen) :]:
            axes.set_visible(False)
        for axes, plane in zip(panels.ravel(), chosen):
            kernels, offsets = parts[plane]
            least = offsets.min(axis=0)
            size = offsets.max(axis=0) - least + 1
            light = np.zeros((size[0], size[1], rows * columns), np.float32)
            light[tuple((offsets - least).T)] = kernels[:, :, point]
            picture = light.reshape(*size, rows, columns).transpose(0, 2, 1, 3)
            picture = np.sqrt(picture.reshape(size[0] * rows, -1))
            show_picture(axes, picture / picture.max(), format_length(float(stack.depth[plane])))
    return [(made.png, f"{name}: root of the light of one voxel in planes of some depths.")]


def _spread(planes: int) -> np.ndarray:
    """Numbers of the planes that are drawn."""
    return np.unique(np.linspace(0, planes - 1, min(planes, SLICES)).round().astype(int))


def _top(values: np.ndarray) -> float:
    return max(float(np.percentile(values, 99.9)), 1e-30)


def _projections(values: np.ndarray, volume: StoredVolume, what: Callable = np.max) -> bytes:
    planes, rows, columns = values.shape
    step, (high, wide) = volume.step, volume.spacing
    sizes = [planes * step, rows * high, columns * wide]
    width = 5.2
    unit = width / (sizes[2] + sizes[0])
    with drawing(width + 0.4, unit * (sizes[1] + sizes[0]) + 0.6) as made:
        grid = made.figure.add_gridspec(
            2,
            2,
            width_ratios=[sizes[2], sizes[0]],
            height_ratios=[sizes[1], sizes[0]],
            wspace=0.04,
            hspace=0.04,
        )
        top = _top(values)
        views = (
            (0, 0, what(values, 0), high / wide, "across the axis"),
            (0, 1, what(values, 2).T, high / step, ""),
            (1, 0, what(values, 1), step / wide, ""),
        )
        for row, column, picture, aspect, title in views:
            axes = made.figure.add_subplot(grid[row, column])
            axes.imshow(picture / top, cmap="gray", vmin=0, vmax=1, aspect=aspect)
            bare(axes, title)
        bar = made.figure.add_subplot(grid[1, 1])
        bare(bar)
        names = ("columns", "rows", "planes")
        span = "\n".join(
            f"{name} {format_length(float(f'{size:.4g}'))}"
            for name, size in zip(names, reversed(sizes))
        )
        bar.text(0.5, 0.5, span, ha="center", va="center", fontsize=7)
    return made.png


def _slices(volume: StoredVolume) -> bytes:
    values = volume.value
    chosen = _spread(len(values))
    columns = min(3, len(chosen))
    rows = -(-len(chosen) // columns)
    height, width = values.shape[1:]
    top = _top(values)
    with drawing(3.1 * columns, (3.1 * height / width + 0.25) * rows) as made:
        panels = made.figure.subplots(rows, columns, squeeze=False).ravel()
        for axes in panels[len(chosen) :]:
            axes.set_visible(False)
        for axes, plane in zip(panels, chosen):
            show_picture(axes, values[plane] / top, format_length(float(volume.depth[plane])))
    return made.png
