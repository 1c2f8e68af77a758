"""The main lens's spread function where the pupil is rotationally symmetric: one Hankel integral
instead of a surface integral.

    h(d) = 2 pi/(lambda z2 sqrt(S)) * integral of P(rho) J0(k rho |d|/z2) rho d rho

is an even function of |d| whose frequencies end at the pupil's rim, so a Chebyshev series in |d|^2
carries it from a few hundred radii to any number of points. Source: Born and Wolf, section 8.5;
docs/model.md, "From a point to the lenslet array".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.pupil import (
    aperture_area,
    unit_radius,
    wavefront,
    wavefront_slope,
)
from plenocli.forward.camera.quadrature import gauss, nodes_for
from plenocli.forward.camera.sections.main_lens import noll_indices

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera

SERIES_POINTS = 1 << 13
"""Points that go through the series together: three such arrays stay in the cache."""
_TOGETHER = 64
"""Radii whose orders are transformed together: this bounds memory."""


def is_radial(camera: Camera) -> bool:
    """Whether the pupil, its filters and its wavefront error are the same in all directions."""
    lens = camera.main_lens
    plain = (
        lens.aperture_shape in ("circle", "annulus")
        and camera.filter_array is None
        and lens.wavefront is None
        and not lens.rims
    )
    return plain and all(noll_indices(term.noll)[1] == 0 for term in lens.aberrations or ())


def profile(camera: Camera, geometry: Geometry, reach: float) -> np.ndarray:
    """The spread function of a radial pupil as a series.

    reach: largest distance |d|, m.

    Returns Chebyshev coefficients (term,) of h (1/m) in 2 |d|^2/reach^2 - 1, real where h is.
    """
    g, lens = geometry, camera.main_lens
    outer = g.D1 / 2
    inner = outer * (lens.obscuration or 0.0)
    rate = g.k * reach / g.z2
    half = (outer - inner) / 2
    t, w = gauss(
        nodes_for(half * (rate + g.k * (abs(g.eps) * unit_radius(lens) + wavefront_slope(lens))))
    )
    rho = inner + half * (t + 1)
    weight = (
        half
        * w
        * rho
        * np.exp(1j * g.k * (wavefront(lens, np.zeros_like(rho), rho) + g.eps / 2 * rho * rho))
    )
    return hankel_series(rate * rho, weight, rate * outer) * (
        2 * np.pi / (g.wavelength * g.z2 * math.sqrt(aperture_area(lens)))
    )


def hankel_series(rates: np.ndarray, weight: np.ndarray, edge: float) -> np.ndarray:
    """Chebyshev coefficients, in 2 t^2 - 1 for 0 <= t <= 1, of the sum of weight J0(rate t).

    rates: (node,), at most `edge`;
    weight: (node,) complex;
    edge: largest rate.

    Returns (term,), real where the sum is.

    J0(2 z sin u) is the sum of J_k(z)^2 cos(2 k u) over all orders k (Neumann), and the J_k(z) are
    the Fourier coefficients of exp(i z sin u) (Jacobi and Anger): no series is fitted.
    """
    count = int(edge / 2 + 4 * np.cbrt(edge) + 12)
    wave = np.sin(np.arange(2 * count) * np.pi / count)
    series = np.zeros(count, complex)
    for first in range(0, len(rates), _TOGETHER):
        some = slice(first, first + _TOGETHER)
        orders = np.fft.fft(np.exp(0.5j * rates[some, None] * wave), norm="forward")
        series += weight[some] @ orders.real[:, :count] ** 2
    series[1:] *= 2
    series[1::2] *= -1
    real = np.abs(series.imag).max() <= 1e-14 * np.abs(series.real).max()
    return series.real if real else series


def radial_field(
    camera: Camera,
    geometry: Geometry,
    dy: np.ndarray,
    dx: np.ndarray,
    profile: Callable[..., np.ndarray] = profile,
) -> np.ndarray:
    """The spread function of a radial pupil (is_radial) on a grid.

    dy, dx: m;
    profile: what computes the series, this module's or debye.spherical_profile.

    Returns h (len(dy), len(dx)), 1/m, real where it is.
    """
    reach = math.hypot(np.abs(dy).max(), np.abs(dx).max()) or geometry.D2
    series = profile(camera, geometry, reach)
    # every distance once: grids are even and usually the same along both axes
    rows, back_y = np.unique(np.abs(dy), return_inverse=True)
    columns, back_x = np.unique(np.abs(dx), return_inverse=True)
    square = len(rows) == len(columns) and np.array_equal(rows, columns)
    i, j = (
        np.triu_indices(len(rows))
        if square
        else (a.ravel() for a in np.indices((len(rows), len(columns))))
    )
    place = 2 * (rows[i] ** 2 + columns[j] ** 2) / reach**2 - 1
    field = np.empty((len(rows), len(columns)), series.dtype)
    values = _chebyshev(series.real, place)
    if np.iscomplexobj(series):
        values = values + 1j * _chebyshev(series.imag, place)
    field[i, j] = values
    if square:
        field[j, i] = values
    return field[back_y[:, None], back_x]


def _chebyshev(series: np.ndarray, t: np.ndarray) -> np.ndarray:
    """sum_n series[n] T_n(t) for a flat array t, by Clenshaw's recurrence slab by slab."""
    out = np.empty_like(t)
    for start in range(0, len(t), SERIES_POINTS):
        part = t[start : start + SERIES_POINTS]
        twice = 2 * part
        one, two, work = np.zeros_like(part), np.zeros_like(part), np.empty_like(part)
        for coefficient in series[:0:-1].tolist():
            np.multiply(twice, one, out=work)
            np.subtract(work, two, out=two)
            two += coefficient
            one, two = two, one
        out[start : start + SERIES_POINTS] = part * one - two + series[0]
    return out
