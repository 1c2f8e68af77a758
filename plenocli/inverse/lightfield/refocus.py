"""Pictures focused elsewhere, and views through parts of the main lens."""

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.tiling import bands
from plenocli.inverse.lightfield.samples import AT_ONCE, Samples

STEP = 4
"""Points of a refocused picture per lenslet pitch."""


def views(
    samples: Samples, count: int, shape: tuple[int, int], reach: float | None = None
) -> np.ndarray:
    """Pictures through parts of the pupil, one value a lenslet pitch, whatever channels samples are
    of.

    samples: of one capture.
    count: parts along each side.
    shape: (rows, columns) of a picture.
    reach: half the width of the pupil's image, px; None: as far as the samples reach.

    Returns (view_row, view_column, row, column), NaN where no sample is.
    """
    half = (samples.reach() if reach is None else reach) * np.sqrt(0.5)
    edges = np.linspace(-half, half, count + 1) * (1 + 1e-9)  # the outermost are counted
    part_of = np.stack(
        [(np.digitize(along, edges) - 1).astype(np.int8) for along in samples.offset.T], axis=-1
    )
    found = np.zeros((count, count, *shape))
    for row in range(count):
        for column in range(count):
            some = (part_of[:, 0] == row) & (part_of[:, 1] == column)
            found[row, column] = (
                refocus(samples.where(some), 0.0, shape, step=1)[0] if some.any() else np.nan
            )
    return found


def views_in_colour(samples: Samples, count: int, shape: tuple[int, int]) -> np.ndarray:
    """The views of each channel, (view_row, view_column, channel, row, column); they stand where
    those of all samples do.

    samples, count, shape: as in `views`.
    """
    reach = samples.reach()
    parts = [views(samples.where(some), count, shape, reach) for some in samples.parts()]
    return np.stack(parts, axis=2)


def in_colour(
    samples: Samples, slope: ArrayLike, shape: tuple[int, int], step: int = STEP
) -> np.ndarray:
    """The pictures of a plane in each channel, from the samples of that channel alone.

    samples, slope, shape, step: as in `refocus`.

    Returns (channel, step rows, step columns).
    """
    slope = np.asarray(slope, float)
    return np.stack(
        [
            refocus(samples.where(some), slope[some] if slope.ndim else slope, shape, step)[0]
            for some in samples.parts()
        ]
    )


def refocus(
    samples: Samples, slope: ArrayLike, shape: tuple[int, int], step: int = STEP
) -> tuple[np.ndarray, np.ndarray]:
    """The picture of a plane.

    samples: of one capture.
    slope: of the plane, px per px, or one a sample for a scene of several depths.
    shape: (rows, columns) of lenslet pitches.
    step: points a pitch.

    Points stand `step` to a pitch from the sensor's corner; what is within a pitch counts with a
    weight that falls linearly, so that one lenslet's width is the resolution.

    Returns (mean, variance) of what meets each point, (step rows, step columns), NaN where nothing
    is near.
    docs/model.md, "Refocusing and depth".
    """
    from scipy.ndimage import convolve1d

    rows, columns = shape[0] * step, shape[1] * step
    sums, each = np.zeros((3, rows * columns)), np.asarray(slope, float)
    for some in bands(len(samples.value), AT_ONCE):
        values = samples.value[some].astype(float)
        where = place(samples.where(some), each[some] if each.ndim else each, step)
        low = np.floor(where).astype(int)
        part = where - low
        for down, right in np.ndindex(2, 2):
            r, c = low[:, 0] + down, low[:, 1] + right
            share = np.abs(1 - down - part[:, 0]) * np.abs(1 - right - part[:, 1])
            inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
            index, share, value = (r * columns + c)[inside], share[inside], values[inside]
            if len(index):
                first = index.min()  # a band of lenslets meets a band of the picture
                last = index.max() + 1
                for total, weights in zip(sums, (share, share * value, share * value**2)):
                    total[first:last] += np.bincount(index - first, weights)
    tent = 1 - np.abs(np.arange(1 - step, step)) / step
    weight, first, second = (
        convolve1d(
            convolve1d(s.reshape(rows, columns), tent, axis=0, mode="constant"),
            tent,
            axis=1,
            mode="constant",
        )
        for s in sums
    )
    known = weight > 0.02 * weight.max()
    weight = np.where(known, weight, np.nan)
    picture = first / weight
    return picture, np.maximum(second / weight - picture**2, 0)


def place(samples: Samples, slope: ArrayLike, step: int) -> np.ndarray:
    """Where the samples meet the plane, in points of the picture, (sample, 2)."""
    return (samples.centre + np.reshape(slope, (-1, 1)) * samples.offset) * (step / samples.pitch)


def sharpness(picture: np.ndarray) -> float:
    """Mean square of the gradient: of pictures of one scene, the largest is the sharpest.

    NaN is left out.
    """
    down, right = np.gradient(picture)
    return float(np.nanmean(down**2 + right**2))
