"""Sensor fields behind lenslets of any convex mirror-symmetric shape by matrix triple products: the general Fresnel rung.

The opening is cut into chords at quadrature nodes of one axis, the scan axis. A chord's integral is that over the next shorter
chord plus two short panels at its ends, so that all chords together cost little more than one, and every integrand is
smooth: spectral accuracy for circles and hexagons alike. Mirror images of a chord share it. Per object point remain two
products: scan nodes x separable terms x sensor nodes, and sensor nodes x scan nodes x sensor nodes.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from plenocli.optics.plan import coherent_window, size_band
from plenocli.optics.psf import psf_nodes, separable_field
from plenocli.optics.quadrature import gauss, nodes_for, smooth_nodes
from plenocli.optics.relay import lenslet_kernel, pixel_energy, sensor_nodes

SLAB = 1 << 20
"""Complex numbers in the work arrays of a few points: about what the last-level cache holds."""


@dataclass(frozen=True)
class Chords:
    """Quadrature of a lenslet's opening, in metres from its centre.

    axis: the scan axis (0 rows, 1 columns); at, weight: (chord, mirror) scan nodes, at[h, i] = -at[h, -1-i], chords ascending
    in length; core, core_weight: nodes over the shortest chord; panels, panel_weight: (chord - 1, nodes) over what each longer
    chord adds at both ends.
    """

    axis: int
    at: np.ndarray
    weight: np.ndarray
    core: np.ndarray
    core_weight: np.ndarray
    panels: np.ndarray
    panel_weight: np.ndarray

    @property
    def pieces(self):
        """(nodes, weights) of the core and, where chords differ, of the panels: each (chord, node)."""
        return [piece for piece in ((self.core[None], self.core_weight[None]), (self.panels, self.panel_weight)) if len(piece[0])]


def chords(shape, width, slope, error=1e-10):
    """Chords of a "square", "circle" or "hexagon" of `width` (m, across flat sides) for phases of up to `slope` rad/m.

    error: of the short panels. Hexagons have two flat sides facing +-x and are scanned across them.
    """
    half = width / 2
    if shape == "square":
        t, w = gauss(2 * ((nodes_for(slope * half) + 1) // 2))
        return _chords(0, half * t[None], half * w[None], np.array([half]), slope, error)
    if shape == "circle":
        # equidistant angles converge spectrally, since the integrand is periodic in them; slope runs along the rim
        count = int(np.ceil(slope * half / 4 + 1.5 * np.cbrt(slope * half) + 3))
        theta = (np.arange(count) + 0.5) * np.pi / (2 * count) - np.pi / 2
        at, weight, ends = half * np.sin(theta), np.pi / (2 * count) * half * np.cos(theta), half * np.cos(theta)
    else:
        t, w = gauss(nodes_for(slope * 2 / math.sqrt(3) * half / 2))
        at, weight = -half / 2 * (1 - t), half / 2 * w
        ends = (2 * half + at) / math.sqrt(3)
    return _chords(0 if shape == "circle" else 1, np.stack([at, -at], 1), np.stack([weight, weight], 1), ends, slope, error)


def _chords(axis, at, weight, ends, slope, error):
    t, w = gauss(2 * ((nodes_for(slope * ends[0]) + 1) // 2))
    low, high = ends[:-1, None], ends[1:, None]
    s, v = gauss(smooth_nodes(slope * float(np.max(np.diff(ends), initial=0.0)) / 2, error))
    x, wx = (low + high) / 2 + (high - low) / 2 * s, (high - low) / 2 * v
    return Chords(axis, at, weight, ends[0] * t, ends[0] * w, np.hstack([x, -x]), np.hstack([wx, wx]))


class ShapedLenslets:
    """Sensor fields behind lenslets of one shape on a square or hexagonal lattice, for any pupil of the main lens."""

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self.window = geometry, plan.superpixels, band.window
        self.pixel_nodes, self.dtype = band.pixel_nodes, np.complex128 if plan.double else np.complex64
        self.field = separable_field(camera, geometry, band.half, plan.tolerance)
        self.symmetry, self.notes = self.field.symmetry, {"separable_terms": self.field.terms, "field_tail": self.field.tail}
        self.cut = chords(geometry.lenslet_shape, geometry.lenslet_width, _slope(camera, geometry, plan.superpixels, band.window), plan.tolerance / 1e3)
        self._sites = geometry.places(plan.superpixels)
        self._products = {} if self.window is None else {None: geometry.neighbourhood(self.window)}
        if self.window is None:
            self._products = {site: [([site[0]], [site[1]])] for site in self._sites}
        self._heights = {key: [self._rows(product[self.cut.axis]) for product in products] for key, products in self._products.items()}

    # the two tables of one set of lenslets

    def _rows(self, positions):
        """Terms at the scan nodes of lenslets at `positions`, sums and differences of mirror images: (point, chord, node, term)."""
        g, axis = self.geometry, self.cut.axis
        at = (self.cut.at[:, :, None] + np.asarray(positions) * g.D2).reshape(len(self.cut.at), -1)
        values = self.field.evaluate(at - g.points(axis)[:, None, None], axis)
        return np.ascontiguousarray(_folded(values, 2)).astype(self.dtype)

    def _across(self, positions, place):
        """Kernels along the chords of lenslets at `positions` to the superpixel at `place`: [core, panels], (chord, sensor node, node)."""
        axis = 1 - self.cut.axis
        u, wu = (a.ravel() for a in sensor_nodes(self.geometry, axis, self.pixel_nodes, place))
        parts = []
        for x, w in self.cut.pieces:
            kernels = [(lenslet_kernel(self.geometry, n - place, u, wu, x.ravel()) * w.ravel()).reshape(len(u), *x.shape) for n in positions]
            parts.append(np.ascontiguousarray(np.concatenate(kernels, axis=2).transpose(1, 0, 2)).astype(self.dtype))
        return parts

    def _along(self, positions, index):
        """Terms at the chords' nodes of lenslets at `positions` for point `index` of the chord axis: [core, panels], (chord, node, term)."""
        g, axis = self.geometry, 1 - self.cut.axis
        shift = np.asarray(positions) * g.D2
        return [self.field.evaluate(x[:, None, :] + shift[:, None] - g.points(axis)[index], axis).reshape(len(x), -1, self.field.terms).astype(self.dtype)
                for x, _ in self.cut.pieces]

    def _kernel(self, products, place):
        """Kernel from the scan nodes of all products to the superpixel at `place`: (sensor node, sums of all, differences of all)."""
        axis = self.cut.axis
        v, wv = (a.ravel() for a in sensor_nodes(self.geometry, axis, self.pixel_nodes, place))
        sums, differences = [], []
        for product in products:
            kernels = np.stack([lenslet_kernel(self.geometry, n - place, v, wv, self.cut.at.ravel()) * self.cut.weight.ravel() for n in product[axis]], axis=-1)
            folded = _folded(kernels.reshape(len(v), len(self.cut.at), -1), 2) / 2
            half = folded.shape[2] // 2
            sums.append(folded[:, :, :half].reshape(len(v), -1))
            differences.append(folded[:, :, half:].reshape(len(v), -1))
        return np.ascontiguousarray(np.hstack(sums + differences)).astype(self.dtype)

    # pixel energies

    def columns(self, rows, columns, out):
        """Pixel energies of points (rows[i], columns[i]) into out (points, superpixel rows, superpixel columns, pixel rows, pixel columns)."""
        points = (rows, columns)
        scan, chord = points[self.cut.axis], points[1 - self.cut.axis]
        order = np.argsort(chord, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(chord[order])) + 1)
        for key, place, sites in self._tasks():
            products = self._products[key]
            across = [self._across(product[1 - self.cut.axis], place) for product in products]
            kernels = [(index, self._kernel(products, n), self._mirrored(products, n)) for index, n in sites]
            step = max(1, SLAB // max(a.size for _, a, _ in kernels))
            for group in groups:
                spread = [self._spread(product, kernel, chord[group[0]]) for product, kernel in zip(products, across)]
                for start in range(0, len(group), step):
                    part = group[start:start + step]
                    lines = self._lines(key, scan[part], spread)
                    for (sy, sx), kernel, mirrored in kernels:
                        energy = self._energy(kernel, lines, mirrored)
                        out[part, sy, sx] = energy.transpose(0, 2, 1) if self.cut.axis else energy

    def _tasks(self):
        """Superpixels that share their place along the chords: (key of the products, place, [(index in out, scan place)])."""
        tasks = {}
        for site, index in self._sites.items():
            key = site if self.window is None else None
            tasks.setdefault((key, site[1 - self.cut.axis]), []).append((index, site[self.cut.axis]))
        return [(key, place, sites) for (key, place), sites in tasks.items()]

    def _mirrored(self, products, place):
        """Whether mirroring maps the scan nodes onto themselves as seen from the superpixel, so that sums and differences part."""
        centred = all(np.allclose(np.asarray(p[self.cut.axis]) - place, place - np.asarray(p[self.cut.axis])[::-1], atol=1e-12) for p in products)
        return centred and self.geometry.window_shift(self.cut.axis, place) == 0

    def _spread(self, product, across, index):
        """Terms carried along every chord to the sensor, for one point of the chord axis: (chord, term, sensor node)."""
        out = np.concatenate([values.transpose(0, 2, 1) @ kernel.transpose(0, 2, 1)
                              for values, kernel in zip(self._along(product[1 - self.cut.axis], index), across)])
        return np.cumsum(out, axis=0, out=out)

    def _lines(self, key, scan, spread):
        """Fields of points `scan` at the scan nodes, before the hop along the scan axis: (point, sums then differences, sensor node)."""
        tables = self._heights[key]
        count = sum(t.shape[1] * t.shape[2] for t in tables)
        out = np.empty((len(scan), 2, count // 2, spread[0].shape[2]), self.dtype)
        start = 0
        for table, terms in zip(tables, spread):
            chosen = table[scan].transpose(1, 0, 2, 3)
            chords, points, nodes, _ = chosen.shape
            fields = (chosen.reshape(chords, points * nodes, -1) @ terms).reshape(chords, points, 2, nodes // 2, -1)
            stop = start + chords * nodes // 2
            out[:, :, start:stop].reshape(points, 2, chords, nodes // 2, -1)[...] = fields.transpose(1, 2, 0, 3, 4)
            start = stop
        return out.reshape(len(scan), count, -1)

    def _energy(self, kernel, lines, mirrored):
        p, shape = self.pixel_nodes, self.geometry.pixel_shape
        ps, pc = shape[self.cut.axis], shape[1 - self.cut.axis]
        field = _hop(kernel, lines) if mirrored else kernel @ lines
        return pixel_energy(field.reshape(len(lines), p, ps, p, pc))

    # the guard

    def incident(self, rows, columns):
        """Share of the light of points (rows[i], columns[i]) that enters the lenslets of the neighbourhood: (points,)."""
        scan, chord = (rows, columns) if self.cut.axis == 0 else (columns, rows)
        share = np.zeros(len(rows))
        for key, products in self._products.items():
            for number, product in enumerate(products):
                weight = np.repeat(self.cut.weight[:, :self.cut.weight.shape[1] // 2], len(product[self.cut.axis]), axis=1)
                weight = np.concatenate([weight, weight], axis=1) / 2
                for index in np.unique(chord):
                    here = np.flatnonzero(chord == index)
                    heights = self._heights[key][number][scan[here]]
                    gram = self._gram(product, index)
                    share[here] += np.einsum("ihra,ihra,hr->i", heights @ gram, heights.conj(), weight, optimize=True).real
        return share

    def _gram(self, product, index):
        """Gram matrices of the terms over every chord, for one point of the chord axis: (chord, term, term)."""
        positions, parts = product[1 - self.cut.axis], []
        for values, (_, w) in zip(self._along(positions, index), self.cut.pieces):
            weight = np.tile(w, len(positions)).astype(values.real.dtype)
            parts.append((values * weight[:, :, None]).transpose(0, 2, 1) @ values.conj())
        return np.cumsum(np.concatenate(parts), axis=0)


def _folded(values, axis):
    """Sums, then differences, of mirror images along `axis` (of even length)."""
    first, last = np.split(values, 2, axis=axis)
    last = np.flip(last, axis)
    return np.concatenate([first + last, first - last], axis=axis)


def _hop(kernel, lines):
    """kernel @ lines for a kernel whose sums are even and whose differences are odd over the sensor nodes: half of the work."""
    nodes, count = kernel.shape[0], kernel.shape[1] // 2
    top = (nodes + 1) // 2
    even, odd = kernel[:top, :count] @ lines[:, :count], kernel[:top, count:] @ lines[:, count:]
    out = np.empty((len(lines), nodes, lines.shape[2]), lines.dtype)
    np.add(even, odd, out=out[:, :top])
    np.subtract(even, odd, out=out[:, ::-1][:, :top])
    return out


def _slope(camera, geometry, grid, window):
    """Largest gradient (rad/m) of the phase on a lenslet: of the hop to the farthest pixel, of the pupil's rim, of kappa."""
    g = geometry
    raster = 0.0 if g.pixel_shift is None else 0.5
    far = (0.0, 0.0) if window is None else np.add(g.reach(grid), g.reach(grid, window))
    reach = math.hypot(*((n / 2 + raster) * g.pixel_pitch + f * g.superpixel_pitch for n, f in zip(g.pixel_shape, far)))
    rim = g.D1 / 2 * (1 if camera.main_lens.aperture_shape in ("circle", "annulus") else math.sqrt(2))
    corner = math.hypot(*g.lenslet_extent) if g.lenslet_shape == "square" else max(g.lenslet_extent)
    return g.k * (reach / g.z3 + rim / g.z2 + abs(g.kappa) * corner)
