"""What is left of an exact kernel, from a lenslet to a superpixel displaced by (cy, cx) from it,
when its separable part is taken out: kappa, what the two axes do together. With the same of a
hyperbolic lens, on all displacements d = c + u - x,

    kappa(dy, dx) ell(y, x) = sum_rs P_r(u_y, y) C_rs Q_s(u_x, x).

docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.fresnel.spread_function import legendre, terms_within

if TYPE_CHECKING:
    from numpy.typing import DTypeLike

SLAB = 1 << 22
"""Numbers in a slab of displacements x polynomials."""
AxisFunctions = Callable[[np.ndarray], np.ndarray]
"""Values (place, term) at places (m, or shares of a half width) along one axis."""


def path(d: np.ndarray, z: float, own: float = 0.0, other: float = 0.0) -> np.ndarray:
    """One axis's part of the path R - z, without cancellation.

    path(dy, z, cy, cx) + path(dx, z, cx, cy) is R - z wherever dy = cy or dx = cx; about the centre
    0 it is sqrt(z^2 + d^2) - z.

    d: displacements along the axis, m;
    z: distance of the planes, m;
    own, other: centre along this axis and the other, m.

    Returns m, of the shape of d.
    """
    middle = np.sqrt(z * z + own * own + other * other)
    return (d * d - own * own) / (np.sqrt(z * z + d * d + other * other) + middle) + (
        own * own + other * other
    ) / (2 * (middle + z))


def kappa(
    dy: np.ndarray, dx: np.ndarray, z: float, k: float, centre: tuple[float, float] = (0.0, 0.0)
) -> np.ndarray:
    """The residual of the kernel: what its two axes do together.

    dy, dx: displacements, m, broadcasting;
    z: distance of the planes, m;
    k: wave number, 1/m;
    centre: displacement (rows, columns) about which it is taken, m.

    Returns complex numbers.
    """
    r = np.sqrt(z * z + dy * dy + dx * dx)
    together = np.exp(1j * k * cross_path(dy, dx, z, centre))
    return together * (z / r) ** 2 * (1 + 1j / (k * r))


def cross_path(dy: np.ndarray, dx: np.ndarray, z: float, centre: tuple[float, float]) -> np.ndarray:
    """What of the path R the two axes do together, without cancellation.

    dy, dx: displacements, m, broadcasting;
    z: distance of the planes, m;
    centre: displacement (rows, columns) about which it is taken, m.

    Returns m: R less its values along the lines dy = cy and dx = cx, 0 on both.
    """
    cy, cx = centre
    r, row, column, middle = (
        np.sqrt(z * z + a * a + b * b) for a, b in ((dy, dx), (dy, cx), (cy, dx), (cy, cx))
    )
    # (R - R(dy, cx)) - (R(cy, dx) - R(cy, cx)): differences of squares, and of two
    # numbers that differ much
    return (dx * dx - cx * cx) * (1 / (r + row) - 1 / (column + middle))


def ell(y: np.ndarray, x: np.ndarray, f: float, k: float) -> np.ndarray:
    """The residual of a hyperbolic lens.

    y, x: m from its centre, broadcasting;
    f: focal length, m;
    k: wave number, 1/m.

    Returns complex numbers.
    """
    q = y * y + x * x
    r = np.sqrt(f * f + q) + f
    psi = y * y * (1 / r - 1 / (np.sqrt(f * f + y * y) + f)) + x * x * (
        1 / r - 1 / (np.sqrt(f * f + x * x) + f)
    )
    return np.exp(-1j * k * psi)


@dataclass(frozen=True)
class ObliqueWave:
    """The sphere of a chief ray that comes off the axis, on a lenslet.

    z: distance of the pupil, m;
    chief: where the ray meets the array, (rows, columns) m from the axis;
    lenslet: the lenslet's centre, likewise.
    """

    z: float
    chief: tuple[float, float]
    lenslet: tuple[float, float]

    def together(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Path (m) that the two axes have together at y, x (m, broadcasting) from the lenslet's
        centre.
        """
        return cross_path(self.lenslet[0] + y, self.lenslet[1] + x, self.z, self.chief)


class Residual:
    """kappa ell between a lenslet and the superpixel displaced by `centre` (rows,
    columns, m) from it.

    reach_u, reach_x: half widths (m) of superpixel and lenslet;
    f: focal length of a hyperbolic lens, or None for a parabolic one, which is separable;
    tolerance: root mean square of what may be left out;
    symmetric: one set of functions for both axes, which takes a centre on the diagonal;
    come: the main lens's wave off the axis, whose axes do something together too; None on it.
    core: C;
    lost: root mean square that is left out.
    """

    def __init__(
        self,
        centre: tuple[float, float],
        reach_u: float,
        reach_x: float,
        z: float,
        k: float,
        f: float | None,
        tolerance: float,
        symmetric: bool = False,
        come: ObliqueWave | None = None,
    ) -> None:
        self.centre, self.reach_u, self.reach_x = centre, reach_u, reach_x
        reach = reach_u + reach_x
        slopes = _slopes(centre, reach, z, k)
        # nodes weigh alike, which favours the edges of the lenslet, where a point's
        # column is most sensitive
        t, s = (gauss(_nodes(slope))[0] for slope in slopes)
        whole = kappa(centre[0] + reach * t[:, None], centre[1] + reach * s, z, k, centre)
        whole /= np.sqrt(whole.size)
        left, core, right = split(whole, tolerance / 4, symmetric)
        lost = np.linalg.norm(whole - left @ core @ right.T)
        lens_left, lens_core, lens_right, lens_slope = _lens_terms(
            reach_x, f, k, tolerance / 4, come, symmetric
        )
        self._grids = [
            (
                gauss(_nodes(slope * reach_u / reach))[0],
                gauss(_nodes(slope * reach_x / reach + lens_slope))[0],
            )
            for slope in slopes
        ]
        products: list[np.ndarray] = []
        roots: list[np.ndarray] = []
        for axis, (nodes, basis, lens) in enumerate(((t, left, lens_left), (s, right, lens_right))):
            if axis and symmetric:
                products, roots = products * 2, roots * 2
                break
            gu, gx = self._grids[axis]
            series = _series(nodes) @ (basis * np.sqrt(len(nodes)))
            values = np.empty((len(gu), len(gx), 1, series.shape[1]), series.dtype)
            slab = max(1, SLAB // (len(gx) * len(nodes)))
            for start in range(0, len(gu), slab):
                d = (reach_u * gu[start : start + slab, None] - reach_x * gx) / reach
                values[start : start + slab, :, 0] = (
                    legendre(d.ravel(), len(nodes), 1) @ series
                ).reshape(*d.shape, -1)
            values = values * lens(gx)[:, :, None]
            q, r = np.linalg.qr(values.reshape(len(gu) * len(gx), -1) / np.sqrt(len(gu) * len(gx)))
            products.append(q)
            roots.append(r)
        both = roots[0] @ np.kron(lens_core, core) @ roots[1].T
        left, self.core, right = split(both, tolerance, symmetric)
        self.lost = math.hypot(lost, np.linalg.norm(both - left @ self.core @ right.T))
        self._values = []
        for axis, basis in ((0, left), (1, right)):
            gu, gx = self._grids[axis]
            self._values.append(
                (products[axis] @ basis * np.sqrt(len(gu) * len(gx))).T.reshape(
                    -1, len(gu), len(gx)
                )
            )

    def functions(
        self, axis: int, u: np.ndarray, x: np.ndarray, dtype: DTypeLike = complex
    ) -> np.ndarray:
        """The functions of one axis: P_r (axis 0) or Q_s (axis 1).

        u, x: positions on sensor and lenslet, m from their centres;
        dtype: complex, of what is returned.

        Returns (term, len(u), len(x)).
        """
        values = np.ascontiguousarray(self._values[axis], dtype)
        real = values.real.dtype
        rows, columns = (
            (legendre(place / reach, len(grid), 1) @ _series(grid)).astype(real)
            for place, reach, grid in zip((u, x), (self.reach_u, self.reach_x), self._grids[axis])
        )
        # real by complex, which would be a product of complex numbers, is two of real ones
        wide = (rows @ values.view(real)).view(values.dtype)
        both = np.concatenate([wide.real, wide.imag], axis=1) @ columns.T
        out = np.empty((len(values), len(u), len(x)), values.dtype)
        out.real, out.imag = np.split(both, 2, axis=1)
        return out


def split(
    matrix: np.ndarray, tolerance: float, symmetric: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A matrix as a short product A K B^T.

    tolerance: root sum of squares that may be lost;
    symmetric: whether the matrix is, and A = B is wanted.

    Returns (A, K, B), A and B of orthonormal columns; K is diagonal, or where `symmetric` as nearly
    so as equal singular values allow.
    """
    u, s, vh = np.linalg.svd(matrix, full_matrices=False)
    terms = terms_within(s, tolerance)
    u = u[:, :terms]
    if symmetric:
        return u, u.conj().T @ matrix @ u.conj(), u
    return u, np.diag(s[:terms]), vh[:terms].T


def _lens_terms(
    reach_x: float,
    f: float | None,
    k: float,
    tolerance: float,
    come: ObliqueWave | None,
    symmetric: bool,
) -> tuple[AxisFunctions, np.ndarray, AxisFunctions, float]:
    """What the lens, and the oblique wave of a chief ray, do along both axes together: functions of
    y and of x, their core, and the phase (rad) that they run through per half width.
    """
    slope = 0.0 if f is None else k * f * (reach_x / f) ** 4 / 2
    if come is not None:
        rim = reach_x * np.linspace(-1, 1, 5)
        # a path that is all but a product is steepest at its corners
        slope += k * 2 * np.ptp(come.together(rim[:, None], rim))
    t, _ = gauss(_nodes(slope))
    y, x = reach_x * t[:, None], reach_x * t
    matrix = np.ones((len(t), len(t))) / len(t)
    if come is not None:
        matrix = matrix * np.exp(1j * k * come.together(y, x))
    if f is not None:
        matrix = matrix * ell(y, x, f, k)
    left, core, right = split(matrix, tolerance, symmetric or come is None)
    series = [_series(t) @ (basis * np.sqrt(len(t))) for basis in (left, right)]

    def functions(coefficients: np.ndarray) -> AxisFunctions:
        return lambda grid: legendre(grid, len(t), 1) @ coefficients

    return functions(series[0]), core, functions(series[1]), slope


def residual_nodes(centre: tuple[float, float], reach: float, z: float, k: float) -> int:
    """Nodes along an axis of the matrix whose terms a Residual has.

    centre, z, k: as of Residual;
    reach: half widths of superpixel and lenslet together, m.
    """
    return max(map(_nodes, _slopes(centre, reach, z, k)))


def _slopes(centre: tuple[float, float], reach: float, z: float, k: float) -> list[float]:
    return [_slope(own, other, reach, z, k) for own, other in (centre, centre[::-1])]


def _slope(own: float, other: float, reach: float, z: float, k: float) -> float:
    """Largest phase (rad) of kappa per half span along the axis with the centre `own`."""
    d, e = own + reach * np.linspace(-1, 1, 9)[:, None], other + reach * np.array([-1.0, 1.0])
    return (
        k
        * reach
        * np.abs(
            d / np.sqrt(z * z + d * d + e * e) - d / np.sqrt(z * z + d * d + other * other)
        ).max()
    )


def _nodes(slope: float) -> int:
    """Gauss-Legendre nodes that carry a function whose phase changes by `slope`
    rad per half span.
    """
    return int(np.ceil(slope + 5 * np.cbrt(slope) + 12))


def _series(t: np.ndarray) -> np.ndarray:
    """Legendre coefficients from values on the Gauss nodes t."""
    w = gauss(len(t))[1]
    degrees = np.arange(len(t))
    return legendre(t, len(t), 1).T * w * ((2 * degrees + 1) / 2)[:, None]
