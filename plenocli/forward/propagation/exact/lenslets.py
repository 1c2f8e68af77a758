"""Sensor fields behind square lenslets by the exact scalar kernel: Rayleigh and Sommerfeld's first
integral as low rank. The kernel's residual (residual.Residual) and the main lens's field are short
sums of products, and so is the field M[(u, xp), (v, yp)] of all points of a superpixel, compressed
to its own rank (low_rank_product): factor tables as the paraxial model has them (separable_fields).
docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import on_threads, spread, spread_in_turn
from plenocli.base.device import device
from plenocli.forward.camera.quadrature import gauss, nodes_for
from plenocli.forward.propagation.exact.debye import spherical_field
from plenocli.forward.propagation.exact.interval_pairs import Interval, Modes, Pair, SensorSide
from plenocli.forward.propagation.exact.low_rank_product import Product
from plenocli.forward.propagation.exact.oblique import at_points, oblique_field
from plenocli.forward.propagation.exact.open_fields import too_near
from plenocli.forward.propagation.exact.prolate import prolate, prolate_count
from plenocli.forward.propagation.exact.term_counts import (
    MARGIN_ASIDE,
    MARGINS_JOINED,
    ExactBand,
    field_rank,
    field_terms,
    is_spanned,
    require_sketch,
    sketch_size,
)
from plenocli.forward.propagation.exact.trial import exact_trial_columns
from plenocli.forward.propagation.fresnel.array_to_sensor import lit_lenslets, sensor_nodes
from plenocli.forward.propagation.fresnel.separable_fields import (
    Factors,
    lines_serve,
    on_modes,
    pixel_modes,
)
from plenocli.forward.propagation.fresnel.spread_function import (
    edge_emphasis,
    psf_nodes,
    separable_field,
)
from plenocli.forward.propagation.lenslet_fields import (
    FieldNotes,
    LensletFields,
    PixelEnergies,
)
from plenocli.forward.propagation.sampling import size_band

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.exact.low_rank_product import Matrix
    from plenocli.forward.propagation.plan import PifPlan

CUT, CUT_EFFECT, MANY_CELLS = 0.42, 1.3, 15.0
"""Root-energy cut of the field over the accuracy asked for, and its effect on the worst column
over itself (measured: 0.5 to 2.3), from so many diffraction cells on.
"""

SIDES, COARSE = 0.8, 3e-4
"""By how much finer coarse fields with neighbours are computed: from ten times that accuracy on,
less towards it.
"""

SPILL = 0.25
"""Share of the light outside a point's brightest lenslet that may lie on a superpixel beside it:
what a lenslet's far edge diffracts there is up to 0.23 of it (two cameras, f/4.4 and f/8).
"""

DIM, CONCENTRATION, EVENLY, WORST = 4.0, 0.7, 0.35, 0.25
"""On superpixels beside the own one. Errors of dim light may be as large as what adds so many cuts
to the light by their own energy. Of what lenslets may lose, of all points together, those that
count most take more than their share: 1 would leave them none of it, 0 all. (What narrowing takes
is spread more evenly, at most 3.5 times the mean at f/4.4.) No point may lose more than so many
cuts where terms are left out, by its own light where that is less than the dimmest that was tried.
(Worst columns of two cameras, 5e-2 to 1e-4, as where all points count fully; points between
lenslets of a fill of 0.6 lost up to 1.4 times what was asked with twice as many, at f/1.5 and
f/2.5.)
"""

FINE = 8e-5
"""Accuracy from which on each of many lenslets loses a third as much: corners of steep ones lost
1.8 times what was asked at 1e-5, 1.1 at 6e-5 and 0.9 at 1e-4 (f/1.5).
"""

PIXEL_LOSS = 0.2
"""Cuts that a point's pixels on a superpixel may lose where fewer numbers than nodes carry them:
of what was asked, 0.08 an axis and superpixel. From FINE on a third of it. (Corners at f/1.5 were
0.27 of what was asked worse with half as much again at 1e-3, and 0.2 at 1e-5 without the third.)
"""

LEAST = 1e-10
"""Finest cut: below it is the rounding of double precision."""


def exact_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
) -> ExactBand:
    """As Model.size: node counts of the exact model at one wavelength, and the cut of its fields.

    Raises NumericsError where the field is expected to have far more terms than a sketch may hold.
    """
    # a corner's column is on four superpixels, each with errors of its own: without this up to 1.3
    # of what was asked from 3e-3 to 5e-2, 1.0 at 1e-3 and 0.8 at 1e-4, on 3 cameras (0.83 with it)
    finer = 1 + SIDES * min(1.0, max(0.0, math.log10(accuracy / COARSE))) if ring else 1.0
    base = size_band(
        camera,
        geometry,
        superpixels,
        ring,
        accuracy / finer,
        tolerance,
        tries=exact_trial_columns,
    )
    # light out of focus is spread over many superpixels, each of which is cut by itself; coarse
    # cuts hurt corners more
    share = min(1.0, 4 / math.pi * (geometry.D2 / max(geometry.blur, geometry.D2)) ** 2)
    cut = CUT * accuracy * math.sqrt(share) / (1 + 4 * accuracy) / finer
    # edges are all that columns of points beside a lenslet have
    cut = max(LEAST, cut * base.faintest)
    missed = CUT_EFFECT * max(CUT * accuracy, cut / base.faintest)
    missed *= math.sqrt(min(1.0, geometry.diffraction_cells / MANY_CELLS))
    count = prolate_count(_bandwidth(geometry), cut / 100)
    if count >= 0.8 * base.pixel_nodes * min(geometry.pixel_shape):
        count = 0
    require_sketch(field_terms(geometry, base.terms, cut, True))
    return ExactBand(
        **vars(base) | {"sampling": math.hypot(base.sampling, missed)},
        cut=cut,
        sensor_count=count,
    )


def _extent(geometry: Geometry, pixels: int) -> float:
    """Half width (m) of a superpixel of so many pixels, wherever the raster puts it."""
    return (pixels + (geometry.pixel_shift is not None)) * geometry.pixel_pitch / 2


def _bandwidth(geometry: Geometry) -> float:
    """Largest phase (rad over half a superpixel) of a lenslet's field on any superpixel, the path
    from its middle taken out: steeper rays come from no point of the lenslet. Up to 5 % are added
    for slopes that change on the way: without them, prolate functions fall short of waves that
    reach the band's end.
    """
    reach, source = _extent(geometry, max(geometry.pixel_shape)), geometry.lenslet_width / 2
    bent = 1.5 * ((source + reach) / (2 * geometry.z3)) ** 2
    return geometry.k * source * reach / geometry.z3 * (1 + min(0.05, bent))


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for: square lenslets, and no evanescent waves on the sensor."""
    array = camera.lenslet_array
    if array.lattice != "square" or array.aperture_shape != "square":
        return f"{array.aperture_shape} lenslets on a {array.lattice} lattice are not separable"
    return too_near(geometry)


@dataclass(frozen=True, kw_only=True)
class _Lit:
    """A superpixel and the light that is followed to it.

    at: row and column, from the object's own;
    symmetric: whether all about it is its own mirror image by the diagonal;
    kept: lenslets (row, column) and what they bring, the brightest last;
    cut: root energy of a mean point's field that all lenslets together may lose;
    narrowing, whole: of all points' fields, by narrowing lenslets' products and the joined one;
    guess: columns of the first sketch of that;
    spanned: whether these are kept as its terms;
    parts: of each lenslet, as Product has them, until they are joined.
    """

    at: tuple[int, int]
    symmetric: bool
    kept: dict[tuple[int, int], Pair]
    cut: float
    narrowing: float
    whole: float
    guess: int
    spanned: bool
    parts: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, Matrix]] = field(
        default_factory=dict
    )

    @property
    def brightest(self) -> tuple[int, int]:
        """The lenslet that brings most."""
        return list(self.kept)[-1]

    @property
    def alone(self) -> bool:
        """Whether there is only one."""
        return len(self.kept) == 1


_Part = tuple[np.ndarray, Interval, float]
"""What a lenslet brings along one axis: (lines x points, terms), the Interval, and how far aside
the superpixel is along the other (m)."""


class _Places:
    """Memory of large matrices that is used again: a fresh page takes longer than what is written
    on it.
    """

    def __init__(self) -> None:
        self._free: list[np.ndarray] = []
        self._taking = Lock()

    def take(self, shape: tuple[int, int], dtype: np.dtype) -> np.ndarray:
        """An array of whatever is there."""
        needed = math.prod(shape) * dtype.itemsize
        with self._taking:
            fits = [n for n, place in enumerate(self._free) if len(place) >= needed]
            number = min(fits, key=lambda n: len(self._free[n]), default=None)
            place = None if number is None else self._free.pop(number)
            if place is None:  # those that are too small are not kept beside it
                self._free.clear()
        place = np.empty(needed, np.uint8) if place is None else place
        return place[:needed].view(dtype).reshape(shape)

    def give(self, matrix: np.ndarray) -> None:
        """Back what was taken, and nobody uses any more."""
        while matrix.base is not None:
            matrix = matrix.base
        with self._taking:
            self._free.append(matrix)


def _side_by_side(parts: Sequence[_Part], alone: bool, places: _Places) -> np.ndarray:
    """Terms of all parts, (rows, terms): on what carries a lenslet alone, or where lenslets
    interfere, on the pixels, in one of the places.
    """
    if alone:
        return parts[0][0] if len(parts) == 1 else np.concatenate([p[0] for p in parts], axis=1)
    ends = np.cumsum([factor.shape[1] for factor, _, _ in parts])
    out = places.take((parts[0][1].side.pixel_rows, int(ends[-1])), parts[0][0].dtype)
    for end, (factor, interval, other) in zip(ends, parts):
        interval.on_pixels(factor, other, out[:, end - factor.shape[1] : end])
    return out


class ExactSquareLenslets(LensletFields):
    """Sensor fields behind square lenslets by the exact kernel; see the module."""

    def __init__(self, camera: Camera, geometry: Geometry, plan: PifPlan, band: ExactBand) -> None:
        self.geometry, self.superpixels, self.band = geometry, plan.superpixels, band
        self.dtype = np.dtype(np.complex128 if plan.double else np.complex64)
        self.device = device(plan.device)
        self._parabolic = camera.lenslet_array.profile == "parabolic"
        g = geometry
        self._field = (
            separable_field(camera, g, band.half, band.cut / 2, spherical_field)
            if g.chief == (0.0, 0.0)
            else oblique_field(camera, g, band.half, band.cut / 2)
        )
        flip_rows, flip_columns, turn = (
            a and b for a, b in zip(self._field.symmetry, g.mirrors(self.superpixels))
        )
        self.symmetry = flip_rows, flip_columns, turn
        alike = g.pixel_shape[0] == g.pixel_shape[1] and g.object_shape[0] == g.object_shape[1]
        self._turn = alike and turn
        with on_threads(plan.at_once):
            self._entering, self._counted = self._light()
        self._extent, self._bandwidth = (
            [_extent(geometry, n) for n in geometry.pixel_shape],
            _bandwidth(geometry),
        )
        self._sensor_sides: dict[tuple[int, int, bool], SensorSide] = {}
        self._intervals: dict[tuple[int, int, int, bool], Interval] = {}
        self._tables: dict[tuple[int, int], Factors] = {}
        self._places = _Places()
        products: dict[tuple[int, int], int] = {}
        largest_first = self._pairs()[::-1]

        def join(lit: _Lit) -> None:
            self._tables[lit.at], products[lit.at] = self._joined(lit)

        with on_threads(plan.at_once):
            self._meet_all(largest_first)
            # the brightest lenslets take longest
            spread_in_turn(
                [
                    ([(lit, key) for key in reversed(lit.kept)], partial(join, lit))
                    for lit in (self._lit(*at) for at in largest_first)
                ],
                self._follow,
            )
        self._intervals, self._places = {}, _Places()
        self.notes = FieldNotes(
            separable_terms=max(t.high.shape[3] for t in self._tables.values()),
            field_tail=self._field.tail,
            psf_terms=self._field.terms,
            products=max(products.values()),
        )

    # which lenslets light which superpixels

    def _reach(self, axis: int) -> int:
        return (self.superpixels[axis] - 1) // 2

    def _lenslets(self, s: int, axis: int) -> Sequence[int]:
        """Lenslets along one axis whose light is followed to superpixel s."""
        window = self.band.window
        return [s] if window is None else lit_lenslets(self._reach(axis), window)

    def _pairs(self) -> list[tuple[int, int]]:
        """Superpixels (rows, columns) whose tables are made; the others' follow by symmetry."""
        ry, rx = (self._reach(axis) for axis in (0, 1))
        return sorted(
            {self._canonical(sy, sx)[:2] for sy in range(-ry, ry + 1) for sx in range(-rx, rx + 1)}
        )

    def _canonical(self, sy: int, sx: int) -> tuple[int, int, bool]:
        sy, sx = abs(sy) if self.symmetry[0] else sy, abs(sx) if self.symmetry[1] else sx
        turned = self._turn and sy < sx
        return (sx, sy, True) if turned else (sy, sx, False)

    # one axis

    def _points(self, s: int, axis: int) -> np.ndarray:
        """Object points (m, on the array) along one axis that are computed for superpixel s; the
        others mirror them.
        """
        points = self.geometry.points(axis)
        return points[: (len(points) + 1) // 2] if s == 0 and self.symmetry[axis] else points

    def _counts(self, s: int, axis: int, beside: bool) -> np.ndarray:
        """How much errors of points' fields on superpixel s count, along one axis: (point,).

        beside: whether the superpixel is not the lenslet's own along the other axis either.
        """
        # errors of dim light count by their own energy in the end: accuracy for both axes together
        least = (DIM * self.band.cut / self.band.faintest) ** (0.25 if beside else 0.5)
        weights = self._counted[axis][s + len(self._counted[axis]) // 2]
        return np.maximum(weights[: len(self._points(s, axis))], least)

    def _worst(self, sy: int, sx: int) -> np.ndarray | None:
        """What each point (row, column) may lose on a superpixel beside the own one, root energy of
        its weighted field; None on the own one.
        """
        if not (sy or sx):
            return None
        light = self._entering[: len(self._points(sy, 0)), : len(self._points(sx, 1))]
        # the cut is for the dimmest point that was tried: one between lenslets may have less
        return WORST * self.band.cut * np.minimum(1, np.sqrt(light) / self.band.faintest)

    def _sensor_side(self, s: int, axis: int, beside: bool) -> SensorSide:
        """The SensorSide of superpixel s; beside: as _counts."""
        axis = 0 if self._turn else axis
        if (s, axis, beside) not in self._sensor_sides:
            g = self.geometry
            count, phase, extent = self.band.sensor_count, self._bandwidth, self._extent[axis]
            u, w = (
                a.ravel()
                for a in sensor_nodes(g, axis, self.band.pixel_nodes, s, self.band.pixel_rule)
            )
            modes = None
            if count:
                # functions beyond the bandwidth's own swing faster than it
                t, share = gauss(nodes_for(2 * phase) + count - int(2 * phase / math.pi))
                modes = Modes(
                    weighted=prolate(t, phase, count).T * np.sqrt(share),
                    pixels=u,
                    shown=np.sqrt(w / extent)[:, None] * prolate(u / extent, phase, count),
                )
                u, w = extent * t, extent * share
            points = self._points(s, axis)
            self._sensor_sides[s, axis, beside] = SensorSide(
                u=u,
                root=np.sqrt(w),
                points=points,
                emphasis=edge_emphasis(g, points) * self._counts(s, axis, beside),
                modes=modes,
            )
        return self._sensor_sides[s, axis, beside]

    def _interval(self, s: int, m: int, axis: int, beside: bool) -> None:
        """Makes the interval from lenslet m to superpixel s along an axis."""
        self._intervals[s, m, axis, beside] = Interval(
            self.geometry,
            self._field,
            axis,
            s,
            m,
            self._sensor_side(s, axis, beside),
            self._parabolic,
            self.band.cut / 3,
            self.dtype,
        )

    def _light(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Share of the light of a point (row, column) that enters the lenslets of the
        neighbourhood; by axis, how much errors of points count on superpixels (superpixel, point).
        """
        rows, signs = self._gram(0), self._field.signs
        alike = self._turn and self.superpixels[0] == self.superpixels[1]
        if alike and signs is not None:
            columns = rows * np.outer(signs, signs)
        else:
            columns = self._gram(1)
        y, x = rows.sum(axis=0), columns.sum(axis=0)
        entering = (y.reshape(len(y), -1) @ x.reshape(len(x), -1).T).real
        counted = [self._counting(rows, x, 0), self._counting(columns, y, 1)]
        if self._turn:  # one axis serves both, as far as the longer goes
            counted = [max(counted, key=len)] * 2
        return entering, counted

    def _counting(self, gram: np.ndarray, partner: np.ndarray, axis: int) -> np.ndarray:
        """How much errors of points' fields count along an axis: (superpixel, point), at most 1. An
        error dU of the field U adds 2 U dU to the light, and is a share of the root of the sum of
        its squares, which the brightest superpixels make.

        gram: (lenslet, point, term, term) of this axis;
        partner: (point, term, term) of the other.
        """
        light = np.einsum("mpij,ij->mp", gram, partner.mean(axis=0)).real
        far = (len(light) - self.superpixels[axis]) // 2
        light = np.maximum(light[far : len(light) - far], np.finfo(float).tiny)
        share = light / light.sum(axis=0)
        most = share.max(axis=0)
        shown = np.where(share == most, share, share + SPILL * np.maximum(1 - most - share, 0))
        return np.minimum(1.0, np.sqrt(shown / (share**2).sum(axis=0)))

    def _gram(self, axis: int) -> np.ndarray:
        """(lenslet, point, term, term): overlaps of the terms of h over each lenslet."""
        g, points = self.geometry, self._points(0, axis)
        half = g.lenslet_width / 2
        t, w = gauss(psf_nodes(g, half))
        lenslets = lit_lenslets(self._reach(axis), self.band.window)
        grams: dict[int, np.ndarray] = {}

        def meet(m: int) -> None:
            values = self._field.evaluate(half * t + m * g.D2 - points[:, None], axis)
            values = at_points(self._field, values, points[:, None]).transpose(0, 2, 1)
            grams[m] = (values * (half * w)) @ values.conj().transpose(0, 2, 1)

        spread([(m,) for m in lenslets], meet)
        gram = np.array([grams[m] for m in lenslets])
        mirrored = gram[::-1, : len(g.points(axis)) - len(points)][:, ::-1]
        return np.concatenate([gram, mirrored], axis=1)

    def _lit_by(self, sy: int, sx: int) -> list[tuple[int, int]]:
        """Lenslets (row, column) whose light on a superpixel is computed; mirrored by the diagonal,
        they are the others.
        """
        symmetric = self._turn and sy == sx
        rows, columns = self._lenslets(sy, 0), self._lenslets(sx, 1)
        return [(m, n) for m in rows for n in columns if not symmetric or m <= n]

    def _meet_all(self, superpixels: Sequence[tuple[int, int]]) -> None:
        """Makes all intervals, which tables share, before threads ask for them."""
        keys = {
            key
            for sy, sx in superpixels
            for m, n in self._lit_by(sy, sx)
            for key in self._meeting(sy, sx, m, n)
        }
        for key in keys:  # what they share in turn
            self._sensor_side(key[0], *key[2:])
        spread(sorted(keys), self._interval)

    def _meeting(
        self, sy: int, sx: int, m: int, n: int
    ) -> tuple[tuple[int, int, int, bool], tuple[int, int, int, bool]]:
        """Keys of the intervals of both axes from lenslet (m, n) to superpixel (sy, sx)."""
        beside, second = bool(sy and sx), 0 if self._turn else 1
        return (sy, m, 0, beside), (sx, n, second, beside)

    # products of two axes

    def _bright(self, sy: int, sx: int, least: float) -> dict[tuple[int, int], Pair]:
        """Lenslets' pairs to superpixel (sy, sx), the brightest last, but for dim ones.

        least: root energy that these may have together.
        """
        symmetric = self._turn and sy == sx
        pairs = {}
        for m, n in self._lit_by(sy, sx):
            row, column = (self._intervals[key] for key in self._meeting(sy, sx, m, n))
            pairs[m, n] = Pair(row, column, symmetric and m == n == sy)
        order = sorted(pairs, key=lambda key: pairs[key].weight)
        total = np.cumsum(
            [pairs[m, n].weight ** 2 * (2 if symmetric and m != n else 1) for m, n in order]
        )
        kept = [key for key, power in zip(order, total) if power > least**2] or order[-1:]
        return {key: pairs[key] for key in kept}

    @property
    def _fine(self) -> bool:
        return self.band.cut < CUT * FINE * self.band.faintest

    def _lit(self, sy: int, sx: int) -> _Lit:
        """Superpixel (sy, sx) and the light that is followed to it."""
        weights = [self._counts(s, axis, bool(sy and sx)) for s, axis in ((sy, 0), (sx, 1))]
        mean = math.prod(math.sqrt(np.mean(weight**2)) for weight in weights)
        cut = self.band.cut * mean**CONCENTRATION
        kept = self._bright(sy, sx, cut / 4)
        all_points = math.sqrt(len(self._points(sy, 0)) * len(self._points(sx, 1)))
        own, here = self._expected_rank(0, 0), self._expected_rank(sy, sx)
        guess = sketch_size(here)
        if len(kept) > 1:
            margin, least = MARGINS_JOINED[(sy != 0) + (sx != 0)], MARGIN_ASIDE
            guess = max(sketch_size(own, margin), sketch_size(here, least))
        return _Lit(
            at=(sy, sx),
            symmetric=self._turn and sy == sx,
            kept=kept,
            cut=cut / (6 if len(kept) > 1 and self._fine else 2),
            narrowing=self.band.cut * mean**EVENLY / 2 * all_points,
            whole=self.band.cut * all_points,
            guess=int(guess),
            spanned=len(kept) == 1 and is_spanned(guess),
        )

    def _follow(self, lit: _Lit, key: tuple[int, int]) -> None:
        """What a lenslet brings to a superpixel, into its `parts`."""
        pair = lit.kept[key]
        each = 1 / math.sqrt(len(lit.kept))
        # what is left out of many terms that meet no others adds by energy
        tolerance = lit.cut if key == lit.brightest else lit.cut * each
        weak = 2 * lit.cut if lit.spanned else tolerance / 2
        x, y, coupling = pair.factors(max(self._extent), tolerance, weak)
        if key != lit.brightest:  # its own rank may be far lower
            one = Product(x, y, {(0, 0): coupling}, pair.symmetric, self.device)
            x, y, coupling = one.narrowed(lit.narrowing * each) or (x, y, coupling)
        lit.parts[key] = x, y, coupling

    def _together(self, lit: _Lit) -> Product:
        """What all lenslets bring to a superpixel."""
        left: list[_Part] = []
        right: list[_Part] = []
        couplings: dict[tuple[int, int], Matrix] = {}
        for (m, n), pair in lit.kept.items():
            x, y, coupling = lit.parts.pop((m, n))
            row, column = (x, pair.row, pair.column.offset), (y, pair.column, pair.row.offset)
            first = len(left)
            # the lenslet mirrored by the diagonal brings the transpose
            if lit.symmetric and not pair.symmetric:
                left += [row, column]
                half = coupling if m != n else coupling / 2
                couplings |= {(first, first + 1): half, (first + 1, first): half.T}
            else:
                left, right = [*left, row], [*right, column]
                couplings[first, first] = coupling
        right = left if lit.symmetric else right
        terms = [part[0].shape[1] for part in left], [part[0].shape[1] for part in right]
        high = _side_by_side(left, lit.alone, self._places)
        wide = high if lit.symmetric else _side_by_side(right, lit.alone, self._places)
        return Product(high, wide, couplings, lit.symmetric, self.device, terms)

    def _joined(self, lit: _Lit) -> tuple[Factors, int]:
        """Factors of a superpixel, and the pairs of terms that they are compressed from."""
        product = self._together(lit)
        products = product.left.shape[1]
        high, wide = (
            product.spanned(lit.whole, lit.guess)
            if lit.spanned
            else product.factors(lit.whole, lit.guess, self._worst(*lit.at))
        )
        if not lit.alone and self.device.xp is np:
            self._places.give(product.left)
            if not lit.symmetric:
                self._places.give(product.right)
        del product
        (sy, sx), beside = lit.at, all(lit.at)
        sides = self._sensor_side(sy, 0, beside), self._sensor_side(sx, 1, beside)
        shown = None
        if lit.alone:  # of one lenslet's path no energy tells
            shown = self._modes_shown(sides, high.shape[1])
            if not shown:
                high, wide = lit.kept[lit.brightest].on_pixels(high, wide)
        high, wide = self._by_point(high, sides[0]), self._by_point(wide, sides[1])
        nodes: int | tuple[int, int] = self.band.pixel_nodes
        if not lit.alone:
            high, wide, nodes = self._on_modes(lit, high, wide)
        return Factors(
            high[None],
            wide[None],
            self.geometry.pixel_shape,
            nodes,
            shown=shown,
            device=self.device,
        ), products

    def _on_modes(
        self, lit: _Lit, high: np.ndarray, wide: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
        """Tables (point, nodes x pixels, term) on as few numbers a pixel as carry their light, and
        how many these are along either axis.
        """
        rows, columns = self.geometry.pixel_shape
        light = self._entering[: len(high), : len(wide)]
        most = PIXEL_LOSS * self.band.cut / self.band.faintest / (3 if self._fine else 1)
        down = pixel_modes(high, wide, rows, light, most)
        across = down if lit.symmetric else pixel_modes(wide, high, columns, light.T, most)
        return on_modes(high, down), on_modes(wide, across), (down.shape[2], across.shape[2])

    def _modes_shown(
        self, sides: tuple[SensorSide, SensorSide], terms: int
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """What brings fields of so many terms to the pixels' nodes after they were multiplied; None
        where it is less work to multiply them there.
        """
        y, x = (side.modes for side in sides)
        if y is None or x is None:
            return None
        (v, m), (u, n) = y.shown.shape, x.shown.shape
        return (y.shown, x.shown) if lines_serve((v, u), terms, (m, n)) else None

    def _expected_rank(self, sy: int, sx: int) -> float:
        return field_rank(self.geometry, self.band, self._parabolic, (sy != 0) + (sx != 0))

    def _by_point(self, factor: np.ndarray, side: SensorSide) -> np.ndarray:
        """(pixels' nodes x points, terms) to (points, pixels' nodes, terms), all points as they
        are.
        """
        points, terms = len(side.points), factor.shape[1]
        emphasis = side.emphasis.astype(factor.real.dtype)[:, None, None]
        turned = factor.reshape(-1, points, terms).transpose(1, 0, 2)
        return np.divide(turned, emphasis, out=np.empty(turned.shape, self.dtype))

    # what the builder asks for

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        # the cut, of weighted fields, may add as well as take
        return self._entering[rows, columns] * (1 + self.band.sampling)

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        return partial(self._energies, sy, sx)

    def _energies(
        self, sy: int, sx: int, rows: np.ndarray, columns: np.ndarray, out: np.ndarray
    ) -> None:
        """As PixelEnergies; mirrored points and superpixels are computed as their mirror
        images.
        """
        sy, sx = sy - self._reach(0), sx - self._reach(1)
        row, column, turned = self._canonical(sy, sx)
        table, shape = self._tables[row, column], self.geometry.object_shape
        table = table.turned if turned else table
        # points whose own half of the lenslet has no table
        far_y, far_x = (
            self.symmetry[axis] & ((s < 0) | ((s == 0) & (index >= (shape[axis] + 1) // 2)))
            for axis, s, index in ((0, sy, rows), (1, sx, columns))
        )
        for fy, fx in ((False, False), (False, True), (True, False), (True, True)):
            some = np.flatnonzero((far_y == fy) & (far_x == fx))
            if len(some):
                images = np.empty((len(some), *self.geometry.pixel_shape), out.dtype)
                table.superpixel(
                    0,
                    0,
                    shape[0] - 1 - rows[some] if fy else rows[some],
                    shape[1] - 1 - columns[some] if fx else columns[some],
                    images,
                )
                out[some] = images[:, :: -1 if fy else 1, :: -1 if fx else 1]
