"""Which designs no other beats: the Pareto front of several figures of merit."""

import numpy as np
from numpy.typing import ArrayLike


def front(values: ArrayLike, signs: ArrayLike) -> np.ndarray:
    """Which points are beaten by none.

    values: (point, figure); points with NaN are not on the front, and beat nobody.
    signs: (figure,) +1 where more is better, -1 where less is.

    A point is beaten by one that is at least as good in every figure and better in one; equals
    beat none of each other.

    Returns (point,) bool.
    """
    merit = np.asarray(values, dtype=np.float64) * np.asarray(signs, dtype=np.float64)
    if merit.ndim != 2 or merit.shape[1] == 0:
        return np.zeros(len(merit), dtype=bool)
    known = np.flatnonzero(~np.isnan(merit).any(axis=1))
    # best first: whoever beats a point stands before it
    order = known[np.lexsort(tuple(-column for column in merit[known].T[::-1]))]
    kept, found = merit[:0], np.zeros(len(merit), dtype=bool)
    for index in order:
        row = merit[index]
        if not ((kept >= row).all(axis=1) & (kept > row).any(axis=1)).any():
            kept = np.vstack([kept, row])
            found[index] = True
    return found
