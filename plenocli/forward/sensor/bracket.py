"""Exposure brackets: captures of one still scene at many exposure times made into
one picture of rates.
"""

import numpy as np

# DN: black is clipped below, so that the least values are not in proportion to the light
FLOOR = 4.0
CEILING = 0.98  # of the white level: pixels that were averaged after clipping read less than it
HALF = 0.5  # DN: a converter that cuts off instead of rounding reads this much too little


def merge_bracket(frames, seconds, darks, white, floor=FLOOR, ceiling=CEILING, truncated=True):
    """Rate (rows, columns) DN/s: sum of signals over the sum of their times, of the exposures that
    are good at a pixel.

    frames: (rows, columns) each, DN;
    seconds each;
    darks: dark image or number of each. A value counts from `floor` DN to below `ceiling` of
        `white` DN. A pixel below the floor in every exposure takes its longest one. NaN
        where all saturate.
    truncated: whether the converter cuts off its last digit.
    """
    total = time = 0.0
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


def linearity(frames, seconds, darks, labels, white, least=20.0, ceiling=CEILING):
    """Ratios of the rates of successive exposures, 1 for a linear sensor: list of (label, shorter
    s, longer s, ratio).

    labels (rows, columns): regions 1.., 0 elsewhere. Regions with a saturated pixel or a mean of
        the shorter exposure below `least` DN are left out. No offset is added: the test is of the
        values as they are.
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


def _signal(frame, dark, truncated):
    return np.asarray(frame, float) - dark + (HALF if truncated else 0.0)
