"""Fields behind lenslets of any shape, anywhere on the array, by the exact scalar kernel: with
opening weights W on nodes of the rectangle around a lenslet and the kernel as a short sum of
products (residual.Residual), the field of a point is

    U(v, u) = sum over lenslets and terms r of [P_r(v, y_i)] [W_ij L_ij h_ij] [Q_r(u, x_j)]^T.

docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.forward.camera.quadrature import gauss, nodes_for, opening_weights
from plenocli.forward.propagation.exact.debye import spherical_field
from plenocli.forward.propagation.exact.oblique import at_points, oblique_field
from plenocli.forward.propagation.exact.residual import Residual, path, residual_nodes
from plenocli.forward.propagation.fresnel.spread_function import separable_field

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

Place = tuple[float, float]
"""(row, column), in pitches where it is said."""
Nodes = tuple[np.ndarray, np.ndarray]
"""(positions, m from a superpixel's centre; weights, m)."""


MOST_NODES, MANY_NODES = 600, 100
"""Nodes along an axis of what a kernel's axes have together: beyond the first singular values take
seconds and functions gigabytes; beyond the second they are not kept for other pairs.
"""
NEAREST = 10
"""Wavelengths from lenslets to sensor within which evanescent waves reach it."""


def too_near(geometry: Geometry) -> str | None:
    """Why the exact kernel does not serve a sensor that close; None where it does."""
    away = geometry.z3 / geometry.wavelength
    if away >= NEAREST:
        return None
    return (
        f"the sensor lies {away:.2g} wavelengths behind the lenslets, and within {NEAREST} "
        "evanescent waves reach it"
    )


class OpenFields:
    """Fields of points behind lenslets of any shape.

    half: of the interval (m) on which the spread function is known;
    cuts: root energy of the spread function, and root mean square of the kernel, that may be left
        out;
    window: coherent lenslets on either side, None for isolated ones.
    field: the spread function;
    parabolic: whether lenslets are.
    """

    def __init__(
        self,
        camera: Camera,
        geometry: Geometry,
        half: float,
        cuts: tuple[float, float],
        window: int | None,
        dtype: np.dtype,
    ) -> None:
        self.geometry, self.window, self.dtype = geometry, window, dtype
        self.parabolic = camera.lenslet_array.profile == "parabolic"
        spread_cut, self._kernel_cut = cuts
        self.field = (
            separable_field(camera, geometry, half, spread_cut, spherical_field)
            if geometry.chief == (0.0, 0.0)
            else oblique_field(camera, geometry, half, spread_cut)
        )

    def on(
        self, place: Place, nodes: list[Nodes], rows: np.ndarray, columns: np.ndarray
    ) -> np.ndarray:
        """Fields on a superpixel, weights included.

        place: of the superpixel, in pitches;
        nodes: along rows and columns;
        rows, columns: (point,) indices.

        Returns (point, row node, column node).
        """
        total = np.zeros((len(rows), len(nodes[0][0]), len(nodes[1][0])), self.dtype)
        for lenslet in seen_from(self.geometry, place, self.window):
            self._add(place, lenslet, nodes, rows, columns, total)
        return total

    def _add(
        self,
        place: Place,
        lenslet: Place,
        nodes: list[Nodes],
        rows: np.ndarray,
        columns: np.ndarray,
        total: np.ndarray,
    ) -> None:
        """Add a lenslet's field on the nodes of a superpixel: total (point, row, column)."""
        g, offset = self.geometry, offset_of(self.geometry, place, lenslet)
        opening = Opening(
            g, self.parabolic, lenslet, opening_nodes(g, self.parabolic, offset, lenslet)
        )
        residual = residual_of(g, offset, self._kernel_cut)
        down, across = (
            self._kernel(residual, opening, axis, offset, *nodes[axis]) for axis in (0, 1)
        )
        # terms side by side, the kernel's weights in the first of the two
        down = np.ascontiguousarray(np.einsum("rvy,rs->vsy", down, residual.core.astype(complex)))
        down = down.astype(self.dtype).reshape(-1, len(opening.y))
        across = across.transpose(0, 2, 1).astype(self.dtype).reshape(-1, across.shape[1])
        lens = opening.wave().astype(self.dtype)
        for some, fields in self.entering(opening, rows, columns):
            for point, field in zip(some, fields):
                behind = down @ (field * lens)
                total[point] += behind.reshape(total.shape[1], -1) @ across

    def _kernel(
        self,
        residual: Residual,
        opening: Opening,
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

    def entering(
        self, opening: Opening, rows: np.ndarray, columns: np.ndarray
    ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Fields of points on the nodes of an opening, without weights and the chief ray's sphere.

        Yields (which points, (point, row, column)) column by column of the points.
        """
        lines, values = (rows, columns), []
        for axis, at in enumerate(opening.places):
            points = self.geometry.points(axis)
            used = np.unique(lines[axis])
            found = self.field.evaluate(at - points[used][:, None], axis)
            found = at_points(self.field, found, points[used][:, None])
            kind = self.dtype if np.iscomplexobj(found) else np.empty(0, self.dtype).real.dtype
            values.append(found.astype(kind))
        row = np.searchsorted(np.unique(rows), rows)
        for number, column in enumerate(np.unique(columns)):
            some = np.flatnonzero(columns == column)
            yield some, values[0][row[some]] @ values[1][number].T


class Opening:
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


def lenslets_about(
    geometry: Geometry, superpixels: tuple[int, int], window: int | None
) -> list[Place]:
    """Where lenslets stand whose light is followed, in pitches."""
    if window is None:
        return list(geometry.places(superpixels))
    return [p for lenslets in geometry.neighbourhood(window) for p in product(*lenslets)]


def seen_from(geometry: Geometry, place: Place, window: int | None) -> list[Place]:
    """The lenslets that light the superpixel at `place`."""
    return [place] if window is None else lenslets_about(geometry, (1, 1), window)


def offset_of(geometry: Geometry, place: Place, lenslet: Place) -> Place:
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


def residual_of(geometry: Geometry, offset: Place, cut: float) -> Residual:
    """What the kernel's two axes do together, from a lenslet to a superpixel.

    Raises NumericsError where that takes more than MOST_NODES.
    """
    g = geometry
    reach, own = max(_reach(g, 0), _reach(g, 1)), max(g.lenslet_extent)
    nodes = residual_nodes(offset, reach + own, g.z3, g.k)
    if nodes > MOST_NODES:
        raise NumericsError(
            f"what both axes of the way from a lenslet to its pixels have together takes {nodes} "
            f"nodes along an axis, more than {MOST_NODES}",
            "sensor",
            "take fewer pixels of a lenslet, or the paraxial model",
        )
    keep = _kept_residual if nodes <= MANY_NODES else _large_residual
    return keep(offset, reach, own, g.z3, g.k, None, cut)


_kept_residual, _large_residual = (lru_cache(maxsize=n)(Residual) for n in (512, 2))


@lru_cache(maxsize=4096)
def opening_nodes(geometry: Geometry, parabolic: bool, offset: Place, lenslet: Place) -> int:
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
