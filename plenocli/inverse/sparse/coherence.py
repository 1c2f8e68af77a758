"""Coherence of the columns that a sparse code chooses from."""

import numpy as np

INVISIBLE = 1e-6
"""Share of the largest column's norm below which the sensor cannot tell one from nothing."""


def column_coherence(
    effective: np.ndarray, block: int = 512
) -> tuple[float | None, float | None, np.ndarray]:
    """|cosine| of pairs of different columns.

    effective: (pixel, atom) D, what the sensor sees of each atom.
    block: columns whose products are held at a time.

    Returns (largest, mean, visible): None and None without a pair; visible (atom,) bool, columns of
    at least INVISIBLE of the largest norm, which alone count.
    """
    norm = np.linalg.norm(effective, axis=0)
    visible = norm > INVISIBLE * norm.max(initial=0)
    unit = effective[:, visible] / norm[visible]
    count = unit.shape[1]
    if count < 2:
        return None, None, visible
    largest, total = 0.0, 0.0
    for start in range(0, count, block):
        left = unit[:, start : start + block]
        for other in range(start, count, block):
            gram = np.abs(left.T @ unit[:, other : other + block])
            if other == start:
                gram = np.triu(gram, 1)
            largest = max(largest, float(gram.max(initial=0)))
            total += float(gram.sum(dtype=np.float64))
    return min(largest, 1.0), total / (count * (count - 1) / 2), visible
