"""Sensor fields behind lenslets of any other shape by matrix triple products, row by row of the aperture: the general Fresnel rung."""

import numpy as np

from plenocli.optics.psf import separable_field
from plenocli.optics.quadrature import gauss, nodes_for
from plenocli.optics.relay import lenslet_kernel, lit_lenslets, pixel_energy, sensor_nodes


class RoundLenslets:
    """Sensor fields behind circular lenslets, row by row of the aperture; any separable sum h serves.

    Rows lie at y = R sin(theta), theta equidistant, with chords +-R cos(theta). The integral along a chord is the one along
    the next shorter chord plus two short panels at its ends, so all chords cost little more than one.
    """

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self.window = geometry, plan.superpixels, band.window
        self.pixel_nodes, self.dtype = band.pixel_nodes, np.complex128 if plan.double else np.complex64
        self.field = field = separable_field(camera, geometry, band.half, plan.tolerance)
        self.symmetry, self.notes = field.symmetry, {"separable_terms": field.terms, "field_tail": field.tail}
        superpixels, window, dtype = plan.superpixels, band.window, self.dtype
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
        self._bound = [self._gram(axis, band.lenslet_nodes) for axis in (0, 1)]

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
