"""Sensor fields behind lenslets of any shape, anywhere on the array and with their neighbours, by
the exact scalar kernel: with opening weights W on nodes of the rectangle around a lenslet and the
kernel as a short sum of products (residual.Residual), the field of a point is

    U(v, u) = sum over lenslets and terms r of [P_r(v, y_i)] [W_ij L_ij h_ij] [Q_r(u, x_j)]^T.

docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.quadrature import gauss, nodes_for, opening_weights
from plenocli.forward.propagation.costs import Features
from plenocli.forward.propagation.exact.cost_law import OBLIQUE_TERMS, columns, field_seconds
from plenocli.forward.propagation.exact.debye import spherical_field
from plenocli.forward.propagation.exact.oblique import at_points, oblique_field, orders_for
from plenocli.forward.propagation.exact.residual import Residual, path
from plenocli.forward.propagation.fresnel.array_to_sensor import pixel_energy, sensor_nodes
from plenocli.forward.propagation.fresnel.spread_function import separable_field
from plenocli.forward.propagation.lenslet_fields import FieldNotes, LensletFields, PixelEnergies
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import (
    expected_symmetry,
    size_band,
    superpixels_of,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan

Place = tuple[float, float]
"""(row, column), in pitches where it is said."""
NEAREST = 10
"""Wavelengths from lenslets to sensor within which evanescent waves reach it."""
MOST_PAIRS = 4000
"""Pairs of a lenslet and a superpixel beyond which a sum over openings is no plan."""
KERNEL_CUT = 0.1
"""Root mean square that may be left out of the kernel, over the accuracy asked for."""
CUT_ASIDE = 0.08
"""Effect of the spread function's cut off the axis on the dimmest column, over the cut and the
fourth root of the column's light: with it 96 % of 448 foreign cameras' errors were told within a
factor of ten.
"""
TOGETHER = 1 << 22
"""Values on the sensor of points that are gone through together."""


@dataclass(frozen=True, kw_only=True)
class OpeningBand(BandPlan):
    """A BandPlan of the exact model through whole openings: lenslet_nodes of the farthest pair of
    a lenslet and a superpixel.

    kernel_cut: root mean square that may be left out of the kernel;
    kernel_terms: products that the kernel takes, from the lenslet that is farthest.
    """

    kernel_cut: float
    kernel_terms: int


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for: no evanescent waves on the sensor, nor lenslets whose terms separate."""
    shape, lattice = camera.lenslet_array.aperture_shape, camera.lenslet_array.lattice
    if (shape, lattice, geometry.chief) == ("square", "square", (0.0, 0.0)):
        return "square lenslets on the axis are left to separable terms"
    if geometry.z3 < NEAREST * geometry.wavelength:
        return "the sensor lies within ten wavelengths of the lenslets"
    return None


def opening_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
) -> OpeningBand:
    """As Model.size.

    Raises NumericsError as size_band, and for more than MOST_PAIRS.
    """
    base = size_band(camera, geometry, superpixels, ring, accuracy, tolerance)
    count = math.prod(superpixels)
    if base.window is not None:
        count *= len(_lenslets(geometry, superpixels, base.window))
    if count > MOST_PAIRS:
        raise NumericsError(
            f"{count} pairs of a lenslet and a superpixel are too many to sum over openings",
            "superpixels",
            "take fewer superpixels or coherent neighbours",
        )
    # off the axis there is more to cut
    aside, dim = geometry.chief != (0.0, 0.0), math.sqrt(base.faintest)
    moved = aside * CUT_ASIDE * base.spread_cut / dim
    cut = KERNEL_CUT * accuracy * base.faintest
    parabolic = camera.lenslet_array.profile == "parabolic"
    pairs = {pair for _, pair in _pairs(geometry, superpixels, base.window)}
    own, far = _nearest_and_farthest(geometry, pairs, cut)
    return OpeningBand(
        **vars(base)
        | {
            "lenslet_nodes": max(_count(geometry, parabolic, *pair) for pair in pairs),
            "sampling": math.hypot(base.sampling, moved, own.lost / dim),
        },
        kernel_cut=cut,
        kernel_terms=len(far.core),
    )


class OpenLenslets(LensletFields):
    """Sensor fields behind lenslets of any shape by the exact kernel; see the module."""

    shared_axis = 1

    def __init__(
        self, camera: Camera, geometry: Geometry, plan: PifPlan, band: OpeningBand
    ) -> None:
        self.geometry, self.superpixels, self.band = geometry, plan.superpixels, band
        self.dtype = np.dtype(np.complex128 if plan.double else np.complex64)
        self._parabolic = camera.lenslet_array.profile == "parabolic"
        self._field = (
            separable_field(camera, geometry, band.half, band.spread_cut, spherical_field)
            if geometry.chief == (0.0, 0.0)
            else oblique_field(camera, geometry, band.half, band.spread_cut)
        )
        self.symmetry = self._field.symmetry
        self.notes = FieldNotes(
            separable_terms=band.kernel_terms,
            field_tail=self._field.tail,
            psf_terms=self._field.terms,
        )

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        g, total = self.geometry, np.zeros(len(rows))
        count = nodes_for(4 * g.k * g.D1 / 2 / g.z2 * max(g.lenslet_extent))
        for lenslet in _lenslets(g, self.superpixels, self.band.window):
            opening = _Opening(g, self._parabolic, lenslet, count)
            weight = opening.weights * opening.nearer**2
            for some, fields in self._entering(opening, rows, columns):
                power = np.square(fields.real) + np.square(fields.imag)
                total[some] += np.tensordot(power, weight, 2)
        return total * (1 + self.band.sampling)

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        reach = [(n - 1) // 2 for n in self.superpixels]
        place = self.geometry.centre(sy - reach[0], sx - reach[1])
        nodes = [
            sensor_nodes(self.geometry, axis, self.band.pixel_nodes, s, self.band.pixel_rule)
            for axis, s in enumerate(place)
        ]

        def energies(rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
            shape = nodes[0][0].size, nodes[1][0].size
            step = max(1, TOGETHER // math.prod(shape))
            order = np.argsort(columns, kind="stable")
            for start in range(0, len(order), step):
                part = order[start : start + step]
                total = np.zeros((len(part), *shape), self.dtype)
                for lenslet in _seen_from(self.geometry, place, self.band.window):
                    self._add(place, lenslet, nodes, rows[part], columns[part], total)
                out[part] = pixel_energy(
                    total.reshape(len(part), *nodes[0][0].shape, *nodes[1][0].shape)
                )

        return energies

    def _add(
        self,
        place: Place,
        lenslet: Place,
        nodes: list[tuple[np.ndarray, np.ndarray]],
        rows: np.ndarray,
        columns: np.ndarray,
        total: np.ndarray,
    ) -> None:
        """Add a lenslet's field on the nodes of a superpixel: total (point, row, column)."""
        g, offset = self.geometry, _offset(self.geometry, place, lenslet)
        opening = _Opening(g, self._parabolic, lenslet, _count(g, self._parabolic, offset, lenslet))
        residual = _residual(g, offset, self.band.kernel_cut)
        down, across = (
            self._kernel(residual, opening, axis, offset, *(a.ravel() for a in nodes[axis]))
            for axis in (0, 1)
        )
        # terms side by side, the kernel's weights in the first of the two
        down = np.ascontiguousarray(np.einsum("rvy,rs->vsy", down, residual.core.astype(complex)))
        down = down.astype(self.dtype).reshape(-1, len(opening.y))
        across = across.transpose(0, 2, 1).astype(self.dtype).reshape(-1, across.shape[1])
        lens = opening.wave().astype(self.dtype)
        for some, fields in self._entering(opening, rows, columns):
            for point, field in zip(some, fields):
                behind = down @ (field * lens)
                total[point] += behind.reshape(total.shape[1], -1) @ across

    def _kernel(
        self,
        residual: Residual,
        opening: _Opening,
        axis: int,
        offset: Place,
        u: np.ndarray,
        weight: np.ndarray,
    ) -> np.ndarray:
        """The kernel along an axis, roots of the sensor's weights in it: (term, node, place)."""
        g, x = self.geometry, (opening.y, opening.x)[axis]
        way = path(offset[axis] + u[:, None] - x, g.z3, offset[axis], offset[1 - axis])
        wave = np.sqrt(weight / (g.wavelength * g.z3))[:, None] * np.exp(1j * g.k * way)
        return residual.functions(axis, u, x) * wave

    def _entering(
        self, opening: _Opening, rows: np.ndarray, columns: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Fields of points on the nodes of an opening, without weights and the chief ray's sphere.

        Yields (which points, (point, row, column)) column by column of the points.
        """
        lines, values = (rows, columns), []
        for axis, at in enumerate(opening.places):
            points = self.geometry.points(axis)
            used = np.unique(lines[axis])
            found = self._field.evaluate(at - points[used][:, None], axis)
            found = at_points(self._field, found, points[used][:, None])
            kind = self.dtype if np.iscomplexobj(found) else np.empty(0, self.dtype).real.dtype
            values.append(found.astype(kind))
        row = np.searchsorted(np.unique(rows), rows)
        for number, column in enumerate(np.unique(columns)):
            some = np.flatnonzero(columns == column)
            yield some, values[0][row[some]] @ values[1][number].T


class _Opening:
    """Nodes of the rectangle around a lenslet's opening.

    y, x: m from its centre;
    places: m from the object's own lenslet;
    weights: (row, column) m^2;
    nearer: (row, column) how much stronger the main lens's wave is than at the object's own
        lenslet.
    """

    def __init__(self, geometry: Geometry, parabolic: bool, lenslet: Place, count: int) -> None:
        g, t = geometry, gauss(count)[0]
        self._geometry, self._parabolic = g, parabolic
        self.y, self.x = (extent * t for extent in g.lenslet_extent)
        self.places = tuple(a * g.D2 + at for a, at in zip(lenslet, (self.y, self.x)))
        self.weights = math.prod(g.lenslet_extent) * opening_weights(g.lenslet_shape, count)
        self._aside = g.chief != (0.0, 0.0)
        y, x = (c + at for c, at in zip(g.chief, self.places))
        self._far2 = g.z2**2 + y[:, None] ** 2 + x**2
        self.nearer = np.ones(self.weights.shape)
        if self._aside:
            self.nearer = (g.z2**2 + g.chief[0] ** 2 + g.chief[1] ** 2) / self._far2

    def wave(self) -> np.ndarray:
        """Lens, chief ray's sphere and weights: (row, column) m^2."""
        g = self._geometry
        q = self.y[:, None] ** 2 + self.x**2
        lens = q / (2 * g.f2) if self._parabolic else q / (np.hypot(np.sqrt(q), g.f2) + g.f2)
        if self._aside:
            middle = g.z2**2 + g.chief[0] ** 2 + g.chief[1] ** 2
            come = (self._far2 - middle) / (np.sqrt(self._far2) + math.sqrt(middle))
        else:
            come = (self.places[0][:, None] ** 2 + self.places[1] ** 2) / (2 * g.z2)
        return self.weights * self.nearer * np.exp(1j * g.k * (come - lens))


def _lenslets(geometry: Geometry, superpixels: tuple[int, int], window: int | None) -> list[Place]:
    """Where lenslets stand whose light is followed, in pitches."""
    if window is None:
        return list(geometry.places(superpixels))
    return [p for lenslets in geometry.neighbourhood(window) for p in product(*lenslets)]


def _seen_from(geometry: Geometry, place: Place, window: int | None) -> list[Place]:
    """The lenslets that light the superpixel at `place`."""
    return [place] if window is None else _lenslets(geometry, (1, 1), window)


def _pairs(
    geometry: Geometry, superpixels: tuple[int, int], window: int | None
) -> Iterator[tuple[Place, tuple[Place, Place]]]:
    """(superpixel, (offset from the lenslet, lenslet)) of all pairs."""
    for place in geometry.places(superpixels):
        for lenslet in _seen_from(geometry, place, window):
            yield place, (_offset(geometry, place, lenslet), lenslet)


def _nearest_and_farthest(
    geometry: Geometry, pairs: Collection[tuple[Place, Place]], cut: float
) -> tuple[Residual, Residual]:
    """Residuals of a lenslet's own superpixel and of the pair (offset, lenslet) farthest apart."""
    far = max(math.hypot(*offset) for offset, _ in pairs)
    farthest = min(offset for offset, _ in pairs if math.hypot(*offset) >= far)
    own = _offset(geometry, (0.0, 0.0), (0.0, 0.0))
    return _residual(geometry, own, cut), _residual(geometry, farthest, cut)


def _offset(geometry: Geometry, place: Place, lenslet: Place) -> Place:
    """From a lenslet to the centre of the superpixel at `place` (both in pitches): (rows, columns)
    m.
    """
    g = geometry
    y, x = (
        s * g.superpixel_pitch - m * g.D2 + c * g.z3 / g.z2
        for s, m, c in zip(place, lenslet, g.chief)
    )
    return y, x


def _reach(geometry: Geometry, axis: int) -> float:
    """Half width (m) of a superpixel's window, wherever the raster puts it."""
    pixels = geometry.pixel_shape[axis] + (geometry.pixel_shift is not None)
    return pixels * geometry.pixel_pitch / 2


@lru_cache(maxsize=512)
def _residual(geometry: Geometry, offset: Place, cut: float) -> Residual:
    """What the kernel's two axes do together, from a lenslet to a superpixel."""
    g = geometry
    reach = max(_reach(g, 0), _reach(g, 1))
    return Residual(offset, reach, max(g.lenslet_extent), g.z3, g.k, None, cut)


@lru_cache(maxsize=4096)
def _count(geometry: Geometry, parabolic: bool, offset: Place, lenslet: Place) -> int:
    """Nodes per axis that integrate what is summed over a square opening, or that carry it to the
    weights of another.
    """
    g, most = geometry, 0.0
    y, x = (extent * np.linspace(-1, 1, 5) for extent in g.lenslet_extent)
    v, u = (o + _reach(g, n) * np.linspace(-1, 1, 5) for n, o in enumerate(offset))
    y, x = y[:, None, None, None], x[:, None, None]
    come = [c + m * g.D2 + at for c, m, at in zip(g.chief, lenslet, (y, x))]
    goes = v[:, None] - y, u - x
    far = np.sqrt(g.z2**2 + come[0] ** 2 + come[1] ** 2) if g.chief != (0.0, 0.0) else g.z2
    on = np.sqrt(g.z3**2 + goes[0] ** 2 + goes[1] ** 2)
    bend = g.f2 if parabolic else np.sqrt(g.f2**2 + y * y + x * x)
    for axis, at in enumerate((y, x)):
        slope = np.abs(come[axis] / far - at / bend - goes[axis] / on).max()
        most = max(most, g.lenslet_extent[axis] * (slope + g.D1 / (2 * g.z2)))
    return nodes_for((1 if g.lenslet_shape == "square" else 2) * g.k * most)


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix consists of, as Model.features."""
    assert isinstance(band, OpeningBand)
    g, superpixels, oblique = geometry, superpixels_of(shape[1]), geometry.chief != (0.0, 0.0)
    parabolic = camera.lenslet_array.profile == "parabolic"
    lit = columns(camera, g, shape) / shape[1]
    tall, wide = (n * band.pixel_nodes for n in g.pixel_shape)
    all_pairs = [pair for _, pair in _pairs(g, superpixels, band.window)]
    nodes = np.array([_count(g, parabolic, *pair) for pair in all_pairs])
    # the kernel's products are fewer for lenslets that are near
    r = (len(_nearest_and_farthest(g, all_pairs, band.kernel_cut)[0].core) + band.kernel_terms) / 2
    made = 1.0  # share of superpixels that symmetry does not give
    if not oblique:
        flip_rows, flip_columns, turned = expected_symmetry(camera, g, shape)
        rows, across = (
            (n + flip) // (1 + flip) for n, flip in zip(superpixels, (flip_rows, flip_columns))
        )
        made = (rows * (rows + 1) / 2 if turned else rows * across) / shape[1]
    pairs = len(nodes) * made
    most, lines, terms = int(nodes.max()), max(g.object_shape), float(band.terms)
    # a wave off the axis has terms that go with the point, too
    orders, terms = orders_for(g, band.spread_cut), (OBLIQUE_TERMS if oblique else 1) * terms
    values = float((nodes**2).sum()) * lit
    # every part of the points makes its kernels anew
    parts = max(math.ceil(g.object_shape[1] / 16), math.ceil(lit * tall * wide / TOGETHER))
    twice, item = (2.0, 16) if double else (1.0, 8)
    return Features(
        {
            "products": 8.0 * r * lit * float((nodes * tall * (nodes + wide)).sum()),
            "fields": 8.0 * terms * values,
        },
        {
            "process": 1.0,
            "pairs": pairs,
            "pair_parts": pairs * parts,
            "values": twice * values,
            "sensor_values": twice * tall * wide * lit * len(nodes),
            "kernel_values": float(nodes.mean()) * r * (tall + wide) * parts * pairs,
            "spread_values": orders * pairs * parts * most * lines * band.psf_nodes * terms,
            "written": math.prod(shape[1:]),
        }
        | field_seconds(camera, g, band, band.spread_cut, twice),
        (
            {
                "process": 1.0,
                "kernels": item * band.kernel_terms * most * (tall + wide),
                "fields": item * lines * (most**2 + 2 * most * terms),
                "spread": 16 * (orders * band.psf_nodes) ** 2,
                "sensor": item * tall * wide * max(min(lit / parts, TOGETHER / tall / wide), 1),
            },
        ),
    )
