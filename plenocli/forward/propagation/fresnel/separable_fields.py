"""From factor tables to pixel energies: the inner loop of every model whose sensor field is a
short sum of products.

The field of the point (row r, column c) on superpixel (sy, sx) is

    U[v, u] = sum_j high[sy, r, v, j] wide[sx, c, u, j]

on quadrature nodes v, u of the pixels, so all fields of an object column are one matrix product.
The product is made in pieces that stay in the caches, real and imaginary parts side by side, and is
squared and summed over the nodes of each pixel before it leaves it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from plenocli.base.device import CPU, Device
from plenocli.forward.propagation.complex_matrices import THREE_SERVE, product_of_thirds, thirds

WORK_BYTES = 1 << 22
"""Size of the product before it is squared: small beside the shared cache, large enough that the
right-hand side is packed for several points.
"""

LINES_SERVE = 0.8
"""Share of the operations that fields multiplied line by line may take: they are moved once more.
"""


def field_operations(
    nodes: tuple[int, int], terms: float, lines: tuple[int, int] | None = None
) -> float:
    """Real operations that the field of one point takes on so many nodes: multiplied there, or on
    `lines` that are shown on them afterwards.
    """
    (v, u), (m, n) = nodes, lines or nodes
    return 8.0 * m * n * terms + (4.0 * u * m * (n + v) if lines else 0.0)


def lines_serve(nodes: tuple[int, int], terms: float, lines: tuple[int, int]) -> bool:
    """Whether fields are better multiplied on `lines`."""
    return field_operations(nodes, terms, lines) < LINES_SERVE * field_operations(nodes, terms)


class Factors:
    """Pixel energies from factor tables.

    high: (superpixel rows, point rows, nodes x pixel rows, terms), wide: (superpixel columns, point
        columns, nodes x pixel columns, terms), both complex and of one type; the nodes of a pixel
        run slowest along v and u (as array_to_sensor.sensor_nodes orders them), square roots of the
        quadrature weights (m) are folded in, so that |U|^2 summed over the nodes of a pixel is the
        share of the light that it receives.
    pixel_shape: (rows, columns);
    pixel_nodes: nodes of a pixel, along either axis or (rows, columns);
    signs: (terms,) of +-1 that multiply the terms, so that one table may serve as both;
    shown: real (nodes x pixel rows, lines) and (nodes x pixel columns, lines) that bring fields to
        the nodes, where the tables have lines in their place; None: they have the nodes;
    device: where tables are multiplied.
    """

    def __init__(
        self,
        high: np.ndarray,
        wide: np.ndarray,
        pixel_shape: tuple[int, int],
        pixel_nodes: int | tuple[int, int],
        signs: np.ndarray | None = None,
        shown: tuple[np.ndarray, np.ndarray] | None = None,
        device: Device = CPU,
    ) -> None:
        per_pixel = (pixel_nodes,) * 2 if isinstance(pixel_nodes, int) else pixel_nodes
        nodes = [n * pixels for n, pixels in zip(per_pixel, pixel_shape)]
        lines = [high.shape[2], wide.shape[2]]
        whole = [x.shape for x in shown] == [*zip(nodes, lines)] if shown else lines == nodes
        if not whole or high.shape[3] != wide.shape[3]:
            raise ValueError(
                f"tables {high.shape} and {wide.shape} do not fit {pixel_nodes} nodes in "
                f"pixels {pixel_shape}"
            )
        self.high, self.wide = (
            np.ascontiguousarray(high),
            np.ascontiguousarray(wide, dtype=high.dtype),
        )
        self.pixel_shape, self.pixel_nodes = (pixel_shape[0], pixel_shape[1]), per_pixel
        self.signs = None if signs is None else signs.astype(high.real.dtype)
        self.shown = shown and (_as(high, shown[0]), _as(high, shown[1].T))
        self.device = device

    @cached_property
    def turned(self) -> Factors:
        """Rows and columns exchanged, of tables without signs."""
        shape, nodes = self.pixel_shape[::-1], self.pixel_nodes[::-1]
        shown = self.shown and (self.shown[1].T, self.shown[0])
        return Factors(self.wide, self.high, shape, nodes, shown=shown, device=self.device)

    @cached_property
    def _there(self) -> tuple[Any, Any]:
        """Both tables on the device."""
        wide = self.wide if self.signs is None else self.wide * self.signs
        return self.device.put(self.high), self.device.put(wide)

    def superpixel(
        self, sy: int, sx: int, rows: np.ndarray, columns: np.ndarray, out: np.ndarray
    ) -> None:
        """Pixel energies on one superpixel.

        sy, sx: superpixel, as counted in the tables;
        rows, columns: (point,) indices;
        out: (point, pixel row, pixel column), filled.
        """
        order = np.argsort(columns, kind="stable")
        starts = np.flatnonzero(np.diff(columns[order]) > 0) + 1
        groups = np.split(order, starts)
        if self.device.xp is not np:
            for group in groups:
                out[group] = self._elsewhere(sy, sx, rows[group], columns[group[0]])
            return
        real, lines, width = self.high.real.dtype, self.high.shape[2], self.wide.shape[2]
        (py, px), nodes = self.pixel_shape, self.pixel_nodes[0]
        step = max(1, round(WORK_BYTES / (lines * 2 * width * real.itemsize)))
        work = np.empty((3 if self._thirds else 2) * step * lines * width, real)
        for group in groups:
            right = self._right(self.wide[sx, columns[group[0]]])
            for start in range(0, len(group), step):
                part = group[start : start + step]
                at = rows[part]
                # neighbours in order lie together: no copy
                together = len(at) == 1 or (np.diff(at) == 1).all()
                chosen = slice(at[0], at[-1] + 1) if together else at
                energy: np.ndarray | int = 0
                for field in self._product(sy, chosen, right, work):
                    # (point, node, pixel row x (part, node, pixel column)): squares over nodes
                    parts = self._shown(field).reshape(len(part), nodes, -1)
                    energy = energy + np.einsum("nqk,nqk->nk", parts, parts)
                out[part] = np.einsum("nyqx->nyx", np.reshape(energy, (len(part), py, -1, px)))

    def _elsewhere(self, sy: int, sx: int, rows: np.ndarray, column: int) -> np.ndarray:
        """(point, pixel row, pixel column) of points of one column, by the device."""
        xp, put = self.device.xp, self.device.put
        (py, px), (ny, nx), (high, wide) = self.pixel_shape, self.pixel_nodes, self._there
        left = xp.take(high[sy, :, :, :], put(rows), axis=0)
        field = left @ wide[sx, int(column), :, :].T
        if self.shown:
            y, x = (xp.astype(put(n), field.dtype) for n in self.shown)
            field = y @ (field @ x)
        energy = xp.abs(field) ** 2
        return self.device.get(xp.sum(xp.reshape(energy, (len(rows), ny, py, nx, px)), axis=(1, 3)))

    def _shown(self, product: np.ndarray) -> np.ndarray:
        """(points x lines, parts x lines) on the nodes."""
        if not self.shown:
            return product
        (y, x), lines = self.shown, self.high.shape[2]
        wide = product.reshape(-1, x.shape[0]) @ x
        return y @ wide.reshape(product.shape[0] // lines, lines, -1)

    @cached_property
    def _thirds(self) -> tuple[np.ndarray, ...] | None:
        """Of `high`, where they serve."""
        return thirds(self.high) if self.high.shape[3] >= THREE_SERVE else None

    def _product(
        self, sy: int, chosen: slice | np.ndarray, right: tuple[np.ndarray, ...], work: np.ndarray
    ) -> Sequence[np.ndarray]:
        """Fields of chosen rows of points, (points x lines, (real, imaginary) x lines) or each of
        the two by itself; in `work`.

        right: as `_right`.
        """
        if self._thirds is None:
            left = self.high[sy, chosen].view(self.high.real.dtype)
            left = left.reshape(-1, len(right[0]))
            out = work[: len(left) * right[0].shape[1]].reshape(len(left), -1)
            return [np.matmul(left, right[0], out=out)]
        lefts = [part[sy, chosen].reshape(-1, part.shape[3]) for part in self._thirds]
        count, width = len(lefts[0]), right[0].shape[1]
        return product_of_thirds(lefts, right, work[: 3 * count * width].reshape(3, count, width))

    def _right(self, factor: np.ndarray) -> tuple[np.ndarray, ...]:
        """(node, term) complex as the right-hand side of one real product, (term x (real,
        imaginary), (real, imaginary) x node), or as those of three, (term, node).
        """
        turned = factor.T if self.signs is None else factor.T * self.signs[:, None]
        if self._thirds is not None:
            return thirds(turned)
        right = np.empty((len(turned), 2, 2, turned.shape[1]), factor.real.dtype)
        right[:, 0, 0] = right[:, 1, 1] = turned.real
        right[:, 0, 1] = turned.imag
        np.negative(turned.imag, out=right[:, 1, 0])
        return (right.reshape(2 * len(turned), -1),)


def pixel_modes(
    high: np.ndarray, wide: np.ndarray, pixels: int, light: np.ndarray, most: float
) -> np.ndarray:
    """Orthonormal functions on the nodes of each pixel along one axis, the dimmest first, that
    carry nearly all of the light there. Nodes resolve how fringes of all lenslets are summed up;
    the field itself has fewer numbers a pixel, and what is perpendicular to them only adds to the
    light by its own.

    high, wide: tables of this axis and of the other, (point, nodes x pixels, term);
    pixels: along this axis;
    light: of points, (point of this axis, of the other);
    most: that a point's pixels may lose together (root sum of squares, as summed along the other
        axis), over what they have at the least.

    Returns (pixel, node, function).
    """
    points, _, terms = high.shape
    bright = np.stack([np.einsum("nt,nt->t", w.real, w.real) for w in wide])
    bright += np.stack([np.einsum("nt,nt->t", w.imag, w.imag) for w in wide])
    nodes = _by_pixel(high, pixels)
    weighted = nodes.reshape(pixels, -1, points, terms) * np.sqrt(bright.mean(axis=0))
    weighted = weighted.reshape(nodes.shape)
    _, vectors = np.linalg.eigh((weighted @ weighted.conj().transpose(0, 2, 1)).astype(complex))
    lost, last = np.zeros((pixels, *light.shape)), vectors.shape[2] - 1
    for drop in range(last):
        seen = vectors[:, None, :, drop].conj().astype(high.dtype) @ nodes
        power = (np.square(seen.real) + np.square(seen.imag)).reshape(pixels, points, terms)
        lost += power @ bright.T
        if (np.sqrt(pixels * np.square(lost).sum(axis=0)) > most * light).any():
            return vectors[:, :, drop:]
    return vectors[:, :, last:]


def on_modes(table: np.ndarray, modes: np.ndarray) -> np.ndarray:
    """A table (point, nodes x pixels, term) on functions of each pixel, (pixel, node, function), in
    place of its nodes.
    """
    points, _, terms = table.shape
    pixels, _, count = modes.shape
    adjoint = modes.conj().transpose(0, 2, 1).astype(table.dtype)
    shown = (adjoint @ _by_pixel(table, pixels)).reshape(pixels, count, points, terms)
    return np.ascontiguousarray(shown.transpose(2, 1, 0, 3)).reshape(points, -1, terms)


def _by_pixel(table: np.ndarray, pixels: int) -> np.ndarray:
    """A table (point, nodes x pixels, term) as (pixel, node, point x term)."""
    points, _, terms = table.shape
    parts = table.reshape(points, -1, pixels, terms).transpose(2, 1, 0, 3)
    return parts.reshape(pixels, -1, points * terms)


def _as(table: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """A real matrix in the precision of a table."""
    return np.ascontiguousarray(matrix, table.real.dtype)
