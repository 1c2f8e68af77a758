"""The system matrix A: pupil image functions of the object points over one lenslet,
integrated over pixels.

Scalar wave optics in the paraxial approximation (Berkner et al. 2013, section 2-3-1; Shroff and
Berkner 2013). Columns are shares of the light through the main-lens aperture; nothing is
normalised or thresholded.
"""

from dataclasses import dataclass, field

import numpy as np

from plenocli.base.budget import one_thread, spread
from plenocli.base.errors import NumericsError
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.lens import at_wavelength
from plenocli.forward.propagation.bands import combined
from plenocli.forward.propagation.exact.lenslets import ExactSquareLenslets
from plenocli.forward.propagation.fresnel.shaped import ShapedLenslets
from plenocli.forward.propagation.fresnel.square import SquareLenslets
from plenocli.forward.propagation.rays import RayLenslets

BLOCK_BYTES = 1 << 28
"""Size of a block of columns while a matrix is filled."""


@dataclass(frozen=True)
class Pif:
    """A system matrix.

    A: (band, lenslet, pixel, point), share of the light through the main-lens aperture (filters not
        counted) from a point that lands in a pixel;
    wavelength: (band,) m;
    lenslet_offset: (lenslet, 2) superpixel row and column relative to the object's own, axial
        numbers on a hexagonal lattice;
    pixel_shape, object_shape: rows, columns;
    column_energy: (band, point);
    notes: how it was made.
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

    offsets: (superpixels, 2) rows and columns;
    symmetry: (flip rows, flip columns, transpose) that map columns onto columns.
    """

    def __init__(self, camera, wavelength, plan, *, dtype=np.float32):
        """Prepare `camera` (plenocli.forward.camera.model.Camera) at `wavelength` (m), one of
        those of the PifPlan `plan`.
        """
        band = next(b for b in plan.bands if b.wavelength == wavelength)
        self.plan, self.geometry, self.dtype = (
            plan,
            geometry(camera, wavelength, plan.pixel_shift),
            np.dtype(dtype),
        )
        camera = at_wavelength(camera, wavelength)
        if plan.model == "exact":
            # a library can be told to stay on one thread only once it is loaded
            import scipy.linalg  # noqa: F401
        with one_thread():
            self._lenslets = _maker(camera, plan)(camera, self.geometry, plan, band)
        self._sampling = band.sampling
        self.notes = self._lenslets.notes
        self.pixel_shape, self.object_shape = self.geometry.pixel_shape, self.geometry.object_shape
        self.points = self.object_shape[0] * self.object_shape[1]
        ry, rx = ((n - 1) // 2 for n in plan.superpixels)
        self.offsets = np.array([(r, c) for r in range(-ry, ry + 1) for c in range(-rx, rx + 1)])
        self.shape = (len(self.offsets), self.pixel_shape[0] * self.pixel_shape[1])
        turn = (
            self.object_shape[0] == self.object_shape[1]
            and self.pixel_shape[0] == self.pixel_shape[1]
            and ry == rx
        )
        flips = [
            a and b
            for a, b in zip(self._lenslets.symmetry, self.geometry.mirrors(plan.superpixels))
        ]
        self.symmetry = (flips[0], flips[1], flips[2] and turn)

    def columns(self, points):
        """A for object points `points` (flat indices or a slice): (superpixel, pixel, len(points)),
        a view that may not be contiguous.

        NumericsError if a column holds more energy than entered the lenslets, the
        sign of too few nodes.
        """
        points = np.arange(self.points)[points]
        return self._flat(self._images(points)).transpose(1, 2, 0)

    def blocks(self, size=None):
        """All columns in an order that uses the symmetry: yields (flat indices, A of these points
        as from `columns`).

        At most about `size` columns at a time (default: a quarter GiB).
        """
        size = size or max(8, BLOCK_BYTES // (self.shape[0] * self.shape[1] * self.dtype.itemsize))
        seeds = self._seeds()
        group = max(1, size // 2 ** sum(self.symmetry))
        for start in range(0, len(seeds), group):
            part = seeds[start : start + group]
            done = np.zeros(0, int)
            for points, images in self._orbit(part, self._images(part)):
                fresh = ~np.isin(points, done) & (
                    np.unique(points, return_index=True)[1][:, None] == np.arange(len(points))
                ).any(0)
                if fresh.any():
                    yield points[fresh], self._flat(images[fresh]).transpose(1, 2, 0)
                done = np.union1d(done, points)

    def orbits(self):
        """As superpixel_orbits, of this matrix."""
        return superpixel_orbits(self.offsets, self.symmetry)

    @property
    def _turns(self):
        return self.symmetry[2] and self.symmetry[0] == self.symmetry[1]

    def fill(self, A, *, workers=1, progress=None):
        """Write the whole matrix of this wavelength into A (superpixel, pixel, point); the same
        bytes for any number of threads.

        progress: called with the number of columns x superpixels that are done.
            Errors as `columns`.
        """
        if not hasattr(self._lenslets, "superpixel"):
            for points, block in self.blocks(max(8, self.points // 8)):
                A[:, :, points] = block
                if progress:
                    progress(len(points) * len(self.offsets))
            return
        for first, members in self.orbits():
            self._slab(first, A[first], workers)
            for index, how in members:
                if index != first:
                    np.copyto(self._planes(A[index]), _mapped(self._planes(A[first]), how))
                if progress:
                    progress(self.points)

    def pieces(self, *, workers=1):
        """The matrix superpixel by superpixel, as (superpixel, A of it (pixel, point)), in the
        order of `orbits`.

        The array is a work array, overwritten by the next one. Makers that compute all superpixels
        of a point at once hold the whole matrix meanwhile.
        """
        if not hasattr(self._lenslets, "superpixel"):
            whole = np.empty((*self.shape, self.points), self.dtype)
            self.fill(whole)
            yield from enumerate(whole)
            return
        slab, other = np.empty((2, self.shape[1], self.points), self.dtype)
        for first, members in self.orbits():
            self._slab(first, slab, workers)
            for index, how in members:
                if how == (False, False, False):
                    yield index, slab
                else:
                    np.copyto(self._planes(other), _mapped(self._planes(slab), how))
                    yield index, other

    def _planes(self, slab):
        return slab.reshape(*self.pixel_shape, *self.object_shape)

    def _slab(self, index, out, workers):
        """A of one superpixel into out (pixel, point); points that the symmetry of this
        superpixel joins are computed once.
        """
        (oy, ox), (r, c) = self.object_shape, self.offsets[index].tolist()
        sy, sx = (int(n) for n in self.offsets[index] - self.offsets[0])
        mirror_y, mirror_x = self.symmetry[0] and r == 0, self.symmetry[1] and c == 0
        turn = self._turns and r == c
        rows, columns = (oy + 1) // 2 if mirror_y else oy, (ox + 1) // 2 if mirror_x else ox
        planes = self._planes(out)
        share = np.empty((oy, ox))
        entered = self._lenslets.incident(*(a.ravel() for a in np.indices((oy, ox)))).reshape(
            oy, ox
        )

        def work(start, stop):
            """Point columns start to stop, all the rows that no symmetry gives,
            into planes and share.
            """
            count = stop if turn else rows
            j, i = (
                a.ravel()
                for a in np.meshgrid(np.arange(start, stop), np.arange(count), indexing="ij")
            )
            images = np.empty((len(i), *self.pixel_shape), self.dtype)
            if turn:
                # a block of columns of different lengths: what is beyond their ends comes
                # from the others later
                within = i <= j
                found = np.empty((int(within.sum()), *self.pixel_shape), self.dtype)
                self._lenslets.superpixel(sy, sx, i[within], j[within], found)
                images[within], images[~within] = found, 0
            else:
                self._lenslets.superpixel(sy, sx, i, j, images)
            share[:count, start:stop] = (
                images.reshape(stop - start, count, -1).sum(axis=2, dtype=float).T
            )
            planes[:, :, :count, start:stop] = images.reshape(
                stop - start, count, *self.pixel_shape
            ).transpose(2, 3, 1, 0)

        # a cache line of points at a time; where columns differ in length, fewer,
        # for threads to share
        step = 8 if turn else 16
        spread(
            [(start, min(start + step, columns)) for start in range(0, columns, step)],
            work,
            workers,
        )
        if turn:
            _complete(planes, share, rows)
        if mirror_y:
            planes[:, :, rows:, :columns] = planes[::-1, :, : oy - rows, :columns][:, :, ::-1]
            share[rows:, :columns] = share[: oy - rows, :columns][::-1]
        if mirror_x:
            planes[:, :, :, columns:] = planes[:, ::-1, :, : ox - columns][:, :, :, ::-1]
            share[:, columns:] = share[:, : ox - columns][:, ::-1]
        self._within(share, entered, *np.indices((oy, ox)))

    def _seeds(self):
        """One flat index of each set of points that the symmetry maps onto each
        other, columns together.
        """
        rows, columns = self.object_shape
        i, j = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
        keep = np.ones(self.object_shape, bool)
        if self.symmetry[0]:
            keep &= i < (rows + 1) // 2
        if self.symmetry[1]:
            keep &= j < (columns + 1) // 2
        if self.symmetry[2]:
            keep &= i <= j if self.symmetry[0] == self.symmetry[1] else keep
        # points whose work a maker shares stand together
        flat, shared = (i * columns + j)[keep], getattr(self._lenslets, "shared_axis", 1)
        return flat[np.argsort(flat % columns if shared else flat // columns, kind="stable")]

    def _orbit(self, points, images):
        """(points, images) and their mirror images under the symmetry;

        images: (point, sy, sx, py, px).
        """
        rows, columns = self.object_shape
        found = [(points, images)]
        if self.symmetry[0]:
            found += [
                ((rows - 1 - p // columns) * columns + p % columns, a[:, ::-1, :, ::-1, :])
                for p, a in found
            ]
        if self.symmetry[1]:
            found += [
                (p // columns * columns + columns - 1 - p % columns, a[:, :, ::-1, :, ::-1])
                for p, a in found
            ]
        if self.symmetry[2] and self.symmetry[0] == self.symmetry[1]:
            found += [
                (p % columns * columns + p // columns, a.transpose(0, 2, 1, 4, 3)) for p, a in found
            ]
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
        self._within(
            out.sum(axis=(1, 2, 3, 4), dtype=float),
            self._lenslets.incident(rows, columns),
            rows,
            columns,
        )

    def _within(self, sensor, entered, rows, columns):
        """NumericsError where points (rows, columns) put more light on the `sensor` than
        `entered` the lenslets.
        """
        sensor, entered, rows, columns = (np.ravel(a) for a in (sensor, entered, rows, columns))
        excess = sensor - entered
        slack = max(1e-6 if self.plan.double else 1e-5, 0.5 * self._sampling)
        worst = int(np.argmax(excess))
        if not np.isfinite(sensor).all() or excess[worst] > slack:
            raise NumericsError(
                (
                    f"point ({rows[worst]}, {columns[worst]}) puts {sensor[worst]:.7f} of its "
                    f"light on the sensor, but only {entered[worst]:.7f} entered the lenslets: the "
                    "field is sampled too coarsely"
                ),
                f"{self.geometry.wavelength * 1e9:.1f} nm",
                "ask for a finer accuracy and report this camera",
            )


def _maker(camera, plan):
    """The class that computes sensor fields for a plan; all take (camera, geometry, plan, band)."""
    if plan.model != "fresnel":
        maker = {"ray": RayLenslets, "exact": ExactSquareLenslets}[plan.model]
    else:
        maker = SquareLenslets if plan.rung == "fresnel, low rank" else ShapedLenslets
    return combined(maker, plan.band_nodes) if plan.band_nodes else maker


def superpixel_orbits(offsets, symmetry):
    """Superpixels (offsets (superpixel, 2)) that the symmetry (flip rows, flip columns, transpose)
    of A maps onto each other.

    [(first, [(superpixel, (turned, flipped rows, flipped columns) that leads there from the
    first)])], numbers of superpixels.
    """
    place, found = {tuple(o): i for i, o in enumerate(np.asarray(offsets).tolist())}, {}
    turns = symmetry[2] and symmetry[0] == symmetry[1]
    for (r, c), index in place.items():
        flips = bool(r < 0 and symmetry[0]), bool(c < 0 and symmetry[1])
        a, b = (-n if flip else n for n, flip in zip((r, c), flips))
        turned = bool(turns and a > b)
        found.setdefault(place[(b, a) if turned else (a, b)], []).append((index, (turned, *flips)))
    return list(found.items())


def _mapped(planes, how):
    """(pixel row, pixel column, point row, point column) of the superpixel that (turned, flipped
    rows, flipped columns) leads to: a view.
    """
    turned, rows, columns = how
    planes = planes.transpose(1, 0, 3, 2) if turned else planes
    planes = planes[::-1, :, ::-1] if rows else planes
    return planes[:, ::-1, :, ::-1] if columns else planes


def _complete(planes, share, count):
    """Fill points below the diagonal of the first count x count from those above, rows and
    columns exchanged.
    """
    turned = planes.transpose(1, 0, 3, 2)
    for j in range(count):
        planes[:, :, j + 1 : count, j] = turned[:, :, j + 1 : count, j]
        share[j + 1 : count, j] = share[j, j + 1 : count]


def build_pif(camera, plan, *, points=None, progress=None, workers=1):
    """Compute the system matrix of `camera` (plenocli.forward.camera.model.Camera) as a Pif by a
    PifPlan (plenocli.forward.accuracy.dial.plan_pif).

    points: slice of flat point indices, as planned;
    progress: called as progress(done, total);
    workers: threads.
    NumericsError where a column holds more energy than entered the lenslets.
    """
    dtype = np.dtype(plan.dtype)
    A = np.empty(plan.shape, dtype)
    count = _Count(plan, progress)
    tails, builder = [], None
    for b, band in enumerate(plan.bands):
        builder = PifBuilder(camera, band.wavelength, plan, dtype=dtype)
        if points is None:
            builder.fill(A[b], workers=workers, progress=count)
        else:
            for where, block in _chunks(builder, np.arange(builder.points)[points]):
                A[b][:, :, where] = block
                count(len(where) * len(builder.offsets))
        tails.append(builder.notes["field_tail"])
    return Pif(A, *described(plan, builder, tails, A.sum(axis=(1, 2), dtype=float)))


def pif_pieces(camera, plan, *, progress=None, workers=1):
    """The system matrix in pieces, for one too large to hold: yields (builder, band, superpixel, A
    of it (pixel, point)).

    The array is overwritten by the next piece; see PifBuilder.pieces and `described`. Arguments and
    errors as build_pif.
    """
    count = _Count(plan, progress)
    for b, band in enumerate(plan.bands):
        builder = PifBuilder(camera, band.wavelength, plan, dtype=plan.dtype)
        for index, slab in builder.pieces(workers=workers):
            yield builder, b, index, slab
            count(builder.points)


class _Count:
    """Progress in columns of A from numbers of columns of single superpixels."""

    def __init__(self, plan, progress):
        self._superpixels, self._total, self._done, self._report = (
            plan.shape[1],
            plan.shape[0] * plan.shape[3],
            0,
            progress,
        )

    def __call__(self, columns):
        self._done += columns
        if self._report:
            self._report(self._done // self._superpixels, self._total)


def described(plan, builder, tails, energy):
    """What a Pif holds beside A, in its order: `builder` of any band, the field tails of all
    bands and the energy (band, point) of all columns.
    """
    return (
        np.array([band.wavelength for band in plan.bands]),
        builder.offsets,
        builder.pixel_shape,
        builder.object_shape,
        energy,
        _notes(plan, builder, tails, energy),
    )


def _chunks(builder, points):
    size = max(1, BLOCK_BYTES // (builder.shape[0] * builder.shape[1] * builder.dtype.itemsize))
    for start in range(0, len(points), size):
        part = points[start : start + size]
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
        "nodes": {
            "lenslet": [b.lenslet_nodes for b in plan.bands],
            "pixel": [b.pixel_nodes for b in plan.bands],
            "psf": [b.psf_nodes for b in plan.bands],
        },
        "error_by_source": plan.split,
        "left_out": list(plan.left_out),
        "symmetry": list(builder.symmetry),
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
