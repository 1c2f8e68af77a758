"""Exposure brackets: captures of one still scene at many exposure times made into
one picture of rates.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

# DN: black is clipped below, so that the least values are not in proportion to the light
FLOOR = 4.0
CEILING = 0.98  # of the white level: pixels that were averaged after clipping read less than it
HALF = 0.5  # DN: a converter that cuts off instead of rounding reads this much too little


def merge_bracket(
    frames: Sequence[np.ndarray],
    seconds: Sequence[float],
    darks: Sequence[np.ndarray | float],
    white: float,
    floor: float = FLOOR,
    ceiling: float = CEILING,
    truncated: bool = True,
) -> np.ndarray:
    """Rate of light: sum of signals over the sum of their times, of the exposures that are good at
    a pixel.

    A value counts from `floor` to below `ceiling` of `white`. A pixel below the floor in every
    exposure takes its longest one.
    frames: (row, column) each, DN.
    seconds: exposure time of each, s.
    darks: dark image or number of each, DN.
    white: saturation level, DN.
    floor: least value that counts, DN.
    ceiling: share of the white level from which on values are saturated.
    truncated: whether the converter cuts off its last digit.

    Returns (row, column) DN/s, NaN where all exposures saturate.
    """
    total: np.ndarray | float = 0.0
    time: np.ndarray | float = 0.0
    for frame, exposure, dark in zip(frames, seconds, darks, strict=True):
        good = (frame >= floor) & (frame < ceiling * white)
        total = total + np.where(good, _signal(frame, dark, truncated), 0)
        time = time + good * float(exposure)
    last = int(np.argmax(seconds))
    longest = np.asarray(frames[last], float)
    dim = (time == 0) & (longest < floor)
    total = np.where(dim, _signal(longest, darks[last], truncated), total)
    time = np.where(dim, float(seconds[last]), time)
    return np.divide(total, time, out=np.full(longest.shape, np.nan), where=time > 0)


def linearity(
    frames: Sequence[np.ndarray],
    seconds: Sequence[float],
    darks: Sequence[np.ndarray | float],
    labels: np.ndarray,
    white: float,
    least: float = 20.0,
    ceiling: float = CEILING,
) -> list[tuple[int, float, float, float]]:
    """Ratios of the rates of successive exposures, 1 for a linear sensor.

    No offset is added: the test is of the values as they are.
    frames, seconds, darks, white, ceiling: as of merge_bracket.
    labels: (row, column) regions 1.., 0 elsewhere; one with a saturated pixel is left out.
    least: mean of the shorter exposure below which a region is left out, DN.

    Returns (label, shorter s, longer s, ratio) of each region and pair of exposures.
    """
    order = np.argsort(seconds)
    found = []
    for label in np.unique(labels[labels > 0]):
        here = labels == label
        means = []
        for i in order:
            values = np.asarray(frames[i], float)[here]
            means.append(
                _signal(values, np.broadcast_to(darks[i], labels.shape)[here], False).mean()
                if values.max() < ceiling * white
                else np.nan
            )
        for (i, a), (j, b) in zip(zip(order, means), zip(order[1:], means[1:])):
            if np.isfinite(a + b) and a > least:
                found.append(
                    (
                        int(label),
                        float(seconds[i]),
                        float(seconds[j]),
                        float(b / seconds[j] / (a / seconds[i])),
                    )
                )
    return found


def _signal(frame: np.ndarray, dark: np.ndarray | float, truncated: bool) -> np.ndarray:
    return np.asarray(frame, float) - dark + (HALF if truncated else 0.0)
