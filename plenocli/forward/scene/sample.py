"""Photographs and spectral images resampled to the grid of object points by
exact area averaging.
"""

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.errors import InputError

ALL = slice(None)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # ITU-R BT.709 / sRGB primaries, linear


def luminance(picture: ArrayLike) -> np.ndarray:
    """Linear luminance of a picture, by the weights of ITU-R BT.709.

    picture: (rows, cols[, channels]), linear, of 1 to 4 channels. Two and four channels carry
        alpha last, which is left out.

    Returns (rows, cols).
    Raises ValueError for other numbers of channels.
    """
    picture = np.asarray(picture)
    if picture.ndim == 2:
        return picture
    channels = picture.shape[2]
    if channels in (1, 2):
        return picture[:, :, 0]
    if channels in (3, 4):
        return picture[:, :, :3] @ _LUMINANCE.astype(
            picture.dtype if picture.dtype.kind == "f" else np.float64
        )
    raise ValueError(f"a picture of {channels} channels has no luminance")


def area_average(
    values: ArrayLike,
    count: int,
    axis: int = 0,
    start: float = 0.0,
    stop: float | None = None,
    part: slice = ALL,
) -> np.ndarray:
    """Means over equal cells that tile a part of one axis, in input samples.

    The input is piecewise constant, sample k covering [k, k+1); cells may begin and end inside
    samples, so that the sum of cell mean x cell width is exactly the integral of the input over
    [start, stop).

    values: of any shape.
    count: number of cells.
    axis: along which they lie.
    start, stop: ends of what they tile, in samples; by default the whole axis.
    part: the cells that are wanted, a slice without a step.

    Returns float64, as values with `count` along the axis, or as many as are wanted.
    Raises ValueError where the cells do not fit.
    """
    values = np.moveaxis(np.asarray(values, dtype=np.float64), axis, 0)
    length = values.shape[0]
    stop = float(length) if stop is None else float(stop)
    if not (0 <= start < stop <= length + 1e-9 * length) or count < 1:
        raise ValueError(f"cells over [{start}, {stop}) do not fit {length} samples")
    first, last, _ = part.indices(count)
    edges = np.minimum(start + (stop - start) * np.arange(first, last + 1) / count, length)
    whole = np.minimum(edges.astype(np.intp), length - 1)
    part = (edges - whole).reshape((-1,) + (1,) * (values.ndim - 1))
    integral = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, axis=0)])
    at_edges = integral[whole] + part * values[whole]
    return np.moveaxis(np.diff(at_edges, axis=0) / ((stop - start) / count), 0, axis)


def sample_picture(
    picture: ArrayLike, rows: int, cols: int, how: str = "fit", part: slice = ALL
) -> np.ndarray:
    """A picture on a grid of object points, centred.

    picture: (height, width[, channels]).
    rows, cols: object points.
    how: "fit" averages the largest centred part with the grid's aspect ratio over equal cells
        (edges may cut pixels); "crop" takes the central rows x cols pixels as they are.
    part: rows that are wanted, a slice without a step.

    Returns (rows, cols[, channels]) float32.
    Raises InputError where the picture is empty, or too small to crop.
    """
    picture = np.asarray(picture)
    height, width = picture.shape[:2]
    if not height or not width:
        raise InputError("the picture has no pixels", fix="give a picture of at least 1 x 1 pixels")
    if how == "crop":
        if height < rows or width < cols:
            raise InputError(
                (
                    f"the picture is {height} x {width} pixels (rows x columns), smaller than the "
                    f"{rows} x {cols} object points"
                ),
                fix='use a larger picture, or sample it with "fit" instead of "crop"',
            )
        top, left = (height - rows) // 2, (width - cols) // 2
        picture = picture[top : top + rows, left : left + cols][part]
        return np.ascontiguousarray(picture, dtype=np.float32)
    if how != "fit":
        raise ValueError(f'how is "fit" or "crop", not {how!r}')
    scale = min(height / rows, width / cols)
    top, left = (height - scale * rows) / 2, (width - scale * cols) / 2
    averaged = area_average(picture, rows, 0, max(top, 0.0), min(height - top, height), part)
    averaged = area_average(averaged, cols, 1, max(left, 0.0), min(width - left, width))
    return averaged.astype(np.float32)


def block_mean(values: ArrayLike, block: tuple[int, int]) -> np.ndarray:
    """Mean over non-overlapping blocks of the last two axes.

    values: (..., R h, C w).
    block: (h, w) samples.

    Returns (..., R, C) float64.
    Raises ValueError where the samples are no whole number of blocks.
    """
    values = np.asarray(values, dtype=np.float64)
    (height, width), (rows, cols) = block, values.shape[-2:]
    if rows % height or cols % width:
        raise ValueError(
            f"{rows} x {cols} samples are no whole number of {height} x {width} blocks"
        )
    return values.reshape(*values.shape[:-2], rows // height, height, cols // width, width).mean(
        axis=(-3, -1)
    )
