"""Sensor fields behind round and hexagonal lenslets on the axis by the exact scalar kernel."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.exact.debye import radial_waves
from plenocli.forward.propagation.exact.open_fields import too_near
from plenocli.forward.propagation.fresnel.paraxial_error import paraxial_error
from plenocli.forward.propagation.fresnel.radial import is_radial
from plenocli.forward.propagation.harmonics.bessel import bessel_orders
from plenocli.forward.propagation.harmonics.corners import Corners
from plenocli.forward.propagation.harmonics.pixels import pixel_operator
from plenocli.forward.propagation.harmonics.waves import TOGETHER, cone_waves, light_within
from plenocli.forward.propagation.lenslet_fields import (
    FieldNotes,
    LensletFields,
    PixelEnergies,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.harmonics.sizing import HarmonicBand
    from plenocli.forward.propagation.plan import PifPlan


def valid_for(camera: Camera, geometry: Geometry) -> str | None:
    """As Model.valid_for: lenslets behind a pupil that is the same in all directions."""
    array = camera.lenslet_array
    if array.aperture_shape == "square":
        return "square lenslets are not round or hexagonal"
    if not is_radial(camera):
        return (
            "the pupil is not the same in all directions, as harmonics need it; "
            f"the paraxial model is off by about {paraxial_error(geometry, False):.2g}"
        )
    if geometry.chief != (0.0, 0.0):
        return "a lenslet off the axis sees an oblique cone, which this rung does not follow"
    return too_near(geometry)


class CentredLenslets(LensletFields):
    """Sensor fields behind lenslets on the axis by the exact kernel; see harmonics.waves, and
    harmonics.corners for hexagons.
    """

    symmetry = True, True, True

    def __init__(
        self, camera: Camera, geometry: Geometry, plan: PifPlan, band: HarmonicBand
    ) -> None:
        self.geometry, self.superpixels, self.band = geometry, plan.superpixels, band
        self._real = np.dtype(np.float64 if plan.double else np.float32)
        y, x = (geometry.points(axis) for axis in (0, 1))
        self._radius, self._angle = np.hypot(y[:, None], x), np.arctan2(y[:, None], x)
        self._sines, self._weights = radial_waves(camera, geometry, band.half)
        parabolic = camera.lenslet_array.profile == "parabolic"
        self._cones = cone_waves(geometry, band, parabolic, self._sines, self._real)
        self._corners = (
            Corners(geometry, band, parabolic, (self._sines, self._weights), self._real)
            if band.corner_orders
            else None
        )
        self._pixels = pixel_operator(geometry, band, self._real)
        self.notes = FieldNotes(separable_terms=0, field_tail=0.0)

    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """As LensletFields.incident."""
        radii, which = np.unique(np.round(self._radius[rows, columns], 15), return_inverse=True)
        light = light_within(self.geometry, self.band, self._sines, self._weights, radii)
        return light[which]

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """As LensletFields.on_superpixel."""
        return self._energies

    def _energies(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        each = self._behind_circles if self._corners is None else self._behind_hexagons
        each(rows, columns, out)

    def _behind_hexagons(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        assert self._corners is not None
        band, kind = self.band, np.result_type(self._real, np.complex64)
        order = np.argsort(self._radius[rows, columns])
        m = np.arange(band.orders)
        for start in range(0, len(order), TOGETHER):
            some = order[start : start + TOGETHER]
            r, phi = self._radius[rows[some], columns[some]], self._angle[rows[some], columns[some]]
            inner, outer = self._harmonics(r), self._corners.harmonics(r, phi)
            for number, point in enumerate(some):
                turn = np.exp(-1j * phi[number] * m).astype(kind)
                own = inner[number, 0] + 1j * inner[number, 1]
                above, below = outer[number]
                above[:, : band.orders] += own * turn
                below[:, : band.orders] += own * turn.conj()
                waves = np.zeros((band.radii, band.angles), kind)
                waves[:, : band.corner_orders] = above
                waves[:, 1 - band.corner_orders :] = below[:, :0:-1]
                out[point] = (self._pixels @ self._power(waves)).reshape(out.shape[1:])

    def _power(self, waves: np.ndarray) -> np.ndarray:
        """|U|^2 (radius x angle,) from U_m as Fourier transforms count them."""
        from scipy.fft import ifft

        field = ifft(waves, axis=1, norm="forward", overwrite_x=True)
        return np.square(field.real).ravel() + np.square(field.imag).ravel()

    def _behind_circles(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        radii, which = np.unique(np.round(self._radius[rows, columns], 15), return_inverse=True)
        for start in range(0, len(radii), TOGETHER):
            some = radii[start : start + TOGETHER]
            harmonics = self._harmonics(some)
            for number in range(len(some)):
                for point in np.flatnonzero(which == start + number):
                    angle = self._angle[rows[point], columns[point]]
                    power = self._even_power(harmonics[number], angle)
                    out[point] = (self._pixels @ power).reshape(out.shape[1:])

    def _harmonics(self, radii: np.ndarray) -> np.ndarray:
        """U_m of points at these radii: (point, real then imaginary part, radius, order)."""
        outward = bessel_orders(self.band.orders, self.geometry.k * np.outer(self._sines, radii))
        # (order, part, radius, point)
        found = self._times(outward * self._weights.real[:, None])
        if self._weights.imag.any():
            turned = self._times(outward * self._weights.imag[:, None])
            found[:, 0] -= turned[:, 1]
            found[:, 1] += turned[:, 0]
        return np.ascontiguousarray(found.transpose(3, 1, 2, 0))

    def _times(self, waves: np.ndarray) -> np.ndarray:
        waves = waves.astype(self._real)
        orders, parts, radii, cones = self._cones.shape
        found = self._cones.reshape(orders, parts * radii, cones) @ waves
        return found.reshape(orders, parts, radii, -1)

    def _even_power(self, harmonics: np.ndarray, angle: float) -> np.ndarray:
        """|U|^2 (radius x angle,) of a point from its harmonics (part, radius, order)."""
        from scipy.fft import irfft

        turn = np.exp(-1j * angle * np.arange(self.band.orders))
        turn = (self.band.angles * turn).astype(np.result_type(self._real, np.complex64))
        field = irfft(harmonics * turn, self.band.angles, axis=2)
        np.square(field, out=field)
        return (field[0] + field[1]).ravel()
