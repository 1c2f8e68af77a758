"""Kernels of one plane of a volume behind lenslets of any shape on a square or hexagonal lattice.

The array is a grating: what it lets through is a Fourier series over its lattice, of which those
orders are followed that a grid of places carries. From there to the pixels light goes by Fresnel's
transfer function, and a pixel's share is its light's spectrum times that of its own area.
docs/model.md, "Volumes".
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from plenocli.base.linear_maps import torus_for
from plenocli.forward.camera.quadrature import gauss, nodes_for, opening_chords
from plenocli.forward.camera.sections.lenslet_array import ROW_SPACING
from plenocli.forward.volume.arriving import ArrivingField
from plenocli.forward.volume.optics import VolumeOptics
from plenocli.forward.volume.waves import near

BEYOND = 4
"""Cells beyond those kept, so that what goes round the torus misses them."""
ARRIVING = 1.3
"""Samples of the field that arrives, over the fewest that carry it."""


class Grating:
    """The lenslets of a cell, on a grid of places.

    across: places across a pixel.
    cell: height and width, m on the array.
    places: (rows, columns) in a cell.
    """

    def __init__(self, optics: VolumeOptics, across: int) -> None:
        self.optics, self.across = optics, across
        height, width = optics.object_cell
        self.cell = height * optics.magnification, width * optics.magnification
        self.places = optics.cell_pixels[0] * across, optics.cell_pixels[1] * across

    @property
    def area(self) -> float:
        """Of a place, m^2."""
        return math.prod(self.cell) / math.prod(self.places)

    def orders(self, axis: int) -> np.ndarray:
        """(order,) wave numbers of the series along an axis, 1/m, as fft has them."""
        return 2 * np.pi * np.fft.fftfreq(self.places[axis], self.cell[axis] / self.places[axis])

    @cached_property
    def through(self) -> tuple[np.ndarray, np.ndarray]:
        """Fourier series of what the lenslets do to a field, and of where they are open: (row
        order, column order), about the first place.
        """
        o = self.optics
        down, right = self.orders(0), self.orders(1)
        slope = float(max(np.abs(down).max(), np.abs(right).max()))
        slope += o.k * o.open_width / o.focal_length
        half = o.open_width / 2
        tip = half / ROW_SPACING if o.opening == "hexagon" else half
        # along the rim of a circle both axes turn
        along = nodes_for(slope * (tip / 2 if o.opening == "hexagon" else half))
        rows, weights, ends = opening_chords(o.opening, along, along + 4)
        rows, weights, ends = tip * rows, tip * weights, half * ends
        t, w = gauss(nodes_for(slope * ends.max()))
        columns = ends[:, None] * t
        to_rows = np.exp(-1j * down[:, None] * rows) * weights
        to_columns = np.exp(-1j * columns[..., None] * right) * (ends[:, None] * w)[..., None]
        # lenslets of the cell, and from its middle to the middle of its first place
        moved = sum(
            np.multiply.outer(np.exp(-1j * down * y * o.pitch), np.exp(-1j * right * x * o.pitch))
            for y, x in o.sites
        )
        for axis, turns in ((0, down[:, None]), (1, right)):
            first = (0.5 / self.places[axis] - 0.5) * self.cell[axis]
            moved = moved * np.exp(1j * turns * first)
            # of an even number of orders the last has no twin on the other side
            moved = moved * (np.abs(turns) < np.abs(turns).max() * (1 + self.places[axis] % 2))
        found = []
        for bend in (0.5 * o.k / o.focal_length, 0.0):
            lens = np.exp(-1j * bend * (rows[:, None] ** 2 + columns**2))
            chords = np.einsum("cn,cnk->ck", lens, to_columns)
            found.append(to_rows @ chords * moved / math.prod(self.cell))
        return found[0], found[1]

    def propagation(self, k: np.ndarray) -> np.ndarray:
        """Fresnel's transfer function to the pixels for wave numbers along an axis, 1/m.

        Chief rays that spread widen the picture: it is that of a sensor nearer by 1 + d/z2.
        """
        o = self.optics
        return np.exp(-0.5j * o.sensor_distance / o.widening / o.k * k**2).astype(np.complex64)

    def on_pixels(self, light: np.ndarray) -> np.ndarray:
        """Mean over every pixel of the light at the places of whole cells, (row, column): (cell
        row, pixel row, cell column, pixel column).
        """
        o = self.optics
        rows = self._sampled(light.T, 0.0).T
        rows = rows.reshape(len(light) // self.places[0], o.cell_pixels[0], -1)
        # superpixels of a hexagonal lattice are half a pitch aside in every other row
        parts = np.split(rows, len(o.sites), axis=1)
        whole = [self._sampled(part, x) for part, (_, x) in zip(parts, o.sites)]
        return np.concatenate(whole, axis=1).reshape(*rows.shape[:2], -1, o.pixels[1])

    def _sampled(self, light: np.ndarray, shift: float) -> np.ndarray:
        """Means over pixels along the last axis, moved on by `shift` pitches: the light's spectrum
        times that of a pixel.
        """
        from scipy.fft import irfft, rfft

        many, turns = light.shape[-1], np.fft.rfftfreq(light.shape[-1])
        # a pixel's middle is between its places
        move = (self.across - 1) / 2 + shift * self.places[1]
        width = self.optics.pixel_width
        factor = width * np.sinc(turns * self.across * width) * np.exp(2j * np.pi * turns * move)
        spectrum = rfft(light, axis=-1) * factor.astype(np.complex64)
        return irfft(spectrum, many, axis=-1)[..., :: self.across]


class ShapedPlane:
    """Columns of points at one depth, as WavePlane's; superpixels are cells here: one lenslet's
    pixels of a square lattice, two lenslets', one below the other, of a hexagonal one.
    """

    def __init__(self, optics: VolumeOptics, depth: float, reach: int, across: int) -> None:
        """reach: superpixels on each side of a point's own; across: places across a pixel."""
        self.optics, self._depth, self._array = optics, depth, Grating(optics, across)
        self._kept = near(reach, optics)
        self._cells = torus_for(self._kept.shape, (BEYOND, BEYOND))

    @property
    def places(self) -> int:
        """On the torus."""
        return math.prod(self._cells) * math.prod(self._array.places)

    def column(self, y: float, x: float) -> tuple[np.ndarray, float]:
        """Light of the point at (y, x), m from the middle of a cell's own on the object's side.

        Returns the share of its light on every pixel (cell row, pixel row, cell column, pixel
        column), zero beyond `near`, and the share that enters the lenslets there.
        """
        from scipy.fft import fft2, ifft2

        array, (through, open_) = self._array, self._at_places
        field = self._arriving(y, x)
        cells = field.reshape(self._cells[0], array.places[0], self._cells[1], array.places[1])
        light = np.einsum("iajb,ab->ij", cells.real**2 + cells.imag**2, open_)
        entered = float(self._inner(light)[self._kept].sum(dtype=float)) * array.area
        cells *= through[:, None]
        spectrum = fft2(field, overwrite_x=True)
        for axis, count in enumerate(spectrum.shape):
            k = 2 * np.pi * np.fft.fftfreq(count, array.cell[axis] / array.places[axis])
            phases = array.propagation(k)
            spectrum *= phases[:, None] if axis == 0 else phases
        field = ifft2(spectrum, overwrite_x=True)
        out = array.on_pixels(field.real**2 + field.imag**2)
        out *= np.float32(array.area * array.across**2)
        out = self._inner(out.transpose(0, 2, 1, 3)) * self._kept[..., None, None]
        # a series that ends makes a little less than nothing of dark places
        return np.maximum(out, 0).transpose(0, 2, 1, 3), entered

    @cached_property
    def _at_places(self) -> tuple[np.ndarray, np.ndarray]:
        """What the lenslets of a cell do to a field, and whether they are open: (place, place)."""
        through, open_ = (np.fft.ifft2(s) * s.size for s in self._array.through)
        return through.astype(np.complex64), open_.real

    def _inner(self, cells: np.ndarray) -> np.ndarray:
        """Of (cell row, cell column, ...) those about the middle one that may be kept."""
        low, left = (n // 2 - kept // 2 for n, kept in zip(self._cells, self._kept.shape))
        return cells[low : low + self._kept.shape[0], left : left + self._kept.shape[1]]

    def _arriving(self, y: float, x: float) -> np.ndarray:
        """Field at all places (row, column), by the few that carry it."""
        from scipy.fft import fft, ifft

        o, array = self.optics, self._array
        slope = 2 * ARRIVING * o.aperture / o.magnification / o.wavelength
        few = [min(n, math.ceil(slope * size)) for n, size in zip(array.places, array.cell)]
        y_from, x_from = (
            ((np.arange(cells * n) + 0.5) / n - cells // 2 - 0.5) * size
            for cells, n, size in zip(self._cells, few, o.object_cell)
        )
        found = self._field.at(y_from - y, x_from - x).astype(np.complex64)
        for axis in (1, 0):
            count, many = found.shape[axis], self._cells[axis] * array.places[axis]
            spectrum = np.moveaxis(fft(found, axis=axis, overwrite_x=True), axis, -1)
            # places of both grids are the middles of their parts of the torus
            move = np.fft.fftfreq(count) * (count / many - 1)
            spectrum = spectrum * (many / count * np.exp(1j * np.pi * move)).astype(np.complex64)
            whole = np.zeros((*spectrum.shape[:-1], many), np.complex64)
            whole[..., : (count + 1) // 2] = spectrum[..., : (count + 1) // 2]
            whole[..., many - count // 2 :] = spectrum[..., (count + 1) // 2 :]
            found = np.moveaxis(ifft(whole, axis=-1, overwrite_x=True), -1, axis)
        found = np.ascontiguousarray(found)
        found /= np.float32(o.magnification)
        return found

    @cached_property
    def _field(self) -> ArrivingField:
        height, width = (n * size for n, size in zip(self._cells, self.optics.object_cell))
        # a point may be half a cell from the middle
        return ArrivingField(self.optics, self._depth, 0.6 * math.hypot(height, width))
