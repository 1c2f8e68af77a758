"""The main lens's coherent spread function at the lenslet array, as a short sum of separable terms.

A point imaged at xp has the field exp(j k |x|^2/(2 z2)) h(x - xp) on the array, with

    h(d) = 1/(lambda z2 sqrt(S)) * integral of P(xi) exp(-j k xi.d/z2) over the pupil,
    S the aperture's area,

so h depends on x - xp only and the integral of |h|^2 over the plane is the share of the light that
the filters pass. A singular value decomposition on Gauss-Legendre nodes turns h(dy, dx) into sum_j
a_j(dy) b_j(dx); the a_j, b_j are band-limited (the pupil is finite), so their Legendre series carry
them to any other point.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.pupil import aperture_area
from plenocli.forward.camera.pupil_quadrature import pupil_rows
from plenocli.forward.camera.quadrature import Rows, gauss, nodes_for
from plenocli.forward.propagation.fresnel.radial import is_radial, radial_field

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

MAX_NODES = 4000
"""Beyond this many nodes per axis the wave model costs minutes a wavelength, and rays
answer the question.
"""
EDGE = 2.0
"""Extra weight of points at a lenslet's edge in what is left out."""
MOMENTS = 1 << 19
"""Numbers in a slab of pupil nodes x polynomials."""
BASIS_POINTS = 1 << 11
"""Positions at which the series are summed together: the basis of a slab stays in the cache."""


@dataclass(frozen=True, kw_only=True)
class SeparableField:
    """h(dy, dx) = sum_j a_j(dy) b_j(dx) for |dy|, |dx| <= `half`.

    `rows`, `columns`: Legendre coefficients (degrees, terms) of a_j and b_j, real where h is;
    `even`: only even degrees are stored.
    `symmetry`: (flip rows, flip columns, transpose) under which h does not change;
    `tail`: root energy of what was cut;
    `signs`: (terms,) of +-1 where b_j is that times a_j, else None.
    """

    half: float
    rows: np.ndarray
    columns: np.ndarray
    even: bool
    symmetry: tuple
    tail: float
    signs: np.ndarray | None = None

    @property
    def terms(self) -> int:
        """Number of separable terms."""
        return self.rows.shape[1]

    def evaluate(self, d: np.ndarray, axis: int) -> np.ndarray:
        """Terms of h along one axis.

        d: positions, m, of any shape;
        axis: 0 for a_j, 1 for b_j.

        Returns (*d.shape, term), complex, or real where h is, in the precision of the coefficients.
        """
        coefficients = self.columns if axis else self.rows
        return legendre_sum(np.asarray(d, float) / self.half, coefficients, 2 if self.even else 1)


def legendre(t: np.ndarray, count: int, step: int) -> np.ndarray:
    """Legendre polynomials of degrees 0, step, 2 step, ...

    t: (place,) in [-1, 1];
    count: how many.

    Returns (place, count).
    """
    out = np.empty((count, len(t)))
    previous, current, scaled = np.zeros_like(t), np.ones_like(t), np.empty_like(t)
    for degree in range((count - 1) * step + 1):
        if degree % step == 0:
            out[degree // step] = current
        np.multiply(t, (2 * degree + 1) / (degree + 1), out=scaled)
        scaled *= current
        previous *= -degree / (degree + 1)
        previous += scaled
        previous, current = current, previous
    return out.T


def legendre_sum(t: np.ndarray, coefficients: np.ndarray, step: int = 1) -> np.ndarray:
    """Sums of Legendre polynomials of degrees 0, step, 2 step, ...

    t: places in [-1, 1], of any shape;
    coefficients: (degree, sum), real or complex, in whose precision sums are made.

    Returns (*t.shape, sum), of the type of the coefficients.
    """
    coefficients = np.ascontiguousarray(coefficients)
    places, parts = t.ravel(), coefficients.view(coefficients.real.dtype)
    out = np.empty((len(places), parts.shape[1]), parts.dtype)
    for start in range(0, len(places), BASIS_POINTS):
        part = slice(start, start + BASIS_POINTS)
        basis = legendre(places[part], len(coefficients), step).astype(parts.dtype, copy=False)
        np.matmul(basis, parts, out=out[part])
    return out.view(coefficients.dtype).reshape(*t.shape, -1)


def carried(fine: int, few: int) -> np.ndarray:
    """What carries values at few Gauss-Legendre nodes onto fine ones, times the weights of these.

    fine, few: nodes on [-1, 1], on which polynomials of degrees below `few` are known.

    Returns (fine node, node of few).
    """
    (t, w), (tf, wf) = gauss(few), gauss(fine)
    degrees = np.arange(few) + 0.5
    return wf[:, None] * ((legendre(tf, few, 1) * degrees) @ (legendre(t, few, 1).T * w))


def psf_nodes(geometry: Geometry, half: float) -> int:
    """Gauss-Legendre nodes per axis that resolve h on [-half, half], an even number.

    half: m.

    Raises NumericsError for more than MAX_NODES.
    """
    # the functions are interpolated, not only integrated: a few degrees more than
    # the integration rule
    count = nodes_for(2 * geometry.k * geometry.D1 / 2 * half / geometry.z2) + 14
    if count > MAX_NODES:
        raise NumericsError(
            f"the field on the array needs {count} nodes per axis, more than {MAX_NODES}",
            "main_lens and lenslet_array",
            "take fewer superpixels, a longer wavelength or a slower lens",
        )
    return count + count % 2


def sampled_field(camera: Camera, geometry: Geometry, dy: np.ndarray, dx: np.ndarray) -> np.ndarray:
    """The paraxial spread function on a grid, by quadrature over the pupil.

    dy, dx: m.

    Returns h (len(dy), len(dx)), 1/m, real where a radial pupil makes it so.
    docs/model.md, "From a point to the lenslet array".
    """
    if is_radial(camera):
        return radial_field(camera, geometry, dy, dx)
    k, z2 = geometry.k, geometry.z2
    reach = math.hypot(np.abs(dy).max(), np.abs(dx).max())
    total = np.zeros((len(dy), len(dx)), complex)
    for rows in pupil_rows(camera, geometry, k * reach / z2):
        half = len(rows.y) // 2
        if half and len(rows.y) % 2 == 0 and mirrored(rows.y, rows.x, rows.weight, 0):
            upper = Rows(rows.y[half:], rows.x[half:], rows.weight[half:])
            total += (2 * np.cos(k / z2 * np.outer(dy, upper.y))) @ _row_transforms(
                upper, k / z2 * dx
            )
        else:
            total += np.exp(-1j * k / z2 * np.outer(dy, rows.y)) @ _row_transforms(
                rows, k / z2 * dx
            )
    return total / (geometry.wavelength * z2 * math.sqrt(aperture_area(camera.main_lens)))


def mirrored(y: np.ndarray, x: np.ndarray, weight: np.ndarray, axis: int) -> bool:
    """Whether a quadrature rule is symmetric about its middle.

    y: (row,), x: (row, node), weight: (row, node) of the rule;
    axis: 0 for the middle of its rows, 1 for that of its nodes.
    """
    if axis == 0:
        return np.allclose(y, -y[::-1], rtol=0, atol=1e-14 * np.abs(y).max()) and np.allclose(
            weight, weight[::-1], rtol=1e-12, atol=0
        )
    return np.allclose(x, -x[:, ::-1], rtol=0, atol=1e-14 * np.abs(x).max()) and np.allclose(
        weight, weight[:, ::-1], rtol=1e-12, atol=0
    )


def _row_transforms(rows: Rows, frequency: np.ndarray) -> np.ndarray:
    """sum_i weight[m, i] exp(-j frequency[n] x[m, i]): (rows, len(frequency)). A few nodes across
    all rows carry the waves, and each row is brought onto these by its Legendre moments; symmetric
    rows have even ones alone, of half of them.
    """
    if rows.x.strides[0] == 0:  # a grid of nodes: one matrix product
        return rows.weight @ np.exp(-1j * np.outer(rows.x[0], frequency))
    low, high = rows.x.min(), rows.x.max()
    middle, half = (low + high) / 2, max((high - low) / 2, np.finfo(float).tiny)
    even = mirrored(rows.y, rows.x, rows.weight, 1)
    # a node in the middle is nobody's mirror image
    first, twice = rows.x.shape[1] // 2 * even, np.ones(rows.x.shape[1])
    twice[(rows.x.shape[1] + 1) // 2 :] += even
    x, weight = (a[:, first:] for a in ((rows.x - middle) / half, rows.weight * twice))
    parts = np.stack([weight.real, weight.imag], -1)
    bend = half * np.abs(frequency).max()
    step, count = 1 + int(even), math.ceil(bend + 6 * math.cbrt(bend) + 16)
    nodes, weights = gauss(count)
    onto = legendre(nodes, -(-count // step), step)
    onto *= (step * np.arange(onto.shape[1]) + 0.5) * weights[:, None]
    moments = np.empty((len(x), onto.shape[1]), complex)
    slab = max(1, MOMENTS // (x.shape[1] * count))
    for start in range(0, len(x), slab):
        some = x[start : start + slab]
        values = legendre(some.ravel(), onto.shape[1], step).T.reshape(-1, *some.shape)
        seen = values.transpose(1, 0, 2) @ parts[start : start + slab]
        moments[start : start + slab] = seen.view(complex)[..., 0]
    return moments @ onto.T @ np.exp(-1j * np.outer(middle + half * nodes, frequency))


def edge_emphasis(geometry: Geometry, points: np.ndarray) -> np.ndarray:
    """Weights of points in what is left out: those at the lenslet's edge lose light and split it,
    so that the same error would be a larger share of their columns.

    points: (point,) m on the array, along one axis.

    Returns (point,).
    """
    g = geometry
    return 1 + EDGE * np.exp((np.abs(points) - g.D2 / 2) * g.D1 / (g.wavelength * g.z2))


def separable_field(
    camera: Camera,
    geometry: Geometry,
    half: float,
    tolerance: float,
    sample: Callable[..., np.ndarray] = sampled_field,
) -> SeparableField:
    """The spread function on [-half, half]^2 as a short sum of products.

    half: m;
    tolerance: root energy that may be lost;
    sample: what computes h on a grid, sampled_field (paraxial) or debye.spherical_field.

    Raises NumericsError as psf_nodes.
    docs/model.md, "From a point to the lenslet array".
    """
    count = psf_nodes(geometry, half)
    t, w = gauss(count)
    h = sample(camera, geometry, half * t, half * t)
    scale = np.abs(h).max()
    if scale == 0:
        empty = np.zeros((1, 1))
        return SeparableField(
            half=half,
            rows=empty,
            columns=empty,
            even=False,
            symmetry=(True, True, True),
            tail=0.0,
        )
    same = [np.abs(h - other).max() < 1e-10 * scale for other in (h[::-1], h[:, ::-1], h.T)]
    even = bool(same[0] and same[1])
    if even:
        t, w, h = t[count // 2 :], 2 * w[count // 2 :], h[count // 2 :, count // 2 :]
    if np.abs(h.imag).max() < 1e-13 * scale:
        h = h.real
    root = np.sqrt(w * half)
    u, s, v, signs = _factors(root[:, None] * h * root, same[2])
    terms = terms_within(s, tolerance)
    s_root = np.sqrt(s[:terms])
    a = u[:, :terms] * s_root / root[:, None]
    b = a if v is None else v[:terms].T * s_root / root[:, None]
    tail = float(np.linalg.norm(s[terms:]))
    step = 2 if even else 1
    project = legendre(t, len(t), step).T * w * ((2 * step * np.arange(len(t)) + 1) / 2)[:, None]
    rows = project @ a
    signs = None if signs is None else signs[:terms]
    columns = project @ b if signs is None else rows * signs
    return SeparableField(
        half=half,
        rows=rows,
        columns=columns,
        even=even,
        symmetry=(bool(same[0]), bool(same[1]), bool(same[2])),
        tail=tail,
        signs=signs,
    )


def terms_within(
    values: np.ndarray, tolerance: float | np.ndarray, rest: float | np.floating = 0.0
) -> int:
    """How many singular values it takes to lose no more than a tolerance, one at the least.

    values: (value,), the largest first;
    tolerance: root sum of squares, one number or one for each number of terms;
    rest: root sum of squares that is lost in any case.
    """
    tails = np.sqrt(np.cumsum(values.astype(float)[::-1] ** 2)[::-1] + rest**2)
    return max(1, int(np.count_nonzero(tails > tolerance)))


def _factors(
    matrix: np.ndarray, symmetric: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Singular value decomposition u, s, v of a square matrix; for a real symmetric one also the
    signs with v^T = u * signs.
    """
    if not symmetric or np.iscomplexobj(matrix):
        return *np.linalg.svd(matrix), None
    values, u = np.linalg.eigh((matrix + matrix.T) / 2)
    order = np.argsort(-np.abs(values), kind="stable")
    return u[:, order], np.abs(values[order]), None, np.where(values[order] < 0, -1.0, 1.0)
