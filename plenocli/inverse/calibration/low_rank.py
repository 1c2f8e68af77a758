"""Responses of many lenslets cleaned of noise by what they have in common.

Lenslets differ by gain, by where they lie within their pixels and little else, so that their
responses, one a row, are a matrix of rank six or so below noise of full rank (docs/model.md, "The
response predicted"). What stands out of the noise is kept, and shrunk as Gavish and Donoho (2017)
find it optimal for white noise of known size: nothing is tuned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

BLOCK = 1024
"""Lenslets that are decomposed together; more gain little and cost their square."""
LEAST = 12
"""Fewer lenslets have little in common to find."""
EDGE = 1.1
"""How far above the largest eigenvalue of noise alone one must be to count: noise is not quite
alike in all lenslets.
"""
FILLS = 3
"""Rounds in which pixels that are not known are filled in from what the others say."""


def low_rank(
    response: np.ndarray, variance: np.ndarray, groups: np.ndarray | None = None
) -> tuple[np.ndarray, float, int]:
    """Responses without most of their noise.

    response: (lenslet, pixel, band); NaN stays NaN.
    variance: (pixel, band), of one entry, mean over lenslets, in the units of response squared.
    groups: (lenslet,), lenslets of one number are alike (windows that begin on one colour of the
        sensor's filters); each group is cleaned for itself, and lenslets in groups of fewer than
        LEAST stay as they are.

    Returns the responses, the share of the noise variance left, and the largest rank.
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


@dataclass(frozen=True)
class Basis:
    """What responses have in common.

    pictures: (rank, pixel, band), of which each response is a mixture; NaN: no response knows it.
    dual: (rank, pixel * band), whose products with a response are its coefficients.
    middle: (rank,), mean coefficients.
    left: share of a response's noise variance that is left in its mixture.
    """

    pictures: np.ndarray
    dual: np.ndarray
    middle: np.ndarray
    left: float

    def coefficients(self, response: np.ndarray) -> np.ndarray:
        """Coefficients (lenslet, rank) of responses (lenslet, pixel, band); NaN counts as
        nothing.
        """
        found = response.reshape(len(response), -1) @ self.dual.T
        lost = np.isnan(found).any(axis=1)
        if lost.any():
            found[lost] = np.nan_to_num(response[lost]).reshape(int(lost.sum()), -1) @ self.dual.T
        return found

    def mixed(self, coefficients: np.ndarray) -> np.ndarray:
        """Responses (lenslet, pixel, band) of coefficients (lenslet, rank)."""
        return (coefficients @ self.pictures.reshape(len(self.pictures), -1)).reshape(
            -1, *self.pictures.shape[1:]
        )


def common(response: np.ndarray, variance: np.ndarray) -> Basis:
    """What stands out of the noise in responses; all of it where they are few.

    response: (lenslet, pixel, band).
    variance: (pixel, band), of one entry.
    """
    matrix, known, scale, _, use = _whitened(response, variance)
    m, n = matrix.shape
    filled = np.where(known, matrix, _level(matrix, known))
    squares, vectors = _decomposed(filled)
    keep = squares > ((np.sqrt(m) + np.sqrt(n)) ** 2 * EDGE if m >= LEAST else 1e-9 * squares[-1])
    keep[-1] = True
    unit = (vectors[:, keep] / np.sqrt(np.maximum(squares[keep], 1e-30))).T.astype(
        np.float32
    ) @ filled
    pictures, dual = (
        np.full((len(unit), use.size), np.nan, np.float32),
        np.zeros((len(unit), use.size), np.float32),
    )
    pictures[:, use], dual[:, use] = unit * scale, unit / scale
    found = Basis(
        pictures=pictures.reshape(-1, *response.shape[1:]),
        dual=dual,
        middle=np.zeros(len(unit)),
        left=min(1.0, int(keep.sum()) * (1 / m + 1 / n)),
    )
    return replace(found, middle=found.coefficients(response).mean(axis=0))


def _whitened(response: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, ...]:
    """(matrix (lenslet, entry) whose noise has unit variance, which are known, scale by entry,
    by lenslet, entries used).
    """
    count = len(response)
    matrix = response.reshape(count, -1)
    known = np.isfinite(matrix)
    scale = np.sqrt(np.maximum(np.nan_to_num(variance), 0)).ravel().astype(np.float32)
    use = (scale > 0) & known.any(axis=0)
    matrix, known, scale = matrix[:, use] / scale[use], known[:, use], scale[use]
    # shot noise goes with a lenslet's light
    light = np.where(known, matrix * scale, 0).sum(axis=1) / np.maximum(known.sum(axis=1), 1)
    rows = np.sqrt(np.clip(light / max(float(light.mean()), 1e-30), 0.05, None)).astype(np.float32)[
        :, None
    ]
    return matrix / rows, known, scale, rows, use


def _level(matrix: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What an entry is on average."""
    return np.where(known, matrix, 0).sum(axis=0) / known.sum(axis=0)


def _decomposed(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Squared singular values, ascending, and left vectors."""
    return np.linalg.eigh((matrix @ matrix.T).astype(float))


def _cleaned(response: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, float, int]:
    """low_rank of one block: (response, share left, rank)."""
    matrix, known, scale, rows, use = _whitened(response, variance)
    filled = np.where(known, matrix, _level(matrix, known))
    for _ in range(1 if known.all() else FILLS):
        found, rank, left = _shrunk(filled)
        filled = np.where(known, matrix, found)
    out = response.reshape(len(response), -1).copy()
    out[:, use] = np.where(known, found * rows * scale, np.nan)
    return out.reshape(response.shape), left, rank


def _shrunk(matrix: np.ndarray) -> tuple[np.ndarray, int, float]:
    """(matrix of low rank, its rank, share of the noise left in it) from one with white
    noise of unit variance.

    A singular value s above the noise's edge becomes sqrt((s^2 - m - n)^2 - 4 m n)/s;
    the others vanish.
    """
    m, n = matrix.shape
    squares, vectors = _decomposed(matrix)
    keep = squares > (np.sqrt(m) + np.sqrt(n)) ** 2 * EDGE
    if not keep.any():
        return np.zeros_like(matrix), 0, 0.0
    share = np.sqrt((squares[keep] - m - n) ** 2 - 4.0 * m * n) / squares[keep]
    vectors = vectors[:, keep]
    found = (vectors * share).astype(np.float32) @ (vectors.T.astype(np.float32) @ matrix)
    return found, int(keep.sum()), min(1.0, float((share**2).sum()) * (m + n) / (m * n))
