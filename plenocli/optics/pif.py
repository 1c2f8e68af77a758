"""The system matrix A: pupil image functions of the object points over one lenslet, integrated over pixels.

Scalar wave optics in the paraxial approximation (Berkner et al. 2013, section 2-3-1; Shroff and Berkner 2013). Columns are
shares of the light through the main-lens aperture; nothing is normalised or thresholded.
"""

from dataclasses import dataclass, field

import numpy as np

from plenocli.errors import NumericsError
from plenocli.optics.geometry import geometry
from plenocli.optics.shaped import ShapedLenslets
from plenocli.optics.square import SquareLenslets

BLOCK_BYTES = 1 << 28
"""Size of a block of columns while a matrix is filled."""


@dataclass(frozen=True)
class Pif:
    """A system matrix.

    A: (band, lenslet, pixel, point), share of the light through the main-lens aperture (filters not counted) from a point
    that lands in a pixel; wavelength: (band,) m; lenslet_offset: (lenslet, 2) superpixel row and column relative to the
    object's own; pixel_shape, object_shape: rows, columns; column_energy: (band, point); notes: how it was made.
    """

    A: np.ndarray
    wavelength: np.ndarray
    lenslet_offset: np.ndarray
    pixel_shape: tuple
    object_shape: tuple
    column_energy: np.ndarray
    notes: dict = field(default_factory=dict)


class PifBuilder:
    """Columns of A at one wavelength on demand; the set-up is shared by all blocks.

    offsets: (superpixels, 2) rows and columns; symmetry: (flip rows, flip columns, transpose) that map columns onto columns.
    """

    def __init__(self, camera, wavelength, plan, *, dtype=np.float32):
        """Prepare `camera` (plenocli.config.Camera) at `wavelength` (m), one of those of the PifPlan `plan`."""
        band = next(b for b in plan.bands if b.wavelength == wavelength)
        self.plan, self.geometry, self.dtype = plan, geometry(camera, wavelength, plan.pixel_shift), np.dtype(dtype)
        self._lenslets = _maker(camera, plan)(camera, self.geometry, plan, band)
        self.notes = self._lenslets.notes
        self.pixel_shape, self.object_shape = self.geometry.pixel_shape, self.geometry.object_shape
        self.points = self.object_shape[0] * self.object_shape[1]
        ry, rx = ((n - 1) // 2 for n in plan.superpixels)
        self.offsets = np.array([(r, c) for r in range(-ry, ry + 1) for c in range(-rx, rx + 1)])
        self.shape = (len(self.offsets), self.pixel_shape[0] * self.pixel_shape[1])
        turn = self.object_shape[0] == self.object_shape[1] and self.pixel_shape[0] == self.pixel_shape[1] and ry == rx
        flips = [a and b for a, b in zip(self._lenslets.symmetry, self.geometry.mirrors(plan.superpixels))]
        self.symmetry = (flips[0], flips[1], flips[2] and turn)

    def columns(self, points):
        """A for object points `points` (flat indices or a slice): (superpixel, pixel, len(points)), a view that may not be contiguous.

        NumericsError if a column holds more energy than entered the lenslets, the sign of too few nodes.
        """
        points = np.arange(self.points)[points]
        return self._flat(self._images(points)).transpose(1, 2, 0)

    def blocks(self, size=None):
        """All columns in an order that uses the symmetry: yields (flat indices, A of these points as from `columns`).

        At most about `size` columns at a time (default: a quarter GiB).
        """
        size = size or max(8, BLOCK_BYTES // (self.shape[0] * self.shape[1] * self.dtype.itemsize))
        seeds = self._seeds()
        group = max(1, size // 2 ** sum(self.symmetry))
        for start in range(0, len(seeds), group):
            part = seeds[start:start + group]
            done = np.zeros(0, int)
            for points, images in self._orbit(part, self._images(part)):
                fresh = ~np.isin(points, done) & (np.unique(points, return_index=True)[1][:, None] == np.arange(len(points))).any(0)
                if fresh.any():
                    yield points[fresh], self._flat(images[fresh]).transpose(1, 2, 0)
                done = np.union1d(done, points)

    def _seeds(self):
        """One flat index of each set of points that the symmetry maps onto each other, columns together."""
        rows, columns = self.object_shape
        i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        keep = np.ones(self.object_shape, bool)
        if self.symmetry[0]:
            keep &= i < (rows + 1) // 2
        if self.symmetry[1]:
            keep &= j < (columns + 1) // 2
        if self.symmetry[2]:
            keep &= i <= j if self.symmetry[0] == self.symmetry[1] else keep
        flat = (i * columns + j)[keep]
        return flat[np.argsort(flat % columns, kind="stable")]

    def _orbit(self, points, images):
        """(points, images) and their mirror images under the symmetry; images: (point, sy, sx, py, px)."""
        rows, columns = self.object_shape
        found = [(points, images)]
        if self.symmetry[0]:
            found += [((rows - 1 - p // columns) * columns + p % columns, a[:, ::-1, :, ::-1, :]) for p, a in found]
        if self.symmetry[1]:
            found += [(p // columns * columns + columns - 1 - p % columns, a[:, :, ::-1, :, ::-1]) for p, a in found]
        if self.symmetry[2] and self.symmetry[0] == self.symmetry[1]:
            found += [(p % columns * columns + p // columns, a.transpose(0, 2, 1, 4, 3)) for p, a in found]
        return found

    def _images(self, points):
        ry, rx = self.plan.superpixels
        out = np.empty((len(points), ry, rx, *self.pixel_shape), self.dtype)
        rows, columns = points // self.object_shape[1], points % self.object_shape[1]
        self._lenslets.columns(rows, columns, out)
        self._guard(rows, columns, out)
        return out

    def _flat(self, images):
        return np.ascontiguousarray(images).reshape(len(images), *self.shape)

    def _guard(self, rows, columns, out):
        sensor = out.sum(axis=(1, 2, 3, 4), dtype=float)
        entered = self._lenslets.incident(rows, columns)
        excess = sensor - entered
        slack = 1e-6 if self.plan.double else 1e-5
        worst = int(np.argmax(excess))
        if not np.isfinite(sensor).all() or excess[worst] > slack:
            raise NumericsError(
                f"point ({rows[worst]}, {columns[worst]}) puts {sensor[worst]:.7f} of its light on the sensor, but only {entered[worst]:.7f} "
                "entered the lenslets: the field is sampled too coarsely", f"{self.geometry.wavelength * 1e9:.1f} nm",
                "ask for a finer accuracy and report this camera")


def _maker(camera, plan):
    """The class that computes sensor fields for a plan; all take (camera, geometry, plan, band)."""
    array = camera.lenslet_array
    return SquareLenslets if (array.aperture_shape, array.lattice) == ("square", "square") else ShapedLenslets


def build_pif(camera, plan, *, points=None, progress=None):
    """Compute the system matrix of `camera` (plenocli.config.Camera) as a Pif by a PifPlan (plenocli.accuracy.plan_pif).

    points: slice of flat point indices, as planned; progress: called as progress(done, total). NumericsError where a column
    holds more energy than entered the lenslets.
    """
    dtype = np.dtype(plan.dtype)
    A = np.empty(plan.shape, dtype)
    energy = np.empty((plan.shape[0], plan.shape[3]))
    tails, builder = [], None
    for b, band in enumerate(plan.bands):
        builder = PifBuilder(camera, band.wavelength, plan, dtype=dtype)
        done, columns = 0, np.empty((plan.shape[3], *plan.shape[1:3]), dtype)
        chosen = None if points is None else np.arange(builder.points)[points]
        source = builder.blocks() if points is None else _chunks(builder, chosen)
        for where, block in source:
            columns[where] = block.transpose(2, 0, 1)
            done += len(where)
            if progress:
                progress(b * plan.shape[3] + done, plan.shape[0] * plan.shape[3])
        energy[b] = columns.sum(axis=(1, 2), dtype=float)
        A[b] = columns.transpose(1, 2, 0)
        tails.append(builder.notes["field_tail"])
    return Pif(A, np.array([b.wavelength for b in plan.bands]), builder.offsets, builder.pixel_shape, builder.object_shape, energy,
               _notes(plan, builder, tails, energy))


def _chunks(builder, points):
    size = max(1, BLOCK_BYTES // (builder.shape[0] * builder.shape[1] * builder.dtype.itemsize))
    for start in range(0, len(points), size):
        part = points[start:start + size]
        yield np.arange(start, start + len(part)), builder.columns(part)


def _notes(plan, builder, tails, energy):
    g = builder.geometry
    return {
        "model": plan.model,
        "coherent_ring": plan.coherent_ring,
        "superpixels": list(plan.superpixels),
        "accuracy": plan.accuracy,
        "estimated_accuracy": plan.estimated,
        "precision": "double" if plan.double else "single",
        "nodes": {"lenslet": [b.lenslet_nodes for b in plan.bands], "pixel": [b.pixel_nodes for b in plan.bands], "psf": [b.psf_nodes for b in plan.bands]},
        "error_by_source": plan.split,
        "left_out": list(plan.left_out),
        "separable_terms": builder.notes["separable_terms"],
        "field_tail": max(tails),
        "kappa": g.kappa,
        "eps": g.eps,
        "superpixel_pitch": g.superpixel_pitch,
        "quartic_phase_rad": g.quartic_phase,
        "diffraction_cells": g.diffraction_cells,
        "energy_min": float(energy.min()),
        "energy_max": float(energy.max()),
        "reasons": list(plan.reasons),
        "warnings": list(plan.warnings),
    }
