"""The light of one lenslet on one superpixel by the exact kernel: an interval of each axis, and the
product of two of them.

With the kernel's and the lens's residual sum_rs P_r C_rs Q_s (residual.Residual) and the main
lens's field sum_ij e_i S_ij e'_j on the displacements from the object's points to the lenslet, the
field on the superpixel is X (C (x) S) X'^T,

    X[(u, p), (r, i)] = integral of W(u, x) P_r(u, x) e_i(m D2 + x - p) dx   over the lenslet.

Every pair of a lenslet and a superpixel has functions of its own, as many as its light needs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.forward.camera.quadrature import gauss, nodes_for
from plenocli.forward.propagation.exact.low_rank_product import thin
from plenocli.forward.propagation.exact.oblique import at_points, orders_of
from plenocli.forward.propagation.exact.residual import ObliqueWave, Residual, path, split
from plenocli.forward.propagation.fresnel.spread_function import (
    carried,
    legendre,
    legendre_sum,
    psf_nodes,
    terms_within,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.propagation.exact.low_rank_product import Matrix
    from plenocli.forward.propagation.fresnel.spread_function import SeparableField

ROWS_AT_ONCE = 256
"""Rows whose squares are added up together, so that sums in single precision stay short."""
SHARE = 0.01
"""Of what the terms on a lenslet may miss: what is lost by carrying them on few functions."""
AT_ONCE = 1 << 19
"""Numbers of a field that are brought to pixels together: they stay in the caches."""


@dataclass(frozen=True, kw_only=True)
class Modes:
    """Functions that carry a field on a superpixel once the path from the lenslet's middle is taken
    out of it.

    weighted: (line, node) on the nodes of a SensorSide, roots of the rule's weights in it;
    pixels: nodes of the pixels, m from the superpixel's centre;
    shown: (pixels' node, line) on these, roots of their weights in it.
    """

    weighted: np.ndarray
    pixels: np.ndarray
    shown: np.ndarray


@dataclass(frozen=True, kw_only=True)
class SensorSide:
    """How light goes to the superpixel s along one axis, to all lenslets alike.

    u: sensor nodes, m from its centre;
    root: the roots of their weights;
    points: m on the array, that are computed;
    emphasis: their weights in what is left out;
    modes: what carries the field on the nodes; None: the nodes, which are those of the pixels.
    """

    u: np.ndarray
    root: np.ndarray
    points: np.ndarray
    emphasis: np.ndarray
    modes: Modes | None = None

    @property
    def lines(self) -> int:
        """How many numbers carry the field of one point."""
        return len(self.u if self.modes is None else self.modes.weighted)

    @property
    def pixel_rows(self) -> int:
        """How many numbers show the field of all points on the pixels' nodes."""
        return len(self.points) * len(self.u if self.modes is None else self.modes.pixels)

    def carry(self, wave: np.ndarray) -> np.ndarray:
        """A kernel (nodes, x), roots of weights folded in, as (lines, x)."""
        if self.modes is None:
            return wave
        real = wave.real.dtype
        return (self.modes.weighted.astype(real) @ wave.view(real)).view(wave.dtype)


class Interval:
    """From lenslet m to superpixel s along one axis.

    `place`: the lenslet's nodes x (m) from the axis;
    terms: LocalTerms there;
    onto, values: functions that carry these for all points, as `_functions` has them;
    weigh: R with R^H R the overlaps of what they bring to the superpixel.

    f: focal length of a hyperbolic lenslet, None for a parabolic one;
    tolerance: root energy by which the field may miss.
    """

    def __init__(
        self,
        geometry: Geometry,
        field: SeparableField,
        axis: int,
        s: int,
        m: int,
        side: SensorSide,
        parabolic: bool,
        tolerance: float,
        dtype: np.dtype,
    ) -> None:
        self.geometry, self.side, self.parabolic, self.dtype = geometry, side, parabolic, dtype
        g = geometry
        half = g.lenslet_width / 2
        # the chief ray goes on from the lenslet as it came
        self.aside, self.across = (g.chief[n] * g.z3 / g.z2 for n in (axis, 1 - axis))
        self.chief, self.chief_across = g.chief[axis], g.chief[1 - axis]
        self.offset = s * g.superpixel_pitch - m * g.D2 + self.aside
        fine = nodes_for(half * self._slope(m * g.D2, half))
        self.x = half * gauss(fine)[0]
        self.place = m * g.D2 + self.x
        reach = half + np.abs(g.points(axis)).max()
        self.terms = LocalTerms(
            field,
            axis,
            max(m * g.D2 - reach, -field.half),
            min(m * g.D2 + reach, field.half),
            tolerance,
        )
        self.onto, self.values = self._functions(m * g.D2, fine, SHARE * tolerance)
        power, vectors = np.linalg.eigh(self._gram())
        self.weigh = np.sqrt(np.maximum(power, 0))[:, None] * vectors.conj().T

    def _functions(
        self, middle: float, fine: int, tolerance: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Functions on the lenslet that carry the main lens's field of all points, which swings
        less than the kernel: as few as that takes.

        middle: of the lenslet, m from the axis;
        fine: nodes on which the kernel is known;
        tolerance: root energy of a mean point's field that may be lost.

        Returns (fine node, function), the rule's weights in it, and (function, term, point), the
        terms on these.
        """
        g, points = self.geometry, self.side.points
        half = g.lenslet_width / 2
        few = min(fine, psf_nodes(g, half))
        t, w = gauss(few)
        root = np.sqrt(half * w)[:, None]
        values = self.terms.evaluate(middle + half * t[:, None] - points, points)
        values = (values * self.side.emphasis[:, None]).transpose(0, 2, 1) * root[:, :, None]
        weighed = (values * self.terms.strength[:, None]).reshape(few, -1)
        triangle: Any = np.linalg.qr(weighed.T, mode="r")
        basis, s, _ = np.linalg.svd(triangle.T, full_matrices=False)
        basis = basis[:, : terms_within(s, tolerance * math.sqrt(len(points)))]
        kind = self.dtype if np.iscomplexobj(values) else self.dtype.type().real.dtype
        seen = basis.conj().T @ values.reshape(few, -1)
        onto = half * carried(fine, few) @ (basis / root)
        return onto.astype(kind), seen.astype(kind).reshape(-1, *values.shape[1:])

    def _slope(self, middle: float, half: float) -> float:
        """Largest slope (rad/m) of the integrand's phase: of the way to either end of the
        superpixel, the lens and the main lens's wave.
        """
        g, x = self.geometry, half * np.linspace(-1, 1, 17)
        d = self.offset + np.array([[self.side.u.min()], [self.side.u.max()]]) - x
        bend = x / g.f2 if self.parabolic else x / np.hypot(x, g.f2)
        goes, comes = np.hypot(g.z3, self.across), self.chief + middle + x
        come = (
            comes / np.hypot(comes, np.hypot(g.z2, self.chief_across))
            if g.chief != (0.0, 0.0)
            else comes / g.z2
        )
        return g.k * (np.abs(d / np.hypot(d, goes) + bend - come).max() + g.D1 / (2 * g.z2))

    def wave(self, other: float) -> np.ndarray:
        """W (u, x) towards superpixels displaced by `other` (m) along the other axis, less its
        `carrier` where the sensor's side has modes.
        """
        g, u = self.geometry, self.side.u
        taken_out = self._own_path(u) if self.side.modes is None else self._from_middle(u, other)
        phase = (
            path(self.offset + u[:, None] - self.x, g.z3, self.offset, other)
            - taken_out[:, None]
            + self._incoming()
        )
        phase = phase - (self.x**2 / (2 * g.f2) if self.parabolic else path(self.x, g.f2))
        size = self._nearer() / math.sqrt(g.wavelength * g.z3)
        return (self.side.root[:, None] * size) * np.exp(1j * g.k * phase)

    def _own_path(self, u: np.ndarray) -> np.ndarray:
        """Path (m) to u from the middle of the superpixel's own lenslet, which no energy shows."""
        return path(self.aside + u, self.geometry.z3, self.aside, self.across)

    def _from_middle(self, u: np.ndarray, other: float) -> np.ndarray:
        """Path (m) to u from the middle of this lenslet; other: as `wave`."""
        return path(self.offset + u, self.geometry.z3, self.offset, other)

    def on_pixels(
        self, factor: np.ndarray, other: float, out: np.ndarray | None = None
    ) -> np.ndarray:
        """What modes of the sensor's side carry, on the nodes of the pixels.

        factor: (lines x points, terms);
        other: as `wave`;
        out: where it is put, None: an array of its own.

        Returns (pixels' nodes x points, terms).
        """
        modes, terms = self.side.modes, factor.shape[1]
        if modes is None:
            if out is None:
                return factor
            out[:] = factor
            return out
        shown = modes.shown.astype(factor.real.dtype)
        # singular vectors may lie column by column
        carried = np.ascontiguousarray(factor).reshape(self.side.lines, -1).view(shown.dtype)
        apart = self._from_middle(modes.pixels, other) - self._own_path(modes.pixels)
        turned = np.exp(1j * self.geometry.k * apart).astype(factor.dtype)[:, None, None]
        if out is None:
            out = np.empty((self.side.pixel_rows, terms), factor.dtype)
        nodes, step = out.reshape(len(shown), -1, terms), max(1, AT_ONCE // carried.shape[1])
        for start in range(0, len(shown), step):  # fresh pages take longer than what is moved
            some = slice(start, start + step)
            part = (shown[some] @ carried).view(factor.dtype).reshape(-1, *nodes.shape[1:])
            np.multiply(part, turned[some], out=nodes[some])
        return out

    def _incoming(self) -> np.ndarray:
        """Path (m) of the main lens's wave along this axis on the lenslet's nodes: off the axis of
        the chief ray's sphere.
        """
        g = self.geometry
        if g.chief == (0.0, 0.0):
            return self.place**2 / (2 * g.z2)
        return path(self.chief + self.place, g.z2, self.chief, self.chief_across)

    def _nearer(self) -> np.ndarray | float:
        """What of the main lens's wave is stronger on the lenslet's nodes than at its own lenslet's
        centre, since they are nearer to the pupil: along this axis.
        """
        if self.geometry.chief == (0.0, 0.0):
            return 1.0
        far = self.geometry.z2**2 + self.chief_across**2
        return (far + self.chief**2) / (far + (self.chief + self.place) ** 2)

    def _gram(self) -> np.ndarray:
        """Overlaps, for a mean point, of what each term alone brings to the superpixel through
        the separable part: (term, term).
        """
        terms, points = self.values.shape[1:]
        sheet = np.empty((self.side.lines, terms, points), self.dtype)
        wave = self.side.carry(self.wave(self.across).astype(self.dtype))
        _multiply(wave, self.onto, self.values, out=sheet)
        gram = np.zeros((terms, terms), complex)
        for line in sheet:
            gram += line.conj() @ line.T
        gram /= points
        return gram if np.iscomplexobj(self.values) else gram.real

    def sheet(
        self,
        other: float,
        functions: Callable[[np.ndarray, np.ndarray, np.dtype], np.ndarray],
        mixing: np.ndarray,
        kept: tuple[np.ndarray, ...],
    ) -> np.ndarray:
        """X, what terms of the kernel and of the main lens's field bring to the superpixel.

        other: displacement (m) along the other axis;
        functions: (u, x, type) -> (r, u, x), the kernel's residual;
        mixing: (i', i), terms i of the field in those of this interval;
        kept: (r, i) of the pairs that are wanted.

        Returns (lines of the sensor, pair, points).
        """
        wave, (kept_r, kept_i) = self.wave(other).astype(self.dtype), kept
        values = mixing.T.astype(self.values.dtype) @ self.values
        out = np.empty((self.side.lines, len(kept_r), values.shape[2]), self.dtype)
        for r, term in enumerate(functions(self.side.u, self.x, self.dtype)):
            some = np.flatnonzero(kept_r == r)
            if len(some):
                terms = kept_i[some]
                # strong ones come first: most often all up to the weakest, which need no copy
                few = values[:, : len(terms)] if terms[-1] < len(terms) else values[:, terms]
                side = self.side.carry(wave * term)
                _multiply(side, self.onto, few, out=out[:, some[0] : some[-1] + 1])
        return out


class Pair:
    """Factors of what one lenslet, an Interval of each axis, brings to one superpixel.

    weight: root energy of a mean point's field there, by the separable part alone.
    """

    def __init__(self, row: Interval, column: Interval, symmetric: bool) -> None:
        self.row, self.column, self.symmetric = row, column, symmetric
        field = row.terms.coefficients(0) @ column.terms.coefficients(1).T
        # alike but for what the main lens's field misses: symmetric, its core is all but diagonal
        self._field = (field + field.T) / 2 if symmetric else field
        self.weight = float(np.linalg.norm(row.weigh @ self._field @ column.weigh.T))

    def factors(
        self, reach: float, tolerance: float, weak: float
    ) -> tuple[np.ndarray, np.ndarray, Matrix]:
        """The field on the superpixel as a product X K X'^T.

        reach: half width (m) of the superpixel;
        tolerance: root energy of a mean point's field that may be lost, about;
        weak: of the pairs of terms that may be left out once it is seen what each brings.

        Returns (X, X', K); X' is X where the pair is symmetric.
        """
        g = self.row.geometry
        left, field, right = self._terms(tolerance / 2)
        residual = Residual(
            (self.row.offset, self.column.offset),
            reach,
            g.lenslet_width / 2,
            g.z3,
            g.k,
            None if self.row.parabolic else g.f2,
            min(0.5, tolerance / (3 * self.weight)) if self.weight else 0.5,
            self.symmetric,
            self._come(),
        )
        power = np.outer(_norms(self.row, left), _norms(self.column, right))
        power, core = np.abs(field) ** 2 * power, np.abs(residual.core) ** 2
        kept = [
            _strong(np.outer(core.sum(axis=1 - axis), power.sum(axis=1 - axis)), tolerance / 15)
            for axis in (0, 1)
        ]
        coupling = _coupled(
            thin(residual.core.astype(self.row.dtype)), thin(field.astype(self.row.dtype)), kept
        )
        x = self.row.sheet(self.column.offset, partial(residual.functions, 0), left, kept[0])
        y = (
            x
            if self.symmetric
            else self.column.sheet(self.row.offset, partial(residual.functions, 1), right, kept[1])
        )
        # now that it is seen what each term brings: residuals send light where the
        # separable part does not
        brings = [_energy(x) / len(self.row.side.points)]
        brings += brings if self.symmetric else [_energy(y) / len(self.column.side.points)]
        (some,) = _strong(brings[0] * _weighed(coupling, brings[1]), weak)
        left, coupling = _by_row(x, some), coupling[some][:, some]
        return left, left if self.symmetric else _by_row(y, some), coupling

    def on_pixels(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns for the rows' and for the columns' sensor sides, on the nodes of the pixels."""
        left = self.row.on_pixels(x, self.column.offset)
        return left, left if y is x else self.column.on_pixels(y, self.row.offset)

    def _come(self) -> ObliqueWave | None:
        """What the main lens's wave does along both axes together; None on the axis."""
        g, sides = self.row.geometry, (self.row, self.column)
        if g.chief == (0.0, 0.0):
            return None
        y, x = (float(i.place[0] - i.x[0]) for i in sides)
        return ObliqueWave(g.z2, g.chief, (g.chief[0] + y, g.chief[1] + x))

    def _terms(self, tolerance: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(A, K, B): A K B^T are the terms S of the main lens's field, but for what does not
        reach the superpixel.
        """
        if self.symmetric:
            return split(self._field, tolerance, symmetric=True)
        rows, columns = self.row.weigh, self.column.weigh
        u, s, v = split(rows @ self._field @ columns.T, tolerance)
        s = np.maximum(np.diag(s), np.finfo(float).tiny)  # no light passes a shut filter
        # S through the directions that reach it on either side: exact on these
        return (
            self._field @ columns.T @ v.conj() / s,
            np.diag(s),
            (u.conj().T @ rows @ self._field).T / s,
        )


def _coupled(core: Matrix, field: Matrix, kept: Sequence[tuple[np.ndarray, ...]]) -> Matrix:
    """core[r, s] field[i, j] for the pairs kept = ((r, i), (s, j)): an array, or
    sparse where both are.
    """
    from scipy import sparse

    (r, i), (s, j) = kept
    if sparse.issparse(core) and sparse.issparse(field):
        whole = sparse.kron(core, field, format="csr")
        return sparse.csr_array(whole)[r * field.shape[0] + i][:, s * field.shape[1] + j]
    core, field = (a if isinstance(a, np.ndarray) else a.toarray() for a in (core, field))
    out = core[r[:, None], s]
    for start in range(
        0, len(out), ROWS_AT_ONCE
    ):  # the largest array there is, no second one beside it
        out[start : start + ROWS_AT_ONCE] *= field[i[start : start + ROWS_AT_ONCE, None], j]
    return out


def _weighed(coupling: Matrix, power: np.ndarray) -> np.ndarray:
    """|coupling|^2 @ power, with no second array of that size."""
    parts = range(0, coupling.shape[0], ROWS_AT_ONCE)
    return np.concatenate(
        [abs(coupling[start : start + ROWS_AT_ONCE]) ** 2 @ power for start in parts]
    )


def _norms(interval: Interval, mixing: np.ndarray) -> np.ndarray:
    """Energy, for a mean point, that each column of `mixing` brings to the superpixel."""
    return (np.abs(interval.weigh @ mixing) ** 2).sum(axis=0)


def _energy(sheet: np.ndarray) -> np.ndarray:
    """Sum of squares of each pair of a sheet (line, pair, point): (pair,)."""
    total = np.zeros(sheet.shape[1])
    step = max(1, ROWS_AT_ONCE // sheet.shape[2])
    for start in range(0, len(sheet), step):
        parts = sheet[start : start + step].view(sheet.real.dtype)
        total += np.einsum("uip,uip->i", parts, parts)
    return total


def _by_row(sheet: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Some pairs of a sheet (line, pair, point), as (line x point, pair) in its own memory: fresh
    pages of so large an array take longer than what is moved.
    """
    lines, _, points = sheet.shape
    flat, step = sheet.reshape(-1), points * len(some)
    for line in range(lines):
        flat[line * step : (line + 1) * step] = sheet[line, some].T.ravel()
    return flat[: lines * step].reshape(-1, len(some))


def _strong(power: np.ndarray, tolerance: float) -> tuple[np.ndarray, ...]:
    """Indices (r, i) of all entries of `power` but the weakest, which together are
    at most tolerance^2.
    """
    order = np.argsort(power, axis=None)
    keep = np.ones(power.size, bool)
    keep[order[np.cumsum(power.ravel()[order]) <= tolerance**2]] = False
    keep[order[-1]] = True
    return np.nonzero(keep.reshape(power.shape))


class LocalTerms:
    """An orthonormal basis e_i on [low, high] of the terms of h along one axis, cut at
    `tolerance` of the whole field.

    strength: (i,), root energy of what each carries of it.
    """

    def __init__(
        self, field: SeparableField, axis: int, low: float, high: float, tolerance: float
    ) -> None:
        self.middle, self.half = (low + high) / 2, (high - low) / 2
        count = max(
            8, int(len(field.rows) * (2 if field.even else 1) * self.half / field.half) + 24
        )
        t, w = gauss(count)
        root = np.sqrt(self.half * w)[:, None]
        self.field, orders = field, orders_of(field)
        values = [
            _stacked(root * field.evaluate(self.middle + self.half * t, a), orders) for a in (0, 1)
        ]
        # the partner of a term has the norm sqrt(s), which weighs it
        u, s, _ = np.linalg.svd(values[axis] * field_norms(field, 1 - axis), full_matrices=False)
        basis = u[:, : terms_within(s, tolerance)]
        self.strength = s[: basis.shape[1]]
        self._mixing = [basis.conj().T @ v for v in values]
        degrees = np.arange(count)
        project = legendre(t, count, 1).T * w * ((2 * degrees + 1) / 2)[:, None]
        series = np.hstack([project @ (part / root) for part in np.split(basis, orders)])
        self._series = series.astype(field.rows.dtype)

    def coefficients(self, axis: int) -> np.ndarray:
        """(i, term): the terms of h along `axis` in this basis."""
        return self._mixing[axis]

    def evaluate(self, d: np.ndarray, points: np.ndarray) -> np.ndarray:
        """e_i at d (m) from `points` (m, broadcasting): d.shape + (i,), the same for both axes."""
        t = (np.asarray(d, float) - self.middle) / self.half
        return at_points(self.field, legendre_sum(t, self._series), points)


def _stacked(values: np.ndarray, orders: int) -> np.ndarray:
    """(place, order x term) as (order x place, term)."""
    return values if orders == 1 else np.vstack(np.split(values, orders, axis=1))


def field_norms(field: SeparableField, axis: int) -> np.ndarray:
    """Root energy of each term of h along one axis.

    axis: 0 rows, 1 columns.

    Returns (term,).
    """
    coefficients = field.columns if axis else field.rows
    degrees = np.arange(len(coefficients)) * (2 if field.even else 1)
    power = (np.abs(coefficients) ** 2 * (2 / (2 * degrees + 1))[:, None]).sum(axis=0) * field.half
    return np.sqrt(power.reshape(orders_of(field), -1).sum(axis=0))


def _multiply(kernel: np.ndarray, onto: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    """out (line, term, point) = kernel (line, x) complex @ onto (x, function) @ values (function,
    term, point) of the same precision, both real or both complex, by slices of rows that lie
    together.
    """
    flat, target = (a.reshape(len(a), -1) for a in (values, out))
    if np.iscomplexobj(values):
        np.matmul(kernel @ onto, flat, out=target)
    else:
        parts = np.concatenate([kernel.real, kernel.imag]) @ onto
        target.real, target.imag = np.vsplit(parts @ flat, 2)
