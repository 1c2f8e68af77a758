"""Sensor fields behind square lenslets by low-rank factors: the Fresnel rung of separable arrays."""

import numpy as np

from plenocli.optics.factors import Factors
from plenocli.optics.psf import separable_field
from plenocli.optics.quadrature import gauss
from plenocli.optics.relay import lenslet_kernel, lit_lenslets, sensor_nodes


class SquareLenslets(Factors):
    """Sensor fields behind square lenslets: every separable term of h stays separable up to the sensor."""

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self._nodes = geometry, plan.superpixels, band.pixel_nodes
        self.dtype = np.complex128 if plan.double else np.complex64
        field = separable_field(camera, geometry, band.half, plan.tolerance)
        self.symmetry, self.notes = field.symmetry, {"separable_terms": field.terms, "field_tail": field.tail}
        t, w = gauss(band.lenslet_nodes)
        half = geometry.lenslet_width / 2
        self._x, self._w = half * t, half * w
        (high, rows), (wide, columns) = (self._table(field, axis, band.window) for axis in (0, 1))
        self._grams = rows, columns
        super().__init__(high, wide, geometry.pixel_shape, band.pixel_nodes)

    def _table(self, field, axis, window):
        """The factor table along one axis (as Factors takes it), and the (point, term, term) Gram matrices over the lenslets."""
        g = self.geometry
        v, wv = (a.ravel() for a in sensor_nodes(g, axis, self._nodes))
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
        gy, gx = self._grams
        return np.einsum("iab,iab->i", gy[rows], gx[columns]).real
