"""Band-limited functions on an interval: the fewest that carry waves of all directions
up to a largest one.

The prolate spheroidal functions of order 0 are the orthonormal functions on [-1, 1] that hold most
of what exp(j a t), |a| <= c, puts there, one after the other (Slepian and Pollak, Bell System
Technical Journal 40, 1961). It takes about 2 c/pi of them, where polynomials take c. Their Legendre
coefficients are the eigenvectors of a tridiagonal matrix (Xiao, Rokhlin and Yarvin, Inverse
Problems 17, 2001).
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from plenocli.forward.propagation.fresnel.spread_function import legendre


def prolate_count(c: float, error: float) -> int:
    """How many prolate functions carry waves of all directions up to a largest one.

    c: largest phase, rad over half the interval;
    error: root mean square, over places and directions, that they may miss.

    Returns the law of Landau and Widom (Journal of Mathematical Analysis and Applications 77,
    1980), fitted from c = 0.01 to 1000.
    """
    return int(
        math.ceil(2 * c / math.pi + 2 / math.pi**2 * math.log(1 / error) * math.log(c + 8) + 1)
    )


def prolate(t: np.ndarray, c: float, count: int) -> np.ndarray:
    """Prolate spheroidal functions of order 0, orthonormal over [-1, 1].

    t: (place,) in [-1, 1];
    c: bandwidth, rad over half the interval;
    count: how many.

    Returns (place, count).
    Xiao, Rokhlin and Yarvin 2001.
    """
    series = _series(c, count)
    return legendre(np.asarray(t, float), len(series), 1) @ series


@lru_cache(maxsize=2)
def _series(c: float, count: int) -> np.ndarray:
    """Legendre coefficients (degrees, count) of the first `count` prolate functions."""
    from scipy.linalg import eigh_tridiagonal

    degrees = 2 * math.ceil((c + 7 * np.cbrt(c) + max(0.0, count - 2 * c / math.pi)) / 2 + 12)
    series = np.zeros((degrees, count))
    for odd in range(min(2, count)):
        k = np.arange(odd, degrees, 2.0)
        middle = k * (k + 1) + (2 * k * (k + 1) - 1) / ((2 * k + 3) * (2 * k - 1)) * c * c
        beside = (k + 1) * (k + 2) / ((2 * k + 3) * np.sqrt((2 * k + 1) * (2 * k + 5))) * c * c
        _, vectors = eigh_tridiagonal(
            middle, beside[:-1], select="i", select_range=(0, (count + 1 - odd) // 2 - 1)
        )
        series[odd::2, odd::2] = vectors * np.sqrt(k + 0.5)[:, None]
    series.flags.writeable = False
    return series
