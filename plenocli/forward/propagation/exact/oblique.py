"""The main lens's field on a lenslet off the axis, in direction cosines about its chief ray.

From the pupil point xi to the place C + x on the array (C the lenslet's centre, rho0 = |C| with z2)
the path is that of the chief ray to C + x, which is kept exactly (lenslets.py), and what goes with
the pupil point: with s = (C - xi)/rho, ds = s - s0 and f(s; x) = (|x|^2 - (s.x)^2) s_z/(2 z2),

    psi(xi; x) = ds.x + f(s; x) - f(s0; x)  ~  ds.x + ds.A(x) + ds.B(x).ds/2,

A and B quadratic forms of x, the derivatives of f by s. The field of the point imaged at C + p is
the integral of P exp(j k [psi(xi; p + d) - psi(xi; p)]), d = x - p: no function of d alone, but one
that changes slowly with p. With h(d) of the linear part alone and its derivatives h_i, h_ij, which
stand for j k ds_i,

    F(d; p) = h + sum_i L_i h_i + sum_ij (L^B_ij/(2 j k) + L_i L_j/2) h_ij,
    L_i = A_i(d + p) - A_i(p) = A_i[d, d] + 2 A_i[d, p],

which ends with second powers of p. Blocks of such fields, one for each pair of powers of p's two
coordinates, are one matrix, whose singular vectors are functions of d and p along either axis.
docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.exact.debye import APODISATION, aperture_norm
from plenocli.forward.propagation.exact.low_rank_product import Product
from plenocli.forward.propagation.exact.prolate import prolate, prolate_count
from plenocli.forward.propagation.fresnel.spread_function import (
    SeparableField,
    legendre,
    psf_nodes,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

ORDERS = 3
"""Powers of a point's coordinates, 0 to 2, that its field goes with."""
SINGLE = 3e-5
"""Root energy that may be lost from which on single precision serves."""
ALIKE = 1e-5
"""Relative difference of fields that are mirror images but for the rounding of single precision."""
BAND = 1e-9
"""Root mean square that functions of the band of h may miss of it."""
SHARP = 1e-6
"""Blur of a point, in lenslets, below which it is in focus."""
SKETCH = 64
"""Columns of the first sketch of a field's singular vectors."""
SLAB = 1 << 20
"""Numbers in a slab of pupil nodes x field points."""


@dataclass(frozen=True, kw_only=True)
class ObliqueField(SeparableField):
    """F(d; p) = sum_j a_j(dy, py) b_j(dx, px), as SeparableField, each term a polynomial of the
    point: `rows`, `columns` are Legendre coefficients (degrees, order x term).

    scale: m, that powers of the point are counted in.
    """

    scale: float

    @property
    def terms(self) -> int:
        """Number of separable terms."""
        return self.rows.shape[1] // ORDERS


def orders_of(field: SeparableField) -> int:
    """Powers of the point that the terms of a field are made of, 1 on the axis."""
    return ORDERS if isinstance(field, ObliqueField) else 1


def at_points(field: SeparableField, values: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Terms of a field for points.

    values: (..., order x term) at displacements from them;
    points: m, broadcasting against the leading axes.

    Returns (..., term).
    """
    if not isinstance(field, ObliqueField):
        return values
    parts = values.reshape(*values.shape[:-1], ORDERS, -1)
    share = (points / field.scale)[..., None]
    return parts[..., 0, :] + share * (parts[..., 1, :] + share * parts[..., 2, :])


def oblique_field(
    camera: Camera, geometry: Geometry, half: float, tolerance: float
) -> ObliqueField:
    """The field on [-half, half]^2 about the image points of the lenslet at geometry.chief.

    half: m;
    tolerance: root energy that may be lost.

    Raises NumericsError as psf_nodes.
    """
    g, count = geometry, psf_nodes(geometry, half)
    t, w = gauss(count)
    scale = g.D2 / math.sqrt(12)
    (h, *moved), steepest = _linear_part(camera, g, half * t, tolerance)
    blocks = _by_powers(h, half, g.k * half * steepest, g)
    blocks[1, 0], blocks[0, 1] = (blocks[a] + b for a, b in zip(((1, 0), (0, 1)), moved))
    flips = tuple(g.chief[axis] == 0.0 and _same(h, np.flip(h, axis)) for axis in (0, 1))
    turn = g.chief[0] == g.chief[1] and _same(h, h.T)
    root = np.sqrt(w * half)
    zero = np.zeros_like(blocks[0, 0])
    matrix = np.block(
        [
            [
                blocks.get((a, b), zero) * (root[:, None] * root * scale ** (a + b))
                for b in range(ORDERS)
            ]
            for a in range(ORDERS)
        ]
    )
    unit = np.eye(len(matrix), dtype=matrix.dtype)
    factors = Product([matrix], [unit], {(0, 0): unit}, False).factors(tolerance, SKETCH)
    project = legendre(t, count, 1).T * w * ((2 * np.arange(count) + 1) / 2)[:, None]
    rows, columns = (
        np.hstack([project @ (part / root[:, None]) for part in np.split(factor, ORDERS)])
        for factor in factors
    )
    return ObliqueField(
        half=half,
        rows=rows,
        columns=columns,
        even=False,
        symmetry=(*flips, turn),
        tail=tolerance,
        scale=scale,
    )


def neglected(geometry: Geometry) -> float:
    """Estimated relative L2 error of the worst column by what F leaves out, 0 on the axis.

    Third powers of places on the lenslet in the path, k T x^3/z2^2 with T the tangent at the
    pupil's rim, and of the phase that goes with the point, k T x^2 s/z2.

    Returns a number, 1 to 7 times what was found in 40 cases (f/2.2 to f/11, 1 to 22 degrees, z2
    of 1.5 to 40 mm, blur over up to one lenslet, gaps) where that was above 1e-5.
    """
    g = geometry
    if g.chief == (0.0, 0.0):
        return 0.0
    half = g.D2 / 2
    slope = g.k * g.D1 / (2 * g.z2)
    turned = slope * half**2 * math.sin(g.obliquity) / g.z2
    dim = 1 + 3 * (1 - g.lenslet_width / g.D2)
    return dim * (1.2 * slope * half**3 / g.z2**2 + 3 * turned**3)


def _same(one: np.ndarray, other: np.ndarray) -> bool:
    return bool(np.linalg.norm(one - other) < ALIKE * np.linalg.norm(one))


def _linear_part(
    camera: Camera, geometry: Geometry, d: np.ndarray, tolerance: float
) -> tuple[np.ndarray, float]:
    """(h, h_0, h_1) (3, len(d), len(d)), 1/m, at displacements d (m) along either axis: the
    integral of P exp(j k ds.d) over the pupil, and of that times what a point's wave out of focus
    changes by with its place along either axis, 1/m; and the largest direction cosine ds along an
    axis.
    """
    g, lens = geometry, camera.main_lens
    single, blurred = tolerance > SINGLE, g.blur > SHARP * g.D2
    real = np.dtype(np.float32 if single else np.float64)
    total = np.zeros((3, len(d), len(d)), np.complex64 if single else complex)
    steepest = 0.0
    for rows in pupil_rows(camera, g, g.k * math.sqrt(2) * np.abs(d).max() / g.z2):
        y, x = np.broadcast_to(rows.y[:, None], rows.x.shape).ravel(), rows.x.ravel()
        r2 = y * y + x * x
        cos2 = g.z2**2 / (g.z2**2 + r2)
        here, image = (_Sphere(g, q, y, x) for q in (1 / g.z2, 1 / g.z2 - g.eps))
        # pupil_rows has the paraxial defocus; the difference of the two spheres takes its place
        weight = rows.weight.ravel() * np.exp(1j * g.k * (here.path - image.path - g.eps * r2 / 2))
        weight *= APODISATION[lens.apodisation](cos2) * cos2 / (g.z2 * here.far) ** 2
        steepest = max(steepest, *(float(np.abs(s).max()) for s in here.sines))
        parts = [weight]
        if blurred:
            parts += [1j * g.k * weight * (s - t) for s, t in zip(here.sines, image.sines)]
        step = max(1, SLAB // len(d))
        for start in range(0, len(weight), step):
            some = slice(start, start + step)
            left, right = (
                _waves(g.k / (2 * np.pi) * np.outer(s[some], d), real) for s in here.sines
            )
            for out, part in zip(total, parts):
                out += (left * part[some, None].astype(left.dtype)).T @ right
    norm = g.wavelength * math.sqrt(aperture_norm(lens, g))
    return total.astype(complex) / norm, steepest


class _Sphere:
    """A sphere about a point of the chief ray, its distance 1/q from the pupil.

    y, x: (node,) pupil points, m;
    far: of them from it, over its own distance along the axis;
    path: (node,) m, by which they are farther from it than the pupil's centre is;
    sines: [(node,), (node,)] by how much the direction cosines from them to it differ from the
        chief ray's, for places on the array (over q z2).
    """

    def __init__(self, geometry: Geometry, q: float, y: np.ndarray, x: np.ndarray) -> None:
        ty, tx = (c / geometry.z2 for c in geometry.chief)
        middle = math.sqrt(1 + ty * ty + tx * tx)
        self.far = np.sqrt(1 + (ty - q * y) ** 2 + (tx - q * x) ** 2)
        # differences of squares, over q, so that nothing cancels and q may be 0
        apart = (q * (y * y + x * x) - 2 * (ty * y + tx * x)) / (self.far + middle)
        self.path = apart
        self.sines = [
            -(a * middle + t * apart) / (self.far * middle * geometry.z2)
            for a, t in ((y, ty), (x, tx))
        ]


def _waves(turns: np.ndarray, real: np.dtype) -> np.ndarray:
    """exp(2 pi j turns), complex numbers of parts `real`; `turns` is overwritten."""
    turns -= np.rint(turns)
    phase = (2 * np.pi * turns).astype(real)
    out = np.empty(phase.shape, np.result_type(real, np.complex64))
    out.real, out.imag = np.cos(phase), np.sin(phase)
    return out


def _by_powers(
    h: np.ndarray, half: float, phase: float, geometry: Geometry
) -> dict[tuple[int, int], np.ndarray]:
    """F(d; p) on Gauss nodes of [-half, half] by powers (of p's row, of its column): {(a, b):
    as h}.

    phase: rad over half, that the steepest wave of h runs through.
    """
    g = geometry
    slope, bend = _forms(g)
    t, w = gauss(len(h))
    d = half * t
    # in functions of its own band derivatives do not raise what single precision rounds
    value = prolate(t, phase, min(prolate_count(phase, BAND), len(t)))
    steps = _differentiation(d)
    slopes = steps @ value
    curves = steps @ slopes
    project = value.T * w
    h = project @ h @ project.T
    first = [slopes @ h @ value.T, value @ h @ slopes.T]
    both = slopes @ h @ slopes.T
    second = [[curves @ h @ value.T, both], [both, value @ h @ curves.T]]
    h = value @ h @ value.T
    place = np.broadcast_to(d[:, None], h.shape), np.broadcast_to(d, h.shape)

    def form(m: np.ndarray) -> np.ndarray:
        return m[0, 0] * place[0] ** 2 + 2 * m[0, 1] * place[0] * place[1] + m[1, 1] * place[1] ** 2

    def beside(m: np.ndarray, a: int) -> np.ndarray:
        return 2 * (m[a, 0] * place[0] + m[a, 1] * place[1])

    whole = [form(m) for m in slope]
    mixed = [[beside(m, a) for a in (0, 1)] for m in slope]
    found: dict[tuple[int, int], np.ndarray] = {(0, 0): h.copy()}
    # the amplitude 1/R^2 of a pupil point, against that of the chief ray
    nearer = -2 / (1j * g.k * math.hypot(g.z2, *g.chief))
    for i in (0, 1):
        found[0, 0] += (whole[i] + nearer * place[i]) * first[i]
    for a in (0, 1):
        found[1 - a, a] = mixed[0][a] * first[0] + mixed[1][a] * first[1] + nearer * first[a]
    for i in (0, 1):
        for j in (0, 1):
            curved = bend[i][j] / (2j * g.k)
            found[0, 0] += (form(curved) + whole[i] * whole[j] / 2) * second[i][j]
            for a in (0, 1):
                found[1 - a, a] += (beside(curved, a) + whole[i] * mixed[j][a]) * second[i][j]
                for b in (0, 1):
                    power = (2 - a - b, a + b)
                    found[power] = found.get(power, 0) + (
                        mixed[i][a] * mixed[j][b] / 2 * second[i][j]
                    )
    return found


def _forms(geometry: Geometry) -> tuple[list[np.ndarray], list[list[np.ndarray]]]:
    """(A, B): first and second derivatives by s of (|x|^2 - (s.x)^2) s_z/(2 z2) at the chief ray,
    as 2x2 matrices of quadratic forms of x, 1/m.
    """
    g = geometry
    s = np.array(g.chief) / math.sqrt(g.z2**2 + g.chief[0] ** 2 + g.chief[1] ** 2)
    upright = math.sqrt(1 - s @ s)
    unit = np.eye(2)
    across = unit - np.outer(s, s)
    along = [np.outer(s, e) + np.outer(e, s) for e in unit]
    slope = [(-upright * along[i] - across * s[i] / upright) / (2 * g.z2) for i in (0, 1)]
    bend = [
        [
            (
                -upright * (np.outer(unit[i], unit[j]) + np.outer(unit[j], unit[i]))
                + (along[i] * s[j] + along[j] * s[i]) / upright
                - across * (unit[i, j] / upright + s[i] * s[j] / upright**3)
            )
            / (2 * g.z2)
            for j in (0, 1)
        ]
        for i in (0, 1)
    ]
    return slope, bend


def _differentiation(d: np.ndarray) -> np.ndarray:
    """The matrix that differentiates polynomials given on the nodes d, by barycentric weights."""
    gap = d[:, None] - d
    np.fill_diagonal(gap, 1.0)
    size = np.log(np.abs(gap)).sum(axis=1)
    sign = np.where(np.arange(len(d)) % 2, -1.0, 1.0)
    ratio = np.exp(size[:, None] - size) * np.outer(sign, sign)
    out = ratio / gap
    np.fill_diagonal(out, 0.0)
    np.fill_diagonal(out, -out.sum(axis=1))
    return out
