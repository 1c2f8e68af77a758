"""Removal of white noise from a whole picture by block matching and collaborative filtering.

Similar patches of a picture are stacked and transformed together (a cosine transform in each patch,
Walsh-Hadamard across the stack), shrunk there and put back, overlaps averaged with weights: K.
Dabov, A. Foi, V. Katkovnik, K. Egiazarian, IEEE Trans. Image Processing 16 (2007) 2080. Written
from the paper, in matrix products on strips of the picture, so that memory grows with its height
by what is alike alone; of large pictures the rest is compiled where numba is there.
"""

from __future__ import annotations

from functools import lru_cache, partial
from types import ModuleType

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from plenocli.base.budget import budget, spread
from plenocli.base.device import beside, namespace
from plenocli.base.tiling import bands

PATCH, STEP, SEARCH, STACK = 8, 4, 9, 16
"""Side of a patch, distance of reference patches, how far similar ones are searched, how many
are stacked (a power of two).
"""
THRESHOLD = 2.7
"""Coefficients below so many standard deviations of the noise vanish; the paper's value."""
TOGETHER, TOGETHER_ELSEWHERE = 1 << 12, 1 << 15
"""Stacks that are filtered together, in NumPy's arrays and in those of others."""
LARGE = 250_000
"""Points from which on a picture is worth the seconds in which the kernel is loaded."""


Matched = dict[int, np.ndarray]
"""First row of a strip of patches -> which are like them, see `_match`."""


def block_matching(picture: np.ndarray, sigma: float, matched: Matched | None = None) -> np.ndarray:
    """A picture with its white noise removed.

    picture: (row, column), of any library whose arrays follow the array API standard.
    sigma: standard deviation of the noise.
    matched: what was found alike in a picture of this shape, for the next; filled where empty.

    Returns (row, column) float64, where the picture is. Strips are worked on by as many threads as
    the budget has, in NumPy's arrays.
    Dabov et al. 2007.
    """
    xp, here = namespace(picture), partial(beside, picture)
    unit = float(xp.max(xp.abs(picture)))
    if unit == 0:
        return here(np.zeros(picture.shape))
    # squares of very large or small values leave single precision
    sigma, source = sigma / unit, xp.asarray(picture / unit, dtype=xp.float32)
    height, width = picture.shape
    patch = min(PATCH, height, width)
    rows, columns = _corners(height, patch), _corners(width, patch)
    least = min(SEARCH + 1, height - patch + 1) * min(SEARCH + 1, width - patch + 1)
    stack = min(STACK, 1 << (least.bit_length() - 1))
    total, weight = here(np.zeros(picture.shape)), here(np.zeros(picture.shape))
    matched = {} if matched is None else matched
    kernel = _kernel() if xp is np and picture.size >= LARGE else None
    together, threads = (TOGETHER, budget().threads) if xp is np else (TOGETHER_ELSEWHERE, 1)
    strips = np.array_split(rows, max(1, -(-len(rows) * len(columns) // together)))
    spans = [
        slice(max(strip[0] - SEARCH, 0), min(strip[-1] + patch + SEARCH, height))
        for strip in strips
    ]
    most = max(span.stop - span.start for span in spans) * width * patch**2
    # no page of it is fetched before it is written
    rooms = np.empty((threads, 2, 0 if kernel is None else most), np.float32)
    found: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def clear(number: int) -> None:
        strip, span = strips[number], spans[number]
        part = source[span, :]
        if strip[0] not in matched:
            match = _match if kernel is None else kernel.match
            like = match(part, strip - span.start, columns, patch, SEARCH, stack)
            matched[strip[0]] = xp.asarray(like, dtype=xp.int32)
        alike, room = matched[strip[0]], rooms[number % threads]
        found[number] = (
            _filter(part, alike, patch, sigma)
            if kernel is None
            else _filter_compiled(part, alike, patch, sigma, kernel, room)
        )

    for some in bands(len(strips), threads):
        spread([(number,) for number in range(some.start, some.stop)], clear)
        # added up in their order, so that the sums are the same for any number of threads
        for number in range(some.start, some.stop):
            one, two = found.pop(number)
            total[spans[number], :] += one
            weight[spans[number], :] += two
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
    xp, here, (height, width) = namespace(source), partial(beside, source), source.shape
    in_patches = np.zeros((len(rows), height), np.float32)
    for k, first in enumerate(rows):
        in_patches[k, first : first + patch] = 1
    sum_rows = here(in_patches)
    offsets = np.array([(r, c) for r in range(-reach, reach + 1) for c in range(-reach, reach + 1)])
    distance = here(np.full((len(offsets), len(rows), len(columns)), np.inf, np.float32))
    for k, (down, right) in enumerate(offsets.tolist()):
        r, c = (
            slice(max(0, -down), min(height, height - down)),
            slice(max(0, -right), min(width, width - right)),
        )
        if r.start >= r.stop or c.start >= c.stop:
            continue
        at_r, at_c = (
            slice(*np.searchsorted(corners, (-by, length - patch - by + 1)).tolist())
            for corners, by, length in ((rows, down, height), (columns, right, width))
        )
        change = (
            source[r, c] - source[r.start + down : r.stop + down, c.start + right : c.stop + right]
        )
        change *= change
        down_patches = sum_rows[at_r, r] @ change
        first = columns[at_c] - c.start
        own = (xp.take(down_patches, here(first + n), axis=1) for n in range(patch))
        distance[k, at_r, at_c] = sum(own)
    distance[len(offsets) // 2, :, :] = -1
    by_patch = xp.permute_dims(xp.reshape(distance, (len(offsets), -1)), (1, 0))
    corners = here((rows[:, None] * width + columns).reshape(-1, 1))
    steps = xp.take(here(offsets @ [width, 1]), xp.reshape(_smallest(by_patch, stack), (-1,)))
    return corners + xp.reshape(steps, (-1, stack))


def _smallest(values: np.ndarray, count: int) -> np.ndarray:
    """Where in each row the `count` smallest are, these in order; among equals, any."""
    xp = namespace(values)
    if xp is not np:
        return xp.argsort(values, axis=1)[:, :count]
    best = np.argpartition(values, count - 1, axis=1)[:, :count]
    order = np.argsort(np.take_along_axis(values, best, 1), axis=1, kind="stable")
    return np.take_along_axis(best, order, 1)


def _filter(
    source: np.ndarray, stacks: np.ndarray, patch: int, sigma: float
) -> tuple[np.ndarray, np.ndarray]:
    """(weighted sum, weights), each like source, of the filtered patches.

    Every patch of the plane is transformed once, and what stacks make of it is summed before it is
    transformed back.
    """
    xp, here, (height, width) = namespace(source), partial(beside, source), source.shape
    corners = (height - patch + 1, width - patch + 1)
    cosine, _, taper = _transforms(patch, stacks.shape[1])
    rows, columns = stacks // width, stacks % width
    patches = xp.reshape(_patches(source, patch), (-1, patch * patch))
    spectra = patches @ here(cosine.T)
    sums, counted = _shrink(spectra, rows * corners[1] + columns, THRESHOLD * sigma)
    planes = xp.reshape(here(cosine.T) @ xp.permute_dims(sums, (1, 0)), (patch, patch, *corners))
    counted = xp.reshape(counted, corners)
    total, weights = here(np.zeros(source.shape)), here(np.zeros(source.shape))
    for r, c in np.ndindex(patch, patch):
        there, share = np.s_[r : r + corners[0], c : c + corners[1]], float(taper[r * patch + c])
        total[there] += share * planes[r, c, :, :]
        weights[there] += share * counted
    return total, weights


def _filter_compiled(
    source: np.ndarray,
    stacks: np.ndarray,
    patch: int,
    sigma: float,
    kernel: ModuleType,
    room: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """As `_filter`, by the compiled functions.

    room: (2, n) float32, n at least patch^2 times the points of source; asked for anew at each
        strip, such memory is slow to come, above all to several threads.
    """
    corners = (source.shape[0] - patch + 1, source.shape[1] - patch + 1)
    cosine, _, taper = _transforms(patch, stacks.shape[1])
    rows, columns = np.divmod(stacks, source.shape[1])
    one, two = room[:, : corners[0] * corners[1] * patch**2].reshape(2, -1, patch**2)
    np.copyto(one.reshape(*corners, patch, patch), _patches(source, patch))
    spectra = np.matmul(one, cosine.T, out=two)
    counted = kernel.shrink(spectra, rows * corners[1] + columns, THRESHOLD * sigma, one)
    back = np.matmul(one, cosine, out=two).reshape(-1, patch, patch)
    return kernel.put_back(
        back, counted.reshape(corners), taper.reshape(patch, patch), source.shape
    )


def _patches(source: np.ndarray, patch: int) -> np.ndarray:
    """(row, column, patch row, patch column) of the patches with corners at every sample."""
    xp, (height, width) = namespace(source), source.shape
    if xp is np:
        return sliding_window_view(source, (patch, patch))
    ends = height - patch + 1, width - patch + 1
    parts = [source[r : r + ends[0], c : c + ends[1]] for r, c in np.ndindex(patch, patch)]
    return xp.reshape(xp.stack(parts, axis=2), (*ends, patch, patch))


def _shrink(
    spectra: np.ndarray, stacks: np.ndarray, threshold: float
) -> tuple[np.ndarray, np.ndarray]:
    """(sum, weight) as `shrink` of the kernel, in whole arrays."""
    xp, (number, count) = namespace(spectra), stacks.shape
    at = xp.reshape(xp.permute_dims(stacks, (1, 0)), (-1,))
    across = beside(spectra, _transforms(PATCH, count)[1])
    spectrum = across @ xp.reshape(xp.take(spectra, at, axis=0), (count, -1))
    spectrum = xp.reshape(spectrum, (count, number, -1))
    keep = xp.asarray(xp.abs(spectrum) > threshold, dtype=xp.float32)
    keep[0, :, 0] = 1
    spectrum *= keep
    weight = 1 / xp.sum(keep, axis=(0, 2))
    spectrum *= weight[:, None]
    back = xp.reshape(across @ xp.reshape(spectrum, (count, -1)), (number * count, -1))
    both = _summed(at, spectra.shape[0], back, xp.tile(weight, (count,))[:, None])
    return both[0], both[1][:, 0]


def _summed(at: np.ndarray, size: int, *values: np.ndarray) -> list[np.ndarray]:
    """Rows of values added up where `at` says, among `size` places."""
    xp = namespace(at)
    order = xp.argsort(at, stable=True)
    starts = xp.searchsorted(xp.take(at, order), beside(at, np.arange(size + 1, dtype=np.int32)))
    if xp is np:
        from scipy.sparse import csr_array

        # which of the rows each place has
        member = csr_array((np.ones(len(at), np.float32), order, starts), (size, len(at)))
        return [member @ one for one in values]
    found = []
    for one in values:
        rows = xp.astype(xp.take(one, order, axis=0), xp.float64)
        up_to = xp.cumulative_sum(rows, axis=0, include_initial=True)
        parts = xp.take(up_to, starts[1:], axis=0) - xp.take(up_to, starts[:-1], axis=0)
        found.append(xp.astype(parts, one.dtype))
    return found


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
