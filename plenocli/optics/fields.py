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

from plenocli.optics.quadrature import gauss, nodes_for

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
    """Sensor fields behind circular lenslets, row by row of the aperture; any separable sum h serves.

    Rows lie at y = R sin(theta), theta equidistant, with chords +-R cos(theta). The integral along a chord is the one along
    the next shorter chord plus two short panels at its ends, so all chords cost little more than one.
    """

    def __init__(self, geometry, field, superpixels, window, lenslet_nodes, pixel_nodes, dtype):
        self.geometry, self.field, self.superpixels, self.window = geometry, field, superpixels, window
        self.pixel_nodes, self.dtype = pixel_nodes, dtype
        g = geometry
        half = g.lenslet_width / 2
        far = 0 if window is None else max(superpixels) // 2 + window
        reach = np.hypot(*(n * g.pixel_pitch / 2 + far * g.superpixel_pitch for n in g.pixel_shape))
        slope = g.k * (reach / g.z3 + g.D1 / g.z2 / np.sqrt(2) + abs(g.kappa) * half)
        self._rows, self._row_weight, self._x, self._x_weight = chord_panels(half, slope)
        shift = np.array(lit_lenslets(superpixels[0] // 2, window)) * g.D2
        heights = field.evaluate(self._rows[:, None, None] + shift[:, None] - g.points(0), 0).astype(dtype)
        half_count = len(heights) // 2
        # the two rows of each chord side by side: (chord, point row, both rows x lenslet row, term)
        paired = np.concatenate([heights[:half_count], heights[half_count:][::-1]], axis=1)
        self._heights = np.ascontiguousarray(paired.transpose(0, 2, 1, 3))
        self._bound = [self._gram(axis, lenslet_nodes) for axis in (0, 1)]

    def _gram(self, axis, nodes):
        """Gram matrices of the terms over the squares around the lenslets: (point, term, term)."""
        g = self.geometry
        t, w = gauss(nodes)
        half = g.lenslet_width / 2
        total = 0
        for m in lit_lenslets(self.superpixels[axis] // 2, self.window):
            values = self.field.evaluate(m * g.D2 + half * t - g.points(axis)[:, None], axis).transpose(0, 2, 1)
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
        """Kernel from aperture rows to the sensor rows of superpixel row sy: (sensor row, chord x both rows x lenslet row)."""
        v, wv = (a.ravel() for a in sensor_nodes(self.geometry, 0, self.pixel_nodes))
        half = len(self._rows) // 2
        kernels = np.stack([lenslet_kernel(self.geometry, m - sy, v, wv, self._rows) * self._row_weight for m in self._chosen(sy, 0)], axis=-1)
        paired = np.stack([kernels[:, :half], kernels[:, half:][:, ::-1]], axis=2)
        return np.ascontiguousarray(paired.reshape(len(v), -1)).astype(self.dtype)

    def _across(self, sx):
        """Kernel along the panels to the sensor columns of superpixel column sx: (chord, sensor column, lenslet x node)."""
        u, wu = (a.ravel() for a in sensor_nodes(self.geometry, 1, self.pixel_nodes))
        parts = [(lenslet_kernel(self.geometry, m - sx, u, wu, self._x.ravel()) * self._x_weight.ravel()).reshape(len(u), *self._x.shape)
                 for m in self._chosen(sx, 1)]
        return np.ascontiguousarray(np.concatenate(parts, axis=2).transpose(1, 0, 2)).astype(self.dtype)

    def _spread(self, across, column, sx):
        """Terms carried across to the sensor columns of superpixel column sx, for every chord: (chord, term, sensor column)."""
        g = self.geometry
        shift = np.array(self._chosen(sx, 1)) * g.D2
        x = self._x[:, None, :] + shift[:, None] - g.points(1)[column]
        values = self.field.evaluate(x, 1).reshape(len(self._x), -1, self.field.terms).astype(self.dtype)
        panels = values.transpose(0, 2, 1) @ across.transpose(0, 2, 1)
        return np.cumsum(panels, axis=0, out=panels)

    def _point(self, down, row, spread):
        """Pixel energies of one point in the superpixels of one column of superpixels: (superpixel row, pixel row, pixel column)."""
        p, (py, px) = self.pixel_nodes, self.geometry.pixel_shape
        lines = self._heights[:, row] @ spread
        energy = np.empty((len(down), py, px), lines.real.dtype)
        for s, kernel in enumerate(down):
            part = np.ascontiguousarray(lines[:, s::len(down)]) if self.window is None else lines
            energy[s] = pixel_energy((kernel @ part.reshape(-1, lines.shape[2])).reshape(1, p, py, p, px))[0]
        return energy


def chord_panels(radius, slope):
    """Quadrature of a disc for phases of up to `slope` rad/m: rows y and weights (2 H,), panels x and weights (H, nodes).

    Row h and row 2 H - 1 - h have the h-th shortest chord; its integral is the sum over panels 0 ... h.
    """
    phase = slope * radius
    count = int(np.ceil(phase / 4 + 1.5 * np.cbrt(phase) + 3))
    theta = (np.arange(2 * count) + 0.5) * np.pi / (2 * count) - np.pi / 2
    ends = np.r_[0.0, radius * np.cos(theta[:count])]
    low, high = ends[:-1, None], ends[1:, None]
    t, w = gauss(nodes_for(slope * np.max(np.diff(ends)) / 2))
    x, wx = (low + high) / 2 + (high - low) / 2 * t, (high - low) / 2 * w
    return radius * np.sin(theta), np.pi / (2 * count) * radius * np.cos(theta), np.hstack([x, -x]), np.hstack([wx, wx])
