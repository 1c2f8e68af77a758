"""A map of depths from one capture: the slope at which the views of a point agree best."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.tiling import FORGETFUL, Keeper, around, bands, kept, shared
from plenocli.inverse.lightfield.planes import DepthMap
from plenocli.inverse.lightfield.refocus import STEP, Parts, displacement, pictures, place
from plenocli.inverse.lightfield.samples import AT_ONCE, SampleBands

ROUNDS = 4
"""Corrections of a depth map by least squares."""
FLAT = 0.1
"""Confidence up to which a lenslet has no texture that would tell its depth."""
LOOKS = 20.0
"""Half the number of independent looks at a lenslet's disagreement, found on traced scenes of six
photographs (`pipelines/benchmarks/depth_confidence.py`); others are told as well.
"""
LIKELY = 0.5
"""Confidence below which a slope is unknown."""
LEAST_SIGMA = 0.1
"""Of a slope: what tents, lenslets of one value and rims of the pupil leave at best."""
STEADY, STEP_OF_ROUNDING = 10, 0.05
"""Rounds of the map's total variation, and the step in slope up to which it is quadratic."""
EDGE = 2
"""Lenslets to each side within which a step of the geometric limit makes an occlusion edge."""
FEW = 0.05
"""Share of the lenslets that may lie beyond a range before it grows."""
MOST = 12.0
"""Slope to which a range grows at most: a point's light is then spread over a hundred lenslets."""
GROWTH = 4
"""Planes by which a range grows at a time."""
TOGETHER, SHARE, SUMS_BYTES = (16 << 20, 64 << 20), 32, 72
"""Bytes that planes which are worked on together take, about, at least and at most: a SHARE of the
memory; and those for each point of the rows that one holds (measured). The fewer at a time, the
more often pixels are read; pictures are the same.
"""


def depth(
    source: SampleBands,
    slopes: Sequence[float],
    width: float = 1.5,
    keeper: Keeper = FORGETFUL,
) -> DepthMap:
    """The slope at which the views agree best, with its confidence, one value a pitch.

    source: samples of one capture.
    slopes: at least three, rising.
    width: of the Gaussian over which disagreement is averaged, pitches.
    keeper: of the planes, and of the corrections, of this source.

    Disagreement is the variance of what meets a point beyond that of the picture's own slant within
    a lenslet's width; its least value is found on a parabola, and corrected by least squares. A
    lenslet whose views agree best on the first or the last plane lies beyond the slopes, one whose
    disagreement hardly changes has no texture, and one may have several slopes alike: they are
    unknown, NaN with confidence 0. The known ones, each as sure as its own standard deviation says,
    make the map of the least total variation beside their squares; the standard deviations stay
    those of lenslets by themselves.

    docs/model.md, "Refocusing and depth".
    """
    tried = np.asarray(slopes, float)
    return _map(source, tried, _disagreements(source, tried, width, keeper), width, keeper)


def depth_in_reach(
    source: SampleBands,
    slopes: Sequence[float],
    width: float = 1.5,
    keeper: Keeper = FORGETFUL,
) -> tuple[DepthMap, np.ndarray]:
    """`depth` over a range that grows, at the spacing of `slopes`, on the side on which lenslets
    with texture lie beyond it; at most to where neighbouring pixels of a superpixel see the scene a
    pitch apart, a slope of as many as a pitch has pixels, and to MOST.

    source, width, keeper: as in `depth`.
    slopes: (plane,) at least three, rising, evenly spaced.

    Returns the map and the slopes (plane,) that were tried.
    """
    tried = np.asarray(slopes, float)
    gap = tried[1] - tried[0]
    disagreement = _disagreements(source, tried, width, keeper)
    for side in (-1, 1):
        while _beyond(disagreement, side) > FEW:
            end = tried[0 if side < 0 else -1]
            more = end + side * gap * np.arange(1, 1 + GROWTH)
            more = np.sort(more[np.abs(more) <= min(source.pitch, MOST)])
            if more.size == 0:
                break
            parts = [_disagreements(source, more, width, keeper), disagreement]
            disagreement = np.concatenate(parts[::-side])
            tried = np.concatenate([more, tried][::-side])
    return _map(source, tried, disagreement, width, keeper), tried


def filled(slope: np.ndarray) -> np.ndarray | None:
    """A map of slopes (row, column) in which every lenslet has one: NaN takes the nearest known
    one. None where no slope is known.
    """
    from scipy.ndimage import distance_transform_edt

    unknown = np.isnan(slope)
    if unknown.all():
        return None
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return slope[tuple(nearest)]


def together(
    source: SampleBands, slopes: np.ndarray, todo: Sequence[int], step: int, waiting: int = 0
) -> list[list[int]]:
    """Which planes are worked on together.

    slopes: of all.
    todo: numbers of the planes that are worked on.
    waiting: rows of pictures that are held until others come.
    """
    if not todo:
        return []
    reach = displacement(source, slopes, step)
    most = together_bytes() // plane_bytes(source, reach, step, waiting)
    return [list(todo[some]) for some in bands(len(todo), most)]


def together_bytes() -> int:
    """Memory for planes that are worked on together, unless one takes more."""
    least, most = TOGETHER
    return min(max(budget().memory // SHARE, least), most)


def plane_bytes(source: SampleBands, reach: int, step: int, waiting: int = 0) -> int:
    """Memory that a plane takes while it is worked on.

    reach: points, of the displacement.
    step, waiting: as of `together`.
    """
    most = max(rows.stop - rows.start for rows in source.rows)
    rows = min(step * (most + 2) + 2 * reach + waiting, step * source.shape[0] + waiting)
    return SUMS_BYTES * source.count * rows * step * source.shape[1]


def _map(
    source: SampleBands, tried: np.ndarray, disagreement: np.ndarray, width: float, keeper: Keeper
) -> DepthMap:
    """The map of the least disagreement (plane, row, column)."""

    def first(part: np.ndarray) -> tuple[np.ndarray, ...]:
        least, contrast = _least(part, tried)
        textured = contrast > FLAT
        return least, textured, textured & _at_edge(part)

    found, textured, beyond = _by_rows(first, disagreement)
    for number in range(ROUNDS):
        correct = partial(_correction, source, found, width)
        (step,) = kept(keeper, f"correction {number}", lambda: [correct()])
        found = np.clip(found + step, tried[0], tried[-1])
    inside = (found > tried[0]) & (found < tried[-1])
    confidence, sigma = _by_rows(
        lambda part, slope: _certainty(part, tried, slope), disagreement, found
    )
    known = textured & ~beyond & inside & (confidence >= LIKELY)
    slope = np.where(known, _steady(found, np.where(known, 1 / sigma**2, 0.0)), np.nan)
    return DepthMap(
        slope=slope,
        confidence=np.where(known, confidence, 0.0),
        sigma=np.where(known, sigma, np.nan),
        edge=_edges(slope, sigma),
        beyond=float(np.mean(textured & (beyond | ~inside))),
    )


def _by_rows(
    work: Callable[..., tuple[np.ndarray, ...]], disagreement: np.ndarray, *maps: np.ndarray
) -> tuple[Any, ...]:
    """What `work` makes of each point of the disagreement (plane, row, column), float64, and of
    maps (row, column): maps of its own.
    """
    planes, rows, columns = disagreement.shape
    parts = [
        work(disagreement[:, some].astype(float), *(values[some] for values in maps))
        for some in bands(rows, AT_ONCE // (planes * columns))
    ]
    return tuple(np.concatenate(of_each) for of_each in zip(*parts))


def _steady(slope: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The map s of least sum of weight (s - slope)^2 / 2 + |steps between neighbours|, by
    reweighted least squares; weight 0 takes what lies around. (row, column) each.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    if not weight.any():
        return slope
    middle = float((weight * slope).sum() / weight.sum())
    found = np.where(weight > 0, slope, middle)
    data = (weight * slope).ravel()
    for _ in range(STEADY):
        pulls = [1 / np.hypot(np.diff(found, axis=axis), STEP_OF_ROUNDING) for axis in (0, 1)]

        def product(values: np.ndarray, pulls: list[np.ndarray] = pulls) -> np.ndarray:
            plane = values.reshape(slope.shape)
            out = weight * plane
            down, right = (pull * np.diff(plane, axis=axis) for axis, pull in enumerate(pulls))
            out[:-1] -= down
            out[1:] += down
            out[:, :-1] -= right
            out[:, 1:] += right
            return out.ravel()

        matrix = LinearOperator((slope.size, slope.size), matvec=product, dtype=np.float64)
        solved, _ = cg(matrix, data, x0=found.ravel(), rtol=1e-6, maxiter=500)
        found = solved.reshape(slope.shape)
    return found


def _certainty(
    disagreement: np.ndarray, tried: np.ndarray, found: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(probability that the slope found is within one, the geometric limit; its standard
    deviation), (row, column) each.

    Of variances D as disagreement, and LOOKS pairs of looks at them, the likelihood of a slope goes
    with D^-LOOKS; every slope tried was as likely before. The standard deviation is that about the
    slope found or, where planes stand too far apart to tell, of the parabola through the least.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        level = np.log(disagreement)
    level = np.where(np.isfinite(level).all(axis=0), level, 0.0)
    like = np.exp(-LOOKS * (level - level.min(axis=0)))
    share = like / like.sum(axis=0)
    away = tried[:, None, None] - found
    confidence = (share * (np.abs(away) < 1)).sum(axis=0)
    best = np.clip(level.argmin(axis=0), 1, len(tried) - 2)
    before, least, after = (np.take_along_axis(level, (best + k)[None], 0)[0] for k in (-1, 0, 1))
    down, up = tried[best] - tried[best - 1], tried[best + 1] - tried[best]
    bend = 2 * ((after - least) / up - (least - before) / down) / (up + down)
    variance = np.maximum(1 / (LOOKS * np.maximum(bend, 1e-6)), (share * away**2).sum(axis=0))
    return np.clip(confidence, 0, 1), np.sqrt(variance + LEAST_SIGMA**2)


def _edges(slope: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Where (row, column) known slopes, each nearer by its standard deviation, differ by the
    geometric limit or more within EDGE.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    known, size = np.isfinite(slope), 2 * EDGE + 1
    top = maximum_filter(np.where(known, slope - sigma, -np.inf), size)
    bottom = minimum_filter(np.where(known, slope + sigma, np.inf), size)
    return known & (top - bottom >= 1)


def _disagreements(
    source: SampleBands, slopes: np.ndarray, width: float, keeper: Keeper
) -> np.ndarray:
    """(plane, row, column) float32, NaN where nothing meets a point."""
    found, todo = np.empty((len(slopes), *source.shape), np.float32), []
    names = [plane_name("disagreement", slope) for slope in slopes]
    for number, name in enumerate(names):
        before = keeper.get(name)
        if before is None:
            todo.append(number)
        else:
            found[number] = before[0]
    waiting = 2 * (_coarse(source, width)[0].stop + int(8 * width))
    for numbers in together(source, slopes, todo, 2, waiting):
        streams = shared(source, len(numbers))
        planes = [_disagreement(*both, source, width) for both in zip(streams, slopes[numbers])]
        for rows, parts in zip(_coarse(source, width), zip(*planes)):
            found[numbers, rows] = parts
        for number in numbers:
            keeper.put(names[number], [found[number]])
    return found


def plane_name(what: str, slope: float) -> str:
    """Of what a Keeper keeps of the plane of a slope."""
    return f"{what} {float(slope)!r}"


def _coarse(source: SampleBands, width: float) -> list[slice]:
    """Rows of a picture over which disagreement is averaged together: bands of the source, many
    enough for what lies around to be few beside them.
    """
    each = max(rows.stop - rows.start for rows in source.rows)
    return bands(source.shape[0], each * -(-int(4 * width) // each))


def _at_edge(disagreement: np.ndarray, sides: Sequence[int] = (-1, 1)) -> np.ndarray:
    """Where (row, column) the first or the last plane has the least disagreement."""
    best = np.nan_to_num(disagreement, nan=np.inf).argmin(axis=0)
    ends = [0 if side < 0 else len(disagreement) - 1 for side in sides]
    return np.isin(best, ends)


def _beyond(disagreement: np.ndarray, side: int) -> float:
    """Share of the lenslets, with texture, that agree best on the first (side -1) or last plane."""

    def lost(part: np.ndarray) -> tuple[np.ndarray]:
        return ((_contrast(part) > FLAT) & _at_edge(part, (side,)),)

    return float(np.mean(_by_rows(lost, disagreement)[0]))


def _contrast(disagreement: np.ndarray) -> np.ndarray:
    """How clearly the least disagreement stands out, (row, column); 0 where a plane has none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = 1 - disagreement.min(axis=0) / np.median(disagreement, axis=0)
    return np.nan_to_num(found)


def _disagreement(
    bands_of: Parts, slope: float, source: SampleBands, width: float
) -> Iterator[np.ndarray]:
    """How far apart what meets a point of the plane of this slope is, (row, column) of each band
    of `_coarse`, NaN where nothing does: the variance within each colour, by their light, or how
    little the bands of spectra go together.

    bands_of: all bands of the source.
    """
    channels, streams = source.channels, shared(bands_of, source.count)
    if channels is not None and channels.wavelengths is not None:
        seen = (pictures(stream, source, n, slope, 2) for n, stream in enumerate(streams))
        parts = (np.stack(channel) for channel in zip(*seen))
        floor = 1e-5 * float(source.survey.square.mean())
        for own, part in _around(parts, source, width):
            yield _of_lenslets(_uncorrelated(part, width, floor)[own])
        return
    weights = np.ones(1) if channels is None else channels.weights
    each = [_variance(stream, source, n, slope) for n, stream in enumerate(streams)]
    floors = 1e-9 * source.survey.square
    for parts in zip(*(_around(variance, source, width) for variance in each)):
        found = []
        for (own, part), floor in zip(parts, floors):
            known = np.isfinite(part)
            mean = np.maximum(_smooth(part, known, width), 0) + floor
            found.append(np.where(known, mean, np.nan)[own])
        share = np.isfinite(found) * weights[:, None, None]
        total = (np.nan_to_num(found) * share).sum(axis=0)
        with np.errstate(invalid="ignore"):
            yield _of_lenslets(total / np.where(share.sum(axis=0) > 0, share.sum(axis=0), np.nan))


def _of_lenslets(values: np.ndarray) -> np.ndarray:
    """(row, column) means of values at two points a pitch."""
    return values.reshape(len(values) // 2, 2, -1, 2).mean(axis=(1, 3))


def _around(
    parts: Iterator[np.ndarray], source: SampleBands, width: float
) -> Iterator[tuple[slice, np.ndarray]]:
    """The bands of `_coarse`, two points a pitch, with what a Gaussian reaches around them, and
    which rows of these are theirs.
    """
    own = [slice(2 * rows.start, 2 * rows.stop) for rows in _coarse(source, width)]
    return around(parts, own, int(8 * width + 0.5))


def _variance(
    bands_of: Parts, source: SampleBands, number: int, slope: float
) -> Iterator[np.ndarray]:
    """Variance of what meets a point of a plane, two points a pitch, beyond that of the picture's
    own slant, of one channel.
    """
    parts = pictures(bands_of, source, number, slope, 2, squares=True)
    for own, (picture, variance) in around(parts, source.points(2), 1):
        for part in np.gradient(picture):
            variance = variance - (2 * part) ** 2 / 6  # a tent of a pitch to each side has 1/6
        yield variance[own]


def _smooth(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """Mean of the known values around, by a Gaussian of `width` pitches of two points each."""
    from scipy.ndimage import gaussian_filter

    weight = gaussian_filter(known.astype(float), 2 * width)
    with np.errstate(divide="ignore", invalid="ignore"):
        return gaussian_filter(np.where(known, values, 0.0), 2 * width) / weight


def _uncorrelated(seen: np.ndarray, width: float, floor: float) -> np.ndarray:
    """How little pictures (channel, row, column) of one place go together: the determinant of
    their correlations over a Gaussian, 0 where each tells the others, 1 where none does.

    floor: added to their variances.

    Bando, Chen and Nishita, Extracting depth and matte using a color-filtered aperture, ACM
    Transactions on Graphics 27 (2008) 134.
    """
    known = np.isfinite(seen).all(axis=0)
    values = np.where(known, seen, 0.0)
    count = len(values)
    mean = [_smooth(value, known, width) for value in values]
    moments = np.empty((*known.shape, count, count))
    for i in range(count):
        for j in range(i, count):
            both = _smooth(values[i] * values[j], known, width) - mean[i] * mean[j]
            moments[..., i, j] = moments[..., j, i] = both
    moments = np.nan_to_num(moments) + floor * np.eye(count)
    spread = np.einsum("...ii->...i", moments)
    return np.where(known, np.linalg.det(moments) / spread.prod(axis=-1), np.nan)


def _least(disagreement: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(slope of the least disagreement (plane, row, column), by a parabola; how clearly)."""
    blind = ~np.isfinite(disagreement).all(axis=0)
    clear = np.where(blind, 1.0, disagreement)
    best = np.clip(clear.argmin(axis=0), 1, len(slopes) - 2)
    before, least, after = (np.take_along_axis(clear, (best + k)[None], 0)[0] for k in (-1, 0, 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        move = np.where(
            before + after > 2 * least, (before - after) / (2 * (before - 2 * least + after)), 0.0
        )
    place_of_best = best + np.clip(np.nan_to_num(move), -1, 1)
    found = np.interp(place_of_best, np.arange(len(slopes)), slopes)
    return found, _contrast(disagreement)


def _correction(source: SampleBands, slope: np.ndarray, width: float) -> np.ndarray:
    """By how much the slope (row, column) should change, from how the samples of each colour differ
    from the picture p at their places: at a wrong slope v - p = ds (grad p . q), solved for ds by
    least squares over a Gaussian of `width` pitches; at most half a unit. 0 for bands, of which a
    lenslet has one sample each.
    """
    from scipy.ndimage import gaussian_filter

    if source.channels is not None and source.channels.wavelengths is not None:
        return np.zeros(source.shape)
    weights = np.ones(1) if source.channels is None else source.channels.weights
    sums = np.zeros((2, *source.shape))
    streams = shared(source, source.count)
    each = [_slants(stream, source, n, slope) for n, stream in enumerate(streams)]
    for rows, parts in zip(source.rows, zip(*each)):
        for weight, part in zip(weights, parts, strict=True):
            sums[:, rows] += weight * part
    top, bottom = (gaussian_filter(part, width, mode="constant") for part in sums)
    return np.clip(top / np.maximum(bottom, 1e-30 + 1e-6 * bottom.max()), -0.5, 0.5)


def _slants(
    bands_of: Parts, source: SampleBands, number: int, slope: np.ndarray
) -> Iterator[np.ndarray]:
    """Sums over the samples of each lenslet, (2, row, column) of each band: of (v - p)(grad p . q),
    and of the square of (grad p . q); of one channel.
    """
    from scipy.ndimage import map_coordinates

    now, late = shared(bands_of, 2)
    reach = displacement(source, slope, STEP) + 2
    parts = around(pictures(now, source, number, slope), source.points(STEP), reach)
    for rows, (own, picture), samples in zip(source.rows, parts, late):
        part = samples[number]
        shape = rows.stop - rows.start, source.shape[1]
        if not len(part.value):
            yield np.zeros((2, *shape))
            continue
        picture = np.where(np.isfinite(picture), picture, source.survey.mean[number])
        where = np.stack(place(part, slope, STEP)) - [[STEP * rows.start - own.start], [0]]
        value, down, right = (
            map_coordinates(layer, where, order=1, mode="nearest")
            for layer in (picture, *np.gradient(picture))
        )
        along = (down * part.offset[:, 0] + right * part.offset[:, 1]) * (STEP / part.pitch)
        cell = (part.centres / part.pitch).astype(int) - [rows.start, 0]
        row, column = np.clip(cell, 0, np.subtract(shape, 1)).T
        index = (row * shape[1] + column)[part.lenslet]
        yield np.reshape(
            [
                np.bincount(index, weights, minlength=shape[0] * shape[1])
                for weights in ((part.value - value) * along, along**2)
            ],
            (2, *shape),
        )
