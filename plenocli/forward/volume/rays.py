"""Kernels of one plane of a volume by rays: where the pupil's parts lie, without diffraction."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from plenocli.forward.volume.optics import VolumeOptics

SLOPE_STEP = 1e-4
"""Of the pupil's radius, by which the slope of a path is told."""


class Landing(NamedTuple):
    """Of rays, along one axis: the lenslet that each meets, counted from the one that places are
    told from; the pixel, counted from that one's first; whether the lenslet's open width takes it,
    and whether the pixel senses it.
    """

    lenslet: np.ndarray
    pixel: np.ndarray
    entered: np.ndarray
    kept: np.ndarray


class RayPlane:
    """Columns of points at one depth, by a grid of rays over the pupil.

    weight: (ray,) share of a point's light.
    away: of both axes, (ray,) m from a point's image to where its rays meet the lenslets, on the
        object's side.
    """

    def __init__(self, optics: VolumeOptics, depth: float, reach: int, rays: int) -> None:
        """reach: superpixels on each side of a point's own; rays: across a pixel."""
        self.optics, self.reach = optics, reach
        across = rays * max(optics.pixels) + 1
        side = (np.arange(across) + 0.5) / across * 2 - 1
        y, x = np.meshgrid(side, side, indexing="ij")
        inside = np.hypot(y, x) <= 1
        y, x = y[inside], x[inside]
        self._sines = (y * optics.aperture, x * optics.aperture)
        weight = optics.amplitude(np.hypot(y, x) * optics.aperture) ** 2
        self.weight = weight / weight.sum()
        self.away = tuple(-_slope(optics, depth, y, x, axis) for axis in (0, 1))

    def landed(self, place: np.ndarray | float, axis: int) -> Landing:
        """Where rays from places along an axis (row or column) come down.

        place: m from the middle of a lenslet's own on the object's side, (..., 1) or a number.
        """
        o = self.optics
        on_array = (place + self.away[axis]) * o.magnification
        lenslet = np.rint(on_array / o.pitch)
        inside = on_array - lenslet * o.pitch
        bend = 1 / o.sensor_distance + 1 / o.pupil_distance - 1 / o.focal_length
        on_sensor = o.sensor_distance * (self._sines[axis] / o.magnification + inside * bend)
        size = o.pitch * o.widening / o.pixels[axis]
        pixel = lenslet * o.pixels[axis] + on_sensor / size + (o.pixels[axis] - 1) / 2
        nearest = np.rint(pixel)
        entered = np.abs(inside) <= o.open_width / 2
        kept = entered & (np.abs(pixel - nearest) <= o.pixel_width / 2)
        return Landing(lenslet, nearest.astype(int), entered, kept)

    def column(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """As WavePlane.column."""
        o, half = self.optics, 2 * self.reach + 1
        kept, index = np.ones(len(self.weight), bool), []
        entered = kept.copy()
        for axis, place in enumerate((y, x)):
            landing = self.landed(place, axis)
            entered &= landing.entered & (np.abs(landing.lenslet) <= self.reach)
            place_of = landing.pixel + self.reach * o.pixels[axis]
            kept &= landing.kept & (place_of >= 0) & (place_of < half * o.pixels[axis])
            index.append(place_of)
        kept &= entered
        shape = (half * o.pixels[0], half * o.pixels[1])
        flat = index[0][kept] * shape[1] + index[1][kept]
        light = np.bincount(flat, self.weight[kept], shape[0] * shape[1]).astype(np.float32)
        whole = light.reshape(half, o.pixels[0], half, o.pixels[1])
        return whole, float(self.weight[entered].sum())


def _slope(
    optics: VolumeOptics, depth: float, y: np.ndarray, x: np.ndarray, axis: int
) -> np.ndarray:
    """Slope (m) of the path over the pupil, along an axis of directions: light moves against it.

    y, x: over the pupil's radius, inside it.
    """
    from plenocli.forward.camera.pupil import zernike

    def path(y: np.ndarray, x: np.ndarray) -> np.ndarray:
        found = optics.path(np.hypot(y, x) * optics.aperture, depth)
        for term in optics.terms:
            found = found + term.coefficient * zernike(term.noll, y, x)
        return found

    step = np.array([SLOPE_STEP, 0.0] if axis == 0 else [0.0, SLOPE_STEP])
    # towards the middle at the edge, where directions end
    sign = -np.sign(y if axis == 0 else x)
    ahead = path(y + sign * step[0], x + sign * step[1])
    rise = (ahead - path(y, x)) * sign / SLOPE_STEP
    return rise / optics.aperture
