"""A few columns computed while a matrix is planned: how much light the dimmest points have, and
what the rules of a pixel's nodes make of their fringes.

Where lenslets leave gaps, or are round, points between them have as little as 1e-8 of the brightest
one's light, and their columns are edges and fringes alone: no law for evenly lit lenslets tells
what these need. Their fields are summed over the openings as they are, on nodes that resolve
everything, without separable terms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product, zip_longest
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import band_rule, gauss, nodes_for, opening_weights
from plenocli.forward.propagation.fresnel.array_to_sensor import lenslet_kernel, sensor_nodes
from plenocli.forward.propagation.fresnel.spread_function import (
    carried,
    legendre,
    psf_nodes,
    sampled_field,
    separable_field,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

Point = tuple[int, int]
"""(row, column) of the object."""
CHEAP, AFFORDED = 3e8, 9e8
"""Complex multiplications that a trial may take, and one of few points or of all."""
NEAR = 2
"""Rings of lenslets around those under a point's blur whose fields are tried together by most
columns.
"""
FEW, LINES = 4, 8
"""Points of a symmetric pupil that a trial should have, and the most lines of points per axis."""
VALUES = 1 << 22
"""Values of the spread function, or on the sensor, that it may hold."""
THINNED = 12, 6
"""Lines of pixels along an axis of which the light is looked at where all are too many."""
QUICK = 160
"""Nodes of the spread function per axis up to which its terms are found rather than expected."""
KEPT_VALUES = 1 << 20
"""Coefficients of light within pixels that a trial keeps, of one point at least."""
OTHERS = 6.0
"""Columns tried from which on others are at most twice as bad, of few all the worse."""
KEPT = 16
"""Trials that are kept for the next plan of the same camera."""


@dataclass(frozen=True, kw_only=True)
class TrialColumns:
    """Columns of a few points of a camera.

    light: (column,) share of a point's light on the superpixels looked at;
    fringes: (column, degree, degree) Gram matrices, over all pixels and over the column's squared
        norm, of the Legendre coefficients of the light within a pixel, both axes together;
    light_within: (some column, pixel, degree, degree) these coefficients of light itself, over the
        column's norm;
    pixels: (column, pixel) light of each pixel looked at, as a share of the point's;
    whole: whether they are all columns that symmetry does not give, with all their lenslets and
        pixels;
    window: coherent lenslets on either side, None for isolated ones;
    others: columns tried otherwise, which rules of nodes have to serve as well.
    """

    light: np.ndarray
    fringes: np.ndarray
    light_within: np.ndarray
    pixels: np.ndarray
    whole: bool
    window: int | None
    others: tuple[TrialColumns, ...] = ()

    @property
    def faintest(self) -> float:
        """Least light of a point."""
        return float(self.light.min())

    @property
    def beyond(self) -> float:
        """By how much columns may be worse than those tried say."""
        return 1.0 if self.whole else 1 + (OTHERS / len(self.light)) ** 1.5

    def error(self, count: int, rule: int) -> float:
        """Relative error of the worst column by a rule for the nodes of a pixel.

        count: nodes per axis;
        rule: step of quadrature.band_rule.
        """
        t, w = band_rule(count, rule)
        found = legendre(t, self.fringes.shape[1], 1).T @ w
        true = 2 * np.eye(len(found))[0]
        missed = found - true
        by_axes = np.sqrt(np.maximum(missed @ self.fringes @ missed, 0).max())
        together = np.tensordot(self.light_within, np.outer(found, found) - np.outer(true, true))
        beside = (other.error(count, rule) for other in self.others)
        return float(max(by_axes, np.linalg.norm(together, axis=1).max(), *beside))

    def reach(self, window: int | None) -> bool:
        """Whether some were tried with the light of all lenslets of a window."""
        return any(columns.window == window for columns in (self, *self.others))


def trial_columns(
    camera: Camera,
    geometry: Geometry,
    grid: tuple[int, int],
    window: int | None,
    symmetric: bool,
    kind: Callable[..., Trial] | None = None,
) -> TrialColumns | None:
    """The TrialColumns of a camera, None where they would take too long: of lenslets near the
    object's, which have nearly all light, and beside them of as many as can be tried in time, whose
    fringes are the finest.

    camera: at the wavelength of `geometry`;
    grid: (rows, columns) of superpixels kept;
    window: coherent lenslets on either side, None for isolated ones;
    symmetric: whether pupil and wavefront are mirrored by both axes;
    kind: of trial; None: by the paraxial model.
    """
    near, kind, hashed = near_window(geometry, window), kind or Trial, Hashed(camera)
    columns = _tried(kind, hashed, geometry, grid, near, symmetric, 1)
    if columns is None or near is None or near == window:
        return columns
    far = _tried(kind, hashed, geometry, grid, window, symmetric, near + 1)
    return columns if far is None else replace(columns, others=(far,))


def near_window(geometry: Geometry, window: int | None) -> int | None:
    """Coherent lenslets on either side that a trial looks at: farther ones bring little light."""
    if window is None:
        return None
    return min(window, math.ceil(geometry.blur / (2 * geometry.D2)) + NEAR)


def cut_field(
    camera: Camera, geometry: Geometry, half: float, tolerance: float
) -> tuple[int, float] | None:
    """What separable_field makes of the spread function: (terms, root energy lost); None where
    it takes more than QUICK nodes per axis.

    camera: at the wavelength of `geometry`;
    half, tolerance: as for separable_field.
    """
    if psf_nodes(geometry, half) > QUICK:
        return None
    return _cut(Hashed(camera), geometry, half, tolerance)


class Hashed:
    """A camera with what its files hold, as a key."""

    def __init__(self, camera: Camera) -> None:
        lens = camera.main_lens
        samples = lens.samples("aperture_image"), lens.samples("wavefront")
        self.camera = camera
        self._key = (
            camera.model_dump_json(),
            *(None if values is None else values.tobytes() for values in samples),
        )

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Hashed) and self._key == other._key


@lru_cache(maxsize=KEPT)
def _cut(hashed: Hashed, geometry: Geometry, half: float, tolerance: float) -> tuple[int, float]:
    field = separable_field(hashed.camera, geometry, half, tolerance)
    return field.terms, field.tail


@lru_cache(maxsize=KEPT)
def _tried(
    kind: Callable[..., Trial],
    hashed: Hashed,
    geometry: Geometry,
    grid: tuple[int, int],
    window: int | None,
    symmetric: bool,
    least: int,
) -> TrialColumns | None:
    # fewer pixels, superpixels and lenslets, at least `least`, where that is too much
    lenslets = [None] if window is None else range(window, least - 1, -1)
    for near, beside, lines in product(lenslets, (1, 0), (None, *THINNED)):
        trial = kind(geometry, grid, near, symmetric, beside, lines)
        every = len(trial.points) * trial.cost <= AFFORDED
        few = len(trial.points) if every else min(int(AFFORDED / trial.cost), trial.least)
        points = trial.points[: max(int(CHEAP / trial.cost), few)]
        if points and trial.values <= VALUES:
            whole = len(points) == len(trial.points) and trial.whole and near == window
            return trial.columns(hashed.camera, points, whole)
    return None


def _lines(count: int, symmetric: bool) -> list[int]:
    """Lines of points that are tried, of so many."""
    last = (count - 1) // 2 if symmetric else count - 1
    return np.unique(np.linspace(0, last, LINES).round().astype(int)).tolist()


def _points(tried: list[list[int]], shape: tuple[int, int], symmetric: bool) -> list[Point]:
    """Points on some lines along both axes in the order in which they are tried: a corner, the
    middles of two edges and the middle, of a pupil without symmetry the next corner and so on; then
    the farthest from the middle first.
    """
    marks = [(line[0], line[len(line) // 2], line[-1]) for line in tried]
    order = sorted(
        product(tried[0], tried[1]),
        key=lambda p: (
            not all(i in some for i, some in zip(p, marks)),
            -sum(abs(2 * i / (n - 1 or 1) - 1) for i, n in zip(p, shape)),
        ),
    )
    (top, middle, bottom), (left, centre, right) = marks
    if symmetric:  # the last lines are those of the middle
        first = [(top, left), (top, right), (bottom, left), (bottom, right)]
        return list(dict.fromkeys([*first, *order]))
    corners: list[Point | None] = list(product((top, bottom), (left, right)))
    edges = [(top, centre), (bottom, centre)], [(middle, left), (middle, right)]
    first = [p for kinds in zip_longest(corners, *edges) for p in kinds if p]
    return list(dict.fromkeys([*first[:3], (middle, centre), *first[3:], *order]))


def _pixel_lines(geometry: Geometry, count: int, most: int | None) -> tuple[list[int], float]:
    """`most` of the lines of pixels along an axis that has `count`, from one end of the pupil's
    image to the other; and how many of the lines there these are.
    """
    if most is None or count <= most:
        return list(range(count)), 1.0
    g = geometry
    image = g.D1 * g.z3 / g.z2 + 2 * abs(g.kappa) * g.z3 * max(g.lenslet_extent) + g.blur
    lit = min(count, max(most, math.ceil(image / g.pixel_pitch) + 2))
    lines = (count - lit) // 2 + np.linspace(0, lit - 1, most).round().astype(int)
    return lines.tolist(), most / lit


class Trial:
    """Nodes on lenslets and pixels of one trial, and fields there by the paraxial model."""

    def __init__(
        self,
        geometry: Geometry,
        grid: tuple[int, int],
        window: int | None,
        symmetric: bool,
        beside: int,
        lines: int | None,
    ) -> None:
        """`beside`: superpixels on either side of those under the blur that are looked at;
        `lines` of pixels on each, None for all.
        """
        g = geometry
        self.geometry, self.window, self.half = g, window, g.field_half(grid, window)
        seen = math.ceil(g.blur / (2 * g.D2)) + beside + 0.01
        # the points that symmetry leaves light superpixels on their own side
        other = 0.51 if symmetric and g.blur == 0 else seen
        self.places = [p for p in g.places(grid) if -seen <= min(p) and max(p) <= other]
        self.products = None if window is None else g.neighbourhood(window)
        lit = 0.0 if window is None else max(g.reach(grid, window))
        away = 0.0 if window is None else lit + max(g.reach(grid))
        reach = (max(g.pixel_shape) + 1) * g.pixel_pitch / 2 + away * g.superpixel_pitch
        half = max(g.lenslet_extent)
        slope = g.k * (reach / g.z3 + g.D1 / 2 / g.z2 + abs(g.kappa) * half)
        # fields are interpolated, not only integrated
        self.count = nodes_for(2 * slope * half)
        cycles = 2 * (half + lit * g.D2) * g.pixel_active / (g.wavelength * g.z3)
        # coarse rules miss what has many degrees
        self.degrees = nodes_for(2 * np.pi * cycles) + 2
        self.few = self.count
        if g.lenslet_shape == "square":  # fields need fewer nodes than kernels
            self.few = min(self.count, psf_nodes(g, half))
        self.pixels, self.sampled = zip(*(_pixel_lines(g, n, lines) for n in g.pixel_shape))
        self.whole = lines is None and all(
            (n + symmetric) // (1 + symmetric) <= LINES for n in g.object_shape
        )
        # a pupil without symmetry has no two points alike
        self.least = FEW if symmetric else 2 * FEW - 1
        tried = [_lines(n, symmetric) for n in g.object_shape]
        self.points = _points(tried, g.object_shape, symmetric)

    @property
    def _lenslets(self) -> list[tuple[int, int]]:
        """Rows and columns of each product of lenslets."""
        if self.products is None:
            return [(1, 1)]
        return [(len(rows), len(columns)) for rows, columns in self.products]

    @property
    def values(self) -> int:
        """Of the spread function and on the sensor, in memory at a time."""
        pixels = math.prod(map(len, self.pixels)) * self.degrees**2
        return max(pixels, *(r * c * self.few**2 for r, c in self._lenslets))

    @property
    def looked_into(self) -> int:
        """Points, the first ones, whose light is kept by both degrees within a pixel."""
        values = len(self.places) * math.prod(map(len, self.pixels)) * self.degrees**2
        return max(1, min(FEW, KEPT_VALUES // values))

    @property
    def cost(self) -> float:
        """Complex multiplications for a column."""
        v, u = (len(n) * self.degrees for n in self.pixels)
        each = sum(v * c * self.few * (r * self.few + u) for r, c in self._lenslets)
        return float(len(self.places) * each)

    def columns(self, camera: Camera, points: list[Point], whole: bool) -> TrialColumns:
        """Columns of points, which are the `whole` or not."""
        m, count = self.degrees, len(points)
        gram = np.zeros((count, m, m))
        pixels: list[list[np.ndarray]] = [[] for _ in points]
        within: list[list[np.ndarray]] = [[] for _ in points[: self.looked_into]]
        # from the light at a pixel's nodes, weights included, to Legendre coefficients over half of
        # the pixel
        onto = legendre(gauss(m)[0], m, 1).T * (np.arange(m) + 0.5)[:, None]
        for n, field in self.fields(camera, points):
            energy = (field.real**2 + field.imag**2).reshape(
                len(self.pixels[0]), m, len(self.pixels[1]), m
            )
            series = onto @ energy.sum(axis=3).transpose(1, 0, 2).reshape(m, -1)
            series += onto @ energy.sum(axis=1).transpose(2, 0, 1).reshape(m, -1)
            gram[n] += series @ series.T
            pixels[n].append(energy.sum(axis=(1, 3)).ravel())
            if n < len(within):
                series = onto @ energy.transpose(0, 2, 1, 3) @ onto.T
                within[n].append(series.reshape(-1, m, m).astype(np.float32))
        seen = np.stack([*map(np.concatenate, pixels)])
        norm = np.linalg.norm(seen, axis=1)[:, None, None]
        inside = np.stack([*map(np.concatenate, within)])
        inside /= norm[: len(within), :, :, None].astype(np.float32)
        return TrialColumns(
            light=seen.sum(axis=1) / math.prod(self.sampled),
            fringes=gram / norm**2,
            light_within=inside,
            pixels=seen,
            whole=whole,
            window=self.window,
        )

    def fields(
        self, camera: Camera, points: list[tuple[int, int]]
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Fields of points (row, column) at the nodes of pixels, weights included.

        Yields superpixel by superpixel, for each point (which, (row, column)).
        """
        g, entered, kernels = self.geometry, None, dict[tuple, np.ndarray]()
        at = [(g.points(0)[i], g.points(1)[j]) for i, j in points]
        for place in self.places:
            products = self.products or [(np.array([place[0]]), np.array([place[1]]))]
            if entered is None or self.products is None:
                entered = [self._entering(camera, lenslets, at) for lenslets in products]
            ways = [
                [self._kernel(kernels, axis, lenslets[axis], place[axis]) for axis in (0, 1)]
                for lenslets in products
            ]
            for n in range(len(at)):
                parts = [down @ each[n] @ across.T for (down, across), each in zip(ways, entered)]
                yield n, np.sum(parts, axis=0)

    def nodes(self, axis: int, place: float) -> tuple[np.ndarray, np.ndarray]:
        """(positions, m from the centre of the superpixel at `place`; weights, m) along an axis,
        pixel by pixel.
        """
        v, w = (
            a.T[self.pixels[axis]].ravel()
            for a in sensor_nodes(self.geometry, axis, self.degrees, place)
        )
        return v, w

    def _entering(
        self, camera: Camera, lenslets: tuple, points: list[tuple[float, float]]
    ) -> np.ndarray:
        """Fields (point, row, column) at the nodes of the lenslets of a product, weights included
        but those that kernels have.
        """
        g = self.geometry
        t, _ = gauss(self.few)
        nodes = [
            (np.asarray(places)[:, None] * g.D2 + extent * t).ravel()
            for places, extent in zip(lenslets, g.lenslet_extent)
        ]
        lines, which = zip(
            *(np.unique([point[axis] for point in points], return_inverse=True) for axis in (0, 1))
        )
        dy, dx = ((x - at[:, None]).ravel() for x, at in zip(nodes, lines))
        h = sampled_field(camera, g, dy, dx).reshape(
            len(lines[0]), len(nodes[0]), len(lines[1]), len(nodes[1])
        )
        fields = np.stack([h[i, :, j] for i, j in zip(*which)])
        fields *= g.lenslet_extent[0] * g.lenslet_extent[1]
        if g.lenslet_shape == "square":
            return fields
        return fields * np.tile(
            opening_weights(g.lenslet_shape, self.few), (len(lenslets[0]), len(lenslets[1]))
        )

    def _kernel(
        self, kept: dict[tuple, np.ndarray], axis: int, positions: np.ndarray, place: float
    ) -> np.ndarray:
        """The kernel of an axis from lenslets at `positions` to the nodes of the superpixel at
        `place`.
        """
        key = axis, place, *positions
        if key not in kept:
            g = self.geometry
            v, wv = self.nodes(axis, place)
            x = g.lenslet_extent[axis] * gauss(self.count)[0]
            kernels = [lenslet_kernel(g, n - place, v, wv, x) for n in positions]
            if g.lenslet_shape == "square":
                onto = carried(self.count, self.few)
                kernels = [kernel @ onto for kernel in kernels]
            kept[key] = np.hstack(kernels)
        return kept[key]
