"""Sensor fields behind square lenslets by low-rank factors: the Fresnel rung of separable arrays."""

import numpy as np

from plenocli.optics.psf import separable_field
from plenocli.optics.quadrature import gauss
from plenocli.optics.relay import lenslet_kernel, lit_lenslets, pixel_energy, sensor_nodes

SLAB = 1 << 19
"""Complex numbers in the work array between product and square: a few MiB, within the last-level cache."""


class SquareLenslets:
    """Sensor fields behind square lenslets: every separable term of h stays separable up to the sensor."""

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self.pixel_nodes = geometry, plan.superpixels, band.pixel_nodes
        self.dtype = np.complex128 if plan.double else np.complex64
        field = separable_field(camera, geometry, band.half, plan.tolerance)
        self.symmetry, self.notes = field.symmetry, {"separable_terms": field.terms, "field_tail": field.tail}
        t, w = gauss(band.lenslet_nodes)
        half = geometry.lenslet_width / 2
        self._x, self._w = half * t, half * w
        self.tables, grams = [], []
        for axis in (0, 1):
            table, gram = self._table(field, axis, band.window)
            self.tables.append(table)
            grams.append(gram)
        self._energy = grams

    def _table(self, field, axis, window):
        """(superpixel, point, sensor node, term) fields along one axis, and the (point, term, term) Gram matrices over the lenslets."""
        g = self.geometry
        v, wv = (a.ravel() for a in sensor_nodes(g, axis, self.pixel_nodes))
        reach = (self.superpixels[axis] - 1) // 2
        points = g.points(axis)
        table = np.zeros((2 * reach + 1, len(v), len(points) * field.terms), self.dtype)
        gram = 0
        for m in lit_lenslets(reach, window):
            values = field.evaluate(self._x[:, None] + m * g.D2 - points, axis)
            moved = np.ascontiguousarray(values.transpose(1, 2, 0))
            gram = gram + (moved * self._w) @ moved.conj().transpose(0, 2, 1)
            values = values.reshape(len(self._x), -1).astype(self.dtype)
            for s in range(-reach, reach + 1):
                if window is not None or m == s:
                    table[s + reach] += (lenslet_kernel(g, m - s, v, wv, self._x) * self._w).astype(self.dtype) @ values
        table = table.reshape(2 * reach + 1, len(v), len(points), field.terms).transpose(0, 2, 1, 3)
        return np.ascontiguousarray(table), gram

    def incident(self, rows, columns):
        """Share of the light of points (rows[i], columns[i]) that enters the lenslets of the neighbourhood: (points,)."""
        gy, gx = self._energy
        return np.einsum("iab,iab->i", gy[rows], gx[columns]).real

    def columns(self, rows, columns, out):
        """Pixel energies of points (rows[i], columns[i]) into out (points, superpixel rows, superpixel columns, pixel rows, pixel columns)."""
        high, wide = self.tables
        p, (py, px) = self.pixel_nodes, self.geometry.pixel_shape
        order = np.argsort(columns, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(columns[order]) > 0])
        step = max(1, SLAB // (high.shape[2] * wide.shape[2]))
        for group in np.split(order, starts[1:]):
            column = columns[group[0]]
            for sx in range(wide.shape[0]):
                right = np.ascontiguousarray(wide[sx, column].T)
                for sy in range(high.shape[0]):
                    for start in range(0, len(group), step):
                        part = group[start:start + step]
                        left = high[sy, rows[part]].reshape(-1, right.shape[0])
                        out[part, sy, sx] = pixel_energy((left @ right).reshape(len(part), p, py, p, px))
