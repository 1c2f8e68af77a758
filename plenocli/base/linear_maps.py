"""Linear maps between named spaces: a dense matrix, and a matrix that repeats from
lenslet to lenslet, offset by offset or lattice frequency by lattice frequency.

Every map has `domain` and `range` (Space), `dtype`, `forward(x)` and `adjoint(y)`; both directions
keep leading axes out: x has exactly `domain.shape` and y exactly `range.shape`.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from math import prod
from typing import Any

import numpy as np

from plenocli.base.budget import spread
from plenocli.base.device import CPU, Device, namespace
from plenocli.base.tiling import spread_bands

CHUNK = 1 << 25
"""Bytes of kernels that are transformed at a time."""
CACHED = 4
"""Frequencies whose matrices are multiplied while they are in the processor's cache."""
COLUMNS = 256
"""That a matrix is multiplied with at a time: enough for the processor's full speed."""


@dataclass(frozen=True)
class Space:
    """A space of real arrays: `axes` names each axis of `shape`, in order."""

    axes: tuple[str, ...]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many numbers an array of it has."""
        return prod(self.shape)


class BlockToeplitz:
    """The whole array when every lenslet answers alike: y[l] = sum_o A_o x[l - offset_o], x = 0
    outside the array.

    blocks: A_o, (lenslet offset, pixel, point): light from an object block that lands in the
        superpixel `offset` rows and columns away from the block's own.
    offsets: (lenslet offset, 2) integers, row then column (rows downwards).
    count: (rows, columns) of lenslets.

    The full matrix (for 11 x 11 lenslets 2.5e9 entries) is never formed.
    Berkner et al. 2013, section 3-2 (one on-axis response serves all lenslets).
    """

    def __init__(self, blocks: np.ndarray, offsets: np.ndarray, count: tuple[int, ...]) -> None:
        self.blocks, self.offsets = np.asarray(blocks), np.asarray(offsets, dtype=int)
        if self.blocks.ndim != 3 or self.offsets.shape != (len(self.blocks), 2):
            raise ValueError(
                f"blocks {self.blocks.shape} need offsets ({len(self.blocks)}, 2), not "
                f"{self.offsets.shape}"
            )
        if len({tuple(o) for o in self.offsets.tolist()}) != len(self.offsets):
            raise ValueError("an offset appears twice")
        self.dtype = self.blocks.dtype
        self.terms = list(zip(self.blocks, self.offsets))
        rows, columns = (int(n) for n in count)
        self.domain = Space(
            ("lenslet_row", "lenslet_column", "point"), (rows, columns, self.blocks.shape[2])
        )
        self.range = Space(
            ("lenslet_row", "lenslet_column", "pixel"), (rows, columns, self.blocks.shape[1])
        )

    def forward(self, x: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, point) -> (lenslet_row, lenslet_column, pixel):
        sum_o A_o x[l - o], products in the precision of A.
        """
        x = _checked(x, self.domain)
        y = np.zeros(self.range.shape, np.result_type(self.dtype, x.dtype))
        x = x.astype(self.dtype, copy=False)
        for block, offset in self.terms:
            source, target = _overlap(offset, self.domain.shape[:2])
            y[target] += _through(x[source], block.T)
        return y

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, pixel) -> (lenslet_row, lenslet_column, point):
        sum_o A_o^T y[l + o], products in the precision of A.
        """
        y = _checked(y, self.range)
        x = np.zeros(self.domain.shape, np.result_type(self.dtype, y.dtype))
        y = y.astype(self.dtype, copy=False)
        for block, offset in self.terms:
            source, target = _overlap(offset, self.domain.shape[:2])
            x[source] += _through(y[target], block)
        return x

    def neighbours_only(self) -> BlockToeplitz:
        """The same map without the block's own superpixel: what the neighbours' light adds."""
        other = copy(self)
        other.terms = [(block, offset) for block, offset in self.terms if np.any(offset != 0)]
        return other


def _through(values: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Values (row, column, n) times a matrix (n, m), in one product: one for each row reads the
    matrix anew, which takes four times as long.
    """
    rows, columns, size = values.shape
    flat = values.reshape(rows * columns, size) @ matrix
    return flat.reshape(rows, columns, matrix.shape[1])


class BlockCirculant:
    """The whole array when every lenslet answers alike, on a torus: y[l] = sum_parts sum_o
    A_o x[(l - o) mod torus], kept where lenslets are. After a Fourier transform over the
    lenslets it is one small dense matrix a lattice frequency, so that kernels may reach far.

    parts: (blocks (offset, pixel, point), offsets (offset, 2) integers, row then column) of each
        object plane, as in BlockToeplitz; planes may have offsets of their own. Their points
        one after the other are the unknowns.
    count: (rows, columns) of lenslets that are seen, from [0, 0] of the torus.
    torus: (rows, columns) of lenslets that have unknowns. No light goes round it as long as it
        has `count` and the farthest offset; what lies outside on the left is what lies outside
        on the right, unless it has that offset twice (see torus_for).
    device: where it multiplies and transforms; values at frequencies are arrays of it.

    `spectrum` (frequency, pixel, unknown) has the frequencies of rfft2, row by row, complex64 for
    single precision and complex128 for double. Arrays are worked on in that precision.

    Raises ValueError where parts do not fit together, and where the torus is too small.
    """

    def __init__(
        self,
        parts: Sequence[tuple[np.ndarray, np.ndarray]],
        count: tuple[int, int],
        torus: tuple[int, int],
        device: Device = CPU,
    ) -> None:
        self.device = device
        pairs = [(np.asarray(b), np.asarray(o, dtype=int)) for b, o in parts]
        if not pairs:
            raise ValueError("a map needs at least one part")
        pixels = pairs[0][0].shape[1] if pairs[0][0].ndim == 3 else -1
        for blocks, offsets in pairs:
            if blocks.ndim != 3 or offsets.shape != (len(blocks), 2) or blocks.shape[1] != pixels:
                raise ValueError(
                    f"blocks {blocks.shape} need offsets ({len(blocks)}, 2), not {offsets.shape}, "
                    f"and {pixels} pixels as the others"
                )
            if len({tuple(o) for o in offsets.tolist()}) != len(offsets):
                raise ValueError("an offset appears twice")
        self.reach = tuple(int(max(abs(o[:, a]).max() for _, o in pairs)) for a in (0, 1))
        (rows, columns), self.torus = count, (int(torus[0]), int(torus[1]))
        if any(p < n + r for p, n, r in zip(self.torus, count, self.reach)):
            raise ValueError(
                f"light of {self.reach} lenslets beside {tuple(count)} goes round a torus of "
                f"{self.torus}"
            )
        unknowns = sum(blocks.shape[2] for blocks, _ in pairs)
        self.dtype = np.result_type(np.float32, *(blocks for blocks, _ in pairs))
        self.domain = Space(("lenslet_row", "lenslet_column", "unknown"), (*self.torus, unknowns))
        self.range = Space(("lenslet_row", "lenslet_column", "pixel"), (rows, columns, pixels))
        self.frequencies = (self.torus[0], self.torus[1] // 2 + 1)
        self.spectrum = np.empty(
            (prod(self.frequencies), pixels, unknowns), np.result_type(self.dtype, np.complex64)
        )
        first = 0
        for blocks, offsets in pairs:
            self._transform(blocks, offsets, slice(first, first + blocks.shape[2]))
            first += blocks.shape[2]

    @cached_property
    def _there(self) -> Any:
        """The spectrum on the device, from its first use on."""
        return self.device.put(self.spectrum)

    @staticmethod
    def needed(
        pixels: int, unknowns: int, torus: tuple[int, int], itemsize: int = 4, parts: int = 1
    ) -> tuple[int, int]:
        """Bytes of a spectrum, and those that making it takes beside it.

        pixels, unknowns: of a lenslet.
        torus: (rows, columns) of lenslets.
        itemsize: of the kernels' numbers.
        parts: that the unknowns are in, all alike.
        """
        frequencies = torus[0] * (torus[1] // 2 + 1)
        kernels = itemsize * pixels * unknowns // parts * torus[0] * torus[1]
        return 2 * itemsize * pixels * unknowns * frequencies, 4 * min(CHUNK, kernels)

    def _transform(self, blocks: np.ndarray, offsets: np.ndarray, unknowns: slice) -> None:
        """Fill the columns of a part: rows of pixels at a time, as many as CHUNK has room for."""
        from scipy.fft import rfft2

        (rows, columns), points = self.torus, blocks.shape[2]
        step = max(1, CHUNK // (rows * columns * points * self.dtype.itemsize))
        for low in range(0, blocks.shape[1], step):
            some = blocks[:, low : low + step]
            kernel = np.zeros((rows, columns, *some.shape[1:]), self.dtype)
            kernel[offsets[:, 0] % rows, offsets[:, 1] % columns] = some
            moved = rfft2(kernel, axes=(0, 1), overwrite_x=True)
            self.spectrum[:, low : low + step, unknowns] = moved.reshape(-1, *some.shape[1:])

    def forward(self, x: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, unknown) -> (lenslet_row, lenslet_column, pixel):
        A_k x_k at every frequency.
        """
        rows, columns = self.range.shape[:2]
        of_x = self.to_frequencies(_checked(x, self.domain))
        return self.from_frequencies(self.at_frequencies(of_x))[:rows, :columns]

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, pixel) -> (lenslet_row, lenslet_column, unknown):
        A_k^H y_k at every frequency, y = 0 where no lenslet is.
        """
        y = _checked(y, self.range)
        rows, columns = self.range.shape[:2]
        if self.torus != (rows, columns):
            padded = np.zeros((*self.torus, y.shape[2]), self.dtype)
            padded[:rows, :columns] = y
            y = padded
        return self.from_frequencies(self.back_at_frequencies(self.to_frequencies(y)))

    def on_torus(self) -> BlockCirculant:
        """The same map, with lenslets wherever there are unknowns: what a lenslet outside the
        array would see.
        """
        other = copy(self)
        other._there = self._there
        other.range = Space(self.range.axes, (*self.torus, self.range.shape[2]))
        return other

    def to_frequencies(self, array: np.ndarray) -> Any:
        """(row, column, n) on the torus -> (frequency, n), neither sum nor root divided out."""
        there = self.device.put(np.asarray(array, self.dtype))
        moved = _transforms(there).rfftn(there, axes=(0, 1))
        return namespace(moved).reshape(moved, (-1, array.shape[2]))

    def from_frequencies(self, array: Any) -> np.ndarray:
        """(frequency, n) -> (row, column, n) on the torus, the inverse of to_frequencies."""
        whole = namespace(array).reshape(array, (*self.frequencies, array.shape[1]))
        return self.device.get(_transforms(whole).irfftn(whole, s=self.torus, axes=(0, 1)))

    def at_frequencies(self, x: Any) -> Any:
        """(frequency, unknown) -> (frequency, pixel): A_k x_k."""
        return times(self._there, x)

    def back_at_frequencies(self, y: Any) -> Any:
        """(frequency, pixel) -> (frequency, unknown): A_k^H y_k."""
        return times_adjoint(self._there, y)

    def step_at_frequencies(self, inverse: Any, y: Any, pull: Any) -> tuple[Any, Any]:
        """x_k = inverse_k (A_k^H y_k + pull_k) and A_k x_k; on the processor a few frequencies at
        a time, so that their matrices are read from memory once.

        inverse: (frequency, unknown, unknown); y: (frequency, pixel); pull: (frequency, unknown).
        """
        matrices = self._there
        if not isinstance(matrices, np.ndarray):
            x = times(inverse, times_adjoint(matrices, y) + pull)
            return x, times(matrices, x)
        x, light, mirrored = np.empty_like(pull), np.empty_like(y), y.conj()

        def work(share: slice) -> None:
            for low in range(share.start, min(share.stop, len(x)), CACHED):
                part = slice(low, min(low + CACHED, share.stop))
                back = np.matmul(mirrored[part, None, :], matrices[part])[:, 0].conj() + pull[part]
                np.matmul(inverse[part], back[:, :, None], out=x[part, :, None])
                np.matmul(matrices[part], x[part, :, None], out=light[part, :, None])

        spread(_shares(len(x)), work)
        return x, light


def _transforms(array: Any) -> Any:
    """Fourier transforms for an array; SciPy's keep NumPy's single precision."""
    if not isinstance(array, np.ndarray):
        return namespace(array).fft
    import scipy.fft

    return scipy.fft


def times(matrices: Any, x: Any) -> Any:
    """Each of (frequency, m, n) times its own of (frequency, n); NumPy's on the threads of the
    budget.
    """
    if not isinstance(matrices, np.ndarray):
        return namespace(x).matmul(matrices, x[:, :, None])[:, :, 0]
    y = np.empty(matrices.shape[:2], np.result_type(matrices, x))

    def work(part: slice) -> None:
        np.matmul(matrices[part], x[part, :, None], out=y[part, :, None])

    spread(_shares(len(matrices)), work)
    return y


def times_adjoint(matrices: Any, y: Any) -> Any:
    """The conjugate transpose of each of (frequency, m, n) times its own of (frequency, m)."""
    if not isinstance(matrices, np.ndarray):
        xp = namespace(y)
        return xp.conj(xp.matmul(xp.conj(y)[:, None, :], matrices)[:, 0, :])
    x = np.empty((len(matrices), matrices.shape[2]), np.result_type(matrices, y))

    def work(part: slice) -> None:
        np.matmul(y[part, None, :].conj(), matrices[part], out=x[part, None, :])
        np.conj(x[part], out=x[part])

    spread(_shares(len(matrices)), work)
    return x


def product(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """matrix (m, n) times columns (n, count), some columns at a time on the threads of the budget:
    the same numbers however many there are.
    """
    made = np.empty((len(matrix), columns.shape[1]), np.result_type(matrix, columns))

    def work(part: slice) -> None:
        np.matmul(matrix, columns[:, part], out=made[:, part])

    spread_bands(columns.shape[1], COLUMNS, work)
    return made


def _shares(count: int) -> list[tuple[slice]]:
    step = max(1, -(-count // 16))
    return [(slice(low, low + step),) for low in range(0, count, step)]


def torus_for(
    count: tuple[int, int], reach: tuple[int, int], beyond: bool = False
) -> tuple[int, int]:
    """(rows, columns) of a torus for `count` lenslets whose light reaches `reach` of them.

    count, reach: (rows, columns).
    beyond: give what lies outside on the left unknowns other than what lies on the right.

    The next sizes that are quick to transform.
    """
    from scipy.fft import next_fast_len

    least = [n + (2 if beyond else 1) * r for n, r in zip(count, reach)]
    return next_fast_len(least[0]), next_fast_len(least[1], real=True)


def _checked(array: np.ndarray, space: Space) -> np.ndarray:
    array = np.asarray(array)
    if array.shape != space.shape:
        raise ValueError(f"expected {dict(zip(space.axes, space.shape))}, got shape {array.shape}")
    return array


def _overlap(
    offset: np.ndarray, count: tuple[int, ...]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Slices of the sources l - offset and the targets l that are both inside the array."""
    source, target = [], []
    for shift, n in zip(offset, count):
        shift = int(shift)
        target.append(slice(max(shift, 0), max(n + min(shift, 0), 0)))
        source.append(slice(max(-shift, 0), max(n - max(shift, 0), 0)))
    return tuple(source), tuple(target)
