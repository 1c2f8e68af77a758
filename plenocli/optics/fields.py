"""From the field on the lenslet array to pixel energies: matrix transforms on quadrature nodes.

In coordinates x' from a lenslet's centre and v from its superpixel's centre (which lies at D2 (1 + z3/z2) per lenslet),
lenslet n of the neighbourhood contributes, per axis,

    exp(j k [n^2 D2^2/2 (1/z2 + 1/z3) - n D2 v/z3]) / sqrt(lambda z3)
      * integral of h(n D2 + x' - xp) exp(j k kappa x'^2/2) exp(-j k x' (v - n D2 (1 + z3/z2))/z3) dx'

with kappa = 1/z2 + 1/z3 - 1/f2, the same for every lenslet. Fields of one object point add before the square is taken.
Pixel energies are Gauss-Legendre sums over `nodes` points per axis; sub-nodes run slowest, so that summing them is adding
whole planes.
"""

import numpy as np

from plenocli.optics.quadrature import disc_rows, gauss

SLAB = 1 << 19
"""Complex numbers in the work array between product and square: a few MiB, within the last-level cache."""


def sensor_nodes(geometry, axis, count):
    """Positions (m) from the superpixel's centre and weights (m) of `count` nodes in each pixel along `axis`: (count, pixels)."""
    t, w = gauss(count)
    half = geometry.pixel_active / 2
    return half * t[:, None] + geometry.pixels(axis), np.broadcast_to(half * w[:, None], (count, geometry.pixel_shape[axis]))


def lenslet_kernel(geometry, n, v, weight, x):
    """The per-axis kernel of lenslet n at sensor nodes v (weights folded in as square roots) and lenslet nodes x: (v, x)."""
    g = geometry
    relay = 1 / g.z2 + 1 / g.z3
    phase = n * n * g.D2**2 / 2 * relay - n * g.D2 / g.z3 * v
    phase = phase[:, None] + g.kappa / 2 * x * x - x * (v - n * g.superpixel_pitch)[:, None] / g.z3
    return np.sqrt(weight / (g.wavelength * g.z3))[:, None] * np.exp(1j * g.k * phase)


def lit_lenslets(reach, window):
    """Lenslets (along one axis) whose light is followed: |m| <= window, or each superpixel's own where window is None."""
    far = reach if window is None else window
    return range(-far, far + 1)


class SquareLenslets:
    """Sensor fields behind square lenslets: every separable term of h stays separable up to the sensor."""

    def __init__(self, geometry, field, superpixels, window, lenslet_nodes, pixel_nodes, dtype):
        self.geometry, self.superpixels, self.pixel_nodes, self.dtype = geometry, superpixels, pixel_nodes, dtype
        t, w = gauss(lenslet_nodes)
        half = geometry.lenslet_width / 2
        self._x, self._w = half * t, half * w
        self.tables, grams = [], []
        for axis in (0, 1):
            table, gram = self._table(field, axis, window)
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


def pixel_energy(field):
    """Sum |field|^2 over the sub-nodes of each pixel: (points, p, rows, p, columns) complex, weights included, overwritten."""
    count, p, py, _, px = field.shape
    parts = field.view(field.real.dtype).reshape(count, p, py, p, px, 2)
    np.multiply(parts, parts, out=parts)
    energy = parts[:, :, :, 0] if p == 1 else parts.sum(axis=3)
    energy = energy.sum(axis=1)
    return energy[..., 0] + energy[..., 1]


class RoundLenslets:
    """Sensor fields behind circular lenslets, row by row of the aperture; any separable sum h serves."""

    def __init__(self, geometry, field, superpixels, window, lenslet_nodes, pixel_nodes, dtype):
        self.geometry, self.field, self.superpixels, self.window = geometry, field, superpixels, window
        self.pixel_nodes, self.dtype = pixel_nodes, dtype
        g = geometry
        half = g.lenslet_width / 2
        far = 0 if window is None else max(superpixels) // 2 + window
        reach = np.hypot(*(n * g.pixel_pitch / 2 + far * g.superpixel_pitch for n in g.pixel_shape))
        self.rows = disc_rows(half, g.k * (reach / g.z3 + g.D1 / g.z2 / np.sqrt(2) + abs(g.kappa) * half))
        self._heights, bound_rows = self._vertical(field)
        self._bound = [bound_rows, self._gram(field, 1)]

    def _vertical(self, field):
        """a_j at the aperture rows of every lenslet row for every point row: (m, lenslet row, point row, term)."""
        g = self.geometry
        shift = np.array(lit_lenslets(self.superpixels[0] // 2, self.window)) * g.D2
        heights = field.evaluate(self.rows.y[:, None, None] + shift[:, None] - g.points(0), 0).astype(self.dtype)
        return heights, self._gram(field, 0)

    def _gram(self, field, axis):
        """Gram matrices of the terms over the squares around the lenslets: (point, term, term)."""
        g = self.geometry
        t, w = gauss(self.rows.x.shape[1] + 8)
        half = g.lenslet_width / 2
        total = 0
        for m in lit_lenslets(self.superpixels[axis] // 2, self.window):
            values = field.evaluate(m * g.D2 + half * t - g.points(axis)[:, None], axis).transpose(0, 2, 1)
            total = total + (values * (half * w)) @ values.conj().transpose(0, 2, 1)
        return total

    def incident(self, rows, columns):
        """An upper bound of the share of light entering the lenslets: what enters the squares around them, (points,)."""
        return np.einsum("iab,iab->i", self._bound[0][rows], self._bound[1][columns]).real

    def columns(self, rows, columns, out):
        """As SquareLenslets.columns."""
        order = np.argsort(columns, kind="stable")
        starts = np.flatnonzero(np.r_[True, np.diff(columns[order]) > 0])
        reach = self.superpixels[1] // 2
        down = [self._down(sy) for sy in range(-(self.superpixels[0] // 2), self.superpixels[0] // 2 + 1)]
        for sx in range(-reach, reach + 1):
            across = self._across(sx)
            for group in np.split(order, starts[1:]):
                spread = self._spread(across, columns[group[0]], sx)
                for index in group:
                    out[index, :, sx + reach] = self._point(down, rows[index], spread)

    def _chosen(self, s, axis):
        """Lenslets along an axis that send light to superpixel s."""
        return [s] if self.window is None else list(lit_lenslets(self.superpixels[axis] // 2, self.window))

    def _down(self, sy):
        """Kernel from (lenslet row, aperture row) to the sensor rows of superpixel row sy: (sensor row, lenslet row x aperture row)."""
        v, wv = (a.ravel() for a in sensor_nodes(self.geometry, 0, self.pixel_nodes))
        parts = [lenslet_kernel(self.geometry, m - sy, v, wv, self.rows.y) for m in self._chosen(sy, 0)]
        return np.concatenate(parts, axis=1).astype(self.dtype)

    def _across(self, sx):
        """Kernel along each aperture row to the sensor columns of superpixel column sx: (aperture row, sensor column, lenslet x node)."""
        u, wu = (a.ravel() for a in sensor_nodes(self.geometry, 1, self.pixel_nodes))
        x, weight = self.rows.x.ravel(), self.rows.weight.ravel()
        parts = [(lenslet_kernel(self.geometry, m - sx, u, wu, x) * weight).reshape(len(u), *self.rows.x.shape) for m in self._chosen(sx, 1)]
        return np.ascontiguousarray(np.concatenate(parts, axis=2).transpose(1, 0, 2)).astype(self.dtype)

    def _spread(self, across, column, sx):
        """Terms carried across to the sensor columns of superpixel column sx: (m, term, sensor column)."""
        g = self.geometry
        shift = np.array(self._chosen(sx, 1)) * g.D2
        x = self.rows.x[:, None, :] + shift[:, None] - g.points(1)[column]
        values = self.field.evaluate(x, 1).reshape(len(self.rows.y), -1, self.field.terms).astype(self.dtype)
        return np.ascontiguousarray((across @ values).transpose(0, 2, 1))

    def _point(self, down, row, spread):
        """Pixel energies of one point in the superpixels of one column of superpixels: (superpixel row, pixel row, pixel column)."""
        p, (py, px) = self.pixel_nodes, self.geometry.pixel_shape
        lines = (self._heights[:, :, row] @ spread).transpose(1, 0, 2)
        energy = np.empty((len(down), py, px), lines.real.dtype)
        for s, kernel in enumerate(down):
            part = lines[s:s + 1] if self.window is None else lines
            part = np.ascontiguousarray(part).reshape(-1, lines.shape[2])
            energy[s] = pixel_energy((kernel @ part).reshape(1, p, py, p, px))[0]
        return energy
