"""A map of depths from one capture: the slope at which the views of a point agree best."""

from collections.abc import Sequence

import numpy as np

from plenocli.inverse.lightfield.planes import DepthMap
from plenocli.inverse.lightfield.refocus import STEP, place, refocus
from plenocli.inverse.lightfield.samples import Samples

ROUNDS = 4
"""Corrections of a depth map by least squares."""


def depth(
    samples: Samples, slopes: Sequence[float], shape: tuple[int, int], width: float = 1.5
) -> DepthMap:
    """The slope at which the views agree best, with its confidence, one value a pitch.

    samples: of one capture.
    slopes: at least three, rising.
    shape: (rows, columns) of the map.
    width: of the Gaussian over which disagreement is averaged, pitches.

    Disagreement is the variance of what meets a point beyond that of the picture's own slant within
    a lenslet's width; its least value is found on a parabola, and corrected by least squares.

    docs/model.md, "Refocusing and depth".
    """
    tried = np.asarray(slopes, float)
    disagreement = np.array([_disagreement(samples, slope, shape, width) for slope in tried])
    blind = ~np.isfinite(disagreement).all(axis=0)
    disagreement[:, blind] = 1.0
    found, confidence = _least(disagreement, tried)
    for _ in range(ROUNDS):
        found = np.clip(found + _correction(samples, found, shape, width), tried[0], tried[-1])
    return DepthMap(
        np.where(blind, np.nan, found),
        np.where(blind, 0.0, np.clip(np.nan_to_num(confidence), 0, 1)),
    )


def _disagreement(
    samples: Samples, slope: float, shape: tuple[int, int], width: float
) -> np.ndarray:
    """Variance of what meets a point of the plane of this slope, (row, column), NaN where nothing
    does.
    """
    from scipy.ndimage import gaussian_filter

    floor = 1e-9 * float(np.mean(samples.value**2))
    picture, variance = refocus(samples, slope, shape, step=2)
    for part in np.gradient(picture):
        variance = variance - (2 * part) ** 2 / 6  # a tent of a pitch to each side has 1/6
    known = np.isfinite(variance)
    weight = gaussian_filter(known.astype(float), 2 * width)
    with np.errstate(divide="ignore", invalid="ignore"):
        smooth = gaussian_filter(np.where(known, variance, 0), 2 * width) / weight
    smooth = np.where(known, np.maximum(smooth, 0) + floor, np.nan)
    return smooth.reshape(shape[0], 2, shape[1], 2).mean(axis=(1, 3))


def _least(disagreement: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(slope of the least disagreement (plane, row, column), by a parabola; how clearly)."""
    best = np.clip(disagreement.argmin(axis=0), 1, len(slopes) - 2)
    before, least, after = (
        np.take_along_axis(disagreement, (best + k)[None], 0)[0] for k in (-1, 0, 1)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        move = np.where(
            before + after > 2 * least, (before - after) / (2 * (before - 2 * least + after)), 0.0
        )
        confidence = 1 - disagreement.min(axis=0) / np.median(disagreement, axis=0)
    place_of_best = best + np.clip(np.nan_to_num(move), -1, 1)
    return np.interp(place_of_best, np.arange(len(slopes)), slopes), confidence


def _correction(
    samples: Samples, slope: np.ndarray, shape: tuple[int, int], width: float
) -> np.ndarray:
    """By how much the slope (row, column) should change, from how the samples differ from the
    picture p at their places: at a wrong slope v - p = ds (grad p . q), solved for ds by least
    squares over a Gaussian of `width` pitches; at most half a unit.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    own = map_coordinates(slope, samples.centre.T / samples.pitch - 0.5, order=1, mode="nearest")
    picture, _ = refocus(samples, own, shape, step=STEP)
    picture = np.where(np.isfinite(picture), picture, np.nanmean(picture))
    where = place(samples, own, STEP).T
    value, down, right = (
        map_coordinates(layer, where, order=1, mode="nearest")
        for layer in (picture, *np.gradient(picture))
    )
    along = (down * samples.offset[:, 0] + right * samples.offset[:, 1]) * (STEP / samples.pitch)
    cell = np.clip((samples.centre / samples.pitch).astype(int), 0, np.array(shape) - 1)
    index = cell[:, 0] * shape[1] + cell[:, 1]
    top, bottom = (
        gaussian_filter(
            np.bincount(index, w, shape[0] * shape[1]).reshape(shape), width, mode="constant"
        )
        for w in ((samples.value - value) * along, along**2)
    )
    return np.clip(top / np.maximum(bottom, 1e-30 + 1e-6 * bottom.max()), -0.5, 0.5)
