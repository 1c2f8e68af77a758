"""The main lens's field on a lenslet off the axis, in direction cosines about its chief ray, which
is kept exactly (lenslets.py, openings.py): F(d; p) = sum_ab e_ab(d; p) h_ab(d), d from the point
imaged at p, ds the direction cosines less the chief ray's, h_ab the waves of P ds_y^a ds_x^b, and
e_ab the power series of exp E, what of the path is not linear in ds.
docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.exact.debye import APODISATION, aperture_norm
from plenocli.forward.propagation.exact.low_rank_product import Product
from plenocli.forward.propagation.fresnel.spread_function import (
    SeparableField,
    legendre,
    psf_nodes,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

Place = tuple[float, float]
"""(row, column), m."""
MOST_ORDERS, MOST_POWERS = 10, 24
"""Nodes along an axis of a point's place, and powers of ds, that are affordable."""
FITTED = [(a, n - a) for n in (1, 2, 3, 4) for a in range(n + 1)]
"""Powers of ds along rows and columns that E is fitted by."""
ALIKE = 1e-5
"""Relative difference of fields that are mirror images."""
SHARP = 1e-6
"""Blur of a point, in lenslets, below which it is in focus."""
FINER = 10.0
"""By how much finer a series ends than singular vectors are cut: all of it falls on one column."""
BETWEEN = 1.005
"""Largest sine of the pupil over that of its points which are looked at."""
SKETCH = 192
"""Columns of the first sketch of a field's singular vectors."""
SLOW = 8
"""Places along an axis that carry what of the path no power of ds has."""
SINGLE = 1e-5
"""Root energy that may be lost from which on single precision serves: it takes 4e-7 of a field of
two hundred diffraction cells a side.
"""
SLAB = 1 << 20
"""Numbers in a slab of pupil nodes x polynomials."""


@dataclass(frozen=True, kw_only=True)
class ObliqueField(SeparableField):
    """F(d; p) = sum_j a_j(dy, py) b_j(dx, px), as SeparableField, each term a polynomial of the
    point: `rows`, `columns` are Legendre coefficients (degrees, order x term).

    orders: of normalised Legendre polynomials of the point's place;
    scale: half width (m) of the places that they are normalised on.
    """

    orders: int
    scale: float

    @property
    def terms(self) -> int:
        """Number of separable terms."""
        return self.rows.shape[1] // self.orders


def orders_of(field: SeparableField) -> int:
    """Polynomials of the point that the terms of a field are made of, 1 on the axis."""
    return field.orders if isinstance(field, ObliqueField) else 1


def at_points(field: SeparableField, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Terms of a field for points.

    values: (..., order x term) at displacements from them;
    points: m, broadcasting against the leading axes.

    Returns (..., term).
    """
    if not isinstance(field, ObliqueField):
        return values
    parts = values.reshape(*values.shape[:-1], field.orders, -1)
    at = _of_points(np.asarray(points).ravel() / field.scale, field.orders)
    at = at.reshape(*np.shape(points), 1, field.orders)
    return sum(at[..., n] * parts[..., n, :] for n in range(field.orders))


def _of_points(places: np.ndarray, orders: int) -> np.ndarray:
    """Legendre polynomials of mean square 1: (place in [-1, 1], order)."""
    return legendre(places, orders, 1) * np.sqrt(2 * np.arange(orders) + 1)


def oblique_field(
    camera: Camera, geometry: Geometry, half: float, tolerance: float
) -> ObliqueField:
    """The field on [-half, half]^2 about the image points of the lenslet at geometry.chief.

    half: m;
    tolerance: root energy that may be lost.

    Raises NumericsError as psf_nodes.
    """
    g, count = geometry, psf_nodes(geometry, half)
    (t, w), orders, scale = gauss(count), orders_for(geometry, tolerance), geometry.D2 / 2
    places, share = gauss(orders)
    fields = _Fields(camera, g, half, t, tolerance)
    root = np.sqrt(w * half)
    blocks = np.empty((orders, count, orders, count), fields.dtype)
    for (i, y), (j, x) in product(enumerate(places * scale), repeat=2):
        weight = math.sqrt(share[i] * share[j]) / 2
        blocks[i, :, j] = fields.of((y, x)) * (weight * root[:, None] * root)
    matrix = blocks.reshape(orders * count, -1)
    unit = np.eye(len(matrix), dtype=matrix.dtype)
    # at an end of its interval a polynomial may be `orders` times its root mean square
    cut = tolerance / orders
    factors = Product(matrix, unit, {(0, 0): unit}, False).factors(cut, SKETCH)
    project = legendre(t, count, 1).T * w * ((2 * np.arange(count) + 1) / 2)[:, None]
    onto = _of_points(places, orders).T * np.sqrt(share / 2)
    rows, columns = (
        np.einsum(
            "dy,on,nyj->doj", project / root, onto, factor.reshape(orders, count, -1), optimize=True
        )
        .reshape(count, -1)
        .astype(fields.dtype)
        for factor in factors
    )
    return ObliqueField(
        half=half,
        rows=rows,
        columns=columns,
        even=False,
        symmetry=fields.symmetry,
        tail=cut,
        orders=orders,
        scale=scale,
    )


def neglected(geometry: Geometry) -> float:
    """Estimated relative L2 error of the worst column by what F leaves out, 0 on the axis: what E's
    fit misses, and where a point's place or ds takes more orders than are affordable.
    """
    g = geometry
    if g.chief == (0.0, 0.0):
        return 0.0
    missed, sizes, turns = _sizes(g)
    dim = 1 + 3 * (1 - g.lenslet_width / g.D2)
    return dim * math.hypot(missed, _interpolated(turns, MOST_ORDERS), _beyond(sizes, MOST_POWERS))


def orders_for(geometry: Geometry, tolerance: float) -> int:
    """Nodes along an axis of a point's place that its field takes; 1 on the axis."""
    if geometry.chief == (0.0, 0.0):
        return 1
    turns = _sizes(geometry)[2]
    return next(
        (n for n in range(1, MOST_ORDERS) if FINER * _interpolated(turns, n) < tolerance),
        MOST_ORDERS,
    )


def _interpolated(turns: float, nodes: int) -> float:
    """Error of exp(j turns t) by interpolation from Gauss-Legendre nodes on [-1, 1]."""
    return turns**nodes * 2**nodes * math.factorial(nodes) / math.factorial(2 * nodes)


def _beyond(sizes: Sequence[float], powers: int) -> float:
    """At most what exp E has beyond so many powers of ds, from E's parts of 1, 2, ... powers, of
    these sizes.
    """
    series = [1.0]
    for n in range(1, powers + 1):
        series.append(sum(d / n * e * series[n - d] for d, e in enumerate(sizes, 1) if d <= n))
    return math.exp(min(sum(sizes), 100.0)) - math.fsum(series)


@lru_cache(maxsize=256)
def _sizes(geometry: Geometry) -> tuple[float, list[float], float]:
    """(what the fit of E misses, E's parts by their powers of ds, by how much E changes with the
    point), of a point's light on its own lenslet.
    """
    g = geometry
    waves, t = _Waves(g), np.linspace(-1, 1, 3)
    reach = g.D2 / 2 * (1 + g.row_spacing) / 2
    found = []
    for p, q in product((-reach, 0.0, reach), repeat=2):
        # places on the lenslet, from the point
        exact = waves.exponent((p, q), reach * t - p, reach * t - q)
        parts = waves.parts(exact)
        # out of focus the point's own spheres go with it, too
        late = 1j * g.k * _late(g, (p, q), waves.y, waves.x)[:, None, None]
        found.append((exact - parts.sum(axis=0), np.abs(parts).max(axis=(1, 2, 3)), exact + late))
    missed, sizes, exact = (np.array(a) for a in zip(*found))
    return (
        float(np.abs(missed).max()),
        sizes.max(axis=0).tolist(),
        float(np.abs(exact - exact[len(exact) // 2]).max()),
    )


@lru_cache(maxsize=256)
def _counts(geometry: Geometry, half: float, tolerance: float) -> tuple[int, int, int]:
    """(nodes of ds along an axis, powers of it, places along an axis at which their coefficients
    are found) that the field on [-half, half]^2 takes.
    """
    g, waves = geometry, _Waves(geometry)
    phase = g.k * waves.steepest * half
    # as E is on the lenslets; no field is asked for beyond them
    places = (half - g.D2 / 2) * np.linspace(-1, 1, 3)
    parts = [
        np.abs(waves.parts(waves.exponent((p, q), places - p, places - q)))
        for p, q in product((-g.D2 / 2, g.D2 / 2), repeat=2)
    ]
    sizes = np.max(parts, axis=(0, 2, 3, 4)).tolist()
    powers = next(
        (n for n in range(MOST_POWERS) if FINER * _beyond(sizes, n) < tolerance), MOST_POWERS
    )
    # coefficients go slowly with the place
    few = next((n for n in range(SLOW) if FINER * _interpolated(sum(sizes), n) < tolerance), SLOW)
    return math.ceil(phase + 5 * math.cbrt(phase) + 12), powers, SLOW + few


def field_work(geometry: Geometry, half: float, tolerance: float) -> dict[str, float]:
    """What a field consists of: the pupil on nodes of ds, products of waves and of coefficients,
    the matrix of all points that is brought into terms.
    """
    g, count, orders = geometry, psf_nodes(geometry, half), orders_for(geometry, tolerance)
    nodes, powers, few = _counts(g, half, tolerance)
    made = orders**2 if g.blur > SHARP * g.D2 else 1
    series = (powers + 1) * (powers + 2) / 2
    return {
        "aslant_pupil": float(made * nodes**4),
        "aslant_waves": series * count**2 * (made * nodes + orders**2 * few),
        "aslant_matrix": float((orders * count) ** 2 * min(orders * count, SKETCH)),
    }


class _Waves:
    """Directions all over the pupil, and what of the path the fit by their powers has.

    steepest: T (m/m), the largest |ds| along an axis;
    powers: (pupil point, power) ds^a ds^b/T^(a+b), as FITTED;
    fit: (power, pupil point), its pseudo-inverse.
    """

    def __init__(self, geometry: Geometry) -> None:
        g = self.geometry = geometry
        turn = np.arange(16) * (math.pi / 8)
        # up to the corners of a square pupil
        r = np.array([[0.4], [0.8], [1.1], [1.41422]])
        self.y, self.x = (
            (g.D1 / 2 * np.clip(r * f(turn), -1, 1)).ravel() for f in (np.sin, np.cos)
        )
        s = np.array(_Sphere(g, g.chief, 1 / g.z2, self.y, self.x).sines)
        self.steepest = BETWEEN * float(np.abs(s).max())
        y, x = s / self.steepest
        self.powers = np.stack([y**a * x**b for a, b in FITTED], axis=1)
        self.fit = np.linalg.pinv(self.powers)
        self.sines = s

    def exponent(self, p: Place, dy: np.ndarray, dx: np.ndarray) -> np.ndarray:
        """E of the point imaged at p (m from the lenslet's centre) at displacements dy, dx (m) from
        it: (pupil point, row, column).
        """
        k, (far, near), (far_p, near_p) = (
            self.geometry.k,
            self._ways(p[0] + dy, p[1] + dx),
            self._ways(np.array(p[:1]), np.array(p[1:])),
        )
        linear = self.sines[0][:, None, None] * dy[:, None] + self.sines[1][:, None, None] * dx
        return 1j * k * ((far - near) - (far_p - near_p) - linear) - 2 * (
            np.log(far / near) - self._stronger
        )

    def parts(self, exponent: np.ndarray) -> np.ndarray:
        """The fit of E in parts of 1, 2, ... powers of ds: (part, pupil point, row, column)."""
        fitted = np.tensordot(self.fit, exponent, 1)
        degrees = np.array([a + b for a, b in FITTED])
        some = (degrees == d for d in range(1, degrees.max() + 1))
        return np.stack([np.tensordot(self.powers[:, d], fitted[d], 1) for d in some])

    def _ways(self, y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lengths (m) of the ways from the pupil points, and from its centre, to places (m) on the
        array: (pupil point, row, column) and (row, column).
        """
        g = self.geometry
        y, x = g.chief[0] + y, g.chief[1] + x
        away = (y[:, None] - self.y[:, None, None]) ** 2 + (x - self.x[:, None, None]) ** 2
        return np.sqrt(g.z2**2 + away), np.sqrt(g.z2**2 + y[:, None] ** 2 + x**2)

    @property
    def _stronger(self) -> np.ndarray:
        far, near = self._ways(np.zeros(1), np.zeros(1))
        return np.log(far / near)


class _Fields:
    """F(d; p) on nodes half t along either axis, in the precision that `tolerance` takes: dtype.

    symmetry: (flip rows, flip columns, exchange both) that leave all of them alike.
    """

    def __init__(
        self, camera: Camera, geometry: Geometry, half: float, t: np.ndarray, tolerance: float
    ) -> None:
        g = self.geometry = geometry
        self._camera, self._d = camera, half * t
        self.dtype = np.dtype(np.complex64 if tolerance > SINGLE else np.complex128)
        self._waves = _Waves(g)
        count, self._powers, few = _counts(g, half, tolerance)
        self._nodes, self._node_weights = gauss(count)
        phase = g.k * self._waves.steepest * half
        wave = np.exp(1j * phase * np.outer(t, self._nodes))
        self._along = [(wave * self._nodes**n).astype(self.dtype) for n in range(self._powers + 1)]
        nodes, weights = gauss(few)
        degrees = np.arange(few) + 0.5
        self._few = half * nodes
        onto = legendre(t, few, 1) * degrees @ (legendre(nodes, few, 1).T * weights)
        self._onto = onto.astype(self.dtype)
        self._blurred = g.blur > SHARP * g.D2
        middle = self._density((0.0, 0.0))
        h = self._along[0] @ middle @ self._along[0].T
        flips = tuple(g.chief[axis] == 0.0 and _same(h, np.flip(h, axis)) for axis in (0, 1))
        self.symmetry = (*flips, g.chief[0] == g.chief[1] and _same(h, h.T))
        self._shared = None if self._blurred else self._by_power(middle)

    def of(self, p: Place) -> np.ndarray:
        """F of the point imaged at p (m from the lenslet's centre): (row, column), 1/m."""
        parts = self._shared or self._by_power(self._density(p))
        fitted = np.tensordot(self._waves.fit, self._waves.exponent(p, self._few, self._few), 1)
        series = _exponential(dict(zip(FITTED, fitted)), self._powers)
        out = np.zeros_like(parts[0, 0])
        for power, e in series.items():
            out += self._onto @ e.astype(self.dtype) @ self._onto.T * parts[power]
        return out

    def _by_power(self, density: np.ndarray) -> dict[tuple[int, int], np.ndarray]:
        """h_ab/T^(a+b) for all powers."""
        right = [density @ wave.T for wave in self._along]
        return {
            (a, n - a): self._along[a] @ right[n - a]
            for n in range(self._powers + 1)
            for a in range(n + 1)
        }

    def _density(self, p: Place) -> np.ndarray:
        """The pupil, with the two spheres of the point imaged at p, on nodes of ds/T along either
        axis, which carry waves to all d as the pupil itself does: 1/m.
        """
        g, lens = self.geometry, self._camera.main_lens
        count, steepest = len(self._nodes), self._waves.steepest
        real = np.dtype(np.float32 if self.dtype == np.complex64 else np.float64)
        total = np.zeros((count, 2 * count))
        reach = g.k * math.sqrt(2) * np.abs(self._d).max() / g.z2
        for rows in pupil_rows(self._camera, g, reach):
            y, x = np.broadcast_to(rows.y[:, None], rows.x.shape).ravel(), rows.x.ravel()
            r2 = y * y + x * x
            cos2 = g.z2**2 / (g.z2**2 + r2)
            chief = _Sphere(g, g.chief, 1 / g.z2, y, x)
            # pupil_rows has the paraxial defocus; the difference of the two spheres takes its place
            weight = rows.weight.ravel() * np.exp(1j * g.k * (_late(g, p, y, x) - g.eps * r2 / 2))
            weight *= APODISATION[lens.apodisation](cos2) * cos2 / (g.z2 * chief.far) ** 2
            step = max(1, SLAB // count)
            for start in range(0, len(weight), step):
                some = slice(start, start + step)
                left, right = (
                    legendre(s[some] / steepest, count, 1).T.astype(real) for s in chief.sines
                )
                # sums of a slab in its precision, sums of slabs in double
                right = right * weight[some].astype(self.dtype)
                total += left @ np.ascontiguousarray(right.T).view(real)
        moments = total.view(complex) / (g.wavelength * math.sqrt(aperture_norm(lens, g)))
        degrees = np.arange(count) + 0.5
        onto = legendre(self._nodes, count, 1) * degrees * self._node_weights[:, None]
        return (onto @ moments @ onto.T).astype(self.dtype)


class _Sphere:
    """A sphere about a point of a ray through the pupil's centre, its distance 1/q from the pupil.

    place: where the ray meets the array, m from the axis;
    y, x: (node,) pupil points, m;
    far: of them from it, over its own distance along the axis;
    path: (node,) m, by which they are farther from it than the pupil's centre is;
    sines: [(node,), (node,)] by how much the direction cosines from them to it differ from the
        ray's, for places on the array (over q z2).
    """

    def __init__(
        self, geometry: Geometry, place: Place, q: float, y: np.ndarray, x: np.ndarray
    ) -> None:
        ty, tx = (c / geometry.z2 for c in place)
        middle = math.sqrt(1 + ty * ty + tx * tx)
        self.far = np.sqrt(1 + (ty - q * y) ** 2 + (tx - q * x) ** 2)
        # differences of squares, over q, so that nothing cancels and q may be 0
        apart = (q * (y * y + x * x) - 2 * (ty * y + tx * x)) / (self.far + middle)
        self.path = apart
        self.sines = [
            -(a * middle + t * apart) / (self.far * middle * geometry.z2)
            for a, t in ((y, ty), (x, tx))
        ]


def _late(geometry: Geometry, p: Place, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """By how much the sphere about the image of the point whose chief ray meets the array at p (m
    from the lenslet's centre) is ahead of the one about p, in m: (pupil point,).
    """
    g = geometry
    place = g.chief[0] + p[0], g.chief[1] + p[1]
    here, image = (_Sphere(g, place, q, y, x).path for q in (1 / g.z2, 1 / g.z2 - g.eps))
    return here - image


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.linalg.norm(one - other) < ALIKE * np.linalg.norm(one))


def _exponential(
    exponent: dict[tuple[int, int], np.ndarray], powers: int
) -> dict[tuple[int, int], np.ndarray]:
    """exp of a polynomial without a constant, by powers of its two variables up to so many."""
    one = np.ones_like(next(iter(exponent.values())))
    out: dict[tuple[int, int], np.ndarray] = {(0, 0): one}
    for n in range(1, powers + 1):
        for a in range(n + 1):
            # n e_n = sum of m E_m e_(n-m)
            out[a, n - a] = sum(
                (i + j) / n * e * out[a - i, n - a - j]
                for (i, j), e in exponent.items()
                if i <= a and j <= n - a
            )
    return out
