"""The main lens's pupil: shape, filter array, aberrations; its generalised pupil function as
a quadrature rule.

P(x, y) = P1 sqrt(T) exp(+j k W) exp(+j k eps (x^2 + y^2)/2): P1 the aperture, T the INTENSITY
transmittance of the filter cell, W the wavefront error in metres (W > 0 advances the phase), eps
the defocus (Berkner et al. 2013, section 2-3-1). Filter cells are laid out row by row in a centred
square, rows downwards, gaps and surroundings opaque.

An aperture image is the intensity transmittance of the cells of a square grid over the square of
side D1: n x n cells, constant in each, rows downwards looking along the light. A wavefront grid
holds W at the centres of such cells; between them it is the interpolating cubic spline, which goes
on by half a cell to the edge of the square.
"""

import math

import numpy as np

from plenocli.forward.camera.quadrature import Rows, cell_rows, disc_rows, gauss, smooth_nodes


def aperture_area(lens):
    """Area (m^2) of the open main-lens aperture P1, filters not counted; of an aperture image
    the integral of its values.
    """
    radius = lens.aperture_diameter / 2
    if lens.aperture_shape == "image":
        return lens.aperture_diameter**2 * float(lens.samples("aperture_image").mean())
    if lens.aperture_shape == "square":
        return lens.aperture_diameter**2
    return math.pi * radius**2 * (1 - (lens.obscuration or 0.0) ** 2)


def aperture_picture(lens, y, x):
    """Intensity transmittance of the open aperture at pupil coordinates y, x (m), broadcasting;
    filters not counted.
    """
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


def filter_transmittance(filter_, wavelength):
    """Intensity transmittance of one filter at `wavelength` (m): peak exp(-4 ln2 ((l -
    center)/fwhm)^2) + blocking.
    """
    arg = (wavelength - filter_.center) / filter_.fwhm
    return min(
        1.0, filter_.peak * math.exp(-4 * math.log(2) * arg * arg) + (filter_.blocking or 0.0)
    )


def filter_cells(camera, wavelength):
    """List of ((y0, y1, x0, x1) in m, intensity transmittance) of the filter array, or None
    where there is no array.
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
        cells.append(
            ((top, top + high, left, left + wide), filter_transmittance(filter_, wavelength))
        )
    return cells


def noll_indices(j):
    """Radial and signed azimuthal order (n, m) of Noll's Zernike polynomial j >= 1; m < 0 is the
    sine term (Noll 1976).
    """
    n = int((math.sqrt(8 * j - 7) - 1) / 2)
    rest = j - n * (n + 1) // 2 - 1
    m = 2 * ((rest + 1 - n % 2) // 2) + n % 2
    return n, (-m if j % 2 else m)


def zernike(j, y, x):
    """Noll's Zernike polynomial j, unit root mean square over the unit disc, at (y, x); the
    angle runs from +x to +y.
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


def unit_radius(lens):
    """Radius (m) on which the Zernike polynomials are defined: that of the smallest disc
    around the aperture.
    """
    return lens.aperture_diameter / 2 * (math.sqrt(2) if lens.aperture_shape == "square" else 1)


def wavefront(lens, y, x):
    """Wavefront error W (m) at pupil coordinates y, x (m): the lens's wavefront grid plus its
    Noll terms, coefficients in m rms.
    """
    unit = unit_radius(lens)
    total = np.zeros(np.broadcast(y, x).shape)
    spline = _spline(lens)
    if spline is not None:
        total = total + spline(np.stack(np.broadcast_arrays(y, x), axis=-1))
    for term in _terms(lens):
        noll, coefficient = (term.noll, term.coefficient) if hasattr(term, "noll") else term
        total = total + coefficient * zernike(noll, y / unit, x / unit)
    return total


def _spline(lens):
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


def _terms(lens):
    """The lens's Noll terms.

    A real lens has others at every wavelength:
    plenocli.forward.camera.lens.at_wavelength comes first.
    """
    if getattr(lens, "prescription", None) is not None:
        raise RuntimeError(
            "the wavefront error of a lens prescription was asked for without a wavelength"
        )
    return lens.aberrations or ()


def has_wavefront(lens):
    """Whether the lens has any wavefront error."""
    return bool(_terms(lens)) or lens.wavefront is not None


def _sampled_slopes(lens):
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


def wavefront_slope(lens):
    """An upper estimate of |grad W| over the aperture (dimensionless), for sizing quadratures."""
    if not has_wavefront(lens):
        return 0.0
    _, _, down, across = _sampled_slopes(lens)
    return 1.1 * float(np.hypot(down, across).max(initial=0.0))


def ray_reach(lens, eps, distance):
    """Farthest that a ray lands from the image point along rows or columns (m), `distance` behind a
    pupil of defocus eps (1/m).

    A ray through (y, x) lands at distance * (eps y + dW/dy, eps x + dW/dx). None for a lens
    without wavefront error.
    """
    if not has_wavefront(lens):
        return None
    y, x, down, across = _sampled_slopes(lens)
    return distance * float(
        max(np.abs(eps * y + down).max(initial=0.0), np.abs(eps * x + across).max(initial=0.0))
    )


def pupil_rows(camera, geometry, slope):
    """The generalised pupil as a list of Rows with complex weights; integrating exp(-j k x.d/z2)
    over it gives the field.

    `slope` (rad/m) bounds the phase gradient of the kernel it will be integrated with; defocus and
    W are added here. Weights carry sqrt(T), exp(j k W) and exp(j k eps r^2/2) and the sign -1 over
    a central obscuration.
    """
    lens, k, eps = camera.main_lens, geometry.k, geometry.eps
    radius = lens.aperture_diameter / 2
    corner = radius * (1 if lens.aperture_shape in ("circle", "annulus") else math.sqrt(2))
    slope = slope + k * (abs(eps) * corner + wavefront_slope(lens))
    cells = filter_cells(camera, geometry.wavelength)
    panels = []
    if lens.aperture_shape == "image":
        panels = [(1.0, _image_rows(lens, cells, slope))]
    elif lens.aperture_shape == "square":
        for (y0, y1, x0, x1), t in cells or [((-radius, radius, -radius, radius), 1.0)]:
            box = (max(y0, -radius), min(y1, radius), max(x0, -radius), min(x1, radius))
            panels += [(math.sqrt(t), rows) for rows in cell_rows(box, None, slope)]
    else:
        discs = [(1.0, radius)]
        if lens.obscuration:
            discs.append((-1.0, radius * lens.obscuration))
        for sign, r in discs:
            if cells is None:
                panels.append((sign, disc_rows(r, slope)))
            else:
                panels += [
                    (sign * math.sqrt(t), rows)
                    for cell, t in cells
                    for rows in cell_rows(cell, r, slope)
                ]
    return [_weighted(lens, k, eps, amplitude, rows) for amplitude, rows in panels]


def _image_rows(lens, cells, slope):
    """Rows over an aperture image, exact for its constant cells (and those of a filter array),
    weighted with sqrt(T).

    Neighbouring rows or columns of cells that do not differ are one panel; dark
    margins are left out.
    """
    image, radius = lens.samples("aperture_image"), lens.aperture_diameter / 2
    grid = np.linspace(-radius, radius, len(image) + 1)
    edges = []
    for axis in (0, 1):
        line = np.moveaxis(image, axis, 0)
        steps = np.any(line[1:] != line[:-1], axis=1)
        lit = np.flatnonzero(line.any(axis=1))
        low, high = grid[lit[0]], grid[lit[-1] + 1]
        inner = np.concatenate(
            [grid[1:-1][steps], *([c[2 * axis : 2 * axis + 2] for c, _ in cells or ()])]
        )
        edges.append(np.unique(np.r_[low, inner[(inner > low) & (inner < high)], high]))
    middle = [(e[:-1] + e[1:]) / 2 for e in edges]
    where = [np.clip(np.searchsorted(grid, m) - 1, 0, len(image) - 1) for m in middle]
    transmittance = image[np.ix_(*where)]
    if cells is not None:
        y, x = middle[0][:, None], middle[1][None, :]
        transmittance = transmittance * sum(
            t * ((y > y0) & (y < y1) & (x > x0) & (x < x1)) for (y0, y1, x0, x1), t in cells
        )
    axes = []
    for e in edges:
        t, w = gauss(smooth_nodes(slope * float(np.diff(e).max()) / 2))
        half = np.diff(e)[:, None] / 2
        axes.append(
            (((e[:-1] + e[1:])[:, None] / 2 + half * t).ravel(), (half * w).ravel(), len(t))
        )
    (y, wy, py), (x, wx, px) = axes
    amplitude = np.sqrt(transmittance).repeat(py, axis=0).repeat(px, axis=1)
    return Rows(y, np.broadcast_to(x, amplitude.shape), amplitude * np.outer(wy, wx))


def _weighted(lens, k, eps, amplitude, rows):
    y = rows.y[:, None]
    phase = k * wavefront(lens, y, rows.x) + k * eps / 2 * (y * y + rows.x * rows.x)
    return Rows(rows.y, rows.x, amplitude * rows.weight * np.exp(1j * phase))
