"""Kernels of one plane of a volume by wave optics: where the light of its voxels lands."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.lib.stride_tricks import as_strided

from plenocli.forward.volume.arriving import ArrivingField
from plenocli.forward.volume.lenslets import sampling, to_pixels
from plenocli.forward.volume.optics import VolumeOptics


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
        inner, self._onto = sampling(optics, settings.terms)
        middles = np.arange(-settings.reach, settings.reach + 1) * optics.pitch
        self._nodes = (middles[:, None] + inner).ravel()
        self._onto = self._onto.astype(np.complex64)

    @cached_property
    def _pixels(self) -> tuple[np.ndarray, ...]:
        """Of both axes: terms to nodes of pixels, with the root of the nodes' weights."""
        s, found = self.settings, []
        for axis in (0, 1):
            map_ = to_pixels(self.optics, s.terms, axis, s.neighbours, s.pixel_nodes)
            weights = self.optics.pixel_nodes(s.pixel_nodes, axis)[1]
            roots = np.tile(np.sqrt(weights), self.optics.pixels[axis])
            found.append((roots[:, None] * map_).astype(np.complex64))
        return tuple(found)

    def column(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """Light of the point at (y, x), m from the middle lenslet's own on the object's side.

        Returns the share of its light on every pixel (superpixel row, pixel row, superpixel column,
        pixel column) and the share that enters the lenslets there.
        """
        terms, entered = self._terms(y, x)
        s, rows, columns = self.settings, *self.optics.pixels
        window, step = (2 * s.neighbours + 1) * s.terms, s.terms
        behind_rows = np.matmul(self._pixels[0], _windows(terms, window, step, self._half))
        lines = np.ascontiguousarray(behind_rows.reshape(-1, terms.shape[1]))
        ones = np.repeat(np.eye(columns, dtype=np.float32), 2 * s.pixel_nodes, axis=0)
        to = np.ascontiguousarray(self._pixels[1].T)
        out = np.empty((self._half, rows, self._half, columns), np.float32)
        for p in range(self._half):
            field = lines[:, p * step : p * step + window] @ to
            parts = field.view(np.float32)
            light = np.square(parts, out=parts) @ ones
            out[:, :, p] = light.reshape(self._half, rows, s.pixel_nodes, columns).sum(2)
        return out, entered

    def _terms(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """Legendre terms of all lenslets, none beyond those of the reach: (lenslet row * term,
        lenslet column * term), and the share of light in them.
        """
        o, s, n = self.optics, self.settings, self._half
        field = self._field.at(self._nodes / o.magnification - y, self._nodes / o.magnification - x)
        field = field.astype(np.complex64).reshape(n, -1, n, self._onto.shape[1])
        half = np.matmul(self._onto, field.reshape(n, self._onto.shape[1], -1))
        half = half.reshape(n * s.terms, n, -1).transpose(1, 2, 0)
        both = np.matmul(self._onto, half).transpose(2, 0, 1) / np.float32(o.magnification)
        squares = (o.open_width / (2 * np.arange(s.terms) + 1)) ** 1.0
        light = (np.abs(both.reshape(n, s.terms, n, s.terms)) ** 2).sum((0, 2))
        entered = float(squares @ light @ squares)
        margin = s.neighbours * s.terms
        return np.pad(both.reshape(n * s.terms, -1), margin), entered


def _windows(terms: np.ndarray, window: int, step: int, count: int) -> np.ndarray:
    """(count, window, column) views of rows that start every `step`."""
    row, column = terms.strides
    return as_strided(
        terms, (count, window, terms.shape[1]), (step * row, row, column), writeable=False
    )
