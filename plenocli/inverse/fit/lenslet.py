"""The matrix of one lenslet as a smooth function of a camera's parameters, with its derivatives
both ways: how the matrix changes with each, and what a change of the matrix says of all of them at
the cost of a few matrices.

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

    def at(self, values: np.ndarray, *, slopes: bool = False) -> MatrixAt:
        """The matrix at `values` (parameter,); slopes: whether its derivatives are wanted."""
        optics = self.family.optics(values)
        core = self.spread.core(optics, slopes=slopes)
        return MatrixAt(self, values, optics, core)


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
        out = self._empty()
        for j, field in self._fields(self._high, self._right):
            out[:, j] = self._summed(_squared(field))
        self.matrix = self._flat(out)

    def back(self, weights: np.ndarray) -> np.ndarray:
        """The derivatives by all parameters, (parameter,), of a number that has the derivatives
        `weights` (pixel, point) by the matrix. Needs slopes.
        """
        of, core = self._of, self._core
        by_pixel = weights.T.reshape(*of.object_shape, *of.pixel_shape)
        left = np.zeros((self._high.shape[0] * self._high.shape[1], self._high.shape[2]), of.type)
        right = np.empty_like(self._right)
        flat = self._high.reshape(left.shape)
        for j, field in self._fields(self._high, self._right):
            field *= self._spread(by_pixel[:, j].astype(field.real.dtype))
            left += field @ self._right[j].conj()
            right[j] = field.T @ flat.conj()
        scale = 2 * self._amplitude**2
        tables = left.reshape(self._high.shape), right @ core.value.conj().astype(of.type)
        middle = np.einsum("jua,jub->ab", right, self._wide.conj(), optimize=True)
        slopes = np.zeros(len(self._optics))
        for place, slope in core.slopes.items():
            slopes[place] = scale * float(np.vdot(middle, slope).real)
        for axis, table in enumerate(tables):
            # of the kernel (pixel node, lenslet node)
            kernel = np.einsum("iva,xia->vx", table, self._terms[axis].conj(), optimize=True)
            for place in (CURVATURE, RELAY, DOWN if axis == 0 else RIGHT):
                slopes[place] += scale * float(np.vdot(kernel, self._turned(axis, place)).real)
        whole = 2 * float(np.vdot(weights, self.matrix))
        slopes[PUPIL] += whole / self._optics[PUPIL]
        slopes[RELAY] += whole / self._optics[RELAY]
        return self._of.family.jacobian(self.values).T @ slopes

    def slope(self, place: int) -> np.ndarray:
        """The derivative of the matrix (pixel, point) by one number of the optics. Needs slopes."""
        out, core = self._empty(), self._core
        left, right = self._high, self._right
        if place in core.slopes:
            changed = self._wide @ core.slopes[place].T.astype(self._of.type)
            other = left
        else:
            axes = {DOWN: (0,), RIGHT: (1,)}.get(place, (0, 1))
            moved = [
                self._table(axis, self._turned(axis, place)) if axis in axes else None
                for axis in (0, 1)
            ]
            parts = []
            if moved[0] is not None:
                parts.append((moved[0], right))
            if moved[1] is not None:
                parts.append((left, moved[1] @ core.value.T.astype(self._of.type)))
            other, changed = (np.concatenate(p, axis=2) for p in zip(*parts))
        for (j, field), (_, rise) in zip(self._fields(left, right), self._fields(other, changed)):
            product = field.real * rise.real + field.imag * rise.imag
            out[:, j] = self._summed(2 * product)
        dA = self._flat(out)
        if place in (PUPIL, RELAY):
            dA += 2 / self._optics[place] * self.matrix
        return dA

    def _kernel(self, axis: int) -> np.ndarray:
        """(pixel node, lenslet node), weights included."""
        of, o = self._of, self._optics
        v, weight = of.pixel_nodes_of(axis)
        v = v + o[DOWN + axis]
        turns = o[CURVATURE] / 2 * of.x**2 - o[RELAY] * np.outer(v, of.x)
        turns -= np.rint(turns)
        return (np.exp(2j * np.pi * turns) * weight[:, None] * of.wx).astype(of.type)

    def _turned(self, axis: int, place: int) -> np.ndarray:
        """The derivative of the kernel of an axis by one number of the optics."""
        of, o = self._of, self._optics
        kernel = self._kernels[axis]
        if place == CURVATURE:
            return (kernel * (1j * np.pi * of.x**2)).astype(of.type)
        if place == RELAY:
            v = of.pixel_nodes_of(axis)[0] + o[DOWN + axis]
            return (kernel * (-2j * np.pi * np.outer(v, of.x))).astype(of.type)
        return (kernel * (-2j * np.pi * o[RELAY] * of.x)).astype(of.type)

    def _table(self, axis: int, kernel: np.ndarray) -> np.ndarray:
        """(point, pixel node, term)."""
        terms = self._terms[axis]
        table = (kernel @ terms.reshape(len(terms), -1)).reshape(len(kernel), *terms.shape[1:])
        return np.ascontiguousarray(table.transpose(1, 0, 2))

    def _fields(self, left: np.ndarray, right: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
        """(column j of points, field (row of points x node, node)), without the amplitude."""
        flat = left.reshape(-1, left.shape[2])
        for j, columns in enumerate(right):
            yield j, flat @ columns.T

    def _summed(self, values: np.ndarray) -> np.ndarray:
        """Values on nodes (row of points x node, node) summed over the nodes of each pixel:
        (row of points, pixel row, pixel column).
        """
        n, (py, px) = self._of.pixel_nodes, self._of.pixel_shape
        parts = values.reshape(-1, n, py, n, px)
        return parts.sum(axis=1).sum(axis=2)

    def _spread(self, by_pixel: np.ndarray) -> np.ndarray:
        """The opposite of _summed: each node gets the value of its pixel."""
        n, (py, px) = self._of.pixel_nodes, self._of.pixel_shape
        rows = len(by_pixel)
        whole = np.broadcast_to(by_pixel[:, None, :, None], (rows, n, py, n, px))
        return whole.reshape(rows * n * py, n * px)

    def _empty(self) -> np.ndarray:
        of = self._of
        return np.empty((*of.object_shape, *of.pixel_shape), np.zeros(0, of.type).real.dtype)

    def _flat(self, images: np.ndarray) -> np.ndarray:
        """(pixel, point) from (point row, point column, pixel row, pixel column)."""
        images *= self._amplitude**2
        return images.reshape(images.shape[0] * images.shape[1], -1).T


def _squared(field: np.ndarray) -> np.ndarray:
    return field.real**2 + field.imag**2
