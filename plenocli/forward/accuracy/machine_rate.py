"""How fast this machine multiplies complex matrices: the unit in which plans are
turned into seconds.

Plans are chosen at nominal rates (plan.NOMINAL_RATE); the rates measured here only turn the choice
into the seconds that a user is told.
"""

import time
from functools import lru_cache

import numpy as np

from plenocli.base.budget import one_thread


@lru_cache(maxsize=2)
def product_rate(double: bool) -> float:
    """Speed of one core in products of the shape that the field needs.

    double: of double precision, else single.

    Returns real operations a second, 8 for a complex multiply-add.
    """
    dtype = np.complex128 if double else np.complex64
    a, b = np.ones((512, 72), dtype), np.ones((72, 512), dtype)
    out = np.empty((512, 512), dtype)
    best = np.inf
    with one_thread():
        for _ in range(6):
            start = time.process_time()
            np.matmul(a, b, out=out)
            best = min(best, time.process_time() - start)
    return 8.0 * a.size * b.shape[1] / best
