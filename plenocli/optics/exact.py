"""Sensor fields behind square lenslets by the exact scalar kernel: Rayleigh and Sommerfeld's first integral as low rank.

The field on superpixel s of point (xp, yp) is M[(u, xp), (v, yp)], u and v on nodes of the sensor. The kernel's path along
each axis, the lens and the curvature of h separate; the rest is the short sum of residual.Residuals, and so is h
(debye.spherical_field), hence

    M = sum over lenslets m, n of X_m (C_mn (x) S_mn) X_n^T,
    X_m[(u, xp), (r, i)] = integral of W_m(u, x) P_r(u, x) e_i(m D2 + x - xp) dx.

Terms (r, i) that all couplings leave too weak to matter are left out, and M is compressed to its own rank (optics.product):
what is left are factor tables as the paraxial rung has them (optics.factors).
"""

import math
from dataclasses import dataclass

import numpy as np

from plenocli.errors import NumericsError
from plenocli.optics.debye import spherical_field
from plenocli.optics.factors import Factors
from plenocli.optics.plan import BandPlan, distinct, grid_of, is_symmetric, size_band
from plenocli.optics.product import FILL, MAX_SKETCH, Product
from plenocli.optics.psf import legendre, separable_field
from plenocli.optics.quadrature import gauss
from plenocli.optics.relay import lit_lenslets, sensor_nodes
from plenocli.optics.residual import Residuals, path

CUT, CUT_EFFECT = 0.42, 1.3
"""Root-energy cut of the field over the accuracy asked for, and its effect on the worst column over itself (measured: 0.5 to 2.3)."""
EDGE = 2.0
"""Extra weight of points at a lenslet's edge in the cut."""


@dataclass(frozen=True)
class ExactBand(BandPlan):
    """A BandPlan of the exact rung. cut: root-energy error of a mean point's field; sensor_count: Gauss-Legendre nodes across a
    superpixel that carry the field before it goes to the pixels' nodes, 0: the pixels' nodes serve."""

    cut: float = 1e-5
    sensor_count: int = 0


def exact_band(view, grid, ring, accuracy, tolerance):
    """The ExactBand of Geometry `view` for `grid` superpixels (rows, columns), coherent ring and accuracy as in size_band.

    NumericsError where the field is expected to have far more terms than a sketch may hold.
    """
    base = size_band(view, grid, ring, accuracy, tolerance)
    phase = view.k * view.lenslet_width / 2 * max(view.pixel_shape) * view.pixel_pitch / 2 / view.z3
    count = int(math.ceil(phase + 5 * np.cbrt(phase) + 4 + 2 * max(0.0, -math.log10(accuracy) - 5)))
    count = count if base.window is None and count < 0.8 * base.pixel_nodes * min(view.pixel_shape) else 0
    # light out of focus is spread over many superpixels, each of which is cut by itself; coarse cuts hurt corners more
    share = min(1.0, 4 / math.pi * (view.D2 / max(view.blur, view.D2)) ** 2)
    cut = CUT * accuracy * math.sqrt(share) / (1 + 4 * accuracy)
    terms = expected_terms(view, base.terms, cut, True)
    if terms > FILL * MAX_SKETCH:
        raise NumericsError(f"the exact field has about {terms:.0f} separable terms, more than {int(FILL * MAX_SKETCH)}", "model",
                            "ask for a looser accuracy or the paraxial model")
    return ExactBand(**vars(base) | {"sampling": math.hypot(base.sampling, CUT_EFFECT * CUT * accuracy)}, cut=cut, sensor_count=count)


def valid_for(camera, view):
    """None, or one sentence why this rung cannot serve `camera` at the Geometry `view`."""
    array = camera.lenslet_array
    if array.lattice != "square" or array.aperture_shape != "square":
        return f"exact propagation is built for square lenslets on a square lattice, not for {array.aperture_shape} ones on a {array.lattice} lattice"
    if view.z3 < 10 * view.wavelength:
        return "the sensor lies within ten wavelengths of the lenslets, where evanescent waves reach it"
    return None


def fresnel_model_error(view, parabolic):
    """Estimated relative L2 error of the worst column of the paraxial model against the exact one.

    Rays tell where paraxial optics sends light amiss. With T = D1/(2 z2) at the pupil's rim and P = D2/(2 f2) at the lenslet's,
    a hyperbolic lenslet sends the ray through both 3/2 z3 T P (T + P) from where paraxial optics has it, a parabolic one
    z3 P^3/2 more; sine against tangent at the main lens is a part of it. That is a share `moved` of the pupil image's half
    width z3 T. A disc moved by it changes along its rim, which is one pixel or one diffraction cell wide: over the disc's norm
    that is about moved sqrt(disc's width/rim's width). Points beside lenslets that leave gaps are dim, and what is moved weighs
    more in their columns. Measured on 24 cameras (f/1.5 to f/64, 50 to 500 um, 0.4 to 10 um, 3 to 52 pixels, both profiles): between 0.9 and 2.5 times the
    error found (docs/model.md, "Exact propagation").
    """
    # where a lenslet has few cells, diffraction spreads light further than the pupil does
    spread = view.wavelength / (2 * view.D2)
    pupil, lenslet = math.hypot(view.D1 / (2 * view.z2), spread), math.hypot(view.D2 / (2 * view.f2), spread)
    moved = 1.5 * lenslet * (pupil + lenslet) + (lenslet**3 / (2 * pupil) if parabolic else 0.0)
    across = 2 * view.z3 * pupil / view.pixel_pitch
    dim = 1 + 5 * (1 - view.lenslet_width / view.D2)
    return min(1.0, 0.5 * moved * math.sqrt(max(1.0, min(across, view.diffraction_cells))) * dim)


def corner_phase(view):
    """Phase (rad) of the kernel that does not separate, at the largest displacements along both axes within one superpixel."""
    far = view.lenslet_width / 2 + max(view.pixel_shape) * view.pixel_pitch / 2
    return view.k * far**4 / (4 * view.z3**3)


def expected_terms(view, terms, cut, parabolic):
    """Terms of a lenslet's field whose spread function has `terms`: fitted to 144 cases (f/1.5 to f/64, cut 5e-3 to 5e-7), 8 % rms."""
    phase, decades = corner_phase(view), math.log10(5e-3 / cut)
    spread = (0.48 if parabolic else 0.73) * view.diffraction_cells**0.71 * (1 + 5 * phase) ** 0.33
    return max(2.0, terms * (0.75 + 0.23 * phase**0.45) + decades * spread)


def expected_products(view, terms, lit, parabolic):
    """Terms (r, i) of one lenslet's sheet before compression to `terms`, where `lit` lenslets along an axis are followed (fitted alike)."""
    return 1.27 * (1 if parabolic else 1.36) * (1 + corner_phase(view)) ** 0.22 * terms * lit


def cost(camera, view, band, shape, double):
    """What the matrix of `shape` (band, superpixel, pixel, point) costs at one wavelength: operations (real, in matrix products),
    seconds (what does not scale with them, one core) and bytes (beyond the result); fitted to process times (docs/model.md)."""
    parabolic, grid, even = camera.lenslet_array.profile == "parabolic", grid_of(shape[1]), is_symmetric(camera)
    lit = 1 if band.window is None else 2 * band.window + 1
    reach, points = grid[0] // 2, max(view.object_shape)
    places = range(0 if even else -reach, reach + 1)
    lines = band.pixel_nodes * max(view.pixel_shape)
    terms = expected_terms(view, band.terms, band.cut, parabolic) * (0.2 if even and camera.main_lens.aperture_shape == "square" else 1.0)
    sketch, products = 1.12 / FILL * terms + 8, expected_products(view, terms, lit, parabolic)
    nodes, rate, item = band.sensor_count or lines, 2 if double else 1, 16 if double else 8
    rows = [nodes * ((points + 1) // 2 if even and s == 0 else points) for s in places]
    tables = [(a, b) for a in range(len(rows)) for b in range(len(rows)) if b <= a or not even]
    setup = (2.4e-9 * band.psf_nodes**3 / (8 if even else 1) + 1e-9 * points * band.lenslet_nodes * band.terms * (band.terms + band.psf_nodes) + 0.01
             + 0.02 * (len(places) * lit) ** 2)
    for n in rows:
        setup += (1 if even else 2) * lit * n * products * (1.2e-10 * band.lenslet_nodes + 4e-9) * rate
    for a, b in tables:
        n = rows[a] + (0 if even and a == b else rows[b])
        setup += rate * (n * sketch * (3.5e-10 * lit * products + 6e-10 * sketch) + 4e-9 * sketch**3
                         + 2.5e-10 * lit**2 * products**2 * sketch + 1.5e-10 * (rows[a] + rows[b]) * terms * (lines if band.sensor_count else 10))
    pairs, fine = distinct(camera, view, shape)[1], view.pixel_shape[0] * view.pixel_shape[1] * band.pixel_nodes**2
    size = shape[1] * shape[2] * shape[3]
    return {"operations": 8.0 * 1.2 * fine * terms * pairs,
            "seconds": setup + pairs * (4e-5 + fine * (4e-9 if double else 3e-9)) + size * (2e-8 if double else 7e-9),
            "bytes": int(item * ((1 if even else 2) * lit * sum(rows) * products + 4 * max(rows) * sketch
                                 + 2 * len(tables) * points * lines * terms)) + (1 << 25)}


class ExactSquareLenslets:
    """Sensor fields behind square lenslets by the exact kernel; see the module and optics.square.SquareLenslets."""

    def __init__(self, camera, geometry, plan, band):
        self.geometry, self.superpixels, self.band = geometry, plan.superpixels, band
        self.dtype = np.dtype(np.complex128 if plan.double else np.complex64)
        self._parabolic = camera.lenslet_array.profile == "parabolic"
        self._field = separable_field(camera, geometry, band.half, band.cut / 2, spherical_field)
        self.symmetry = tuple(a and b for a, b in zip(self._field.symmetry, geometry.mirrors(plan.superpixels)))
        alike = geometry.pixel_shape[0] == geometry.pixel_shape[1] and geometry.object_shape[0] == geometry.object_shape[1]
        self._turn = alike and self.symmetry[2]
        t, w = gauss(band.lenslet_nodes)
        half = geometry.lenslet_width / 2
        self._x, self._w = half * t, half * w
        self._offsets = self._interval_list()
        extent = [(n + (geometry.pixel_shift is not None)) * geometry.pixel_pitch / 2 for n in geometry.pixel_shape]
        self._extent = extent
        weights = [share * self._amplitude(s, m) for (s, m), (_, share) in self._offsets.items()]
        self._residuals = Residuals([o for o, _ in self._offsets.values()], weights, max(extent), half,
                                    geometry.z3, geometry.k, None if self._parabolic else geometry.f2, band.cut / 3)
        self._number = {key: i for i, key in enumerate(self._offsets)}
        self._local, self._sheets = {}, {}
        grams = [self._gram(axis) for axis in (0, 1)]
        self._entering = (grams[0].reshape(len(grams[0]), -1) @ grams[1].reshape(len(grams[1]), -1).T).real
        self._kept = self._strong_terms()
        self._tables, ranks = {}, []
        for sy, sx in self._pairs():
            self._tables[sy, sx] = self._compressed(sy, sx)
            ranks.append(self._tables[sy, sx].high.shape[3])
        self._local, self._sheets = {}, {}
        self.notes = {"separable_terms": max(ranks), "field_tail": self._field.tail, "psf_terms": self._field.terms,
                      "residual_terms": max(len(a) for a in self._residuals.core.values()), "products": max(len(r) for r, _ in self._kept.values())}

    # which lenslets light which superpixels

    def _reach(self, axis):
        return (self.superpixels[axis] - 1) // 2

    def _lenslets(self, s, axis):
        """Lenslets along one axis whose light is followed to superpixel s."""
        window = self.band.window
        return [m for m in lit_lenslets(self._reach(axis), window) if window is not None or m == s]

    def _interval_list(self):
        """{(s, m): (displacement of the superpixel's centre from the lenslet's, share of the amplitude)}."""
        g = self.geometry
        cells = g.D2**2 / (g.wavelength * g.z3)
        found = {}
        for axis in (0, 1):
            for s in range(-self._reach(axis), self._reach(axis) + 1):
                if s < 0 and self.symmetry[axis]:
                    continue
                for m in self._lenslets(s, axis):
                    share = 1.0 if m == s else min(1.0, math.sqrt(1 / (cells * abs(m - s))))
                    found[s, m] = (s * g.superpixel_pitch - m * g.D2, share)
        return found

    def _pairs(self):
        """Superpixels (rows, columns) whose tables are made; the others' follow by symmetry."""
        ry, rx = (self._reach(axis) for axis in (0, 1))
        return sorted({self._canonical(sy, sx)[:2] for sy in range(-ry, ry + 1) for sx in range(-rx, rx + 1)})

    def _canonical(self, sy, sx):
        sy, sx = abs(sy) if self.symmetry[0] else sy, abs(sx) if self.symmetry[1] else sx
        turned = self._turn and sy < sx
        return (sx, sy, True) if turned else (sy, sx, False)

    # the factors of one axis

    def _gram(self, axis):
        """(point, term, term): overlaps of the terms of h over the lenslets."""
        g, total = self.geometry, 0
        points = self._points(0, axis)
        for m in lit_lenslets(self._reach(axis), self.band.window):
            values = self._field.evaluate(self._x + m * g.D2 - points[:, None], axis).transpose(0, 2, 1)
            total = total + (values * self._w) @ values.conj().transpose(0, 2, 1)
        return np.concatenate([total, total[:len(g.points(axis)) - len(points)][::-1]])

    def _amplitude(self, s, m):
        """Fourth root of the light of a mean point that enters the lenslets m along one axis: two such factors bound what enters one."""
        if m == s:
            return 1.0
        most = 0.0
        for axis in (0, 1):
            points = self._points(s, axis)
            power = np.abs(self._field.evaluate(self._x[:, None] + m * self.geometry.D2 - points, axis)) ** 2 @ field_norms(self._field, 1 - axis) ** 2
            most = max(most, float(self._w @ power @ self._emphasis(s, axis) ** 2) / len(points))
        return min(1.0, most**0.25)

    def _emphasis(self, s, axis):
        """Weights of the points in the compression: those at the lenslet's edge lose light and split it, so that the same error
        would be a larger share of their columns."""
        g = self.geometry
        edge = (g.D2 / 2 - np.abs(self._points(s, axis))) * g.D1 / (g.wavelength * g.z2)
        return 1 + EDGE * np.exp(-edge)

    def _points(self, s, axis):
        """Object points (m, on the array) along one axis that are computed for superpixel s; the others mirror them."""
        points = self.geometry.points(axis)
        return points[: (len(points) + 1) // 2] if s == 0 and self.symmetry[axis] else points

    def _nodes(self, s, axis):
        """Sensor positions (m, from the centre of superpixel s) of the field, and the roots of their weights."""
        if self.band.sensor_count:
            t, w = gauss(self.band.sensor_count)
            return self._extent[axis] * t, np.sqrt(self._extent[axis] * w)
        u, w = sensor_nodes(self.geometry, axis, self.band.pixel_nodes, s, self.band.pixel_rule)
        return u.ravel(), np.sqrt(w.ravel())

    def _strong_terms(self):
        """{(s, m, axis): (r, i)}: which terms of each X are made; what the others carry together is a quarter of the cut."""
        intervals = [(s, m, axis) for axis in (0, 1) for s, m in self._offsets if s <= self._reach(axis) and m in self._lenslets(s, axis)]
        norms = {key: self._mean_norms(*key) for key in intervals}
        strength = dict.fromkeys(intervals, 0.0)
        for one in intervals:
            for other in intervals:
                if one[2] == 0 and other[2] == 1:
                    c = np.abs(self._residuals.core[self._number[one[:2]], self._number[other[:2]]]) ** 2
                    t = np.abs(self._local_terms(*one).coefficients(0) @ self._local_terms(*other).coefficients(1).T) ** 2
                    t *= np.outer(norms[one], norms[other])
                    strength[one] = np.maximum(strength[one], np.outer(c.sum(axis=1), t.sum(axis=1)))
                    strength[other] = np.maximum(strength[other], np.outer(c.sum(axis=0), t.sum(axis=0)))
        kept = {}
        for key, power in strength.items():
            order = np.argsort(power, axis=None)
            weak = np.cumsum(power.ravel()[order]) <= (self.band.cut / 4) ** 2 / len(self._lenslets(key[0], key[2]))
            keep = np.ones(power.size, bool)
            keep[order[weak]] = False
            kept[key] = np.nonzero(keep.reshape(power.shape))
        return kept

    def _mean_norms(self, s, m, axis):
        """Mean square over the points of what each e_i has on lenslet m, times the share of it that reaches superpixel s."""
        points = self._points(s, axis)
        values = self._local_terms(s, m, axis).evaluate(m * self.geometry.D2 + self._x[:, None] - points, axis)
        power = np.einsum("xpi,x,p->i", np.abs(values) ** 2, self._w, self._emphasis(s, axis) ** 2) / len(points)
        return power * self._offsets[s, m][1] ** 2

    def _sheet(self, s, axis):
        """X of superpixel s along one axis: list of (m, (sensor nodes x points, terms) array)."""
        axis = 0 if self._turn else axis
        if (s, axis) in self._sheets:
            return self._sheets[s, axis]
        g, k = self.geometry, self.geometry.k
        u, root = self._nodes(s, axis)
        points, x = self._points(s, axis), self._x
        sheets = []
        for m in self._lenslets(s, axis):
            d = self._offsets[s, m][0] + u[:, None] - x
            place = m * g.D2 + x
            phase = path(d, g.z3) - path(u, g.z3)[:, None] + place**2 / (2 * g.z2)
            phase = phase - (x * x / (2 * g.f2) if self._parabolic else path(x, g.f2))
            wave = (root[:, None] * self._w / math.sqrt(g.wavelength * g.z3)) * np.exp(1j * k * phase)
            values = self._local_terms(s, m, axis).evaluate(place[:, None] - points, axis) * self._emphasis(s, axis)[:, None]
            values = values.astype(self.dtype if np.iscomplexobj(values) else self.dtype.type().real.dtype)
            kept_r, kept_i = self._kept[s, m, axis]
            sheet = np.empty((len(u), len(points), len(kept_r)), self.dtype)
            for r, term in enumerate(self._residuals.functions(self._number[s, m], u, x)):
                some = np.flatnonzero(kept_r == r)
                if len(some):
                    flat = values[:, :, kept_i[some]].reshape(len(x), -1)
                    sheet[:, :, some[0]:some[-1] + 1] = _times((wave * term).astype(self.dtype), flat).reshape(len(u), len(points), -1)
            sheets.append((m, sheet.reshape(len(u) * len(points), -1)))
        self._sheets[s, axis] = sheets
        return sheets

    def _local_terms(self, s, m, axis):
        key = (s, m, axis)
        if key not in self._local:
            g, share = self.geometry, self._offsets[s, m][1]
            if self.band.window is None and (not self._turn or self._field.signs is not None):
                self._local[key] = AllTerms(self._field, self._turn)
            else:
                reach = self._x[-1] + np.abs(g.points(axis)).max()
                low, high = max(m * g.D2 - reach, -self.band.half), min(m * g.D2 + reach, self.band.half)
                self._local[key] = LocalTerms(self._field, axis, low, high, self.band.cut / 3 / share)
        return self._local[key]

    # products of two axes

    def _couplings(self, sy, sx, left, right):
        """{(a, b): K_ab} for the terms kept on sheets a, b of the two axes."""
        found, second = {}, 0 if self._turn else 1
        for a, (m, _) in enumerate(left):
            for b, (n, _) in enumerate(right):
                (r, i), (s, j) = self._kept[sy, m, 0], self._kept[sx, n, second]
                core = self._residuals.core[self._number[sy, m], self._number[sx, n]]
                terms = self._local_terms(sy, m, 0).coefficients(0) @ self._local_terms(sx, n, second).coefficients(1).T
                found[a, b] = (core[r[:, None], s] * terms[i[:, None], j]).astype(self.dtype)
        return found

    def _compressed(self, sy, sx):
        """Factors of superpixel (sy, sx)."""
        left, right = self._sheet(sy, 0), self._sheet(sx, 1)
        product = Product([x for _, x in left], [x for _, x in right], self._couplings(sy, sx, left, right), self._turn and sy == sx)
        count = len(self._points(sy, 0)) * len(self._points(sx, 1))
        high, wide = product.factors(self.band.cut * math.sqrt(count), self._first_guess())
        return Factors(self._to_pixels(high, sy, 0)[None], self._to_pixels(wide, sx, 1)[None], self.geometry.pixel_shape, self.band.pixel_nodes)

    def _first_guess(self):
        """Columns of the first sketch, from the rank expected."""
        return int(1.12 / FILL * expected_terms(self.geometry, self._field.terms, self.band.cut, self._parabolic)) + 8

    def _to_pixels(self, factor, s, axis):
        """(sensor nodes x points, terms) to (points, pixel nodes, terms)."""
        u, root = self._nodes(s, axis)
        factor = factor.reshape(len(u), -1)
        points = len(self._points(s, axis))
        if self.band.sensor_count:
            v, w = sensor_nodes(self.geometry, axis, self.band.pixel_nodes, s, self.band.pixel_rule)
            t, wt = gauss(len(u))
            degrees = np.arange(len(u))
            back = legendre(t, len(u), 1).T * wt * ((2 * degrees + 1) / 2)[:, None]
            matrix = np.sqrt(w.ravel())[:, None] * (legendre(v.ravel() / self._extent[axis], len(u), 1) @ back) / root
            real = factor.real.dtype
            factor = (matrix.astype(real) @ factor.view(real)).view(factor.dtype)
        factor = factor.reshape(len(factor), points, -1).transpose(1, 0, 2)
        return factor / self._emphasis(s, axis).astype(factor.real.dtype)[:, None, None]

    # what the builder asks for

    def incident(self, rows, columns):
        """Share of the light of points (rows[i], columns[i]) that enters the lenslets of the neighbourhood: (points,)."""
        # the cut, of weighted fields, may add as well as take
        return self._entering[rows, columns] * (1 + self.band.sampling)

    def columns(self, rows, columns, out):
        """As Factors.columns."""
        for sy in range(self.superpixels[0]):
            for sx in range(self.superpixels[1]):
                self.superpixel(sy, sx, rows, columns, out[:, sy, sx])

    def superpixel(self, sy, sx, rows, columns, out):
        """As Factors.superpixel; mirrored points and superpixels are computed as their mirror images."""
        sy, sx = sy - self._reach(0), sx - self._reach(1)
        *table, turned = self._canonical(sy, sx)
        table, shape = self._tables[*table], self.geometry.object_shape
        if turned:
            table = Factors(table.wide, table.high, self.geometry.pixel_shape, self.band.pixel_nodes)
        # points whose own half of the lenslet has no table
        far_y, far_x = (self.symmetry[axis] & ((s < 0) | ((s == 0) & (index >= (shape[axis] + 1) // 2)))
                        for axis, s, index in ((0, sy, rows), (1, sx, columns)))
        for fy, fx in ((False, False), (False, True), (True, False), (True, True)):
            some = np.flatnonzero((far_y == fy) & (far_x == fx))
            if len(some):
                images = np.empty((len(some), *self.geometry.pixel_shape), out.dtype)
                table.superpixel(0, 0, shape[0] - 1 - rows[some] if fy else rows[some], shape[1] - 1 - columns[some] if fx else columns[some], images)
                out[some] = images[:, :: -1 if fy else 1, :: -1 if fx else 1]


class AllTerms:
    """The terms of h as they are, with the methods of LocalTerms; for `turn` those of the rows serve the columns too."""

    def __init__(self, field, turn):
        self._field, self._turn = field, turn

    def coefficients(self, axis):
        return np.diag(self._field.signs) if axis and self._turn else np.eye(self._field.terms)

    def evaluate(self, d, axis):
        return self._field.evaluate(d, axis)


class LocalTerms:
    """An orthonormal basis e_i on [low, high] of the terms of h along one axis, cut at `tolerance` of the whole field."""

    def __init__(self, field, axis, low, high, tolerance):
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        count = max(8, int(len(field.rows) * (2 if field.even else 1) * self.half / field.half) + 24)
        t, w = gauss(count)
        root = np.sqrt(self.half * w)[:, None]
        values = [root * field.evaluate(self.middle + self.half * t, a) for a in (0, 1)]
        # the partner of a term has the norm sqrt(s), which weighs it
        u, s, _ = np.linalg.svd(values[axis] * field_norms(field, 1 - axis), full_matrices=False)
        tails = np.sqrt(np.cumsum(s[::-1] ** 2)[::-1])
        basis = u[:, : max(1, int(np.count_nonzero(tails > tolerance)))]
        self._mixing = [basis.conj().T @ v for v in values]
        degrees = np.arange(count)
        self._series = ((legendre(t, count, 1).T * w * ((2 * degrees + 1) / 2)[:, None]) @ (basis / root))

    def coefficients(self, axis):
        """(i, term): the terms of h along `axis` in this basis."""
        return self._mixing[axis]

    def evaluate(self, d, axis):
        """e_i at d (m): d.shape + (i,), the same for both axes."""
        t = (np.asarray(d, float).ravel() - self.middle) / self.half
        return (legendre(t, len(self._series), 1) @ self._series).reshape(*np.shape(d), -1)


def field_norms(field, axis):
    """Root energy of each term of h along one axis: (terms,)."""
    coefficients = field.columns if axis else field.rows
    degrees = np.arange(len(coefficients)) * (2 if field.even else 1)
    return np.sqrt((np.abs(coefficients) ** 2 * (2 / (2 * degrees + 1))[:, None]).sum(axis=0) * field.half)


def _times(kernel, values):
    """kernel @ values for a complex kernel and real or complex values of the same precision."""
    if np.iscomplexobj(values):
        return kernel @ values
    out = np.empty((len(kernel), values.shape[1]), kernel.dtype)
    out.real, out.imag = np.vsplit(np.concatenate([kernel.real, kernel.imag]) @ values, 2)
    return out
