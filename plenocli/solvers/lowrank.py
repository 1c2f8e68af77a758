"""Responses of many lenslets cleaned of noise by what they have in common.

Lenslets differ by gain, by where they lie within their pixels and little else, so that their responses, one a row, are a
matrix of rank six or so below noise of full rank (docs/model.md, "The response predicted"). What stands out of the noise is kept, and
shrunk as Gavish and Donoho (2017) find it optimal for white noise of known size: nothing is tuned.
"""

import numpy as np

BLOCK = 1024
"""Lenslets that are decomposed together; more gain little and cost their square."""
LEAST = 12
"""Fewer lenslets have little in common to find."""
EDGE = 1.1
"""How far above the largest eigenvalue of noise alone one must be to count: noise is not quite alike in all lenslets."""
FILLS = 3
"""Rounds in which pixels that are not known are filled in from what the others say."""


def low_rank(response, variance, groups=None):
    """Responses (lenslet, pixel, band) without most of their noise: (response, share of the noise variance left, largest rank).

    variance (pixel, band): of one entry, mean over lenslets, in the units of response squared. groups (lenslet,): lenslets of one
    number are alike (windows that begin on one colour of the sensor's filters); each is cleaned for itself. NaN stays NaN, and lenslets
    in groups of fewer than LEAST stay as they are.
    """
    out = np.array(response, np.float32)
    groups = np.zeros(len(out), int) if groups is None else np.asarray(groups)
    left, ranks = 0.0, [0]
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        for part in np.array_split(members, max(1, -(-len(members) // BLOCK))):
            share = 1.0
            if len(part) >= LEAST:
                out[part], share, rank = _cleaned(out[part], variance)
                ranks.append(rank)
            left += share * len(part) / len(out)
    return out, float(left), max(ranks)


def _cleaned(response, variance):
    """low_rank of one block: (response, share left, rank)."""
    count = len(response)
    matrix = response.reshape(count, -1)
    known = np.isfinite(matrix)
    scale = np.sqrt(np.maximum(np.nan_to_num(variance), 0)).ravel().astype(np.float32)
    use = (scale > 0) & known.any(axis=0)
    matrix, known, scale = matrix[:, use] / scale[use], known[:, use], scale[use]
    # shot noise goes with a lenslet's light
    light = np.where(known, matrix * scale, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    rows = np.sqrt(np.clip(light / max(float(light.mean()), 1e-30), 0.05, None)).astype(np.float32)[:, None]
    matrix = matrix / rows
    middle = np.where(known, matrix, 0).sum(axis=0) / known.sum(axis=0)
    filled = np.where(known, matrix, rows * middle)
    for _ in range(1 if known.all() else FILLS):
        found, rank, left = _shrunk(filled)
        filled = np.where(known, matrix, found)
    out = response.reshape(count, -1).copy()
    out[:, use] = np.where(known, found * rows * scale, np.nan)
    return out.reshape(response.shape), left, rank


def _shrunk(matrix):
    """(matrix of low rank, its rank, share of the noise left in it) from one with white noise of unit variance.

    A singular value s above the noise's edge becomes sqrt((s^2 - m - n)^2 - 4 m n)/s; the others vanish.
    """
    m, n = matrix.shape
    squares, vectors = np.linalg.eigh((matrix @ matrix.T).astype(float))
    keep = squares > (np.sqrt(m) + np.sqrt(n)) ** 2 * EDGE
    if not keep.any():
        return np.zeros_like(matrix), 0, 0.0
    share = np.sqrt((squares[keep] - m - n) ** 2 - 4.0 * m * n) / squares[keep]
    vectors = vectors[:, keep]
    found = (vectors * share).astype(np.float32) @ (vectors.T.astype(np.float32) @ matrix)
    return found, int(keep.sum()), min(1.0, float((share**2).sum()) * (m + n) / (m * n))
