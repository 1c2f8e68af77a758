"""The main lens's generalised pupil function as a quadrature rule.

Sources and signs as in plenocli.forward.camera.pupil.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.pupil import filter_cells, wavefront, wavefront_slope
from plenocli.forward.camera.quadrature import (
    Cell,
    Rows,
    cell_rows,
    disc_rows,
    gauss,
    smooth_nodes,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.main_lens import MainLens


def pupil_rows(camera: Camera, geometry: Geometry, slope: float) -> list[Rows]:
    """The generalised pupil; integrating exp(-j k x.d/z2) over it gives the field.

    slope: rad/m that bounds the phase gradient of the kernel that it will be integrated with;
        defocus and W are added here.

    Returns panels with complex weights, which carry sqrt(T), exp(j k W) and exp(j k eps r^2/2) and
    the sign -1 over a central obscuration; what rims cut off is left out.
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
            panels += [(math.sqrt(t), rows) for rows in cell_rows(box, lens.rims, slope)]
    else:
        discs = [(1.0, radius)]
        if lens.obscuration:
            discs.append((-1.0, radius * lens.obscuration))
        for sign, r in discs:
            if cells is None and not lens.rims:
                panels.append((sign, disc_rows(r, slope)))
            else:
                panels += [
                    (sign * math.sqrt(t), rows)
                    for cell, t in cells or [((-r, r, -r, r), 1.0)]
                    for rows in cell_rows(cell, ((0.0, 0.0, r), *lens.rims), slope)
                ]
    return [_weighted(lens, k, eps, amplitude, rows) for amplitude, rows in panels]


def _image_rows(lens: MainLens, cells: list[tuple[Cell, float]] | None, slope: float) -> Rows:
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


def _weighted(lens: MainLens, k: float, eps: float, amplitude: float, rows: Rows) -> Rows:
    y = rows.y[:, None]
    phase = k * wavefront(lens, y, rows.x) + k * eps / 2 * (y * y + rows.x * rows.x)
    return Rows(rows.y, rows.x, amplitude * rows.weight * np.exp(1j * phase))
