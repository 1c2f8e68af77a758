"""The geometric rung: shares of the pupil that rays carry into each pixel, as exact areas.

Nothing is sampled.

Per axis a ray from the pupil at x towards the image point u0 meets the array at u = u0 + x z2 eps.
Through the lenslet at m D2 it lands on the sensor at

    t = a x + b_m,   a = z3 (kappa z2 eps - 1/z2),   b_m = z3 kappa u0 + m D2 z3/f2

(section 6 of docs/model.md), an affine map. So what a pixel sees of the pupil through a square
lenslet is a rectangle: its own image in the pupil cut by that of the lenslet, and its light is the
transmittance integrated over that rectangle. Defocus and tilt in the wavefront error (Noll 1 to 4)
keep the map affine: W = a2 r^2 is eps + 2 a2, W = g x moves u0 by z2 g. Where a vanishes, all rays
of a lenslet meet in one point, which belongs to one pixel; pixels and lenslets own
their lower edges.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.geometry import ROW_SPACING
from plenocli.forward.camera.pupil import aperture_area, filter_cells, unit_radius
from plenocli.forward.propagation.costs import Features, law
from plenocli.forward.propagation.lenslet_fields import (
    FieldNotes,
    LensletFields,
    PixelEnergies,
)
from plenocli.forward.propagation.plan import BandPlan
from plenocli.forward.propagation.sampling import (
    blur_ring,
    distinct,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.main_lens import MainLens
    from plenocli.forward.propagation.plan import PifPlan

PupilMeasure = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(y, x) (m, broadcasting) -> share of the open aperture at smaller y and smaller x."""
WORK_CORNERS = 1 << 17
"""Corners of rectangles in a work array: about what a second-level cache holds."""
DARK = 2.0
"""Error of points that are dark to rays: as good as none serves."""
FOCUSED = 1e-9
"""An image of a whole pupil smaller than this share of a pixel or a lenslet is a point."""


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for: the rays must keep the pupil's image affine."""
    lens = camera.main_lens
    if lens.wavefront is not None or any(term.noll > 4 for term in lens.aberrations or ()):
        return (
            "wavefront errors beyond tilt and defocus bend the pupil's image, which "
            "rays here take as affine"
        )
    if lens.rims:
        return "rims cut the pupil, whose areas rays here know for whole discs and squares only"
    if (
        geometry.lenslet_shape != "square"
        and abs(_affine(lens, geometry)[0]) * geometry.z2 * geometry.D1 > FOCUSED * geometry.D2
    ):
        return (
            f"out of focus the rays of a {geometry.lenslet_shape} lenslet fill no "
            "rectangle of the pupil"
        )
    return None


def size_band(
    camera: Camera,
    geometry: Geometry,
    superpixels: tuple[int, int],
    ring: int,
    accuracy: float,
    tolerance: float,
) -> BandPlan:
    """As Model.size: no quadrature; every lenslet under the blur of every superpixel kept counts
    (ring 0: its own only).
    """
    window = (
        None if ring == 0 else math.ceil(max(geometry.reach(superpixels))) + blur_ring(geometry) + 1
    )
    return BandPlan(
        wavelength=geometry.wavelength,
        window=window,
        lenslet_nodes=0,
        pixel_nodes=0,
        psf_nodes=0,
        terms=0,
        half=0.0,
    )


def error_bound(camera: Camera, geometry: Geometry, joined: bool) -> float:
    """Estimated relative L2 error of the worst column against the Fresnel model.

    Diffraction rounds off every edge of the pupil's image over one cell, lambda z3/D2 wide: c = D2
    pixel/(lambda z3) cells fit into a pixel. In focus only the rim is an edge, of N = D2 D1/(lambda
    z2) cells; but a point d cells from the border between two lenslets sends its light through
    both. Out of focus that border cuts every image.

    What of its light that takes is missed as well (`_missed`). A point that is imaged beside the
    openings is dark to rays, and all its light is diffraction.

    joined: whether the fields of neighbours add.

    Returns a number within 2.5 of the error of 132 cases (N from 3 to 47, c from 0.06 to 16, blur
    from 0 to 3 lenslets; docs/model.md), DARK where a point is beside openings.
    """
    cells, fit = (
        geometry.diffraction_cells,
        geometry.D2 * geometry.pixel_active / (geometry.wavelength * geometry.z3),
    )
    border, cut = _border(camera, geometry, joined)
    if border <= 0 and geometry.blur < geometry.D2:
        return DARK
    blurred = (1 + 2 / cells) / (1 + fit) if geometry.blur * cells > geometry.D2 else 0.0
    focused = math.hypot(
        0.9 / (cells * (1 + fit)) ** 0.7, 2 / (1 + 5 * max(border, 0.0)) / (1 + fit / 4)
    )
    return min(DARK, math.hypot(max(focused, blurred), cut))


def _border(camera: Camera, geometry: Geometry, joined: bool) -> tuple[float, float]:
    """Of the points nearest the edge of their lenslet: how far within it they lie, in diffraction
    cells, negative beside it; and the light that edges take, over what is left.
    """
    g = geometry
    _, *tilt = _affine(camera.main_lens, g)
    y, x = (np.abs(g.points(n) + g.z2 * tilt[n]) for n in (0, 1))
    half, in_cells = g.lenslet_width / 2, g.diffraction_cells / g.D2
    border = float(half - _off_middle(g.lenslet_shape, y[:, None], x).max()) * in_cells
    if g.lenslet_shape == "square":
        sides = [((half - at.max()) * in_cells, (half + at.max()) * in_cells) for at in (y, x)]
    else:
        sides = [(border, border)] * 2
    cut, disc = _taken(camera, sides), g.blur * in_cells
    if disc > 1:
        # a lenslet alone has its part of the pupil, whose edges are all its own; what neighbours
        # that join lose they give each other
        part = half * in_cells * min(1.0, g.D2 / g.blur)
        own = 0.0 if joined else _taken(camera, [(part, part)] * 2)
        cut = max(cut / disc, own)
    return border, cut


def _off_middle(shape: str, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Half the width of an opening of a shape on whose edge the places y, x (none negative) lie."""
    if shape == "square":
        return np.maximum(y, x)
    return np.hypot(y, x) if shape == "circle" else np.maximum(x, ROW_SPACING * y + x / 2)


def _taken(camera: Camera, sides: list[tuple[float, float]]) -> float:
    """Light that edges so far away (cells) along either axis take, over what they leave: once of
    what enters a lenslet, and once of its pixels, which the pupil's image fills.
    """
    kept = math.prod(1 - sum(_missed(camera, cells) for cells in pair) for pair in sides)
    return max(kept, 1e-3) ** -2 - 1


def _missed(camera: Camera, cells: float) -> float:
    """Share of a sharp point's light beyond an edge so many diffraction cells away: half at it, and
    far off what the pupil's rim diffracts there, which goes by its length over the pupil's area.
    """
    lens = camera.main_lens
    rim = 1.0 if lens.aperture_shape == "square" else 4 / math.pi
    away = max(cells, 0.0) / rim * (1 - lens.obscuration)
    return 0.5 / (1 + 2 * away + (math.pi**2 - 2) * away**2 / (1 + away))


def features(
    camera: Camera, geometry: Geometry, band: BandPlan, shape: tuple[int, ...], double: bool
) -> Features:
    """What a matrix of `shape` (band, superpixel, pixel, point) consists of."""
    columns = distinct(camera, geometry, shape)[1]
    cells = 1 if camera.filter_array is None else len(camera.filter_array.filters)
    pixels = columns * math.prod(geometry.pixel_shape) * cells
    lenslets = 1 if band.window is None else 2 * band.window + 1
    # in focus one lenslet lights a superpixel; out of focus so do slivers of its neighbours, the
    # fewer the wider the blur
    slivers = 1 + law("rays").counts["blur_weight"] * geometry.blur / geometry.D2
    lit = {"pixels_focused": pixels} if geometry.blur == 0 else {"pixels_blurred": pixels / slivers}
    edges = columns * lenslets * sum(geometry.pixel_shape)
    return Features({}, {"process": 1.0, "edges": edges, **lit}, ({"corners": 8.0 * WORK_CORNERS},))


class RayLenslets(LensletFields):
    """Pixel energies by rays."""

    def __init__(self, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan) -> None:
        lens = camera.main_lens
        self.geometry, self.superpixels, self.window = geometry, plan.superpixels, band.window
        self.eps, *self._tilt = _affine(lens, geometry)
        self.slope = geometry.z3 * (geometry.kappa * geometry.z2 * self.eps - 1 / geometry.z2)
        self._below, self._joined = (
            pupil_measure(lens),
            geometry.pixel_active == geometry.pixel_pitch,
        )
        cells = filter_cells(camera, geometry.wavelength)
        half = lens.aperture_diameter / 2
        self._cells = [((-half, half, -half, half), 1.0)] if cells is None else cells
        plain = cells is None and lens.aperture_shape != "image" and not any(self._tilt)
        self.symmetry = (plain, plain, plain)
        self.notes = FieldNotes(separable_terms=0, field_tail=0.0)
        self._passed = sum(
            t * float(self._rectangles(np.array([[y0, y1]]), np.array([[x0, x1]]))[0, 0, 0])
            for (y0, y1, x0, x1), t in self._cells
        )
        self._places = {where: place for place, where in geometry.places(plan.superpixels).items()}

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident: all that the filters pass."""
        return np.full(len(rows), self._passed)

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        return partial(self._energies, self._places[sy, sx])

    def _energies(
        self, place: tuple[float, float], rows: np.ndarray, columns: np.ndarray, out: np.ndarray
    ) -> None:
        """Pixel energies in the superpixel at `place` (pitches), as PixelEnergies."""
        g = self.geometry
        step = max(1, WORK_CORNERS // (4 * g.pixel_shape[0] * g.pixel_shape[1]))
        products = (
            [([place[0]], [place[1]])] if self.window is None else g.neighbourhood(self.window)
        )
        for start in range(0, len(rows), step):
            part = slice(start, start + step)
            out[part] = 0
            for down, across in products:
                high = [(m, self._edges(0, rows[part], place[0], m)) for m in down]
                wide = [(m, self._edges(1, columns[part], place[1], m)) for m in across]
                for m, y in high:
                    for n, x in wide:
                        if _lit(y) and _lit(x):
                            out[part] += self._light(y, x) * self._enters(
                                rows[part], columns[part], m, n
                            )

    def _edges(self, axis: int, points: np.ndarray, place: float, m: float) -> np.ndarray:
        """Edges in the pupil of what the pixels of the superpixel at `place` see through the
        lenslet at m (both in pitches): (points, pixels + 1) where pixels touch, else pairs
        (points, 2 x pixels).
        """
        g = self.geometry
        points, where = np.unique(points, return_inverse=True)
        u0 = g.points(axis)[points] + g.z2 * self._tilt[axis]
        low, high = g.pixel_spans(axis, place)
        edges = place * g.superpixel_pitch + (
            np.r_[low[0], high] if self._joined else np.stack([low, high], -1).ravel()
        )
        t = edges - (g.z3 * g.kappa * u0 + m * g.D2 * g.z3 / g.f2)[:, None]
        opening = np.array([-1, 1]) * g.lenslet_extent[axis] + m * g.D2 - u0[:, None]
        low, high = np.sort(self._into_pupil(opening, g.z2 * self.eps, FOCUSED * g.D2), axis=1).T[
            ..., None
        ]
        return np.clip(self._into_pupil(t, self.slope, FOCUSED * g.pixel_pitch), low, high)[where]

    def _into_pupil(self, position: np.ndarray, slope: float, small: float) -> np.ndarray:
        """Pupil coordinates of positions = slope x; where the pupil's image is a point, +-inf
        for positions on either side of it.
        """
        if abs(slope) * self.geometry.D1 > small:
            return position / slope
        return np.where(position <= 0, -np.inf, np.inf)

    def _enters(
        self, rows: np.ndarray, columns: np.ndarray, m: float, n: float
    ) -> np.ndarray | int:
        """Whether points in focus lie in the opening of lenslet (m, n) where its shape is not
        square: (points, 1, 1).
        """
        g = self.geometry
        if g.lenslet_shape == "square":
            return 1
        y, x = (
            np.abs(g.points(axis)[index] + g.z2 * self._tilt[axis] - at * g.D2)
            for axis, index, at in ((0, rows, m), (1, columns, n))
        )
        far = _off_middle(g.lenslet_shape, y, x)
        return (far <= g.lenslet_width / 2)[:, None, None]

    def _light(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Light (points, pixel rows, pixel columns) through rectangles with edges y, x in
        pairs, filters included.
        """
        total: np.ndarray | int = 0
        for (y0, y1, x0, x1), transmittance in self._cells:
            total = total + transmittance * self._rectangles(np.clip(y, y0, y1), np.clip(x, x0, x1))
        return np.asarray(total)

    def _rectangles(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Share of the open pupil in the rectangles between edges y and x (points, edges),
        neighbours or pairs: (points, rows, columns).
        """
        # both axes run through the pupil the same way, so that their signs cancel
        step = 1 if self._joined else 2
        areas = np.diff(
            np.diff(self._below(y[:, :, None], x[:, None, :]), axis=1)[:, ::step], axis=2
        )
        # differences of nearly equal areas round to below 0
        return np.maximum(areas[:, :, ::step], 0)


def _lit(edges: np.ndarray) -> bool:
    return bool((edges != edges[:, :1]).any())


def _affine(lens: MainLens, geometry: Geometry) -> tuple[float, float, float]:
    """Defocus (1/m) and tilt (rows, columns) of the rays: those of the geometry and of the
    wavefront's Noll terms 2 to 4.
    """
    unit = unit_radius(lens)
    found = {2: 0.0, 3: 0.0, 4: 0.0}
    for term in lens.aberrations or ():
        if term.noll in found:
            found[term.noll] += term.coefficient
    return (
        geometry.eps + 8 * math.sqrt(3) * found[4] / unit**2 / 2,
        2 * found[3] / unit,
        2 * found[2] / unit,
    )


# the pupil as a measure: its share below and left of a corner


def pupil_measure(lens: MainLens) -> PupilMeasure:
    """The pupil of a main lens as a measure of what lies below and left of a corner."""
    half = lens.aperture_diameter / 2
    if lens.aperture_shape == "image":
        return _image_measure(lens.samples("aperture_image"), half)
    if lens.aperture_shape == "square":
        return lambda y, x: (np.clip(y / half, -1, 1) + 1) * (np.clip(x / half, -1, 1) + 1) / 4
    if not lens.obscuration:
        return lambda y, x: disc_below(y / half, x / half) / math.pi
    hole = lens.obscuration * half
    share = math.pi * half**2 / aperture_area(lens)
    return lambda y, x: (
        share
        / math.pi
        * (disc_below(y / half, x / half) - lens.obscuration**2 * disc_below(y / hole, x / hole))
    )


def disc_below(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Area of the part of the unit disc at smaller y and x than given, in closed form.

    It is the integral over X up to x of min(y, c) + c, c = sqrt(1 - X^2), where positive; the
    integral of c is C(X) = (X c + asin X)/2, and beyond |X| = q = sqrt(1 - y^2) the corner's
    height no longer counts.

    y, x: corners, in radii, broadcasting.

    Returns squared radii.
    """
    y, x = np.clip(y, -1, 1), np.clip(x, -1, 1)
    q = np.sqrt((1 - y) * (1 + y))
    at_x, at_q = _cap(x), _cap(q)
    middle = np.abs(y) * (np.clip(x, -q, q) + q)
    side = np.where(x < -q, at_x, -at_q) + np.where(x > q, at_x - at_q, 0.0) + math.pi / 4
    return at_x + math.pi / 4 + np.sign(y) * (side + middle)


def _cap(x: np.ndarray) -> np.ndarray:
    return (x * np.sqrt((1 - x) * (1 + x)) + np.arcsin(x)) / 2


def _image_measure(image: np.ndarray, half: float) -> PupilMeasure:
    """The measure of an aperture of constant cells: bilinear between the sums up to
    the cells' corners.
    """
    count = len(image)
    total = np.zeros((count + 1, count + 1))
    total[1:, 1:] = np.cumsum(np.cumsum(image, axis=0), axis=1) / image.sum()

    def below(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        y, x = ((np.clip(v / half, -1, 1) + 1) * count / 2 for v in (y, x))
        i, j = (np.minimum(v.astype(int), count - 1) for v in (y, x))
        y, x = y - i, x - j
        return (total[i, j] * (1 - y) + total[i + 1, j] * y) * (1 - x) + (
            total[i, j + 1] * (1 - y) + total[i + 1, j + 1] * y
        ) * x

    return below
