"""Sensor fields behind lenslets of any convex mirror-symmetric shape by matrix triple products: the
general Fresnel model.

The opening is cut into chords at quadrature nodes of one axis, the scan axis. A chord's integral is
that over the next shorter chord plus two short panels at its ends, so that all chords together cost
little more than one, and every integrand is smooth: spectral accuracy for circles and hexagons
alike. Mirror images of a chord share it. Per object point remain two products: scan nodes x
separable terms x sensor nodes, and sensor nodes x scan nodes x sensor nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.forward.camera.quadrature import gauss, nodes_for, smooth_nodes
from plenocli.forward.propagation.costs import Features
from plenocli.forward.propagation.fresnel.array_to_sensor import (
    lenslet_kernel,
    pixel_energy,
    sensor_nodes,
)
from plenocli.forward.propagation.fresnel.spread_function import separable_field
from plenocli.forward.propagation.lenslet_fields import FieldNotes, LensletFields
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import (
    distinct,
    field_features,
    has_real_field,
    superpixels_of,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan

Positions = Sequence[float] | np.ndarray
"""Where lenslets stand along one axis, in pitches."""
Products = Sequence[tuple[Positions, Positions]]
"""Lenslets as products of rows and columns."""
WORK_VALUES = 1 << 20
"""Complex numbers in the work arrays of a few points: about what the last-level cache holds."""
KEPT_BYTES = 1 << 26
"""Values of terms along chords that are kept for the guard, which needs them a second time; as
much again for kernels.
"""
PIECES = 6
"""Groups of short panels with a node count of their own."""
BLOCKS = 8
"""Blocks that columns come in, about."""


@dataclass(frozen=True)
class Chords:
    """Quadrature of a lenslet's opening, in metres from its centre.

    axis: the scan axis (0 rows, 1 columns);
    at, weight: (chord, mirror) scan nodes, at[h, i] = -at[h, -1-i], chords ascending in length;
    pieces: [(x, weight)], each (chord, node), in the chords' order: what a chord adds to the next
        shorter one, the first its whole self.
    """

    axis: int
    at: np.ndarray
    weight: np.ndarray
    pieces: tuple


def chords(shape: str, width: float, slope: float, error: float = 1e-10) -> Chords:
    """Chords of a lenslet's opening; hexagons have two flat sides facing +-x and are scanned across
    them.

    shape: "square", "circle" or "hexagon";
    width: m, across flat sides;
    slope: of the integrand's phase, up to so many rad/m;
    error: relative, of the short panels.
    """
    half = width / 2
    if shape == "square":
        t, w = gauss(2 * ((nodes_for(slope * half) + 1) // 2))
        return _chords(0, half * t[None], half * w[None], np.array([half]), slope, error)
    if shape == "circle":
        # equidistant angles converge spectrally, since the integrand is periodic in them; slope
        # runs along the rim
        count = int(np.ceil(slope * half / 4 + 1.5 * np.cbrt(slope * half) + 3))
        theta = (np.arange(count) + 0.5) * np.pi / (2 * count) - np.pi / 2
        at, weight, ends = (
            half * np.sin(theta),
            np.pi / (2 * count) * half * np.cos(theta),
            half * np.cos(theta),
        )
    else:
        t, w = gauss(nodes_for(slope * 2 / math.sqrt(3) * half / 2))
        at, weight = -half / 2 * (1 - t), half / 2 * w
        ends = (2 * half + at) / math.sqrt(3)
    return _chords(
        0 if shape == "circle" else 1,
        np.stack([at, -at], 1),
        np.stack([weight, weight], 1),
        ends,
        slope,
        error,
    )


def _chords(
    axis: int, at: np.ndarray, weight: np.ndarray, ends: np.ndarray, slope: float, error: float
) -> Chords:
    t, w = gauss(2 * ((nodes_for(slope * ends[0]) + 1) // 2))
    pieces = [(ends[0] * t[None], ends[0] * w[None])]
    # panels differ in width and so in nodes
    for part in (
        np.array_split(np.arange(1, len(ends)), min(PIECES, len(ends) - 1)) if len(ends) > 1 else ()
    ):
        low, high = ends[part - 1][:, None], ends[part][:, None]
        t, w = gauss(smooth_nodes(slope * float(np.max(high - low)) / 2, error))
        x, wx = (low + high) / 2 + (high - low) / 2 * t, (high - low) / 2 * w
        pieces.append((np.hstack([x, -x]), np.hstack([wx, wx])))
    return Chords(axis, at, weight, tuple(pieces))


class ShapedLenslets(LensletFields):
    """Sensor fields behind lenslets of one shape on a square or hexagonal lattice, for any
    pupil of the main lens.
    """

    by_superpixel = False

    def __init__(self, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan) -> None:
        self.geometry, self.superpixels, self.window = geometry, plan.superpixels, band.window
        self.pixel_nodes, self.pixel_rule, self.dtype = (
            band.pixel_nodes,
            band.pixel_rule,
            np.complex128 if plan.double else np.complex64,
        )
        self.field = separable_field(camera, geometry, band.half, band.spread_cut)
        self.symmetry = self.field.symmetry
        self.notes = FieldNotes(separable_terms=self.field.terms, field_tail=self.field.tail)
        self.cut = chords(
            geometry.lenslet_shape,
            geometry.lenslet_width,
            _slope(camera, geometry, plan.superpixels, band.window),
            band.spread_cut / 30,
        )
        self.shared_axis = 1 - self.cut.axis
        self._sites = geometry.places(plan.superpixels)
        self._products: dict[Hashable, Products] = (
            {site: [([site[0]], [site[1]])] for site in self._sites}
            if self.window is None
            else {None: geometry.neighbourhood(self.window)}
        )
        self._kept: dict[Hashable, list[np.ndarray]] = {}
        self._hops: dict[Hashable, tuple[Any, int]] = {}
        self._heights = {
            key: [self._rows(product[self.cut.axis]) for product in products]
            for key, products in self._products.items()
        }

    def _stored(self, values: np.ndarray) -> np.ndarray:
        """Values of terms in the precision of the tables, real where they are."""
        return values.astype(self.dtype if np.iscomplexobj(values) else self.dtype().real.dtype)

    # the two tables of one set of lenslets

    def _rows(self, positions: Positions) -> np.ndarray:
        """Terms at the scan nodes of lenslets at `positions`, sums and differences of mirror
        images: (point, chord, node, term).
        """
        g, axis = self.geometry, self.cut.axis
        at = (self.cut.at[:, :, None] + np.asarray(positions) * g.D2).reshape(len(self.cut.at), -1)
        values = self.field.evaluate(at - g.points(axis)[:, None, None], axis)
        return np.ascontiguousarray(self._stored(_folded(values, 2)))

    def _across(self, positions: Positions, place: float) -> list[np.ndarray]:
        """Kernels along the chords of lenslets at `positions` to the superpixel at `place`: by
        piece (chord, node, sensor node).
        """
        axis = 1 - self.cut.axis
        u, wu = (
            a.ravel()
            for a in sensor_nodes(self.geometry, axis, self.pixel_nodes, place, self.pixel_rule)
        )
        parts = []
        for x, w in self.cut.pieces:
            kernels = [
                (lenslet_kernel(self.geometry, n - place, u, wu, x.ravel()) * w.ravel()).reshape(
                    len(u), *x.shape
                )
                for n in positions
            ]
            parts.append(
                np.ascontiguousarray(np.concatenate(kernels, axis=2).transpose(1, 2, 0)).astype(
                    self.dtype
                )
            )
        return parts

    def _along(self, positions: Positions, index: int) -> list[np.ndarray]:
        """Terms at the chords' nodes of lenslets at `positions` for point `index` of the chord
        axis: by piece (chord, term, node).
        """
        key = tuple(positions), int(index)
        if key not in self._kept:
            g, axis = self.geometry, 1 - self.cut.axis
            shift = np.asarray(positions) * g.D2 - g.points(axis)[index]
            nodes = np.concatenate(
                [(x[:, None, :] + shift[:, None]).ravel() for x, _ in self.cut.pieces]
            )
            values = np.ascontiguousarray(self._stored(self.field.evaluate(nodes, axis)).T)
            parts, start = [], 0
            for x, _ in self.cut.pieces:
                stop = start + x.size * len(shift)
                parts.append(
                    values[:, start:stop].reshape(len(values), len(x), -1).transpose(1, 0, 2)
                )
                start = stop
            if sum(_whole(kept[0]).nbytes for kept in self._kept.values()) > KEPT_BYTES:
                self._kept.clear()
            self._kept[key] = parts
        return self._kept[key]

    def _kernel(self, products: Products, place: float) -> np.ndarray:
        """Kernel from the scan nodes of all products to the superpixel at `place`: (sensor node,
        sums of all, differences of all).
        """
        axis = self.cut.axis
        v, wv = (
            a.ravel()
            for a in sensor_nodes(self.geometry, axis, self.pixel_nodes, place, self.pixel_rule)
        )
        sums, differences = [], []
        for product in products:
            kernels = np.stack(
                [
                    lenslet_kernel(self.geometry, n - place, v, wv, self.cut.at.ravel())
                    * self.cut.weight.ravel()
                    for n in product[axis]
                ],
                axis=-1,
            )
            folded = _folded(kernels.reshape(len(v), len(self.cut.at), -1), 2) / 2
            half = folded.shape[2] // 2
            sums.append(folded[:, :, :half].reshape(len(v), -1))
            differences.append(folded[:, :, half:].reshape(len(v), -1))
        return np.ascontiguousarray(np.hstack(sums + differences)).astype(self.dtype)

    # pixel energies

    def columns(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        """As LensletFields.columns."""
        points = (rows, columns)
        scan, chord = points[self.cut.axis], points[1 - self.cut.axis]
        order = np.argsort(chord, kind="stable")
        groups = np.split(order, np.flatnonzero(np.diff(chord[order])) + 1)
        for key, place, sites in self._tasks():
            products = self._products[key]
            across = self._once(
                ("across", key, place),
                lambda: [self._across(product[1 - self.cut.axis], place) for product in products],
            )
            kernels = [
                (
                    index,
                    self._once(("scan", key, n), partial(self._kernel, products, n)),
                    self._mirrored(products, n),
                )
                for index, n in sites
            ]
            step = max(1, WORK_VALUES // max(a.size for _, a, _ in kernels))
            for group in groups:
                spread = [
                    self._spread(product, kernel, chord[group[0]])
                    for product, kernel in zip(products, across)
                ]
                for start in range(0, len(group), step):
                    part = group[start : start + step]
                    lines = self._lines(key, scan[part], spread)
                    for (sy, sx), kernel, mirrored in kernels:
                        energy = self._energy(kernel, lines, mirrored)
                        out[part, sy, sx] = energy.transpose(0, 2, 1) if self.cut.axis else energy

    def _once(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """Kernels made by `make`, kept for the next block of points while they are few."""
        if key not in self._hops:
            if sum(size for _, size in self._hops.values()) > KEPT_BYTES:
                self._hops.clear()
            made = make()
            self._hops[key] = (
                made,
                sum(a.nbytes for part in made for a in part)
                if isinstance(made, list)
                else made.nbytes,
            )
        return self._hops[key][0]

    def _tasks(self) -> list[tuple[Hashable, float, list]]:
        """Superpixels that share their place along the chords: (key of the products, place,
        [(index in out, scan place)]).
        """
        tasks: dict[tuple[Hashable, float], list] = {}
        for site, index in self._sites.items():
            key = site if self.window is None else None
            tasks.setdefault((key, site[1 - self.cut.axis]), []).append(
                (index, site[self.cut.axis])
            )
        return [(key, place, sites) for (key, place), sites in tasks.items()]

    def _mirrored(self, products: Products, place: float) -> bool:
        """Whether mirroring maps the scan nodes onto themselves as seen from the superpixel, so
        that sums and differences part.
        """
        centred = all(
            np.allclose(
                np.asarray(p[self.cut.axis]) - place,
                place - np.asarray(p[self.cut.axis])[::-1],
                atol=1e-12,
            )
            for p in products
        )
        return centred and self.geometry.window_shift(self.cut.axis, place) == 0

    def _spread(
        self, product: tuple[Positions, Positions], across: list[np.ndarray], index: int
    ) -> np.ndarray:
        """Terms carried along every chord to the sensor, for one point of the chord axis:
        (chord, term, sensor node).
        """
        out = np.empty((len(self.cut.at), self.field.terms, across[0].shape[2]), self.dtype)
        start = 0
        for values, kernel in zip(self._along(product[1 - self.cut.axis], index), across):
            _times(values, kernel, out[start : start + len(kernel)])
            start += len(kernel)
        return _accumulated(out)

    def _lines(self, key: Hashable, scan: np.ndarray, spread: list[np.ndarray]) -> np.ndarray:
        """Fields of points `scan` at the scan nodes, before the hop along the scan axis: (point,
        sums then differences, sensor node).
        """
        tables = self._heights[key]
        count = sum(t.shape[1] * t.shape[2] for t in tables)
        out = np.empty((len(scan), 2, count // 2, spread[0].shape[2]), self.dtype)
        start = 0
        for table, terms in zip(tables, spread):
            chosen = table[scan].transpose(1, 0, 2, 3)
            chords, points, nodes, _ = chosen.shape
            fields = np.empty((chords, points * nodes, terms.shape[2]), self.dtype)
            _times(chosen.reshape(chords, points * nodes, -1), terms, fields)
            fields = fields.reshape(chords, points, 2, nodes // 2, -1)
            stop = start + chords * nodes // 2
            out[:, :, start:stop].reshape(points, 2, chords, nodes // 2, -1)[...] = (
                fields.transpose(1, 2, 0, 3, 4)
            )
            start = stop
        return out.reshape(len(scan), count, -1)

    def _energy(self, kernel: np.ndarray, lines: np.ndarray, mirrored: bool) -> np.ndarray:
        p, shape = self.pixel_nodes, self.geometry.pixel_shape
        ps, pc = shape[self.cut.axis], shape[1 - self.cut.axis]
        field = _hop(kernel, lines) if mirrored else kernel @ lines
        return pixel_energy(field.reshape(len(lines), p, ps, p, pc))

    # the guard

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        scan, chord = (rows, columns) if self.cut.axis == 0 else (columns, rows)
        share = np.zeros(len(rows))
        for key, products in self._products.items():
            for number, product in enumerate(products):
                weight = np.repeat(
                    self.cut.weight[:, : self.cut.weight.shape[1] // 2],
                    len(product[self.cut.axis]),
                    axis=1,
                )
                weight = np.concatenate([weight, weight], axis=1) / 2
                for index in np.unique(chord):
                    here = np.flatnonzero(chord == index)
                    heights = self._heights[key][number][scan[here]].transpose(1, 0, 2, 3)
                    lines = heights.reshape(len(heights), -1, self.field.terms)
                    entered = (lines @ self._gram(product, index)).view(lines.real.dtype)
                    entered *= lines.view(lines.real.dtype)
                    share[here] += np.einsum(
                        "hir,hr->i", entered.sum(axis=2).reshape(heights.shape[:3]), weight
                    )
        return share

    def _gram(self, product: tuple[Positions, Positions], index: int) -> np.ndarray:
        """Gram matrices of the terms over every chord, for one point of the chord axis:
        (chord, term, term).
        """
        positions, parts = product[1 - self.cut.axis], []
        for values, (_, w) in zip(self._along(positions, index), self.cut.pieces):
            weight = np.tile(w, len(positions)).astype(values.real.dtype)
            parts.append((values * weight[:, None]) @ values.conj().transpose(0, 2, 1))
        return _accumulated(np.concatenate(parts))


def _whole(part: np.ndarray) -> np.ndarray:
    """The array that holds the numbers of a view."""
    return part if part.base is None else part.base


def _times(values: np.ndarray, kernel: np.ndarray, out: np.ndarray) -> None:
    """out[...] = values @ kernel, for real or complex values and a complex kernel."""
    if np.iscomplexobj(values):
        np.matmul(values, kernel, out=out)
    else:  # real and imaginary parts side by side
        np.matmul(values, kernel.view(values.dtype), out=out.view(values.dtype))


def _accumulated(panels: np.ndarray) -> np.ndarray:
    """Running sums over the first axis, in place: plane by plane, which is many times
    faster than cumsum.
    """
    for shorter, longer in zip(panels, panels[1:]):
        longer += shorter
    return panels


def _folded(values: np.ndarray, axis: int) -> np.ndarray:
    """Sums, then differences, of mirror images along `axis` (of even length)."""
    first, last = np.split(values, 2, axis=axis)
    last = np.flip(last, axis)
    return np.concatenate([first + last, first - last], axis=axis)


def _hop(kernel: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """kernel @ lines for a kernel whose sums are even and whose differences are odd over the
    sensor nodes: half of the work.
    """
    nodes, count = kernel.shape[0], kernel.shape[1] // 2
    top = (nodes + 1) // 2
    even, odd = kernel[:top, :count] @ lines[:, :count], kernel[:top, count:] @ lines[:, count:]
    out = np.empty((len(lines), nodes, lines.shape[2]), lines.dtype)
    np.add(even, odd, out=out[:, :top])
    np.subtract(even, odd, out=out[:, ::-1][:, :top])
    return out


def _slope(camera: Camera, geometry: Geometry, grid: tuple[int, int], window: int | None) -> float:
    """Largest gradient (rad/m) of the phase on a lenslet: of the hop to the farthest pixel, of
    the pupil's rim, of kappa.
    """
    g = geometry
    raster = 0.0 if g.pixel_shift is None else 0.5
    far = (0.0, 0.0) if window is None else np.add(g.reach(grid), g.reach(grid, window))
    reach = math.hypot(
        *(
            (n / 2 + raster) * g.pixel_pitch + f * g.superpixel_pitch
            for n, f in zip(g.pixel_shape, far)
        )
    )
    rim = (
        g.D1 / 2 * (1 if camera.main_lens.aperture_shape in ("circle", "annulus") else math.sqrt(2))
    )
    corner = math.hypot(*g.lenslet_extent) if g.lenslet_shape == "square" else max(g.lenslet_extent)
    return g.k * (reach / g.z3 + rim / g.z2 + abs(g.kappa) * corner)


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for; None: every lenslet shape and lattice of a camera description, and every
    pupil, can be cut into chords.
    """
    return None


def _chord_counts(
    shape: str, width: float, slope: float, error: float
) -> tuple[int, int, int, int]:
    """What `chords` will make: (axis, lines, nodes across the lines, nodes along all their
    pieces), without making them.
    """
    half = width / 2

    def pieces(ends: np.ndarray) -> int:
        total = 2 * ((nodes_for(slope * ends[0]) + 1) // 2)
        for part in (
            np.array_split(np.arange(1, len(ends)), min(PIECES, len(ends) - 1))
            if len(ends) > 1
            else ()
        ):
            total += (
                2
                * len(part)
                * smooth_nodes(slope * float(np.max(ends[part] - ends[part - 1])) / 2, error)
            )
        return total

    if shape == "square":
        count = 2 * ((nodes_for(slope * half) + 1) // 2)
        return 0, 1, count, pieces(np.array([half]))
    if shape == "circle":
        count = int(np.ceil(slope * half / 4 + 1.5 * np.cbrt(slope * half) + 3))
        return (
            0,
            count,
            2 * count,
            pieces(half * np.cos((np.arange(count) + 0.5) * np.pi / (2 * count) - np.pi / 2)),
        )
    count = nodes_for(slope * 2 / math.sqrt(3) * half / 2)
    # Gauss-Legendre nodes to a part in a million
    t = -np.cos(np.pi * (np.arange(count) + 0.75) / (count + 0.5))
    return 1, count, 2 * count, pieces((2 * half - half / 2 * (1 - t)) / math.sqrt(3))


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix consists of, counted from the node rules, without the points that
    symmetry gives.
    """
    grid, superpixels, item = superpixels_of(shape[1]), shape[1], 16 if double else 8
    axis, count, on_scan, on_chords = _chord_counts(
        geometry.lenslet_shape,
        geometry.lenslet_width,
        _slope(camera, geometry, grid, band.window),
        band.spread_cut / 30,
    )
    products = [([0.0], [0.0])] if band.window is None else geometry.neighbourhood(band.window)
    nodes = [n * band.pixel_nodes for n in geometry.pixel_shape]
    across, along = nodes[1 - axis], nodes[axis]
    points, of_axis = distinct(camera, geometry, shape)[0], geometry.object_shape[1 - axis]
    # at the blocks' borders a line of points is begun anew
    lanes = min(points, BLOCKS + (of_axis if points == shape[3] else (of_axis + 1) // 2))
    scan = sum(on_scan * len(p[axis]) for p in products)
    chord = sum(on_chords * len(p[1 - axis]) for p in products)
    count, terms = count * len(products), band.terms
    places = geometry.lines(grid, 1 - axis) if band.window is not None else superpixels
    wide = item / 8  # what is twice as long takes twice the time
    parts = 1 if has_real_field(camera, geometry) else 2
    chord_values = lanes * chord * band.psf_nodes
    scan_values = geometry.object_shape[axis] * scan * band.psf_nodes
    heights = geometry.object_shape[axis] * scan * terms
    kernels = places * chord * across + superpixels * scan * along
    alone = superpixels if band.window is None else 1
    return Features(
        {
            "chords_to_sensor": 4.0 * parts * lanes * places * chord * terms * across,
            "scan_lines": 4.0 * parts * points * places * scan * terms * across,
            "hop": 8.0 * points * scan * across * along * superpixels,
            "guard": 2.0 * parts**2 * points * scan * terms**2,
        },
        {
            "process": 1.0,
            "line_values": wide * places * across * (lanes * count * terms + points * scan),
            "sensor_values": wide * points * superpixels * across * along,
            "guard_values": wide * lanes * count * terms**2,
            "lines_of_points": lanes,
            "line_places": lanes * places,
            "line_superpixels": lanes * superpixels,
            "chord_values": chord_values,
            "chord_term_values": chord_values * terms,
            "scan_values": scan_values,
            "scan_term_values": scan_values * terms,
            "kernel_values": places * (chord * across + scan * along),
            "written": math.prod(shape[1:]),
            **field_features(camera, geometry, band),
        },
        (
            {
                "heights": item / 2 * parts * heights * alone,
                "spread": item * count * terms * across,
                "kept": sum(
                    min(KEPT_BYTES, item * values)
                    for values in (alone * of_axis * chord * terms, kernels)
                ),
                "process": 1.0,
            },
        ),
    )
