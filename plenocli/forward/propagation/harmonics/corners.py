"""What a hexagonal lenslet has beyond its inscribed circle: of a circle of radius q = a/cos t it
keeps the directions farther than t from the middles of its six sides, whose harmonics c_6l couple
those of the main lens's field,

    E_m(q) = sum over l of c_6l h_(m - 6l) e^(-j(m - 6l) phi).

docs/model.md, "Exact propagation".
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.camera.quadrature import gauss
from plenocli.forward.propagation.harmonics.bessel import bessel_orders
from plenocli.forward.propagation.harmonics.waves import kernel_harmonics, sensor_radii

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.propagation.harmonics.sizing import HarmonicBand

SIDES = 6
"""Sides of a hexagon; nothing here counts on there being six."""


class Corners:
    """The corners of one lenslet."""

    def __init__(
        self,
        geometry: Geometry,
        band: HarmonicBand,
        parabolic: bool,
        cones: tuple[np.ndarray, np.ndarray],
        real: np.dtype,
    ) -> None:
        """`cones`: direction sines and weights of debye.radial_waves; `real`: precision."""
        self.geometry, self.band, self._cones, self._real = geometry, band, cones, real
        self._complex = np.result_type(real, np.complex64)
        inner, widest = geometry.lenslet_width / 2, math.pi / SIDES
        t, w = gauss(band.corner_nodes)
        t = widest / 2 * (t + 1)
        self._q = inner / np.cos(t)
        weight = widest / 2 * w * inner * np.sin(t) / np.cos(t) ** 2 * self._q
        self._inward = bessel_orders(band.orders, geometry.k * np.outer(self._q, cones[0]))
        self._classes = _classes(t, band)
        kernel = kernel_harmonics(
            geometry, band, parabolic, sensor_radii(band), self._q, weight, real, band.corner_orders
        )
        # (order, radius, node)
        self._kernel = (kernel[:, 0] + 1j * kernel[:, 1]).astype(self._complex)

    def harmonics(self, r: np.ndarray, phi: np.ndarray) -> np.ndarray:
        """What the corners add to U_m of points.

        r, phi: (point,) distance (m) and angle from the lenslet's axis.

        Returns (point, turn, radius, order): orders 0 ... corner_orders - 1, and as many below 0.
        """
        orders, most = self.band.orders, self.band.corner_orders
        field = self._field(r)
        n = np.arange(1 - orders, orders)
        turned = field[np.abs(n)] * np.exp(-1j * n[:, None] * phi)[:, None]
        turned = turned.astype(self._complex)
        # (node, order from 1 - most, point)
        coupled = np.empty((len(self._q), 2 * most - 1, len(r)), self._complex)
        for some_m, some_n, share in self._classes:
            part = np.ascontiguousarray(turned[some_n].transpose(1, 0, 2))
            real = share.astype(self._real) @ part.view(self._real)
            coupled[:, some_m] = real.view(self._complex)
        out = np.empty((len(r), 2, self._kernel.shape[1], most), self._complex)
        for number, part in enumerate((coupled[:, most - 1 :], coupled[:, most - 1 :: -1])):
            found = self._kernel @ np.ascontiguousarray(part.transpose(1, 0, 2))
            out[:, number] = found.transpose(2, 1, 0)
        return out

    def _field(self, r: np.ndarray) -> np.ndarray:
        """h_n at the nodes: (order, node, point)."""
        sines, weights = self._cones
        outward = bessel_orders(self.band.orders, self.geometry.k * np.outer(sines, r))
        field = self._inward @ (outward * weights.real[:, None])
        if not weights.imag.any():
            return field
        return field + 1j * (self._inward @ (outward * weights.imag[:, None]))


def _classes(t: np.ndarray, band: HarmonicBand) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Orders that the sides couple: those of the same rest by their number.

    t: (node,) half angles that the sides take.

    Returns [(places of m among 1 - corner_orders ..., places of n among 1 - orders ..., share
    (node, m, n) of n in m)].
    """
    m, n = (
        np.arange(1 - band.corner_orders, band.corner_orders),
        np.arange(1 - band.orders, band.orders),
    )
    most = (band.corner_orders + band.orders) // SIDES + 1
    order = np.arange(-most, most + 1)
    shares = -np.sin(SIDES * t[:, None] * order) / (np.pi * np.where(order, order, 1))
    shares[:, most] = 1 - SIDES * t / np.pi
    found = []
    for rest in range(SIDES):
        some_m, some_n = np.flatnonzero(m % SIDES == rest), np.flatnonzero(n % SIDES == rest)
        apart = (m[some_m, None] - n[some_n]) // SIDES
        found.append((some_m, some_n, shares[:, apart + most]))
    return found
