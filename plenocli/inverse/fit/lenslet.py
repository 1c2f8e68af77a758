"""The matrix of one lenslet as a smooth function of a camera's parameters, with its derivatives by
all of them.

Paraxial, square lenslets, each lit by the object in front of it only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from plenocli.forward.camera.quadrature import gauss, smooth_nodes
from plenocli.inverse.fit.optics import CURVATURE, DOWN, PUPIL, RELAY, RIGHT, CameraFamily
from plenocli.inverse.fit.spread import Core, SpreadFamily, widened

PIXEL_ERROR = 1e-4
"""Of the integral over a pixel of the finest fringes, which hold next to no light."""


def fringes_a_pixel(family: CameraFamily) -> float:
    """How many of the finest fringes that a lenslet of the described camera makes fall on what is
    sensitive of a pixel.
    """
    g = family.geometry
    relay = abs(float(family.optics(family.start)[RELAY]))
    return relay * g.pixel_active * g.lenslet_width / g.D2


class LensletFamily:
    """Matrices A (pixel, point) of one lenslet of a family of cameras.

    pixel_shape, object_shape: (rows, columns).
    """

    def __init__(
        self,
        family: CameraFamily,
        *,
        tolerance: float = 1e-6,
        pixel_nodes: int | None = None,
        double: bool = False,
    ) -> None:
        """Prepare what no parameter changes.

        family: of cameras, with square lenslets.
        tolerance: root energy of the spread function that may be lost.
        pixel_nodes: a side of a pixel; None: enough for any fringe.
        double: precision of the fields.
        """
        g = family.geometry
        self.family, self.double = family, double
        self.pixel_shape, self.object_shape = g.pixel_shape, g.object_shape
        self.type = np.complex128 if double else np.complex64
        half = widened(family, g.D2 / 2 + g.lenslet_width / 2)
        self.spread = SpreadFamily(family, half, tolerance)
        window = max(g.pixel_shape) * g.pixel_pitch / 2
        relay, curve = (abs(family.optics(family.start)[place]) for place in (RELAY, CURVATURE))
        fill = g.lenslet_width / g.D2
        fringe = np.pi * fringes_a_pixel(family)
        self.pixel_nodes = pixel_nodes or max(2, smooth_nodes(fringe, PIXEL_ERROR) - 1)
        phase = np.pi * fill * (relay * window + g.D1 * g.D2 / (2 * g.wavelength * g.z2))
        t, w = gauss(smooth_nodes(1.1 * (phase + np.pi * curve * fill**2 / 2), 1e-8) + 2)
        self.x, self.wx = fill / 2 * t, fill / 2 * w
        self.carry, self._nodes = [], []
        tp, wp = gauss(self.pixel_nodes)
        for axis in (0, 1):
            points = g.points(axis) / g.D2
            self.carry.append(
                self.spread.interpolation((self.x[:, None] - points).ravel()).reshape(
                    len(t), len(points), -1
                )
            )
            v = g.pixel_active / 2 * tp[:, None] + g.pixels(axis)
            weight = np.broadcast_to(g.pixel_active / 2 * wp[:, None], v.shape)
            self._nodes.append((v.ravel(), np.sqrt(weight.ravel())))

    def pixel_nodes_of(self, axis: int) -> tuple[np.ndarray, np.ndarray]:
        """Nodes along an axis, sub-nodes slowest: (m from the middle of the window, root weights),
        (node,) each.
        """
        return self._nodes[axis]

    def at(self, values: np.ndarray) -> MatrixAt:
        """The matrix at `values` (parameter,)."""
        optics = self.family.optics(values)
        return MatrixAt(self, values, optics, self.spread.core(optics))


class MatrixAt:
    """One lenslet's matrix at one camera.

    values: (parameter,) the camera;
    matrix: (pixel, point) shares of the light through the aperture.
    """

    def __init__(
        self, lenslets: LensletFamily, values: np.ndarray, optics: np.ndarray, core: Core
    ) -> None:
        self._of, self.values, self._optics, self._core = lenslets, values, optics, core
        self._amplitude = float(optics[PUPIL] * optics[RELAY])
        self._terms = tuple(
            (carry.reshape(-1, carry.shape[2]) @ basis)
            .astype(lenslets.type)
            .reshape(*carry.shape[:2], -1)
            for carry, basis in zip(lenslets.carry, (core.rows, core.columns))
        )
        self._kernels = tuple(self._kernel(axis) for axis in (0, 1))
        self._high, self._wide = (self._table(axis, self._kernels[axis]) for axis in (0, 1))
        self._right = self._wide @ core.value.T.astype(lenslets.type)
        rows, columns = lenslets.object_shape
        out = np.empty((rows, columns, np.prod(lenslets.pixel_shape)), self._right.real.dtype)
        for j, field in self._fields():
            out[:, j] = self._summed(_product(field, field))
        out *= self._amplitude**2
        self.matrix = out.reshape(rows * columns, -1).T

    def slopes(self) -> Iterator[tuple[slice, np.ndarray]]:
        """The derivatives of the matrix by each number of the optics, a column of points after the
        other: (which points, (optics, row of points, pixel)).
        """
        of, o, core = self._of, self._optics, self._core
        high: dict[int, np.ndarray] = {}
        wide: dict[int, np.ndarray] = {}
        for axis, tables, place in ((0, high, DOWN), (1, wide, RIGHT)):
            tables[place] = self._table(axis, self._kernels[axis] * (-2j * np.pi * o[RELAY] * of.x))
            tables[CURVATURE] = self._table(axis, self._kernels[axis] * (1j * np.pi * of.x**2))
        wide = {place: table @ core.value.T for place, table in wide.items()}
        wide |= {place: self._wide @ slope.T for place, slope in core.slopes.items()}
        high, wide = ({p: t.astype(of.type) for p, t in each.items()} for each in (high, wide))
        # a phase -nu x v turns with nu as with a shift of v, times v/nu
        down, right = ((of.pixel_nodes_of(k)[0] + o[DOWN + k]) / o[RELAY] for k in (0, 1))
        lever = {DOWN: np.tile(down, len(self._high))[:, None], RIGHT: np.repeat(right, 2)}
        whole = self.matrix.T.reshape(*of.object_shape, -1)
        for j, field in self._fields():
            out = np.zeros((len(o), *whole[:, j].shape), whole.dtype)
            for place in {*high, *wide}:
                product = np.zeros(1, whole.dtype)
                if place in high:
                    product = _product(field, _flat(high[place]) @ self._right[j].T)
                if place in wide:
                    product = product + _product(field, _flat(self._high) @ wide[place][j].T)
                out[place] = self._summed(product)
                if place in lever:
                    out[RELAY] += self._summed(product * lever[place].astype(whole.dtype))
            out *= 2 * self._amplitude**2
            for place in (PUPIL, RELAY):
                out[place] += 2 / o[place] * whole[:, j]
            yield slice(j, None, of.object_shape[1]), out

    def _kernel(self, axis: int) -> np.ndarray:
        """(pixel node, lenslet node), weights included."""
        of, o = self._of, self._optics
        v, weight = of.pixel_nodes_of(axis)
        v = v + o[DOWN + axis]
        turns = o[CURVATURE] / 2 * of.x**2 - o[RELAY] * np.outer(v, of.x)
        turns -= np.rint(turns)
        return (np.exp(2j * np.pi * turns) * weight[:, None] * of.wx).astype(of.type)

    def _table(self, axis: int, kernel: np.ndarray) -> np.ndarray:
        """(point, pixel node, term)."""
        terms = self._terms[axis]
        table = (kernel @ terms.reshape(len(terms), -1)).reshape(len(kernel), *terms.shape[1:])
        return np.ascontiguousarray(table.transpose(1, 0, 2))

    def _fields(self) -> Iterator[tuple[int, np.ndarray]]:
        """(column j of points, field (row of points x node, node)), without the amplitude."""
        for j, columns in enumerate(self._right):
            yield j, _flat(self._high) @ columns.T

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Products as of _product (row of points x node, node x 2) summed over the nodes of each
        pixel: (row of points, pixel).
        """
        n, (py, px) = self._of.pixel_nodes, self._of.pixel_shape
        parts = values.reshape(-1, n, py, n, px, 2).sum(axis=1).sum(axis=2)
        return (parts[..., 0] + parts[..., 1]).reshape(len(parts), -1)


def _flat(table: np.ndarray) -> np.ndarray:
    """(point x node, term) of (point, node, term)."""
    return table.reshape(-1, table.shape[2])


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The products of real parts and of imaginary parts, side by side."""
    kind = a.real.dtype
    return a.view(kind) * b.view(kind)
