"""Removal of white noise from a whole picture by block matching and collaborative filtering.

Similar patches of a picture are stacked and transformed together (a cosine transform in each patch,
Walsh-Hadamard across the stack), shrunk there and put back, overlaps averaged with weights: K.
Dabov, A. Foi, V. Katkovnik, K. Egiazarian, IEEE Trans. Image Processing 16 (2007) 2080. Written
from the paper, in matrix products on strips of the picture, so that memory grows with its height
by what is alike alone; of large pictures the rest is compiled where numba is there.
"""

from __future__ import annotations

from functools import lru_cache
from types import ModuleType

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

PATCH, STEP, SEARCH, STACK = 8, 4, 9, 16
"""Side of a patch, distance of reference patches, how far similar ones are searched, how many
are stacked (a power of two).
"""
THRESHOLD = 2.7
"""Coefficients below so many standard deviations of the noise vanish; the paper's value."""
TOGETHER = 4096
"""Stacks that are filtered together."""
LARGE = 250_000
"""Points from which on a picture is worth the seconds in which the kernel is loaded."""


Matched = dict[int, np.ndarray]
"""First row of a strip of patches -> which are like them, see `_match`."""


def block_matching(picture: np.ndarray, sigma: float, matched: Matched | None = None) -> np.ndarray:
    """A picture with its white noise removed.

    picture: (row, column).
    sigma: standard deviation of the noise.
    matched: what was found alike in a picture of this shape, for the next; filled where empty.

    Returns (row, column) float64.
    Dabov et al. 2007.
    """
    picture = np.asarray(picture, float)
    unit = np.abs(picture).max()  # squares of very large or small values leave single precision
    if unit == 0:
        return picture.copy()
    picture, sigma = picture / unit, sigma / unit
    patch = min(PATCH, *picture.shape)
    rows, columns = (_corners(n, patch) for n in picture.shape)
    least = min(SEARCH + 1, picture.shape[0] - patch + 1) * min(
        SEARCH + 1, picture.shape[1] - patch + 1
    )
    stack = min(STACK, 1 << (least.bit_length() - 1))
    source = np.asarray(picture, np.float32)
    total, weight = np.zeros(picture.shape), np.zeros(picture.shape)
    matched = {} if matched is None else matched
    kernel = _kernel() if picture.size >= LARGE else None
    for strip in np.array_split(rows, max(1, -(-len(rows) * len(columns) // TOGETHER))):
        span = slice(max(strip[0] - SEARCH, 0), min(strip[-1] + patch + SEARCH, picture.shape[0]))
        if strip[0] not in matched:
            match = _match if kernel is None else kernel.match
            found = match(source[span], strip - span.start, columns, patch, SEARCH, stack)
            matched[strip[0]] = found.astype(np.int32, copy=False)
        one, two = _filter(source[span], matched[strip[0]], patch, sigma, kernel)
        total[span] += one
        weight[span] += two
    return unit * total / weight


@lru_cache(maxsize=1)
def _kernel() -> ModuleType | None:
    """The compiled functions, None where numba is missing: several times slower, the same but for
    rounding.
    """
    try:
        from plenocli.inverse.picture.solvers import block_matching_kernel
    except ImportError:
        return None
    return block_matching_kernel


def _corners(length: int, patch: int) -> np.ndarray:
    """First samples of the patches along a side, the last one included."""
    return np.unique(
        np.append(np.arange(0, length - patch + 1, max(1, min(STEP, patch // 2))), length - patch)
    )


def _match(
    source: np.ndarray, rows: np.ndarray, columns: np.ndarray, patch: int, reach: int, stack: int
) -> np.ndarray:
    """As `match` of the kernel, in whole arrays; among patches that are equally like, any."""
    height, width = source.shape
    sum_rows = np.zeros((len(rows), height), np.float32)
    for k, first in enumerate(rows):
        sum_rows[k, first : first + patch] = 1
    up_to = np.zeros((len(rows), width + 1))
    offsets = np.array([(r, c) for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)])
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
            source[r, c] - source[r.start + down : r.stop + down, c.start + right : c.stop + right]
        )
        down_patches = sum_rows[at_r, r] @ np.square(change, out=change)
        sums = up_to[: len(down_patches), : down_patches.shape[1] + 1]
        np.cumsum(down_patches, axis=1, out=sums[:, 1:])
        first = columns[at_c] - c.start
        distance[k, at_r, at_c] = sums[:, first + patch] - sums[:, first]
    distance[len(offsets) // 2] = -1
    by_patch = distance.reshape(len(offsets), -1).T
    best = np.argpartition(by_patch, stack - 1, axis=1)[:, :stack]
    order = np.argsort(np.take_along_axis(by_patch, best, 1), axis=1, kind="stable")
    best = np.take_along_axis(best, order, 1)
    return (rows[:, None] * width + columns).ravel()[:, None] + (offsets @ [width, 1])[best]


def _filter(
    source: np.ndarray, stacks: np.ndarray, patch: int, sigma: float, kernel: ModuleType | None
) -> tuple[np.ndarray, np.ndarray]:
    """(weighted sum, weights), each like source, of the filtered patches.

    Every patch of the plane is transformed once, and what stacks make of it is summed before it is
    transformed back.
    """
    shape = source.shape
    corners = (shape[0] - patch + 1, shape[1] - patch + 1)
    cosine, _, taper = _transforms(patch, stacks.shape[1])
    rows, columns = np.divmod(stacks, shape[1])
    patches = sliding_window_view(source, (patch, patch)).reshape(-1, patch * patch)
    shrink = _shrink if kernel is None else kernel.shrink
    sums, counted = shrink(patches @ cosine.T, rows * corners[1] + columns, THRESHOLD * sigma)
    planes = (cosine.T @ sums.T).reshape(patch, patch, *corners)
    counted = counted.reshape(corners)
    total, weights = np.zeros(shape), np.zeros(shape)
    for r, c in np.ndindex(patch, patch):
        here = np.s_[r : r + corners[0], c : c + corners[1]]
        total[here] += taper[r * patch + c] * planes[r, c]
        weights[here] += taper[r * patch + c] * counted
    return total, weights


def _shrink(
    spectra: np.ndarray, stacks: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """As `shrink` of the kernel, in whole arrays."""
    from scipy.sparse import csr_array

    count, at = stacks.shape[1], stacks.T.ravel()
    across = _transforms(PATCH, count)[1]
    spectrum = (across @ spectra[at].reshape(count, -1)).reshape(count, len(stacks), -1)
    keep = np.abs(spectrum) > threshold
    keep[0, :, 0] = True
    spectrum *= keep
    weight = 1 / keep.sum(axis=(0, 2), dtype=np.float32)
    spectrum *= weight[:, None]
    back = (across @ spectrum.reshape(count, -1)).reshape(len(at), -1)
    # which stacks each patch is in
    order = np.argsort(at, kind="stable")
    starts = np.searchsorted(at[order], np.arange(len(spectra) + 1))
    member = csr_array((np.ones(len(at), np.float32), order, starts), (len(starts) - 1, len(at)))
    return member @ back, member @ np.tile(weight, count)


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
