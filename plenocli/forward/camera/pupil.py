"""The main lens's pupil: shape, filter array, aberrations.

P(x, y) = P1 sqrt(T) exp(+j k W) exp(+j k eps (x^2 + y^2)/2): P1 the aperture, T the INTENSITY
transmittance of the filter cell, W the wavefront error in metres (W > 0 advances the phase), eps
the defocus (Berkner et al. 2013, section 2-3-1). Filter cells are laid out row by row in a centred
square, rows downwards, gaps and surroundings opaque.

An aperture image is the intensity transmittance of the cells of a square grid over the square of
side D1: n x n cells, constant in each, rows downwards looking along the light. A wavefront grid
holds W at the centres of such cells; between them it is the interpolating cubic spline, which goes
on by half a cell to the edge of the square.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.forward.camera.quadrature import Cell
from plenocli.forward.camera.sections.filter_array import FILTER_SIGNS
from plenocli.forward.camera.sections.main_lens import noll_indices

if TYPE_CHECKING:
    from scipy.interpolate import NdBSpline

    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.filter_array import Filter, FilterArray
    from plenocli.forward.camera.sections.main_lens import Aberration, MainLens

POLARISATIONS = "0 deg", "90 deg"
"""Two orthogonal states of light."""
RIM = 1e-4
"""Share of the pupil's radius that a rim must reach into it to count."""
STRIPS = 64
"""By which polygons are scanned, at least."""
Polygon = Sequence[tuple[float, float]]
"""Corners (y, x), m."""


def aperture_area(lens: MainLens) -> float:
    """Area (m^2) of the open main-lens aperture P1, filters and rims not counted; of an aperture
    image the integral of its values.
    """
    radius = lens.aperture_diameter / 2
    if lens.aperture_shape == "image":
        return lens.aperture_diameter**2 * float(lens.samples("aperture_image").mean())
    if lens.aperture_shape == "square":
        return lens.aperture_diameter**2
    return math.pi * radius**2 * (1 - (lens.obscuration or 0.0) ** 2)


def aperture_picture(lens: MainLens, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Intensity transmittance of the open aperture, filters not counted.

    y, x: pupil coordinates, m, broadcast against each other.
    """
    open_ = np.ones(())
    for cy, cx, radius in lens.rims:
        open_ = open_ * (np.hypot(y - cy, x - cx) <= radius)
    return open_ * _aperture(lens, y, x)


def _aperture(lens: MainLens, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    half = lens.aperture_diameter / 2
    edge = half * (1 + 1e-9)
    if lens.aperture_shape == "image":
        image = lens.samples("aperture_image")
        row, column = (
            np.clip(
                ((v / lens.aperture_diameter + 0.5) * len(image)).astype(int), 0, len(image) - 1
            )
            for v in np.broadcast_arrays(y, x)
        )
        return image[row, column] * ((np.abs(y) <= edge) & (np.abs(x) <= edge))
    if lens.aperture_shape == "square":
        return 1.0 * ((np.abs(y) <= edge) & (np.abs(x) <= edge))
    r = np.hypot(y, x)
    return 1.0 * ((r <= edge) & (r >= half * (lens.obscuration or 0.0)))


def filter_transmittance(filter_: Filter, wavelength: float) -> float:
    """Intensity transmittance of one filter for light that meets it at right angles.

    wavelength: m; beyond a measured curve its last values hold.
    """
    if filter_.transmittance is not None:
        return filter_.transmittance
    if filter_.curve is not None:
        curve = filter_.curve
        return float(np.interp(wavelength, curve.wavelength, curve.transmittance))
    arg = (wavelength - filter_.center) / filter_.fwhm
    return min(
        1.0, filter_.peak * math.exp(-4 * math.log(2) * arg * arg) + (filter_.blocking or 0.0)
    )


def filter_cells(camera: Camera, wavelength: float) -> list[tuple[Cell, float]] | None:
    """Rectangles of the filter array, for light of the polarisation that the camera's has.

    Of a filter whose band moves with the angle, a rectangle has the mean over the angles at which
    light crosses it; how the angle differs within it, and with the place of the object point, is
    left out.
    wavelength: m.

    Returns [((y0, y1, x0, x1) m, intensity transmittance)], None where there is no array.
    """
    if camera.filter_array is None:
        return None
    return [
        (cell, _through(camera, filter_, cell, wavelength))
        for filter_, cells in zip(camera.filter_array.filters, filter_places(camera.filter_array))
        for cell in cells
    ]


@lru_cache(maxsize=32)
def filter_places(array: FilterArray) -> tuple[tuple[Cell, ...], ...]:
    """The rectangles (y0, y1, x0, x1), m, that each filter of an array consists of.

    Raises ConfigError for polygons that overlap.
    """
    if array.layout is None and array.drawing is None:
        return _polygons([one.polygon or () for one in array.filters])
    assert array.size is not None
    if array.drawing is not None:
        return _drawn(array.drawing, len(array.filters), array.size)
    assert array.layout is not None
    rows, columns = array.layout
    high, wide = (
        (array.size - (rows - 1) * array.gap) / rows,
        (array.size - (columns - 1) * array.gap) / columns,
    )
    corners = [
        (-array.size / 2 + row * (high + array.gap), -array.size / 2 + column * (wide + array.gap))
        for row in range(rows)
        for column in range(columns)
    ]
    return tuple(((top, top + high, left, left + wide),) for top, left in corners)


def _drawn(rows: tuple[str, ...], count: int, size: float) -> tuple[tuple[Cell, ...], ...]:
    """Places of `count` filters drawn over a square of side `size`, m."""
    down, across = (np.linspace(-size / 2, size / 2, n + 1) for n in (len(rows), len(rows[0])))
    lines = [
        (
            float(down[k]),
            float(down[k + 1]),
            [
                [(float(across[i]), float(across[j])) for i, j in _runs(row, sign)]
                for sign in FILTER_SIGNS[1 : count + 1]
            ],
        )
        for k, row in enumerate(rows)
    ]
    return _stacked(lines, count)


def _runs(row: str, sign: str) -> list[tuple[int, int]]:
    """First and behind the last place of each run of a sign."""
    return [(found.start(), found.end()) for found in re.finditer(re.escape(sign) + "+", row)]


def _polygons(polygons: Sequence[Polygon]) -> tuple[tuple[Cell, ...], ...]:
    """Polygons as strips, each as wide as the polygon in its middle, so that areas are exact to
    second order; strips end at corners.
    """
    heights = [y for polygon in polygons for y, _ in polygon]
    even = np.linspace(min(heights), max(heights), STRIPS + 1)
    ends = np.unique(np.concatenate([heights, even]))
    lines = []
    for top, bottom in zip(ends[:-1].tolist(), ends[1:].tolist()):
        spans = [_crossed(polygon, (top + bottom) / 2) for polygon in polygons]
        ordered = sorted(span for one in spans for span in one)
        if any(right - left > 1e-9 for (_, right), (left, _) in zip(ordered, ordered[1:])):
            where = f"{(top + bottom) / 2 * 1e3:.3g} mm below the axis"
            raise ConfigError(f"polygons of filters overlap {where}", "filter_array.filters")
        lines.append((top, bottom, spans))
    return _stacked(lines, len(polygons))


def _crossed(polygon: Polygon, y: float) -> list[tuple[float, float]]:
    """What of the line at height y lies in a polygon, by pairs of crossings."""
    edges = zip(polygon, (*polygon[1:], polygon[0]))
    x = sorted(
        x0 + (y - y0) / (y1 - y0) * (x1 - x0)
        for (y0, x0), (y1, x1) in edges
        if (y0 > y) != (y1 > y)
    )
    return list(zip(x[::2], x[1::2]))


def _stacked(
    lines: Sequence[tuple[float, float, Sequence[Sequence[tuple[float, float]]]]], count: int
) -> tuple[tuple[Cell, ...], ...]:
    """Rectangles of each filter from lines (top, bottom, its spans); spans that go on below are
    one rectangle.
    """
    done: list[list[Cell]] = [[] for _ in range(count)]
    open_: dict[tuple[int, tuple[float, float]], float] = {}
    bottom = 0.0
    for top, following, spans in [*lines, (lines[-1][1], lines[-1][1], [()] * count)]:
        now = {(k, span) for k, one in enumerate(spans) for span in one}
        for key in [key for key in open_ if key not in now]:
            done[key[0]].append((open_.pop(key), bottom, *key[1]))
        for key in sorted(now - open_.keys()):
            open_[key] = top
        bottom = following
    return tuple(tuple(cells) for cells in done)


def polarised(camera: Camera, state: str) -> Camera:
    """The camera in light of one polarisation, "0 deg" or "90 deg"."""
    light = camera.light.model_copy(update={"polarisation": state})
    return camera.model_copy(update={"light": light})


def polarisations(camera: Camera) -> tuple[Camera, ...]:
    """The camera in the light of each polarisation that its light consists of and its filters tell
    apart; the camera itself where they tell none.

    Filters along 0 and 90 degrees leave these two states apart from each other: each is carried by
    itself, and their intensities add.
    """
    if camera.light.polarisation is None and tells_polarisation(camera):
        return tuple(polarised(camera, state) for state in POLARISATIONS)
    return (camera,)


def tells_polarisation(camera: Camera) -> bool:
    """Whether filters of the camera polarise."""
    array = camera.filter_array
    return array is not None and any(one.polariser is not None for one in array.filters)


def _through(camera: Camera, filter_: Filter, cell: Cell, wavelength: float) -> float:
    """Mean intensity transmittance of a filter over a cell (y0, y1, x0, x1) m of the pupil."""
    passed = filter_.passes(camera.light.polarisation)
    return passed * _transmittance(camera, filter_, cell, wavelength)


def _transmittance(camera: Camera, filter_: Filter, cell: Cell, wavelength: float) -> float:
    """The same for light of the filter's own polarisation."""
    if filter_.index is None:
        return filter_transmittance(filter_, wavelength)
    behind = camera.filter_array is not None and camera.filter_array.side == "image"
    distance = camera.lenslet_array.distance if behind else camera.object.distance
    nodes, weights = np.polynomial.legendre.leggauss(6)
    y, x = (
        (low + high) / 2 + nodes * (high - low) / 2
        for low, high in ((cell[0], cell[1]), (cell[2], cell[3]))
    )
    square = y[:, None] ** 2 + x[None, :] ** 2
    sine = np.sqrt(square / (square + distance**2))
    moved = wavelength / np.sqrt(1 - (sine / filter_.index) ** 2)
    passed = [[filter_transmittance(filter_, w) for w in row] for row in moved.tolist()]
    return float(weights @ np.array(passed) @ weights) / 4


def zernike(j: int, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Noll's Zernike polynomial j, of unit root mean square over the unit disc.

    y, x: over the disc's radius; the angle runs from +x to +y.
    """
    n, m = noll_indices(j)
    rho, theta = np.hypot(y, x), np.arctan2(y, x)
    size = abs(m)
    radial = sum(
        (-1) ** s
        * math.factorial(n - s)
        / (
            math.factorial(s)
            * math.factorial((n + size) // 2 - s)
            * math.factorial((n - size) // 2 - s)
        )
        * rho ** (n - 2 * s)
        for s in range((n - size) // 2 + 1)
    )
    if m == 0:
        return math.sqrt(n + 1) * radial
    return (
        math.sqrt(2 * (n + 1)) * radial * (np.cos(size * theta) if m > 0 else np.sin(size * theta))
    )


def unit_radius(lens: MainLens) -> float:
    """Radius (m) on which the Zernike polynomials are defined: that of the smallest disc around the
    aperture.
    """
    return lens.aperture_diameter / 2 * (math.sqrt(2) if lens.aperture_shape == "square" else 1)


def wavefront(lens: MainLens, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Wavefront error: the lens's wavefront grid plus its Noll terms, coefficients in m rms.

    y, x: pupil coordinates, m, broadcast against each other.

    Returns W, m.
    """
    unit = unit_radius(lens)
    total = np.zeros(np.broadcast(y, x).shape)
    spline = _spline(lens)
    if spline is not None:
        total = total + spline(np.stack(np.broadcast_arrays(y, x), axis=-1))
    for term in _terms(lens):
        total = total + term.coefficient * zernike(term.noll, y / unit, x / unit)
    return total


def _spline(lens: MainLens) -> NdBSpline | None:
    """The interpolating cubic spline W(y, x) through the lens's wavefront grid, or None
    where it has none.
    """
    values = lens.samples("wavefront")
    if values is None:
        return None
    from scipy.interpolate import NdBSpline, make_interp_spline

    n = len(values)
    centres = ((np.arange(n) + 0.5) / n - 0.5) * lens.aperture_diameter
    down = make_interp_spline(centres, values, axis=0)
    across = make_interp_spline(centres, down.c, axis=1)
    return NdBSpline(
        (down.t, across.t), np.ascontiguousarray(np.moveaxis(across.c, 0, 1)), 3, extrapolate=True
    )


def _terms(lens: MainLens) -> tuple[Aberration, ...]:
    """The lens's Noll terms.

    A real lens has others at every wavelength and place:
    plenocli.forward.camera.field.at_field comes first.
    """
    if lens.prescription is not None or lens.field:
        raise RuntimeError(
            "the wavefront error of a lens was asked for without a wavelength and a place"
        )
    return lens.aberrations or ()


def has_wavefront(lens: MainLens) -> bool:
    """Whether the lens has any wavefront error."""
    return bool(_terms(lens)) or lens.wavefront is not None


def _sampled_slopes(lens: MainLens) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(y, x, dW/dy, dW/dx) at points over the open aperture, for bounds; flat arrays, m
    and dimensionless.
    """
    half, count = lens.aperture_diameter / 2, 129
    if lens.wavefront is not None:
        count = min(2 * len(lens.samples("wavefront")) + 1, 513)
    axis = np.linspace(-half, half, max(count, 129))
    slopes = np.gradient(
        wavefront(lens, axis[:, None], axis[None, :]), axis[1] - axis[0], edge_order=2
    )
    y, x = np.broadcast_arrays(axis[:, None], axis[None, :])
    # a central obscuration is integrated over, and taken away again
    inside = (
        aperture_picture(lens, y, x) > 0
        if lens.aperture_shape == "image"
        else np.hypot(y, x) <= unit_radius(lens) * (1 + 1e-9)
    )
    return y[inside], x[inside], slopes[0][inside], slopes[1][inside]


def wavefront_slope(lens: MainLens) -> float:
    """An upper estimate of |grad W| over the aperture (dimensionless), for sizing quadratures."""
    if not has_wavefront(lens):
        return 0.0
    _, _, down, across = _sampled_slopes(lens)
    return 1.1 * float(np.hypot(down, across).max(initial=0.0))


def ray_reach(lens: MainLens, eps: float, distance: float) -> float | None:
    """Farthest that a ray lands from the image point along rows or columns: a ray through (y, x) of
    the pupil lands at distance * (eps y + dW/dy, eps x + dW/dx).

    eps: defocus of the pupil, 1/m;
    distance: to the image behind it, m.

    Returns m, None for a lens without wavefront error.
    """
    if not has_wavefront(lens):
        return None
    y, x, down, across = _sampled_slopes(lens)
    return distance * float(
        max(np.abs(eps * y + down).max(initial=0.0), np.abs(eps * x + across).max(initial=0.0))
    )
