"""Removal of white noise from a whole picture by block matching and collaborative filtering.

Similar patches of a picture are stacked and transformed together (a cosine transform in each patch,
Walsh-Hadamard across the stack), shrunk there and put back, overlaps averaged with weights: K.
Dabov, A. Foi, V. Katkovnik, K. Egiazarian, IEEE Trans. Image Processing 16 (2007) 2080. Written
from the paper, in matrix products on strips of the picture, so that memory does not
grow with its height.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

PATCH, STEP, SEARCH, STACK = 8, 4, 9, 16
"""Side of a patch, distance of reference patches, how far similar ones are searched, how many
are stacked (a power of two).
"""
THRESHOLD = 2.7
"""Coefficients below so many standard deviations of the noise vanish; the paper's value."""
TOGETHER = 8192
"""Stacks that are filtered together."""


def block_matching(
    picture: np.ndarray, sigma: float, pilot: np.ndarray | None = None
) -> np.ndarray:
    """A picture with its white noise removed.

    picture: (row, column).
    sigma: standard deviation of the noise.
    pilot: a picture like it with less noise, or None. Without one coefficients are cut at THRESHOLD
        sigma; with one patches are matched in it and shrunk by the Wiener factor p^2 / (p^2 +
        sigma^2) of its coefficients p.

    Returns (row, column) float64.
    Dabov et al. 2007.
    """
    picture = np.asarray(picture, float)
    unit = np.abs(picture).max()  # squares of very large or small values leave single precision
    if unit == 0:
        return picture.copy()
    picture, sigma, pilot = (
        picture / unit,
        sigma / unit,
        None if pilot is None else np.asarray(pilot, float) / unit,
    )
    patch = min(PATCH, *picture.shape)
    rows, columns = (_corners(n, patch) for n in picture.shape)
    least = min(SEARCH + 1, picture.shape[0] - patch + 1) * min(
        SEARCH + 1, picture.shape[1] - patch + 1
    )
    stack = min(STACK, 1 << (least.bit_length() - 1))
    guide = np.asarray(picture if pilot is None else pilot, np.float32)
    source = np.asarray(picture, np.float32)
    total, weight = np.zeros(picture.shape), np.zeros(picture.shape)
    for strip in np.array_split(rows, max(1, -(-len(rows) * len(columns) // TOGETHER))):
        span = slice(max(strip[0] - SEARCH, 0), min(strip[-1] + patch + SEARCH, picture.shape[0]))
        stacks = _match(guide[span], strip - span.start, columns, patch, stack)
        one, two = _filter(
            source[span], None if pilot is None else guide[span], stacks, patch, sigma
        )
        total[span] += one
        weight[span] += two
    return unit * total / weight


def _corners(length: int, patch: int) -> np.ndarray:
    """First samples of the patches along a side, the last one included."""
    return np.unique(
        np.append(np.arange(0, length - patch + 1, max(1, min(STEP, patch // 2))), length - patch)
    )


def _match(
    guide: np.ndarray, rows: np.ndarray, columns: np.ndarray, patch: int, stack: int
) -> np.ndarray:
    """Flat corners (reference, stack) of the patches most like those with corners at rows x
    columns, these first.
    """
    height, width = guide.shape
    sum_rows, sum_columns = (
        np.zeros((len(at), n), np.float32) for at, n in ((rows, height), (columns, width))
    )
    for sums, at in ((sum_rows, rows), (sum_columns, columns)):
        for k, first in enumerate(at):
            sums[k, first : first + patch] = 1
    offsets = np.array(
        [(r, c) for r in range(-SEARCH, SEARCH + 1) for c in range(-SEARCH, SEARCH + 1)]
    )
    distance = np.full((len(offsets), len(rows), len(columns)), np.inf, np.float32)
    for k, (down, right) in enumerate(offsets):
        r, c = (
            slice(max(0, -down), min(height, height - down)),
            slice(max(0, -right), min(width, width - right)),
        )
        if r.start >= r.stop or c.start >= c.stop:
            continue
        at_r = slice(
            np.searchsorted(rows, -down), np.searchsorted(rows, height - patch - down, side="right")
        )
        at_c = slice(
            np.searchsorted(columns, -right),
            np.searchsorted(columns, width - patch - right, side="right"),
        )
        change = (
            guide[r, c] - guide[r.start + down : r.stop + down, c.start + right : c.stop + right]
        )
        distance[k, at_r, at_c] = (
            sum_rows[at_r, r] @ np.square(change, out=change) @ sum_columns[at_c, c].T
        )
    distance[len(offsets) // 2] = -1
    by_patch = distance.reshape(len(offsets), -1).T
    best = np.argpartition(by_patch, stack - 1, axis=1)[:, :stack]
    order = np.argsort(np.take_along_axis(by_patch, best, 1), axis=1, kind="stable")
    best = np.take_along_axis(best, order, 1)
    return (rows[:, None] * width + columns).ravel()[:, None] + (offsets @ [width, 1])[best]


def _filter(
    source: np.ndarray, guide: np.ndarray | None, stacks: np.ndarray, patch: int, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """(weighted sum, weights), each like source, of the filtered patches.

    guide: None, or the pilot.
    """
    shape = source.shape
    cosine, across, taper = _transforms(patch, stacks.shape[1])
    index = stacks[:, :, None] + (np.arange(patch)[:, None] * shape[1] + np.arange(patch)).ravel()

    def forward(plane: np.ndarray) -> np.ndarray:
        return across @ (plane.ravel()[index].reshape(-1, patch * patch) @ cosine.T).reshape(
            index.shape
        )

    spectrum = forward(source)
    if guide is None:
        keep = np.abs(spectrum) > THRESHOLD * sigma
        keep[:, 0, 0] = True
        spectrum *= keep
        weight = 1 / keep.sum(axis=(1, 2), dtype=np.float32)
    else:
        wiener = np.square(forward(guide))
        wiener /= wiener + np.float32(max(sigma, 1e-12) ** 2)
        wiener[:, 0, 0] = 1
        spectrum *= wiener
        weight = 1 / np.maximum(np.square(wiener).sum(axis=(1, 2)), 1)
    weight = weight[:, None, None] * taper
    back = ((across @ spectrum).reshape(-1, patch * patch) @ cosine).reshape(index.shape) * weight
    index, size = index.ravel(), source.size
    weights = np.broadcast_to(weight, back.shape)
    return np.bincount(index, back.ravel(), size).reshape(shape), np.bincount(
        index, weights.ravel(), size
    ).reshape(shape)


@lru_cache(maxsize=8)
def _transforms(patch: int, stack: int) -> tuple[np.ndarray, ...]:
    """(cosine transform of a patch, Walsh-Hadamard transform of a stack, Kaiser window),
    orthonormal, float32.
    """
    from scipy.fft import dct
    from scipy.linalg import hadamard

    one = dct(np.eye(patch), axis=0, norm="ortho")
    taper = np.kaiser(patch, 2.0)
    return tuple(
        m.astype(np.float32)
        for m in (
            np.kron(one, one),
            hadamard(stack) / np.sqrt(stack),
            np.outer(taper, taper).ravel(),
        )
    )
