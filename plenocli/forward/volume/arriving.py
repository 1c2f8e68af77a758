"""The field of a point that arrives at the lenslet array."""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import CubicSpline

from plenocli.forward.volume.optics import VolumeOptics

SLAB = 1 << 21
"""Bessel functions computed at once."""
SPLINE_STEP = 0.12
"""Of the spline that the table is taken from, times the largest wave number: error 4e-7."""


class ArrivingField:
    """Field of a point at one depth around its image, by Hankel transforms of the pupil's angular
    harmonics on a radial table.

    E(r) = (1/lambda) * integral of P(s) exp(i k s.r) d2s; |E|^2 integrates to the light through
    the pupil, which is 1. Linear between the table's values, which are as fine as `error` needs.
    Born and Wolf, section 8.8 (Debye's integral); docs/model.md, "Volumes".
    """

    def __init__(
        self, optics: VolumeOptics, depth: float, reach: float, error: float = 1e-5
    ) -> None:
        """depth: of the point, m; reach: largest distance from its image, m (on the object's
        side); error: of values between the table's, relative to the field's typical size.
        """
        self.reach = reach
        s, ds = optics.nodes(reach)
        bend = optics.k * optics.aperture
        step = math.sqrt(8 * error) / bend
        self._count = int(reach / step) + 3
        self._per_metre = (self._count - 2) / reach
        r = np.arange(self._count) / self._per_metre
        coarse = np.linspace(0, r[-1], int(r[-1] * bend / SPLINE_STEP) + 8)
        scale = 2 * np.pi / optics.wavelength / math.sqrt(optics.norm(s, ds))
        self._tables = {}
        for m, wave in optics.pupil(s, depth).items():
            knots = _hankel(m, optics.k * s, coarse, scale * 1j**m * wave * s * ds)
            self._tables[m] = CubicSpline(coarse, knots)(r).astype(np.complex64)

    def at(self, y: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Field at distances (m) y (row,) and x (column,) from the image: (row, column) complex."""
        square = (y**2)[:, None] + x**2
        place = np.sqrt(square, out=square)
        place *= self._per_metre
        index = np.minimum(place.astype(np.int32), self._count - 2)
        part = place - index
        found: np.ndarray | None = None
        for m, table in self._tables.items():
            value = table[index] + part * np.diff(table)[index]
            if m:
                with np.errstate(invalid="ignore", divide="ignore"):
                    turn = (x + 1j * y[:, None]) * (self._per_metre / place)
                value *= np.where(place > 0, turn, 1) ** m
            found = value if found is None else found + value
        assert found is not None
        return found

    def kept(self, distance: float) -> float:
        """Share of the light within `distance` m of the image, no more than `reach`."""
        r = np.arange(self._count) / self._per_metre
        inside = r <= distance
        power = sum(np.abs(table) ** 2 for table in self._tables.values())
        return float(np.trapezoid((power * 2 * np.pi * r)[inside], r[inside]))


def _hankel(order: int, k: np.ndarray, r: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """sum_i weight_i J_order(k_i r), (r,)."""
    from scipy.special import j0, jv

    out = np.empty(len(r), complex)
    rows = max(1, SLAB // len(k))
    for start in range(0, len(r), rows):
        part = slice(start, start + rows)
        z = r[part, None] * k
        # the product with a real matrix, apart, spares half of the work
        bessel = j0(z) if order == 0 else jv(order, z)
        out[part] = bessel @ weight.real + 1j * (bessel @ weight.imag)
    return out
