"""What is left of an exact kernel when its separable part is taken out, as a short sum of products.

Rayleigh and Sommerfeld's first kernel from the array to the sensor (docs/model.md, "Exact propagation") is

    K = z/(j lambda R^2) (1 + j/(k R)) exp(j k (R - z)) = exp(j k phi(dx)) exp(j k phi(dy)) kappa(dx, dy)/(j lambda z),

R^2 = z^2 + dx^2 + dy^2, phi(d) = d^2/(sqrt(z^2 + d^2) + z) the exact path of one axis. kappa differs from 1 by a phase of
about -k dx^2 dy^2/(4 z^3); a lens of hyperbolic profile leaves an ell(x, y) of the same form. Their product on the
displacements d = offset + u - x that occur between a lenslet and a superpixel is

    kappa(dy, dx) ell(y, x) = sum_rs P_r(u_y, y) C_rs P_s(u_x, x)

with one set of functions P for each offset, by singular value decompositions.
"""

import numpy as np

from plenocli.optics.psf import legendre
from plenocli.optics.quadrature import gauss


def path(d, z):
    """sqrt(z^2 + d^2) - z without cancellation."""
    return d * d / (np.sqrt(z * z + d * d) + z)


def kappa(dy, dx, z, k):
    """The residual of the kernel at displacements dy, dx (m) over the distance z (m)."""
    q = dy * dy + dx * dx
    r = np.sqrt(z * z + q)
    # (R - z) - phi(dy) - phi(dx), each term without cancellation, is small: their difference is taken in one expression
    ry, rx = np.sqrt(z * z + dy * dy) + z, np.sqrt(z * z + dx * dx) + z
    psi = dy * dy * (1 / (r + z) - 1 / ry) + dx * dx * (1 / (r + z) - 1 / rx)
    return np.exp(1j * k * psi) * (z / r) ** 2 * (1 + 1j / (k * r))


def ell(y, x, f, k):
    """The residual of a hyperbolic lens of focal length f (m) at (y, x) from its centre."""
    q = y * y + x * x
    r = np.sqrt(f * f + q) + f
    psi = y * y * (1 / r - 1 / (np.sqrt(f * f + y * y) + f)) + x * x * (1 / r - 1 / (np.sqrt(f * f + x * x) + f))
    return np.exp(-1j * k * psi)


MAX_GRID = 96
"""Nodes along u and x that carry the functions P: half of the displacements' span each."""


class Residuals:
    """kappa ell for all pairs of `offsets` (m) along the two axes.

    offsets: displacement of a superpixel's centre from a lenslet's, one per interval; reach_u, reach_x: half widths (m) of
    superpixel and lenslet; weights: share of the field amplitude that an offset carries, which scales what may be left out;
    f: focal length of a hyperbolic lens, or None for a parabolic one, which is separable.
    """

    def __init__(self, offsets, weights, reach_u, reach_x, z, k, f, tolerance):
        self.offsets, self.z, self.k, self.f = np.asarray(offsets, float), z, k, f
        self.reach_u, self.reach_x, self.reach = reach_u, reach_x, reach_u + reach_x
        weights = np.asarray(weights, float)
        nodes = _nodes(np.abs(self.offsets).max() + self.reach, self.reach, z, k)
        t, _ = gauss(nodes)
        # nodes weigh alike, which favours the edges of the lenslet, where a point's column is most sensitive
        d = self.offsets[:, None] + self.reach * t
        blocks = {(a, b): kappa(d[a][:, None], d[b], z, k) / nodes for a in range(len(d)) for b in range(len(d))}
        count = range(len(d))
        bases = [_left(np.hstack([weights[a] * weights[b] * blocks[a, b] for b in count]), tolerance / 4) for a in count]
        core = {(a, b): bases[a].conj().T @ blocks[a, b] @ bases[b].conj() for a, b in blocks}
        self._series = [_series(t) @ (basis * np.sqrt(nodes)) for basis in bases]
        lens, lens_core = self._lens_terms(reach_x, tolerance)
        self._grid, _ = gauss(min(nodes, MAX_GRID))
        sampled = [self._products(a, lens) for a in count]
        full, self._values, into = {(a, b): np.kron(lens_core, core[a, b]) for a, b in core}, [], []
        grams = [_gram_root(columns) for columns in sampled]
        for a in count:
            u, s, vh = np.linalg.svd(sampled[a], full_matrices=False)
            keep = s > 1e-9 * s[0]
            reduced = (s[:, None] * vh)[keep]
            stack = np.hstack([weights[a] * weights[b] * reduced @ full[a, b] @ grams[b] for b in count])
            basis = _left(stack, tolerance)
            # values on the grid of (u, x), whose mean square is 1
            self._values.append((u[:, keep] @ basis * len(self._grid)).T.reshape(-1, len(self._grid), len(self._grid)))
            into.append(basis.conj().T @ reduced)
        self.core = {(a, b): into[a] @ full[a, b] @ into[b].T for a, b in full}

    def _lens_terms(self, reach_x, tolerance):
        """Functions of the lens on the grid's x, a function of x, and their core."""
        if self.f is None:
            return lambda x: np.ones((len(x), 1)), np.ones((1, 1))
        nodes = int(20 + 2 * self.k * self.f * (reach_x / self.f) ** 4)
        t, _ = gauss(nodes)
        block = ell(reach_x * t[:, None], reach_x * t, self.f, self.k) / nodes
        basis = _left(block, tolerance / 4)
        series = _series(t) @ (basis * np.sqrt(nodes))
        return lambda x: legendre(x / reach_x, nodes, 1) @ series, basis.conj().T @ block @ basis.conj()

    def _products(self, a, lens):
        """All products of kappa's and the lens's functions of offset number a on the grid: (u x x, lens terms x kappa terms), over the
        grid's size."""
        t = self._grid
        d = (self.reach_u * t[:, None] - self.reach_x * t) / self.reach
        values = (legendre(d.ravel(), len(self._series[a]), 1) @ self._series[a]).reshape(len(t), len(t), 1, -1)
        return (values * lens(self.reach_x * t)[:, :, None]).reshape(len(t) ** 2, -1) / len(t)

    def functions(self, a, u, x):
        """P_r of offset number a at sensor positions u and lenslet positions x (m, from their centres): (terms, len(u), len(x))."""
        series = _series(self._grid)
        rows, columns = (legendre(place / reach, len(series), 1) @ series for place, reach in ((u, self.reach_u), (x, self.reach_x)))
        return rows @ self._values[a] @ columns.T


def _nodes(far, reach, z, k):
    """Nodes that carry kappa over displacements within `reach` of an offset, all at most `far` (m)."""
    side = np.sqrt(z * z + far * far)
    slope = k * reach * far * abs(1 / np.sqrt(side * side + far * far) - 1 / side)
    return int(np.ceil(slope + 5 * np.cbrt(slope) + 12))


def _series(t):
    """Legendre coefficients from values on the Gauss nodes t."""
    w = gauss(len(t))[1]
    degrees = np.arange(len(t))
    return legendre(t, len(t), 1).T * w * ((2 * degrees + 1) / 2)[:, None]


def _left(matrix, tolerance):
    """Orthonormal columns that hold the matrix up to `tolerance` (root sum of squares)."""
    u, s, _ = np.linalg.svd(matrix, full_matrices=False)
    tails = np.sqrt(np.cumsum(s[::-1] ** 2)[::-1])
    return u[:, : max(1, int(np.count_nonzero(tails > tolerance)))]


def _gram_root(columns):
    """R^T with columns = Q R: what weighs coefficients as the functions themselves."""
    return np.linalg.qr(columns, mode="r").T
