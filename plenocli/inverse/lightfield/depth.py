"""A map of depths from one capture: the slope at which the views of a point agree best."""

from collections.abc import Sequence

import numpy as np

from plenocli.base.tiling import bands
from plenocli.inverse.lightfield.planes import DepthMap
from plenocli.inverse.lightfield.refocus import STEP, in_colour, place, refocus
from plenocli.inverse.lightfield.samples import AT_ONCE, Samples

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


def depth(
    samples: Samples, slopes: Sequence[float], shape: tuple[int, int], width: float = 1.5
) -> DepthMap:
    """The slope at which the views agree best, with its confidence, one value a pitch.

    samples: of one capture.
    slopes: at least three, rising.
    shape: (rows, columns) of the map.
    width: of the Gaussian over which disagreement is averaged, pitches.

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
    return _map(samples, tried, _disagreements(samples, tried, shape, width), width)


def depth_in_reach(
    samples: Samples, slopes: Sequence[float], shape: tuple[int, int], width: float = 1.5
) -> tuple[DepthMap, np.ndarray]:
    """`depth` over a range that grows, at the spacing of `slopes`, on the side on which lenslets
    with texture lie beyond it; at most to where neighbouring pixels of a superpixel see the scene a
    pitch apart, a slope of as many as a pitch has pixels, and to MOST.

    samples, shape, width: as in `depth`.
    slopes: (plane,) at least three, rising, evenly spaced.

    Returns the map and the slopes (plane,) that were tried.
    """
    tried = np.asarray(slopes, float)
    gap = tried[1] - tried[0]
    disagreement = _disagreements(samples, tried, shape, width)
    for side in (-1, 1):
        while _beyond(disagreement, side) > FEW:
            end = tried[0 if side < 0 else -1]
            more = end + side * gap * np.arange(1, 1 + GROWTH)
            more = np.sort(more[np.abs(more) <= min(samples.pitch, MOST)])
            if more.size == 0:
                break
            parts = [_disagreements(samples, more, shape, width), disagreement]
            disagreement = np.concatenate(parts[::-side])
            tried = np.concatenate([more, tried][::-side])
    return _map(samples, tried, disagreement, width), tried


def all_in_focus(samples: Samples, slope: np.ndarray, shape: tuple[int, int]) -> np.ndarray | None:
    """The picture in which every lenslet is refocused by its own slope.

    samples: of one capture.
    slope: (row, column), one value a pitch; NaN takes the nearest known one.
    shape: (rows, columns) of the map.

    Returns (channel, row, column), like `in_colour`; None where no slope is known.
    docs/model.md, "Refocusing and depth".
    """
    from scipy.ndimage import distance_transform_edt

    unknown = np.isnan(slope)
    if unknown.all():
        return None
    nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return in_colour(samples, _own(samples, slope[tuple(nearest)]), shape)


def _own(samples: Samples, slope: np.ndarray) -> np.ndarray:
    """(sample,) slope of each sample's lenslet, from a map (row, column)."""
    from scipy.ndimage import map_coordinates

    places = samples.centres.T / samples.pitch - 0.5
    own = map_coordinates(slope, places, order=1, mode="nearest")
    return own.astype(np.float32)[samples.lenslet]


def _map(samples: Samples, tried: np.ndarray, disagreement: np.ndarray, width: float) -> DepthMap:
    """The map of the least disagreement (plane, row, column)."""
    least, contrast = _least(disagreement, tried)
    shape = (least.shape[0], least.shape[1])
    textured = contrast > FLAT
    beyond = textured & _at_edge(disagreement)
    found = least
    for _ in range(ROUNDS):
        found = np.clip(found + _correction(samples, found, shape, width), tried[0], tried[-1])
    inside = (found > tried[0]) & (found < tried[-1])
    confidence, sigma = _certainty(disagreement, tried, found)
    known = textured & ~beyond & inside & (confidence >= LIKELY)
    slope = np.where(known, _steady(found, np.where(known, 1 / sigma**2, 0.0)), np.nan)
    return DepthMap(
        slope=slope,
        confidence=np.where(known, confidence, 0.0),
        sigma=np.where(known, sigma, np.nan),
        edge=_edges(slope, sigma),
        beyond=float(np.mean(textured & (beyond | ~inside))),
    )


def _steady(slope: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The map s of least sum of weight (s - slope)^2 / 2 + |steps between neighbours|, by
    reweighted least squares; weight 0 takes what lies around. (row, column) each.
    """
    from scipy import sparse
    from scipy.sparse.linalg import cg

    if not weight.any():
        return slope
    rows, columns = (sparse.diags([-1.0, 1.0], [0, 1], shape=(n - 1, n)) for n in slope.shape)
    down, right = sparse.eye(slope.shape[0]), sparse.eye(slope.shape[1])
    steps = sparse.vstack([sparse.kron(rows, right), sparse.kron(down, columns)]).tocsr()
    data = sparse.diags(weight.ravel())
    middle = float((weight * slope).sum() / weight.sum())
    found = np.where(weight > 0, slope, middle).ravel()
    for _ in range(STEADY):
        size = np.hypot(steps @ found, STEP_OF_ROUNDING)
        matrix = data + steps.T @ sparse.diags(1 / size) @ steps
        found, _ = cg(matrix, data @ slope.ravel(), x0=found, rtol=1e-6, maxiter=500)
    return found.reshape(slope.shape)


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
    samples: Samples, slopes: np.ndarray, shape: tuple[int, int], width: float
) -> np.ndarray:
    """(plane, row, column), NaN where nothing meets a point."""
    return np.array([_disagreement(samples, slope, shape, width) for slope in slopes])


def _at_edge(disagreement: np.ndarray, sides: Sequence[int] = (-1, 1)) -> np.ndarray:
    """Where (row, column) the first or the last plane has the least disagreement."""
    best = np.nan_to_num(disagreement, nan=np.inf).argmin(axis=0)
    ends = [0 if side < 0 else len(disagreement) - 1 for side in sides]
    return np.isin(best, ends)


def _beyond(disagreement: np.ndarray, side: int) -> float:
    """Share of the lenslets, with texture, that agree best on the first (side -1) or last plane."""
    textured = _contrast(disagreement) > FLAT
    return float(np.mean(textured & _at_edge(disagreement, (side,))))


def _contrast(disagreement: np.ndarray) -> np.ndarray:
    """How clearly the least disagreement stands out, (row, column); 0 where a plane has none."""
    with np.errstate(divide="ignore", invalid="ignore"):
        found = 1 - disagreement.min(axis=0) / np.median(disagreement, axis=0)
    return np.nan_to_num(found)


def _disagreement(
    samples: Samples, slope: float, shape: tuple[int, int], width: float
) -> np.ndarray:
    """How far apart what meets a point of the plane of this slope is, (row, column), NaN where
    nothing does: the variance within each colour, by their light, or how little the bands of
    spectra go together.
    """
    channels, parts = samples.channels, samples.parts()
    if channels is not None and channels.wavelengths is not None:
        found = _uncorrelated(in_colour(samples, slope, shape, step=2), width)
    else:
        colours = [samples.where(some) for some in parts]
        lit = [len(colour.value) > 0 for colour in colours]
        each = [_variance(c, slope, shape, width) for c, some in zip(colours, lit) if some]
        weights = np.ones(1) if channels is None else channels.weights[lit]
        share = np.isfinite(each) * weights[:, None, None]
        with np.errstate(invalid="ignore"):
            total = (np.nan_to_num(each) * share).sum(axis=0)
            found = total / np.where(share.sum(axis=0) > 0, share.sum(axis=0), np.nan)
    return found.reshape(shape[0], 2, shape[1], 2).mean(axis=(1, 3))


def _variance(samples: Samples, slope: float, shape: tuple[int, int], width: float) -> np.ndarray:
    """Variance of what meets a point of a plane, two points a pitch, beyond that of the picture's
    own slant.
    """
    floor = 1e-9 * float(np.mean(samples.value**2, dtype=float))
    picture, variance = refocus(samples, slope, shape, step=2)
    for part in np.gradient(picture):
        variance = variance - (2 * part) ** 2 / 6  # a tent of a pitch to each side has 1/6
    known = np.isfinite(variance)
    return np.where(known, np.maximum(_smooth(variance, known, width), 0) + floor, np.nan)


def _smooth(values: np.ndarray, known: np.ndarray, width: float) -> np.ndarray:
    """Mean of the known values around, by a Gaussian of `width` pitches of two points each."""
    from scipy.ndimage import gaussian_filter

    weight = gaussian_filter(known.astype(float), 2 * width)
    with np.errstate(divide="ignore", invalid="ignore"):
        return gaussian_filter(np.where(known, values, 0.0), 2 * width) / weight


def _uncorrelated(pictures: np.ndarray, width: float) -> np.ndarray:
    """How little pictures (channel, row, column) of one place go together: the determinant of
    their correlations over a Gaussian, 0 where each tells the others, 1 where none does.

    Bando, Chen and Nishita, Extracting depth and matte using a color-filtered aperture, ACM
    Transactions on Graphics 27 (2008) 134.
    """
    known = np.isfinite(pictures).all(axis=0)
    values = np.where(known, pictures, 0.0)
    count = len(values)
    mean = [_smooth(value, known, width) for value in values]
    moments = np.empty((*known.shape, count, count))
    for i in range(count):
        for j in range(i, count):
            both = _smooth(values[i] * values[j], known, width) - mean[i] * mean[j]
            moments[..., i, j] = moments[..., j, i] = both
    moments = np.nan_to_num(moments) + 1e-5 * np.mean(values**2) * np.eye(count)
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


def _correction(
    samples: Samples, slope: np.ndarray, shape: tuple[int, int], width: float
) -> np.ndarray:
    """By how much the slope (row, column) should change, from how the samples of each colour differ
    from the picture p at their places: at a wrong slope v - p = ds (grad p . q), solved for ds by
    least squares over a Gaussian of `width` pitches; at most half a unit. 0 for bands, of which a
    lenslet has one sample each.
    """
    from scipy.ndimage import gaussian_filter

    if samples.channels is not None and samples.channels.wavelengths is not None:
        return np.zeros(shape)
    weights = np.ones(1) if samples.channels is None else samples.channels.weights
    top, bottom = np.zeros(shape), np.zeros(shape)
    for some, weight in zip(samples.parts(), weights, strict=True):
        colour = samples.where(some)
        if len(colour.value):
            slant, square = _slants(colour, slope, shape)
            top += weight * slant
            bottom += weight * square
    top, bottom = (gaussian_filter(part, width, mode="constant") for part in (top, bottom))
    return np.clip(top / np.maximum(bottom, 1e-30 + 1e-6 * bottom.max()), -0.5, 0.5)


def _slants(
    samples: Samples, slope: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Sums over the samples of each lenslet, (row, column): of (v - p)(grad p . q), and of the
    square of (grad p . q).
    """
    from scipy.ndimage import map_coordinates

    own = _own(samples, slope)
    picture, _ = refocus(samples, own, shape, step=STEP)
    picture = np.where(np.isfinite(picture), picture, np.nanmean(picture))
    layers, sums = (picture, *np.gradient(picture)), np.zeros((2, shape[0] * shape[1]))
    for some in bands(len(samples.value), AT_ONCE):
        part = samples.where(some)
        where = place(part, own[some], STEP).T
        value, down, right = (
            map_coordinates(layer, where, order=1, mode="nearest") for layer in layers
        )
        along = (down * part.offset[:, 0] + right * part.offset[:, 1]) * (STEP / part.pitch)
        cell = np.clip((part.centre / part.pitch).astype(int), 0, np.array(shape) - 1)
        index = cell[:, 0] * shape[1] + cell[:, 1]
        for total, weights in zip(sums, ((part.value - value) * along, along**2)):
            first = index.min()
            total[first : index.max() + 1] += np.bincount(index - first, weights)
    return sums[0].reshape(shape), sums[1].reshape(shape)
