"""The main lens's pupil: shape, filter array, aberrations; its generalised pupil function as a quadrature rule.

P(x, y) = P1 sqrt(T) exp(+j k W) exp(+j k eps (x^2 + y^2)/2): P1 the aperture, T the INTENSITY transmittance of the filter
cell, W the wavefront error in metres (W > 0 advances the phase), eps the defocus (Berkner et al. 2013, section 2-3-1).
Filter cells are laid out row by row in a centred square, rows downwards, gaps and surroundings opaque.
"""

import math

import numpy as np

from plenocli.optics.quadrature import Rows, cell_rows, disc_rows


def aperture_area(lens):
    """Area (m^2) of the open main-lens aperture P1, filters not counted."""
    radius = lens.aperture_diameter / 2
    if lens.aperture_shape == "square":
        return lens.aperture_diameter**2
    return math.pi * radius**2 * (1 - (lens.obscuration or 0.0) ** 2)


def filter_transmittance(filter_, wavelength):
    """Intensity transmittance of one filter at `wavelength` (m): peak exp(-4 ln2 ((l - center)/fwhm)^2) + blocking."""
    arg = (wavelength - filter_.center) / filter_.fwhm
    return min(1.0, filter_.peak * math.exp(-4 * math.log(2) * arg * arg) + (filter_.blocking or 0.0))


def filter_cells(camera, wavelength):
    """List of ((y0, y1, x0, x1) in m, intensity transmittance) of the filter array, or None where there is no array."""
    array = camera.filter_array
    if array is None:
        return None
    rows, columns = array.layout
    gap = array.gap or 0.0
    high, wide = (array.size - (rows - 1) * gap) / rows, (array.size - (columns - 1) * gap) / columns
    cells = []
    for index, filter_ in enumerate(array.filters):
        top = -array.size / 2 + (index // columns) * (high + gap)
        left = -array.size / 2 + (index % columns) * (wide + gap)
        cells.append(((top, top + high, left, left + wide), filter_transmittance(filter_, wavelength)))
    return cells


def noll_indices(j):
    """Radial and signed azimuthal order (n, m) of Noll's Zernike polynomial j >= 1; m < 0 is the sine term (Noll 1976)."""
    n = int((math.sqrt(8 * j - 7) - 1) / 2)
    rest = j - n * (n + 1) // 2 - 1
    m = 2 * ((rest + 1 - n % 2) // 2) + n % 2
    return n, (-m if j % 2 else m)


def zernike(j, y, x):
    """Noll's Zernike polynomial j, unit root mean square over the unit disc, at (y, x); the angle runs from +x to +y."""
    n, m = noll_indices(j)
    rho, theta = np.hypot(y, x), np.arctan2(y, x)
    size = abs(m)
    radial = sum(
        (-1) ** s * math.factorial(n - s)
        / (math.factorial(s) * math.factorial((n + size) // 2 - s) * math.factorial((n - size) // 2 - s)) * rho ** (n - 2 * s)
        for s in range((n - size) // 2 + 1)
    )
    if m == 0:
        return math.sqrt(n + 1) * radial
    return math.sqrt(2 * (n + 1)) * radial * (np.cos(size * theta) if m > 0 else np.sin(size * theta))


def unit_radius(lens):
    """Radius (m) on which the Zernike polynomials are defined: that of the smallest disc around the aperture."""
    return lens.aperture_diameter / 2 * (math.sqrt(2) if lens.aperture_shape == "square" else 1)


def wavefront(lens, y, x):
    """Wavefront error W (m) at pupil coordinates y, x (m): the sum of the lens's Noll terms, coefficients in metres rms."""
    unit = unit_radius(lens)
    total = np.zeros(np.broadcast(y, x).shape)
    for term in lens.aberrations or ():
        noll, coefficient = (term.noll, term.coefficient) if hasattr(term, "noll") else term
        total = total + coefficient * zernike(noll, y / unit, x / unit)
    return total


def wavefront_slope(lens):
    """An upper estimate of |grad W| over the aperture (dimensionless), for sizing quadratures."""
    if not lens.aberrations:
        return 0.0
    half = lens.aperture_diameter / 2
    axis = np.linspace(-half, half, 129)
    values = wavefront(lens, axis[:, None], axis[None, :])
    slopes = np.hypot(*np.gradient(values, axis[1] - axis[0]))
    inside = np.hypot(axis[:, None], axis[None, :]) <= unit_radius(lens)
    return 1.1 * float(slopes[inside].max())


def pupil_rows(camera, geometry, slope):
    """The generalised pupil as a list of Rows with complex weights; integrating exp(-j k x.d/z2) over it gives the field.

    `slope` (rad/m) bounds the phase gradient of the kernel it will be integrated with; defocus and W are added here.
    Weights carry sqrt(T), exp(j k W) and exp(j k eps r^2/2) and the sign -1 over a central obscuration.
    """
    lens, k, eps = camera.main_lens, geometry.k, geometry.eps
    slope = slope + k * (abs(eps) * unit_radius(lens) + wavefront_slope(lens))
    cells = filter_cells(camera, geometry.wavelength)
    radius = lens.aperture_diameter / 2
    panels = []
    if lens.aperture_shape == "square":
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
                panels += [(sign * math.sqrt(t), rows) for cell, t in cells for rows in cell_rows(cell, r, slope)]
    return [_weighted(lens, k, eps, amplitude, rows) for amplitude, rows in panels]


def _weighted(lens, k, eps, amplitude, rows):
    y = rows.y[:, None]
    phase = k * wavefront(lens, y, rows.x) + k * eps / 2 * (y * y + rows.x * rows.x)
    return Rows(rows.y, rows.x, amplitude * rows.weight * np.exp(1j * phase))
