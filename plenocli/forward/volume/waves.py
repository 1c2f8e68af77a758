"""Kernels of one plane of a volume by wave optics: where the light of its voxels lands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from plenocli.forward.volume.arriving import ArrivingField
from plenocli.forward.volume.lenslets import sampling, to_pixels
from plenocli.forward.volume.optics import VolumeOptics

TIPS = 0.15
"""Pitches by which the tips of a hexagon stand out of its row."""


@dataclass(frozen=True, kw_only=True)
class WaveSettings:
    """How finely light is followed.

    neighbours: lenslets on each side whose fields interfere behind one.
    pixel_nodes: across a pixel.
    terms: of a lenslet's field, along an axis.
    reach: superpixels on each side of a point's own.
    """

    neighbours: int
    pixel_nodes: int
    terms: int
    reach: int


class WavePlane:
    """Columns of points at one depth."""

    def __init__(self, optics: VolumeOptics, depth: float, settings: WaveSettings) -> None:
        self.optics, self.settings = optics, settings
        self._half = settings.reach * 2 + 1
        far = (settings.reach + 1) * optics.object_pitch * math.sqrt(2)
        self._field = ArrivingField(optics, depth, far)
        inner, onto, self._basis = sampling(optics, settings.terms)
        middles = np.arange(-settings.reach, settings.reach + 1) * optics.pitch
        self._nodes = (middles[:, None] + inner).ravel()
        self._onto = onto.astype(np.complex64)

    @cached_property
    def _pixels(self) -> tuple[np.ndarray, ...]:
        """Of both axes: modes to nodes of pixels, with the root of the nodes' weights."""
        s, found = self.settings, []
        for axis in (0, 1):
            map_ = to_pixels(self.optics, self._basis, axis, s.neighbours, s.pixel_nodes)
            weights = self.optics.pixel_nodes(s.pixel_nodes, axis)[1]
            roots = np.tile(np.sqrt(weights), self.optics.pixels[axis])
            found.append((roots[:, None] * map_).astype(np.complex64))
        return tuple(found)

    def column(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """Light of the point at (y, x), m from the middle lenslet's own on the object's side.

        Returns the share of its light on every pixel (superpixel row, pixel row, superpixel column,
        pixel column), zero beyond `near`, and the share that enters the lenslets there.
        """
        modes, entered = self._modes(y, x)
        o, s, step = self.optics, self.settings, self._basis.shape[1]
        window, nodes = (2 * s.neighbours + 1) * step, len(self._pixels[0])
        # a point on the diagonal: what is above it is what is below, transposed
        twin = y == x and o.round and o.pixels[0] == o.pixels[1]
        wanted = near(s.reach, o) & (np.tri(self._half, dtype=bool) if twin else True)
        low, high = _ends(wanted.T)
        behind = np.empty((self._half * nodes, modes.shape[1]), np.complex64)
        for q in range(self._half):
            part = slice(low[q] * step, high[q] * step + window - step if high[q] else 0)
            rows = modes[q * step : q * step + window, part]
            np.matmul(self._pixels[0], rows, out=behind[q * nodes : (q + 1) * nodes, part])
        low, high = _ends(wanted)
        ones = np.repeat(np.eye(o.pixels[1], dtype=np.float32), 2 * s.pixel_nodes, axis=0)
        to = np.ascontiguousarray(self._pixels[1].T)
        out = np.zeros((self._half, o.pixels[0], self._half, o.pixels[1]), np.float32)
        for p in range(self._half):
            rows = behind[low[p] * nodes : high[p] * nodes, p * step : p * step + window]
            parts = (rows @ to).view(np.float32)
            light = np.square(parts, out=parts) @ ones
            light = light.reshape(-1, o.pixels[0], s.pixel_nodes, o.pixels[1]).sum(2)
            out[low[p] : high[p], :, p] = light
            if twin:
                out[p, :, p + 1 :] = out[p + 1 :, :, p].transpose(2, 0, 1)
        return out, entered

    def _modes(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """Modes of all lenslets, none beyond those of the reach: (lenslet row * mode, lenslet
        column * mode), and the share of light in them.
        """
        o, s, n = self.optics, self.settings, self._half
        field = self._field.at(self._nodes / o.magnification - y, self._nodes / o.magnification - x)
        step, count = self._onto.shape
        field = field.astype(np.complex64).reshape(n, count, n * count)
        half = np.matmul(self._onto, field).reshape(n * step * n, count)
        both = (half @ self._onto.T / np.float32(o.magnification)).reshape(n * step, n * step)
        light = (np.abs(both.reshape(n, step, n, step)) ** 2).sum((1, 3))
        entered = float(light[near(s.reach, o)].sum(dtype=float))
        return np.pad(both, s.neighbours * step), entered


def near(reach: int, optics: VolumeOptics) -> np.ndarray:
    """(row, column) of the superpixels, or cells, about one: where light lands no farther than
    `reach` pitches from a point that is somewhere before it.
    """
    many = len(optics.sites)
    high = many * optics.row_spacing
    # lenslets of a cell stand out of it by half of its shift
    out = (0.0, 0.0) if many == 1 else (TIPS, 0.25)
    far = math.ceil((reach + out[0]) / high), reach + math.ceil(out[1])
    apart = [
        np.maximum(np.abs(np.arange(-n, n + 1)) * size - size - beside, 0)
        for n, size, beside in zip(far, (high, 1.0), out)
    ]
    return np.hypot(apart[0][:, None], apart[1]) < max(reach, 1)


def _ends(wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First row that is wanted of every column, and the one after the last: 0 where none is."""
    return wanted.argmax(0), (len(wanted) - wanted[::-1].argmax(0)) * wanted.any(0)
