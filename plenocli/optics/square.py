"""Sensor fields behind square lenslets by low-rank factors: the Fresnel rung of separable arrays."""

import math
from threading import Lock

import numpy as np

from plenocli.optics.factors import Factors
from plenocli.optics.psf import edge_emphasis, legendre, psf_nodes, separable_field
from plenocli.optics.quadrature import gauss
from plenocli.optics.relay import lenslet_kernel, lit_lenslets, sensor_nodes

SLAB = 1 << 21
"""Values of the spread function's terms in memory at a time while tables are filled."""
NARROW = 1.0
"""Root-energy cut of a superpixel's factors over that of the spread function."""


class SquareLenslets(Factors):
    """Sensor fields behind square lenslets: every separable term of h stays separable up to the sensor.

    Within one lenslet a term is a polynomial of far lower degree than the kernel to a distant superpixel, so it is sampled
    on few nodes and the kernel is brought onto these. Where h is even, points that mirror each other share their tables.
    """

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self.pixel_nodes, self._band = geometry, plan.superpixels, band.pixel_nodes, band
        self.dtype, self._real = (np.dtype(t) for t in ((np.complex128, np.float64) if plan.double else (np.complex64, np.float32)))
        # off the sensor's own raster every superpixel has its pixels around its centre
        self._centred = geometry.pixel_shift is None
        field = separable_field(camera, geometry, band.half, plan.tolerance)
        self.symmetry, self.notes = field.symmetry, {"separable_terms": field.terms, "field_tail": field.tail}
        self._x, self._w, self._basis = self._lenslet_nodes()
        self._kernels = {}
        high, down = self._table(field, 0)
        if field.signs is not None and self._axes_agree():
            wide, across, signs = high, down * np.outer(field.signs, field.signs).ravel(), field.signs
        else:
            (wide, across), signs = self._table(field, 1), None
        self._entering = (down @ across.T).real
        self._kernels.clear()
        super().__init__(high, wide, geometry.pixel_shape, band.pixel_nodes, signs)
        self._cut = NARROW * plan.tolerance if narrows(geometry, band, plan.superpixels, plan.double) else None
        self._roots, self._narrow, self._lock = {}, (None, None), Lock()

    def superpixel(self, sy, sx, rows, columns, out):
        """As Factors.superpixel, with no more terms than the light of the neighbourhood needs on this superpixel."""
        if self._cut is None:
            return super().superpixel(sy, sx, rows, columns, out)
        with self._lock:
            if self._narrow[0] != (sy, sx):
                self._narrow = (sy, sx), self._narrowed(sy, sx)
            narrow = self._narrow[1]
        return narrow.superpixel(0, 0, rows, columns, out)

    def _narrowed(self, sy, sx):
        """Factors of one superpixel cut at self._cut (root energy of a mean point, points at the lenslet's edge weighing more)."""
        signs = np.ones(self.high.shape[3]) if self.signs is None else self.signs
        left, right = self._root(0, sy), self._root(1, sx) * signs
        u, s, vh = np.linalg.svd(left @ right.T)
        terms = max(1, int(np.count_nonzero(np.sqrt(np.cumsum(s[::-1] ** 2)[::-1]) > self._cut)))
        scale = 1 / np.sqrt(s[:terms])
        # each table through the other's strong directions: exact on these, and nothing small is divided by
        high = self.high[sy] @ (right.T @ vh[:terms].conj().T * scale).astype(self.dtype)
        wide = self.wide[sx] @ (signs[:, None] * left.T @ u[:, :terms].conj() * scale).astype(self.dtype)
        return Factors(high[None], wide[None], self.pixel_shape, self.pixel_nodes)

    def _root(self, axis, s):
        """R with R^H R the overlaps of the terms on superpixel s for a mean point, on as many of its nodes as tell."""
        if (axis, s) not in self._roots:
            step = max(1, self.pixel_nodes // 3)
            table = (self.wide if axis else self.high)[s][:, step // 2::step] * math.sqrt(step)
            points = self.geometry.points(axis)
            weighed = (table * edge_emphasis(self.geometry, points).astype(self._real)[:, None, None]).reshape(-1, table.shape[2]).astype(complex)
            values, vectors = np.linalg.eigh(weighed.conj().T @ weighed / len(points))
            self._roots[axis, s] = np.sqrt(np.maximum(values, 0))[:, None] * vectors.conj().T
        return self._roots[axis, s]

    def _axes_agree(self):
        g = self.geometry
        return self._centred and all(a[0] == a[1] for a in (g.pixel_shape, g.object_shape, self.superpixels))

    def _lenslet_nodes(self):
        """Nodes x and weights (m) on which the terms are sampled, and the kernel's own nodes with what carries it onto the former.

        The last is (nodes, weights x Legendre interpolation (kernel node, term node)); the nodes alone where both are the same.
        """
        g = self.geometry
        half = g.lenslet_width / 2
        fine, few = self._band.lenslet_nodes, psf_nodes(g, half)
        t, w = gauss(min(fine, few))
        if few >= fine:
            return half * t, half * w, (half * t, (half * w).astype(self._real))
        tf, wf = gauss(fine)
        degrees = np.arange(few) + 0.5
        carry = (legendre(tf, few, 1) * degrees) @ (legendre(t, few, 1).T * w)
        return half * t, half * w, (half * tf, (half * wf[:, None] * carry).astype(self._real))

    def _kernel(self, axis, n, place):
        """The kernel (sensor node, 2, term node), real and imaginary part, from a lenslet to the superpixel n before it, which
        stands at `place` (superpixel pitches; it matters on a sensor's own raster only)."""
        key = axis, n, None if self._centred else place
        if key not in self._kernels:
            v, wv = (a.ravel() for a in sensor_nodes(self.geometry, axis, self._band.pixel_nodes, place, self._band.pixel_rule))
            x, carry = self._basis
            kernel = lenslet_kernel(self.geometry, n, v, wv, x)
            parts = np.stack([kernel.real, kernel.imag], axis=1).astype(self._real)
            self._kernels[key] = parts * carry if carry.ndim == 1 else (parts.reshape(-1, len(x)) @ carry).reshape(*parts.shape[:2], -1)
        return self._kernels[key]

    def _table(self, field, axis):
        """The factor table along one axis (as Factors takes it), and the (point, term x term) Gram matrices over the lenslets."""
        g, window, terms = self.geometry, self._band.window, field.terms
        reach = (self.superpixels[axis] - 1) // 2
        points = g.points(axis)
        half = (len(points) + 1) // 2 if field.even and self._centred else len(points)
        lenslets = list(lit_lenslets(reach, window))
        table = np.empty((2 * reach + 1, len(points), self.pixel_nodes * g.pixel_shape[axis], terms), self.dtype)
        entering = np.empty((len(points), terms * terms), self.dtype if field.rows.dtype.kind == "c" else self._real)
        kernels = []
        for s in range(-reach, reach + 1):
            chosen = lenslets if window is not None else [s]
            whole = np.concatenate([self._kernel(axis, m - s, s) for m in chosen], axis=2)
            kernels.append((lenslets.index(chosen[0]) * len(self._x), whole.reshape(-1, whole.shape[2])))
        where = (self._x + np.array(lenslets)[:, None] * g.D2).ravel()
        weight = np.tile(self._w, len(lenslets))[:, None].astype(self._real)
        step = max(1, SLAB // (len(where) * terms))
        for start in range(0, half, step):
            block = field.evaluate(where - points[start:min(start + step, half), None], axis).astype(entering.dtype)
            for i, values in enumerate(block, start):
                entering[i] = (values.T @ (values.conj() * weight)).ravel()
                for s, (first, kernel) in enumerate(kernels):
                    _product(kernel, values[first:first + kernel.shape[1]], table[s, i])
        if half < len(points):  # the mirror image: points, superpixels and sensor nodes reversed
            table[:, half:] = table[::-1, :len(points) - half, ::-1][:, ::-1]
            entering[half:] = entering[:len(points) - half][::-1]
        return table, entering

    def incident(self, rows, columns):
        """Share of the light of points (rows[i], columns[i]) that enters the lenslets of the neighbourhood: (points,)."""
        return self._entering[rows, columns]


def narrows(geometry, band, superpixels, double):
    """Whether superpixels get factors of their own rank: where many columns with many nodes gain by it. In double precision the
    roots of sums of squares would not know what is that small."""
    return band.window is not None and not double and max(superpixels) > 1 and band.pixel_nodes * max(geometry.pixel_shape) >= 200


def _product(kernel, values, out):
    """The kernel (sensor node x (real, imaginary), term node), real, times values (term node, term) into complex `out`."""
    parts = (kernel @ values.view(kernel.dtype).reshape(len(values), -1)).reshape(len(out), 2, -1)
    if not np.iscomplexobj(values):
        out.real, out.imag = parts[:, 0], parts[:, 1]
    else:
        parts = parts.view(values.dtype)
        np.multiply(parts[:, 1], 1j, out=out)
        out += parts[:, 0]
