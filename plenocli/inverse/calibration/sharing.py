"""Whether one response F serves all lenslets: what they differ by, beside what
their noise explains.

An F of its own brings a lenslet the noise of its calibration, a shared one brings it what it
differs from the others by. Either is a wrong F, and costs its lenslet's radiances F+ dF b; the
noise of both is known, so that what one of them costs more can be told without a truth (C. L.
Mallows, Some comments on C_p, Technometrics 15, 1973). docs/model.md, "Spectral response:
calibration and demultiplexing".
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SURE = 4.0
"""Standard deviations by which a pixel must scatter more among lenslets than its noise, to
be said to differ.
"""


@dataclass(frozen=True, kw_only=True)
class Differences:
    """How lenslets' responses differ.

    excess: mean square of the errors in radiance that differences from the mean response make, over
        what the noise of F alone would make (1: alike).
    error: root mean square error of radiances by the shared F's faults over that by the faults of
        own ones.
    worst: the largest single lenslet's excess.
    number: of that lenslet.
    spread: (pixel, band), variance of F over lenslets beyond its noise.
    """

    excess: float
    error: float
    worst: float
    number: int
    spread: np.ndarray


def differences(
    response: np.ndarray, mean: np.ndarray, variance: np.ndarray, step: int = 256
) -> Differences:
    """How responses differ from their mean.

    Radiances count by the light that they bring (columns of F at length 1).
    response: (lenslet, pixel, band); NaN entries differ by nothing.
    mean: (pixel, band), of the responses.
    variance: (pixel, band), of one entry, known.
    step: lenslets that are worked off together.
    """
    count = len(response)
    size = np.sqrt(np.nansum(mean.astype(float) ** 2, axis=0))
    unit = np.nan_to_num(mean / np.where(size > 0, size, np.inf))
    inverse = np.linalg.pinv(unit)
    noise = float((inverse**2 @ (np.nan_to_num(variance) / np.maximum(size, 1e-30) ** 2)).sum())
    back, weight = inverse.astype(np.float32), (1 / np.maximum(size, 1e-30)).astype(np.float32)
    share, square = np.empty(count), 0.0
    for first in range(0, count, step):
        part = response[first : first + step] - mean
        np.nan_to_num(part, copy=False)
        square = square + np.einsum("npk,npk->pk", part, part, dtype=float)
        share[first : first + step] = np.square((back @ part) * weight, dtype=float).sum(
            axis=(1, 2)
        )
    share /= max(noise, 1e-300) * (1 - 1 / max(count, 2))
    excess, left = float(share.mean()), 1 / count
    beyond = square / max(count - 1, 1) - variance
    spread = np.where(beyond > SURE * np.sqrt(2 / max(count - 1, 1)) * variance, beyond, 0.0)
    error = float(np.sqrt(max(0.0, excess - 1) * (1 - left) + left))
    return Differences(
        excess=excess,
        error=error,
        worst=float(share.max()),
        number=int(share.argmax()),
        spread=spread,
    )
