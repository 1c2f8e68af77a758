"""Sensor fields behind square lenslets by low-rank factors: the Fresnel model
of separable arrays.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.fresnel.array_to_sensor import (
    lenslet_kernel,
    lit_lenslets,
    sensor_nodes,
)
from plenocli.forward.propagation.fresnel.separable_fields import Factors
from plenocli.forward.propagation.fresnel.spread_function import (
    carried,
    edge_emphasis,
    psf_nodes,
    separable_field,
)
from plenocli.forward.propagation.lenslet_fields import (
    FieldNotes,
    LensletFields,
    PixelEnergies,
)
from plenocli.forward.propagation.sampling import NARROWING_LOSS

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.fresnel.spread_function import SeparableField
    from plenocli.forward.propagation.plan import BandPlan, PifPlan

TERM_VALUES = 1 << 21
"""Values of the spread function's terms in memory at a time while tables are filled."""


class SquareLenslets(LensletFields):
    """Sensor fields behind square lenslets: every separable term of h stays
    separable up to the sensor.

    Within one lenslet a term is a polynomial of far lower degree than the kernel to a distant
    superpixel, so it is sampled on few nodes and the kernel is brought onto these. Where h is even,
    points that mirror each other share their tables.
    """

    def __init__(self, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan) -> None:
        self.geometry, self.superpixels, self._band = geometry, plan.superpixels, band
        self.dtype, self._real = (
            np.dtype(t)
            for t in ((np.complex128, np.float64) if plan.double else (np.complex64, np.float32))
        )
        # off the sensor's own raster every superpixel has its pixels around its centre
        self._centred = geometry.pixel_shift is None
        field = separable_field(camera, geometry, band.half, band.spread_cut)
        self.symmetry = field.symmetry
        self.notes = FieldNotes(separable_terms=field.terms, field_tail=field.tail)
        self._x, self._w, self._basis = self._lenslet_nodes()
        self._kernels: dict[tuple, np.ndarray] = {}
        self._cut = (
            band.spread_cut if narrows(geometry, band, plan.superpixels, plan.double) else None
        )
        rules = self._rules()
        high, down = self._tables(field, 0, rules)
        if field.signs is not None and self._axes_agree():
            wide, across, signs = (
                high,
                down * np.outer(field.signs, field.signs).ravel(),
                field.signs,
            )
        else:
            (wide, across), signs = self._tables(field, 1, rules), None
        self._entering = (down @ across.T).real
        self._kernels.clear()
        self.factors = Factors(high[0], wide[0], geometry.pixel_shape, rules[0][1][0], signs)
        # the object's own superpixel, where it has more nodes
        self._own = (
            Factors(high[1], wide[1], geometry.pixel_shape, rules[1][1][0], signs)
            if len(rules) > 1
            else None
        )
        self._roots: dict[tuple[int, int], np.ndarray] = {}
        self._least: float | None = None

    def _rules(self) -> list[tuple[bool, tuple[int, int]]]:
        """[(whether all superpixels or the object's own only, (nodes of a pixel per axis,
        rule))], all of them first.
        """
        own = self._band.pixel_nodes, self._band.pixel_rule
        return (
            [(True, own)]
            if self._cut is None or not self._band.beside
            else [(True, self._band.beside), (False, own)]
        )

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel, with no more terms than the light of the neighbourhood
        needs there.
        """
        if self._cut is None:
            return partial(self.factors.superpixel, sy, sx)
        if self._least is None:
            self._least = self._least_term(self._cut)
        return partial(self._narrowed(sy, sx, self._least).superpixel, 0, 0)

    def _narrowed(self, sy: int, sx: int, least: float) -> Factors:
        """Factors of one superpixel, without the terms smaller than `least`."""
        own, source = (2 * sy + 1, 2 * sx + 1) == self.superpixels, self.factors
        left, right, signs = self._roots_of(sy, sx)
        u, s, vh = np.linalg.svd(left @ right.T)
        terms = max(1, int(np.count_nonzero(s > least)))
        scale = 1 / np.sqrt(s[:terms])
        if own and self._own:
            source, sy, sx = self._own, 0, 0
        # each table through the other's strong directions: exact on these, and nothing
        # small is divided by
        high = source.high[sy] @ (right.T @ vh[:terms].conj().T * scale).astype(self.dtype)
        wide = source.wide[sx] @ (signs[:, None] * left.T @ u[:, :terms].conj() * scale).astype(
            self.dtype
        )
        return Factors(high[None], wide[None], source.pixel_shape, source.pixel_nodes)

    def _least_term(self, cut: float) -> float:
        """The terms up to which size (root energy of a mean point, points at the lenslet's edge
        weighing more) all superpixels together lose NARROWING_LOSS `cut` without.
        """
        found = []
        for sy, sx in np.ndindex(*self.superpixels):
            left, right, _ = self._roots_of(sy, sx)
            found.append(np.linalg.svd(left @ right.T, compute_uv=False))
        sizes = np.sort(np.concatenate(found))
        lost = int(np.searchsorted(np.cumsum(sizes**2), (NARROWING_LOSS * cut) ** 2))
        return float(sizes[lost - 1]) if lost else 0.0

    def _roots_of(self, sy: int, sx: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(_root of superpixel row sy, of column sx with the signs of the terms, these signs)."""
        signs = self.factors.signs
        signs = np.ones(self.factors.high.shape[3]) if signs is None else signs
        return self._root(0, sy), self._root(1, sx) * signs, signs

    def _root(self, axis: int, s: int) -> np.ndarray:
        """R with R^H R the overlaps of the terms on superpixel s for a mean point, on
        half of its nodes.
        """
        factors = self.factors
        axis = 0 if factors.wide is factors.high else axis
        if (axis, s) not in self._roots:
            table, points = (factors.wide if axis else factors.high)[s], self.geometry.points(axis)
            node, pixel = np.divmod(np.arange(table.shape[1]), factors.pixel_shape[axis])
            # every other node, of the next pixel the others
            chosen, gram = (node + pixel) % 2 == 0, 0
            for fields, weight in zip(
                table, edge_emphasis(self.geometry, points) ** 2 * 2 / len(points)
            ):
                fields = fields[chosen].astype(complex)
                gram = gram + weight * (fields.conj().T @ fields)
            values, vectors = np.linalg.eigh(gram)
            self._roots[axis, s] = np.sqrt(np.maximum(values, 0))[:, None] * vectors.conj().T
        return self._roots[axis, s]

    def _axes_agree(self) -> bool:
        g = self.geometry
        return self._centred and all(
            a[0] == a[1] for a in (g.pixel_shape, g.object_shape, self.superpixels)
        )

    def _lenslet_nodes(self) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Nodes x and weights (m) on which the terms are sampled, and the kernel's own nodes with
        what carries it onto the former.

        The last is (nodes, weights x Legendre interpolation (kernel node, term node)); the nodes
        alone where both are the same.
        """
        g = self.geometry
        half = g.lenslet_width / 2
        fine, few = self._band.lenslet_nodes, psf_nodes(g, half)
        t, w = gauss(min(fine, few))
        if few >= fine:
            return half * t, half * w, (half * t, (half * w).astype(self._real))
        carry = half * carried(fine, few)
        return half * t, half * w, (half * gauss(fine)[0], carry.astype(self._real))

    def _kernel(self, axis: int, n: int, place: int, nodes: int, rule: int) -> np.ndarray:
        """The kernel (sensor node, 2, term node), real and imaginary part, from a lenslet to the
        superpixel n before it, which stands at `place` (superpixel pitches; it matters on a
        sensor's own raster only).
        """
        key = axis, n, None if self._centred else place, nodes, rule
        if key not in self._kernels:
            v, wv = (a.ravel() for a in sensor_nodes(self.geometry, axis, nodes, place, rule))
            x, carry = self._basis
            kernel = lenslet_kernel(self.geometry, n, v, wv, x, self.dtype)
            parts = np.stack([kernel.real, kernel.imag], axis=1)
            self._kernels[key] = (
                parts * carry
                if carry.ndim == 1
                else (parts.reshape(-1, len(x)) @ carry).reshape(*parts.shape[:2], -1)
            )
        return self._kernels[key]

    def _tables(
        self, field: SeparableField, axis: int, rules: list[tuple[bool, tuple[int, int]]]
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """The factor tables along one axis (as Factors takes them), one of each of `rules`, and the
        (point, term x term) Gram matrices over the lenslets.
        """
        g, window, terms = self.geometry, self._band.window, field.terms
        reach = (self.superpixels[axis] - 1) // 2
        points = g.points(axis)
        half = (len(points) + 1) // 2 if field.even and self._centred else len(points)
        lenslets = list(lit_lenslets(reach, window))
        tables = [
            np.empty(
                (2 * reach + 1 if every else 1, len(points), nodes * g.pixel_shape[axis], terms),
                self.dtype,
            )
            for every, (nodes, _) in rules
        ]
        entering = np.empty(
            (len(points), terms * terms), self.dtype if field.rows.dtype.kind == "c" else self._real
        )
        kernels = []
        for table, (every, rule) in zip(tables, rules):
            for out, s in zip(table, range(-reach, reach + 1) if every else [0]):
                chosen = lenslets if window is not None else [s]
                whole = np.concatenate(
                    [self._kernel(axis, m - s, s, *rule) for m in chosen], axis=2
                )
                kernels.append(
                    (
                        out,
                        lenslets.index(chosen[0]) * len(self._x),
                        whole.reshape(-1, whole.shape[2]),
                    )
                )
        where = (self._x + np.array(lenslets)[:, None] * g.D2).ravel()
        weight = np.tile(self._w, len(lenslets))[:, None].astype(self._real)
        step = max(1, TERM_VALUES // (len(where) * terms))
        for start in range(0, half, step):
            block = field.evaluate(
                where - points[start : min(start + step, half), None], axis
            ).astype(entering.dtype)
            for i, values in enumerate(block, start):
                entering[i] = (values.T @ (values.conj() * weight)).ravel()
                for out, first, kernel in kernels:
                    _product(kernel, values[first : first + kernel.shape[1]], out[i])
        if half < len(points):  # the mirror image: points, superpixels and sensor nodes reversed
            for table in tables:
                table[:, half:] = table[::-1, : len(points) - half, ::-1][:, ::-1]
            entering[half:] = entering[: len(points) - half][::-1]
        return tables, entering

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        return self._entering[rows, columns]


def narrows(geometry: Geometry, band: BandPlan, superpixels: tuple[int, int], double: bool) -> bool:
    """Whether superpixels get factors of their own rank: where many columns with many nodes gain by
    it. In double precision the roots of sums of squares would not know what is that small.

    superpixels: (rows, columns) kept;
    double: precision of the fields.
    """
    return (
        band.window is not None
        and not double
        and max(superpixels) > 1
        and band.pixel_nodes * max(geometry.pixel_shape) >= 200
    )


def _product(kernel: np.ndarray, values: np.ndarray, out: np.ndarray) -> None:
    """The kernel (sensor node x (real, imaginary), term node), real, times values (term node,
    term) into complex `out`.
    """
    parts = (kernel @ values.view(kernel.dtype).reshape(len(values), -1)).reshape(len(out), 2, -1)
    if not np.iscomplexobj(values):
        out.real, out.imag = parts[:, 0], parts[:, 1]
    else:
        parts = parts.view(values.dtype)
        np.multiply(parts[:, 1], 1j, out=out)
        out += parts[:, 0]
