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
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.model import noll_indices
from plenocli.forward.camera.quadrature import Cell

if TYPE_CHECKING:
    from scipy.interpolate import NdBSpline

    from plenocli.forward.camera.model import Aberration, Camera, Filter, MainLens


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
    """Cells of the filter array.

    Of a filter whose band moves with the angle, a cell has the mean over the angles at which light
    crosses it; how the angle differs within the cell, and with the place of the object point, is
    left out.
    wavelength: m.

    Returns [((y0, y1, x0, x1) m, intensity transmittance)], None where there is no array.
    """
    array = camera.filter_array
    if array is None:
        return None
    rows, columns = array.layout
    gap = array.gap or 0.0
    high, wide = (
        (array.size - (rows - 1) * gap) / rows,
        (array.size - (columns - 1) * gap) / columns,
    )
    cells = []
    for index, filter_ in enumerate(array.filters):
        top = -array.size / 2 + (index // columns) * (high + gap)
        left = -array.size / 2 + (index % columns) * (wide + gap)
        cell = (top, top + high, left, left + wide)
        cells.append((cell, _through(camera, filter_, cell, wavelength)))
    return cells


def _through(camera: Camera, filter_: Filter, cell: Cell, wavelength: float) -> float:
    """Mean intensity transmittance of a filter over a cell (y0, y1, x0, x1) m of the pupil."""
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
