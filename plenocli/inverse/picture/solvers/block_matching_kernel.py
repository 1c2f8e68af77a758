"""Block matching compiled by numba: what `block_matching` does patch by patch, several times faster
than the same by whole arrays, with the same result but for rounding.

Imported late, because importing numba takes a second. Loops run over slices that start at 0: a
variable offset in an index keeps the compiler from vectorising.
"""

import numpy as np

from plenocli.inverse.compiled import compiled

TOGETHER = 64
"""Reference patches of a row that are compared together: their distances stay in the cache."""

_jit = compiled(fastmath={"reassoc", "contract", "nsz"}, forceinline=True, nogil=True)


@_jit
def match(
    source: np.ndarray, rows: np.ndarray, columns: np.ndarray, patch: int, reach: int, stack: int
) -> np.ndarray:
    """Flat corners (reference, stack) int32 of the patches most like those with corners at rows x
    columns, these first; among patches that are equally like, the first.

    source: (row, column) float32.
    patch: side of a patch.
    reach: how far similar patches are searched, rows and columns.
    stack: how many are wanted, no more than there are.
    """
    height, width = source.shape
    side = 2 * reach + 1
    found = np.empty((len(rows) * len(columns), stack), np.int32)
    distance = np.empty((TOGETHER, side * side), np.float32)
    sums = np.empty(width, np.float32)
    best = np.empty(stack, np.float32)
    for k in range(len(rows)):
        for start in range(0, len(columns), TOGETHER):
            some = columns[start : start + TOGETHER]
            distance[: len(some)] = np.inf
            for down in range(-reach, reach + 1):
                top = rows[k] + down
                if top < 0 or top + patch > height:
                    continue
                for right in range(-reach, reach + 1):
                    first = max(some[0], -right)
                    end = min(some[-1] + patch, width - right)
                    column_sums = sums[: max(end - first, 0)]
                    column_sums[:] = 0
                    for r in range(patch):
                        here = source[rows[k] + r, first:end]
                        there = source[top + r, first + right : end + right]
                        for c in range(len(column_sums)):
                            change = here[c] - there[c]
                            column_sums[c] += change * change
                    which = (down + reach) * side + right + reach
                    for j in range(len(some)):
                        if some[j] >= first and some[j] + patch <= end:
                            own = column_sums[some[j] - first : some[j] - first + patch]
                            total = np.float32(0)
                            for c in range(patch):
                                total += own[c]
                            distance[j, which] = total
            for j in range(len(some)):
                corner = rows[k] * width + some[j]
                alike = found[k * len(columns) + start + j]
                distance[j, reach * side + reach] = -1
                best[:] = np.inf
                for which in range(side * side):
                    one = distance[j, which]
                    if one < best[stack - 1]:
                        place = stack - 1
                        while place > 0 and one < best[place - 1]:
                            best[place] = best[place - 1]
                            alike[place] = alike[place - 1]
                            place -= 1
                        best[place] = one
                        down, right = which // side - reach, which % side - reach
                        alike[place] = corner + down * width + right
    return found


@_jit
def shrink(
    spectra: np.ndarray, stacks: np.ndarray, threshold: float, total: np.ndarray
) -> np.ndarray:
    """What stacks make of their patches: transformed across the stack (Walsh-Hadamard),
    coefficients below the threshold but the mean of all left out, and transformed back, over how
    many were kept. Returns the sum of these weights, (patch,) float32.

    spectra: (patch, coefficient) float32, the mean of a patch first.
    stacks: (stack, member) which patches, a power of two together.
    threshold: of orthonormal coefficients.
    total: (patch, coefficient) float32, which becomes the weighted sum.
    """
    count, size = stacks.shape[1], spectra.shape[1]
    total[:] = 0
    weight = np.zeros(len(spectra), np.float32)
    held = np.empty((count, size), np.float32)
    least = np.float32(threshold * np.sqrt(count))
    for members in stacks:
        for i in range(count):
            held[i] = spectra[members[i]]
        _walsh_hadamard(held)
        mean, kept = held[0, 0], 0
        for i in range(count):
            row = held[i]
            for c in range(size):
                keep = abs(row[c]) > least
                kept += keep
                row[c] = row[c] if keep else np.float32(0)
        if held[0, 0] == 0:
            held[0, 0], kept = mean, kept + 1
        _walsh_hadamard(held)
        share = np.float32(1 / kept)
        scale = share / np.float32(count)
        for i in range(count):
            row, into = held[i], total[members[i]]
            for c in range(size):
                into[c] += scale * row[c]
            weight[members[i]] += share
    return weight


@_jit
def put_back(
    patches: np.ndarray, counted: np.ndarray, taper: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """(sum, weights), each a float64 plane of `shape`, of patches where they lie.

    patches: (corner, patch row, patch column) float32, already weighted; corners row by row.
    counted: (corner row, corner column) float32, their weights; of those of none nothing is added.
    taper: (patch row, patch column) float32, by which points of a patch count.
    """
    total, weights = np.zeros(shape), np.zeros(shape)
    height, width = counted.shape
    for row in range(height):
        for column in range(width):
            weight = counted[row, column]
            if weight == 0:
                continue
            patch = patches[row * width + column]
            for r in range(len(taper)):
                share, own = taper[r], patch[r]
                into = total[row + r, column : column + len(share)]
                beside = weights[row + r, column : column + len(share)]
                for c in range(len(share)):
                    into[c] += share[c] * own[c]
                    beside[c] += share[c] * weight
    return total, weights


@_jit
def _walsh_hadamard(held: np.ndarray) -> None:
    """Across the rows (a power of two), in place; twice it is the number of rows."""
    step = 1
    while step < len(held):
        for first in range(0, len(held), 2 * step):
            for i in range(first, first + step):
                one, two = held[i], held[i + step]
                for c in range(len(one)):
                    a, b = one[c], two[c]
                    one[c], two[c] = a + b, a - b
        step *= 2
