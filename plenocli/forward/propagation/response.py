"""The response of one superpixel to an even object at one wavelength: A summed over object points,
without forming A.

An even, incoherent object that goes on beyond the lenslet's field fills every ray from the pupil to
the array with the same light, and in waves makes the pupil itself an incoherent source (van Cittert
and Zernike). Focus and wavefront error of the main lens then only exchange object points with one
another. What is left is the pupil, with its filters, imaged by one lenslet:

    F(pixel) = opening/cell * integral over the pupil of T(x) * integral over the pixel of spot(t -
        m pitch + (z3/z2) x) dt dx / pupil area,

summed over lenslets m; docs/model.md, "The response predicted". The spot of a lenslet is its
opening, z3 kappa wide per unit, by rays, and |Fourier transform of its opening with the phase k
kappa u^2/2|^2 by waves. The fields of different lenslets are added in intensity: over a pupil of
many diffraction cells their interference averages out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.field import at_field
from plenocli.forward.camera.geometry import geometry as geometry_of
from plenocli.forward.camera.pupil import aperture_area, aperture_picture, filter_cells, wavefront
from plenocli.forward.camera.quadrature import cell_chords, gauss, nodes_for
from plenocli.forward.propagation.ray.rays import pupil_measure

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.main_lens import MainLens
    from plenocli.forward.propagation.system_matrix import PifBuilder

TAIL = 6
"""Pitches beyond the pupil's image over which the diffraction of neighbouring
lenslets is followed.
"""
SAMPLES = 6
"""Samples of a spot's integral per diffraction cell lambda z3/w, for splines of degree 5
(4e-7 of a response).
"""
OPENING_STEPS = 8
"""Nodes across a lenslet for each pixel that its spot is wide, where areas of the pupil
are summed over them.
"""
LIT = 200_000
"""Parts of pixels whose shares of the pupil are found together."""

FilterCells = Sequence[tuple[tuple[float, float, float, float], float]]
"""((y0, y1, x0, x1) in m, transmittance) of the filters in the pupil."""


def valid_for(camera: Camera, model: str) -> str | None:
    """None, or one sentence why `model` ("ray" or "fresnel") has no closed form for this camera."""
    if model == "ray":
        return None
    if camera.lenslet_array.aperture_shape != "square":
        return f"the spot of a {camera.lenslet_array.aperture_shape} lenslet is not separable"
    if camera.main_lens.aperture_shape == "image":
        return "an aperture image has no chords"
    return None


def uniform_response(
    camera: Camera, wavelength: float, model: str, shifts: ArrayLike = ((0.0, 0.0),)
) -> np.ndarray:
    """Response to an even object: the mean over object points of what A, all superpixels together,
    gives a pixel.

    A uniform object of one unit of light a point (through the clear pupil) puts this much into each
    pixel, per point of the object under one lenslet.

    wavelength: m; both lenses by their glass;
    model: "ray" or "fresnel", see valid_for;
    shifts: (lenslet, 2) rows and columns in pixels from the superpixel's centre to the middle of
        its window.

    Returns (lenslet, pixel).
    docs/model.md, "The response predicted".
    """
    geometry, lens = geometry_of(camera, wavelength), at_field(camera, wavelength).main_lens
    shifts = np.atleast_2d(np.asarray(shifts, float))
    cells = filter_cells(camera, wavelength)
    half = lens.aperture_diameter / 2
    cells = [((-half, half, -half, half), 1.0)] if cells is None else cells
    separable = geometry.lenslet_shape == "square" and (
        model == "fresnel" or lens.aperture_shape == "square"
    )
    reach = _reach(geometry, model)
    scale = 1 / (aperture_area(lens) * geometry.row_spacing * geometry.D2**2)
    # lenslets of one row are often shifted alike
    lines, which = zip(*(np.unique(shifts[:, axis], return_inverse=True) for axis in (0, 1)))
    edges = [
        [
            geometry.pixels(axis)
            + (shift + np.array([[-0.5], [0.5]]) * geometry.pixel_active / geometry.pixel_pitch)
            * geometry.pixel_pitch
            for shift in lines[axis]
        ]
        for axis in (0, 1)
    ]
    if separable:
        spot, strips = _spot(geometry, model), _strips(geometry, lens, cells)
        out = _through_spot(geometry, spot, strips, edges, which, reach)
    else:
        out = np.stack(
            [
                _through_opening(geometry, lens, cells, (edges[0][i], edges[1][j]), reach)
                for i, j in zip(*which)
            ]
        )
    return out.reshape(len(shifts), -1) * scale


def field_response(builder: PifBuilder) -> np.ndarray:
    """Response to the object points of one lenslet's field alone: the mean over the columns of A.

    builder: of the matrix; the own superpixel of that field is the one with offset (0, 0). Summed
        over superpixels this is uniform_response, as far as light does not reach beyond those kept.

    Returns (superpixel, pixel).
    """
    total: np.ndarray | float = 0.0
    for _, block in builder.blocks():
        total = total + block.sum(axis=2, dtype=float)
    return np.asarray(total / builder.points)


def own_light(camera: Camera, wavelength: float, count: int = 256) -> float:
    """Share of a lenslet's light that comes from its own object field, by rays; the rest belongs to
    its neighbours'.

    The ray from (y, x) of the pupil that meets the array at u comes from the image point u - z2
    (eps x + dW/dx).

    wavelength: m;
    count: points of the pupil per axis, which tell a share to about 1/count.
    """
    lens = at_field(camera, wavelength).main_lens
    geometry = geometry_of(camera, wavelength)
    axis = ((np.arange(count) + 0.5) / count - 0.5) * lens.aperture_diameter
    y, x, step = axis[:, None], axis[None, :], lens.aperture_diameter / count / 2
    weight = aperture_picture(lens, y, x)
    cells = filter_cells(camera, wavelength)
    if cells is not None:
        passed: np.ndarray | int = 0
        for (y0, y1, x0, x1), t in cells:
            passed = passed + t * ((y > y0) & (y < y1) & (x > x0) & (x < x1))
        weight = weight * passed
    down = geometry.eps * y + (wavefront(lens, y + step, x) - wavefront(lens, y - step, x)) / (
        2 * step
    )
    across = geometry.eps * x + (wavefront(lens, y, x + step) - wavefront(lens, y, x - step)) / (
        2 * step
    )
    stay = np.clip(
        1 - geometry.z2 * np.abs(down) / (geometry.D2 * geometry.row_spacing), 0, None
    ) * np.clip(1 - geometry.z2 * np.abs(across) / geometry.D2, 0, None)
    return float((weight * stay).sum() / weight.sum())


def _reach(geometry: Geometry, model: str) -> int:
    """Lenslets, in pitches, whose light may meet the window of a superpixel."""
    image = geometry.z3 / geometry.z2 * geometry.D1 / 2 + abs(geometry.z3 * geometry.kappa) * max(
        geometry.lenslet_extent
    )
    windows = max(n * geometry.pixel_pitch / 2 + geometry.pixel_pitch for n in geometry.pixel_shape)
    pitch = geometry.superpixel_pitch * geometry.row_spacing
    far = math.ceil((image + windows) / pitch - 1e-9) - (model == "ray")
    return far + (TAIL if model == "fresnel" else 0)


# a lenslet's spot along one axis, of unit light, and its integrals


class RaySpot:
    """Even light over a width of |z3 kappa| times the lenslet: first and second integrals of it
    (odd and even part), in closed form.
    """

    def __init__(self, geometry: Geometry) -> None:
        self.half = abs(geometry.z3 * geometry.kappa) * geometry.lenslet_width / 2

    def first(self, s: np.ndarray) -> np.ndarray:
        """Light below s (m), less one half."""
        return np.clip(s / (2 * self.half), -0.5, 0.5) if self.half else np.sign(s) / 2

    def second(self, s: np.ndarray) -> np.ndarray:
        """Integral of `first` from 0 to s, m; a constant does not matter."""
        far = np.abs(s)
        return np.where(far < self.half, s * s / (4 * self.half or 1.0), far / 2 - self.half / 4)


class WaveSpot:
    """|Fourier transform of the opening with the phase k kappa u^2/2|^2 along one axis.

    Its own transform is known: OTF(v) = (1 - v/w) sinc(kappa v (w - v)/lambda) for rays v apart on
    a lenslet w wide. So the second integral is that of OTF (1 - cos 2 pi f s)/(2 pi f)^2 over the
    band, v = lambda z3 f, which Gauss-Legendre gives to rounding; it is tabulated.
    """

    def __init__(self, geometry: Geometry, reach: float) -> None:
        from scipy.interpolate import make_interp_spline

        width, cell = (
            geometry.lenslet_width,
            geometry.wavelength * geometry.z3 / geometry.lenslet_width,
        )
        count = math.ceil(reach / cell * SAMPLES) + 8
        s = np.arange(-8, count) * cell / SAMPLES
        t, w = gauss(
            nodes_for(math.pi * s[-1] / cell + abs(geometry.k * geometry.kappa) * width**2 / 4)
        )
        v = (t + 1) / 2 * width
        f = v / (geometry.wavelength * geometry.z3)
        # both signs of f
        sinc = np.sinc(geometry.kappa * v * (width - v) / geometry.wavelength)
        otf = (1 - v / width) * sinc * w / cell
        even = np.empty(len(s))
        for start in range(0, len(s), 4096):
            part = slice(start, start + 4096)
            even[part] = (2 * np.sin(np.pi * np.outer(s[part], f)) ** 2) @ (
                otf / (2 * np.pi * f) ** 2
            )
        self._second = make_interp_spline(s, even, 5)
        self._first = self._second.derivative()
        self.reach = s[-1]

    def first(self, s: np.ndarray) -> np.ndarray:
        """As RaySpot.first."""
        return np.sign(s) * self._first(np.abs(s))

    def second(self, s: np.ndarray) -> np.ndarray:
        """As RaySpot.second."""
        return self._second(np.abs(s))


def _spot(geometry: Geometry, model: str) -> RaySpot | WaveSpot:
    if model == "ray":
        return RaySpot(geometry)
    far = (
        geometry.z3 / geometry.z2 * geometry.D1 / 2
        + max(geometry.pixel_shape) * geometry.pixel_pitch / 2
        + 2 * geometry.pixel_pitch
    )
    return WaveSpot(geometry, far + (_reach(geometry, model) + 1) * geometry.superpixel_pitch)


def _strips(geometry: Geometry, lens: MainLens, cells: FilterCells) -> list[tuple]:
    """The pupil as [(weight, top, bottom, left, right)], arrays of m: rectangles, or chords at
    nodes (bottom None, weight times m).
    """
    half = lens.aperture_diameter / 2
    strips = []
    if lens.aperture_shape == "square":
        for (y0, y1, x0, x1), t in cells:
            ends = [np.clip(v, -half, half).reshape(1) for v in (y0, y1, x0, x1)]
            strips.append((np.array([t]), *ends))
        return strips
    # the light of a pixel has the spot's band limit across the pupil, w/(lambda z2) cycles a metre,
    # along y and through the chord's ends
    slope = (
        2 * math.pi * geometry.lenslet_width / (geometry.wavelength * geometry.z2) * math.sqrt(2)
    )
    discs = [(1.0, half)] + ([(-1.0, half * lens.obscuration)] if lens.obscuration else [])
    for sign, radius in discs:
        for cell, t in cells:
            strips += [
                (sign * t * weight, y, None, left, right)
                for y, weight, left, right in cell_chords(cell, [(0.0, 0.0, radius)], slope)
            ]
    return strips


def _through_spot(
    geometry: Geometry,
    spot: RaySpot | WaveSpot,
    strips: list[tuple],
    edges: list[list[np.ndarray]],
    which: Sequence[np.ndarray],
    reach: int,
) -> np.ndarray:
    """Light (lenslet, pixel row, pixel column) of separable lenslets, times pupil
    area and cell area.

    edges: for both axes a list of pixel edges (2, pixel);
    which: for both axes the number of each lenslet in it.
    """
    minify, pitch = geometry.z3 / geometry.z2, geometry.superpixel_pitch

    def between(t: np.ndarray, far: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        ends = (_summed(spot.second, t, far * pitch, minify * end) for end in (high, low))
        return np.subtract(*ends) / minify

    out = np.zeros((len(which[0]), *(line[0].shape[1] for line in edges)))
    for rows, columns in geometry.neighbourhood(reach):
        for weight, top, bottom, left, right in strips:
            down = [
                _summed(spot.first, t, rows * pitch, minify * top)
                if bottom is None
                else between(t, rows, top, bottom)
                for t in edges[0]
            ]
            across = [between(t, columns, left, right) for t in edges[1]]
            for n, (i, j) in enumerate(zip(*which)):
                out[n] += (weight[:, None] * down[i]).T @ across[j]
    return out * geometry.lenslet_width**2


def _summed(
    integral: Callable[[np.ndarray], np.ndarray], t: np.ndarray, far: np.ndarray, place: np.ndarray
) -> np.ndarray:
    """integral(upper edge + place) - integral(lower edge + place), summed over lenslets `far`
    (m) away: (place, pixel) for edges t (2, pixel).
    """
    s = t[:, None, None] + place[:, None, None] - far[:, None]
    return np.subtract(*integral(s[::-1])).sum(axis=1)


def _through_opening(
    geometry: Geometry,
    lens: MainLens,
    cells: FilterCells,
    edges: tuple[np.ndarray, np.ndarray],
    reach: int,
) -> np.ndarray:
    """The same by rays for any pupil and lenslet: exact areas of the pupil, summed over nodes in
    the lenslet's opening.
    """
    below, minify = pupil_measure(lens), geometry.z3 / geometry.z2
    out = np.zeros(tuple(line.shape[1] for line in edges))
    for *middle, weight in _opening_nodes(geometry):
        for far in geometry.neighbourhood(reach):
            ends = [
                (u * geometry.z3 * geometry.kappa + m[:, None] * geometry.superpixel_pitch - t)
                / minify
                for u, m, t in zip(middle, far, (e[:, None] for e in edges))
            ]
            for (y0, y1, x0, x1), t in cells:
                columns, right, left = _lit(ends[1], x0, x1)
                rows, bottom, top = _lit(ends[0], y0, y1)
                step = max(1, LIT // max(1, len(left)))
                for part in (slice(k, k + step) for k in range(0, len(top), step)):
                    low, high = bottom[part, None], top[part, None]
                    light = below(low, right) - below(low, left)
                    light += below(high, left) - below(high, right)
                    out += weight * t * (rows[:, part] @ light @ columns.T)
    return out * aperture_area(lens)


def _lit(ends: np.ndarray, low: float, high: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(pixel, place), 1 where a place is of a pixel, and both ends of places where pixels (2,
    lenslet, pixel) of images of the pupil meet a filter from low to high, m.
    """
    upper, lower = np.clip(ends, low, high)
    hit = np.nonzero(upper > lower)
    return np.eye(ends.shape[2])[:, hit[1]], upper[hit], lower[hit]


def _opening_nodes(geometry: Geometry) -> list[tuple[float, float, float]]:
    """Nodes (y, x, area) over a lenslet's opening, enough for a spot z3 kappa times
    as large on pixels.
    """
    high, wide = geometry.lenslet_extent
    spread = abs(geometry.z3 * geometry.kappa) * geometry.lenslet_width / geometry.pixel_pitch
    if spread < 1e-6:
        return [(0.0, 0.0, geometry.opening_area)]
    t, w = gauss(min(64, math.ceil(OPENING_STEPS * spread) + 4))
    nodes = []
    for y, wy in zip(high * t, high * w):
        far = _opening_half(geometry, y)
        nodes += [(y, far * s, wy * far * ws) for s, ws in zip(t, w)]
    # few nodes place the light well enough, but do not sum to a round opening
    scale = geometry.opening_area / sum(weight for *_, weight in nodes)
    return [(y, x, weight * scale) for y, x, weight in nodes]


def _opening_half(geometry: Geometry, y: float) -> float:
    """Half the width (m) of the opening at height y."""
    half = geometry.lenslet_width / 2
    if geometry.lenslet_shape == "square":
        return half
    if geometry.lenslet_shape == "circle":
        return math.sqrt(max(half * half - y * y, 0.0))
    return min(half, 2 * half - math.sqrt(3) * abs(y))
