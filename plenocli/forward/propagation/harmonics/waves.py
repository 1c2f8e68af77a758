"""What a lenslet makes of one cone of the main lens's waves, by harmonics: with points at (r, phi)
and the sensor's places (rho, theta) about the lenslet's axis,

    U(rho, theta) = sum over m of e^(jm(theta - phi)) sum over s of G_m(rho, s) w J_m(k s r),
    G_m(rho, s) = integral from 0 to the rim of K_m(rho, q) T(q) J_m(k s q) q dq,

K_m the harmonics of Rayleigh and Sommerfeld's kernel and T the lenslet with the curvature of h.
docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.harmonics.bessel import bessel_orders

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.propagation.harmonics.sizing import HarmonicBand

SLAB_VALUES = 1 << 19
"""Values of the kernel in a slab of radii."""


TOGETHER = 24
"""Radii of points that are gone through together."""


def sensor_radii(band: HarmonicBand) -> np.ndarray:
    """Radii (radius,) of the sensor's polar raster, m."""
    return (np.arange(band.radii) + 0.5) * band.step


def kernel_harmonics(
    geometry: Geometry,
    band: HarmonicBand,
    parabolic: bool,
    radii: np.ndarray,
    places: np.ndarray,
    weights: np.ndarray,
    real: np.dtype,
    orders: int,
) -> np.ndarray:
    """K_m T times a weight, from places on the lenslet to radii on the sensor.

    radii: (radius,) m;
    places, weights: (node,) m from the lenslet's centre, and what T is multiplied with;
    real: precision of the result; phases are reduced in double;
    orders: m = 0 ... orders - 1.

    Returns (orders, real then imaginary part, radius, node).
    """
    g, count = geometry, band.half_turn
    half = np.pi * (np.arange(count // 2) + 0.5) / count
    m = np.arange(orders)
    even, odd = (
        (2 * np.pi / count * np.cos(m[start::2, None] * half)).astype(real) for start in (0, 1)
    )
    # -t is pi - t turned by half: of orders one sign, of the others the other
    here, there = (
        _waves(g, parabolic, sign * np.cos(half), radii, places, weights, real) for sign in (1, -1)
    )
    out = np.empty((orders, 2, len(radii), len(places)), real)
    flat = out.reshape(orders, -1)
    flat[0::2] = even @ (here + there).reshape(len(half), -1)
    flat[1::2] = odd @ (here - there).reshape(len(half), -1)
    return out


def _waves(
    g: Geometry,
    parabolic: bool,
    cosines: np.ndarray,
    radii: np.ndarray,
    places: np.ndarray,
    weights: np.ndarray,
    real: np.dtype,
) -> np.ndarray:
    """The kernel and the lenslet's phase: (angle, real then imaginary part, radius, node)."""
    apart = radii[:, None] ** 2 + places**2 - 2 * cosines[:, None, None] * np.outer(radii, places)
    side = np.sqrt(g.z3**2 + apart)
    q2 = places**2
    bend = q2 / (2 * g.f2) if parabolic else q2 / (g.f2 + np.sqrt(g.f2**2 + q2))
    turns = (apart / (side + g.z3) + (q2 / (2 * g.z2) - bend)) / g.wavelength
    turns -= np.rint(turns)
    phase = (2 * np.pi * turns).astype(real)
    near = (1 / (g.k * side)).astype(real)
    size = (g.z3 / g.wavelength * weights / side**2).astype(real)
    cosine, sine = np.cos(phase), np.sin(phase)
    out = np.empty((len(cosines), 2, len(radii), len(places)), real)
    # (1 + j near)(cos + j sin)/j
    out[:, 0] = size * (sine + near * cosine)
    out[:, 1] = size * (near * sine - cosine)
    return out


def cone_waves(
    geometry: Geometry, band: HarmonicBand, parabolic: bool, sines: np.ndarray, real: np.dtype
) -> np.ndarray:
    """G_m of the cones: (orders, real then imaginary part, radius, cone)."""
    t, w = gauss(band.lenslet_nodes)
    half = geometry.lenslet_width / 4
    q = half * (t + 1)
    inward = bessel_orders(band.orders, geometry.k * np.outer(q, sines), real)
    radii = sensor_radii(band)
    out = np.empty((band.orders, 2, len(radii), len(sines)), real)
    step = max(1, SLAB_VALUES // (band.half_turn * len(q)))
    for start in range(0, len(radii), step):
        some = slice(start, start + step)
        kernel = kernel_harmonics(
            geometry, band, parabolic, radii[some], q, half * w * q, real, band.orders
        )
        out[:, :, some] = kernel @ inward[:, None]
    return out


def light_within(
    geometry: Geometry, band: HarmonicBand, sines: np.ndarray, weights: np.ndarray, r: np.ndarray
) -> np.ndarray:
    """Share of the light of points that enters the circle about the opening.

    r: (point,) distances of their images from the lenslet's centre, m.

    Returns (point,).
    """
    t, w = gauss(band.lenslet_nodes)
    half = max(geometry.lenslet_extent) / 2
    q = half * (t + 1)
    inward = bessel_orders(band.orders, geometry.k * np.outer(q, sines))
    inward *= np.sqrt(2 * math.pi * half * w * q)[:, None]
    inward[1:] *= math.sqrt(2)  # of m and -m
    light = np.zeros(len(r))
    for start in range(0, len(r), TOGETHER):
        some = slice(start, start + TOGETHER)
        outward = bessel_orders(band.orders, geometry.k * np.outer(sines, r[some]))
        for part in (weights.real, weights.imag):
            if part.any():
                field = inward @ (outward * part[:, None])
                light[some] += np.square(field, out=field).sum(axis=(0, 1))
    return light
