"""Linear maps between named spaces: a dense matrix, and a matrix that repeats from
lenslet to lenslet.

Every map has `domain` and `range` (Space), `dtype`, `forward(x)` and `adjoint(y)`; both directions
keep leading axes out: x has exactly `domain.shape` and y exactly `range.shape`.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from math import prod
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Space:
    """A space of real arrays: `axes` names each axis of `shape`, in order."""

    axes: tuple[str, ...]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """How many numbers an array of it has."""
        return prod(self.shape)


class LinearMap(Protocol):
    """What every map offers. <forward(x), y> = <x, adjoint(y)> for all x in domain, y in range
    (see adjoint_gap).
    """

    domain: Space
    range: Space
    dtype: np.dtype

    def forward(self, x: np.ndarray) -> np.ndarray:
        """A x, of `range.shape`."""
        ...

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """A* y, of `domain.shape`."""
        ...


class Dense:
    """y = A x for one matrix A (pixel, point)."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.matrix = np.asarray(matrix)
        if self.matrix.ndim != 2:
            raise ValueError(
                f"a dense map needs a matrix, not an array of shape {self.matrix.shape}"
            )
        self.dtype = self.matrix.dtype
        self.range = Space(("pixel",), self.matrix.shape[:1])
        self.domain = Space(("point",), self.matrix.shape[1:])

    def forward(self, x: np.ndarray) -> np.ndarray:
        """(point,) -> (pixel,): A x."""
        return self.matrix @ _checked(x, self.domain)

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """(pixel,) -> (point,): A^T y."""
        return self.matrix.T @ _checked(y, self.range)


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
        sum_o A_o x[l - o].
        """
        x = _checked(x, self.domain)
        y = np.zeros(self.range.shape, np.result_type(self.dtype, x.dtype))
        for block, offset in self.terms:
            source, target = _overlap(offset, self.domain.shape[:2])
            y[target] += x[source] @ block.T
        return y

    def adjoint(self, y: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, pixel) -> (lenslet_row, lenslet_column, point):
        sum_o A_o^T y[l + o].
        """
        y = _checked(y, self.range)
        x = np.zeros(self.domain.shape, np.result_type(self.dtype, y.dtype))
        for block, offset in self.terms:
            source, target = _overlap(offset, self.domain.shape[:2])
            x[source] += y[target] @ block
        return x

    def neighbours_only(self) -> BlockToeplitz:
        """The same map without the block's own superpixel: what the neighbours' light adds."""
        other = copy(self)
        other.terms = [(block, offset) for block, offset in self.terms if np.any(offset != 0)]
        return other


def adjoint_gap(op: LinearMap, seed: int = 0) -> float:
    """|<Ax, y> - <x, A*y>| in units of eps, for a seeded pair x, y.

    op: the map.
    seed: of x and y.

    Returns about 1-10 for a correct pair of forward and adjoint, at any shape and scale.

    Divided by |Ax| |y| / sqrt(size of y), not by the inner product itself, which may be near zero
    by chance. An adjoint that is wrong by 0.1 % gives hundreds (float32) or more, so 100
    separates right from wrong.
    """
    rng = np.random.default_rng(seed)
    x, y = (rng.standard_normal(s.shape).astype(op.dtype) for s in (op.domain, op.range))
    ax, aty = op.forward(x), op.adjoint(y)
    scale = np.linalg.norm(ax) * np.linalg.norm(y) / np.sqrt(y.size)
    if scale == 0:
        return 0.0 if not np.any(aty) else float("inf")
    return float(abs(np.vdot(ax, y) - np.vdot(x, aty)) / (np.finfo(op.dtype).eps * scale))


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
