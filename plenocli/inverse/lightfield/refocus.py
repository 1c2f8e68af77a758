"""Pictures focused elsewhere, and views through parts of the main lens."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from plenocli.base.tiling import around, shared
from plenocli.inverse.lightfield.samples import SampleBands, Samples

STEP = 4
"""Points of a refocused picture per lenslet pitch."""
FAINT = 0.02
"""Of a lenslet's samples: where fewer meet a point, nothing is known of it."""

Parts = Iterable[tuple[Samples, ...]]
"""Bands of samples, in several parts each: of channels, or of parts of the pupil, too."""


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
    parts = views_in_bands(SampleBands.of(_grey(samples), shape), count, reach)
    return np.concatenate(list(parts), axis=3)[:, :, 0]


def views_in_colour(samples: Samples, count: int, shape: tuple[int, int]) -> np.ndarray:
    """The views of each channel, (view_row, view_column, channel, row, column); they stand where
    those of all samples do.

    samples, count, shape: as in `views`.
    """
    return np.concatenate(list(views_in_bands(SampleBands.of(samples, shape), count)), axis=3)


def views_in_bands(
    source: SampleBands, count: int, reach: float | None = None
) -> Iterator[np.ndarray]:
    """(view_row, view_column, channel, row, column) of each band of rows.

    count, reach: as in `views`.
    """
    half = (source.survey.reach if reach is None else reach) * math.sqrt(0.5)
    edges = np.linspace(-half, half, count + 1) * (1 + 1e-9)  # the outermost are counted
    # a square within the round pupil has 2 / pi of its samples
    each = np.tile(source.survey.each, count**2) * 2 / (math.pi * count**2)

    def through() -> Parts:
        for parts in source:
            found = []
            for part in parts:
                row, column = (np.digitize(along, edges) - 1 for along in part.offset.T)
                seen = (row >= 0) & (row < count) & (column >= 0) & (column < count)
                own = np.where(seen, row * count + column, -1)
                found.append([part.where(own == number) for number in range(count**2)])
            yield tuple(part for view in zip(*found) for part in view)

    streams = shared(through(), len(each))
    seen = [
        pictures(stream, source, number, 0.0, step=1, each=least)
        for number, (stream, least) in enumerate(zip(streams, each))
    ]
    for rows in zip(*seen):
        yield np.reshape(rows, (count, count, source.count, *rows[0].shape))


def refocus(
    samples: Samples, slope: float | np.ndarray, shape: tuple[int, int], step: int = STEP
) -> tuple[np.ndarray, np.ndarray]:
    """The picture of a plane.

    samples: of one capture.
    slope: of the plane, px per px, or (row, column), one value a pitch, for a scene of several
        depths.
    shape: (rows, columns) of lenslet pitches.
    step: points a pitch.

    Points stand `step` to a pitch from the sensor's corner; what is within a pitch counts with a
    weight that falls linearly, so that one lenslet's width is the resolution.

    Returns (mean, variance) of what meets each point, (step rows, step columns), NaN where nothing
    is near.
    docs/model.md, "Refocusing and depth".
    """
    source = SampleBands.of(_grey(samples), shape)
    parts = list(pictures(source, source, 0, slope, step, squares=True))
    mean, variance = np.concatenate(parts, axis=1)
    return mean, variance


def _grey(samples: Samples) -> Samples:
    """The samples as those of one channel."""
    return Samples(
        centres=samples.centres,
        lenslet=samples.lenslet,
        offset=samples.offset,
        value=samples.value,
        pitch=samples.pitch,
    )


def pictures(
    bands: Parts,
    source: SampleBands,
    number: int,
    slope: float | np.ndarray,
    step: int = STEP,
    *,
    each: float | None = None,
    squares: bool = False,
) -> Iterator[np.ndarray]:
    """The picture of a plane, (row, column) of each of the source's bands of rows.

    bands: all of a source, from the first on.
    number: of the parts of each band that make the picture.
    slope, step: as in `refocus`.
    each: samples of a lenslet; None: those of the channel `number`.
    squares: whether the variance is wanted, too: (2, row, column), the mean first.
    """
    from scipy.ndimage import convolve1d

    least = FAINT * (float(source.survey.each[number]) if each is None else each)
    tent = 1 - np.abs(np.arange(1 - step, step)) / step
    sums = _sums(bands, source, number, slope, step, 3 if squares else 2)
    for own, part in around(sums, source.points(step), step - 1):
        if step > 1:
            part = convolve1d(part, tent, axis=1, mode="constant")[:, own]
            part = convolve1d(part, tent, axis=2, mode="constant")
        weight = np.where(part[0] > least, part[0], np.nan)
        picture = part[1] / weight
        if squares:
            variance = np.maximum(part[2] / weight - picture**2, 0)
            picture = np.stack([picture, variance])
        yield picture


def _sums(
    bands: Parts,
    source: SampleBands,
    number: int,
    slope: float | np.ndarray,
    step: int,
    powers: int,
) -> Iterator[np.ndarray]:
    """(power, row, column) sums of weights, values and squares around each point, in blocks of rows
    to which no later band of lenslets adds.
    """
    shape = source.shape[0] * step, source.shape[1] * step
    reach, top = displacement(source, slope, step), 0
    held = np.zeros((powers, 0, shape[1]))
    for rows, parts in zip(source.rows, bands):
        done = min(max(rows.start * step - reach, top), shape[0])
        if done > top:
            held = _with_rows(held, done - top)
            yield held[:, : done - top]
            held, top = held[:, done - top :].copy(), done
        part = parts[number]
        if len(part.value):
            first, left, box = _splat(part, place(part, slope, step), powers)
            here = slice(max(first, top), max(min(first + box.shape[1], shape[0]), top))
            there = slice(max(left, 0), max(min(left + box.shape[2], shape[1]), 0))
            held = _with_rows(held, here.stop - top)
            held[:, here.start - top : here.stop - top, there] += box[
                :, here.start - first : here.stop - first, there.start - left : there.stop - left
            ]
    yield _with_rows(held, shape[0] - top)


def _with_rows(held: np.ndarray, count: int) -> np.ndarray:
    """Sums (power, row, column) of at least `count` rows."""
    missing = max(count - held.shape[1], 0)
    return np.pad(held, ((0, 0), (0, missing), (0, 0))) if missing else held


def _splat(
    samples: Samples, where: tuple[np.ndarray, np.ndarray], powers: int
) -> tuple[int, int, np.ndarray]:
    """(first row, first column, sums (power, row, column)) of samples, each shared among the four
    points around its place.
    """
    low = [np.floor(along) for along in where]
    part = [along - least for along, least in zip(where, low)]
    at = [least.astype(np.intp) for least in low]
    first, left = (int(along.min()) for along in at)
    rows, columns = (int(along.max()) - n + 2 for along, n in zip(at, (first, left)))
    index = (at[0] - first) * columns + (at[1] - left)
    value = samples.value.astype(float)
    sums = np.zeros((powers, rows * columns))
    for down, right in np.ndindex(2, 2):
        share = (part[0] if down else 1 - part[0]) * (part[1] if right else 1 - part[1])
        near = index + (down * columns + right)
        for total in sums:
            total += np.bincount(near, share, minlength=rows * columns)
            share = share * value
    return first, left, sums.reshape(powers, rows, columns)


def displacement(source: SampleBands, slope: float | np.ndarray, step: int) -> int:
    """Points, at most, from a lenslet's centre to where one of its samples counts."""
    most = float(np.abs(slope).max()) * source.survey.reach * step / source.pitch
    return math.ceil(most) + 1


def place(samples: Samples, slope: float | np.ndarray, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Where the samples meet the plane, in points of the picture: (rows, columns), (sample,) each.

    slope: of the plane, or a map of slopes (row, column), one value a pitch.
    """
    scale = step / samples.pitch
    along = slopes_of(samples, slope) if isinstance(slope, np.ndarray) else np.float64(slope)
    row, column = (
        (scale * samples.centres[:, axis])[samples.lenslet]
        + (scale * along) * samples.offset[:, axis]
        for axis in (0, 1)
    )
    return row, column


def slopes_of(samples: Samples, slope: np.ndarray) -> np.ndarray:
    """(sample,) slope of each sample's lenslet, from a map (row, column)."""
    from scipy.ndimage import map_coordinates

    places = samples.centres.T / samples.pitch - 0.5
    return map_coordinates(slope, places, order=1, mode="nearest")[samples.lenslet]


def sharpness(picture: np.ndarray) -> float:
    """Mean square of the gradient: of pictures of one scene, the largest is the sharpest.

    NaN is left out.
    """
    down, right = np.gradient(picture)
    return float(np.nanmean(down**2 + right**2))
