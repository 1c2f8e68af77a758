"""The system matrix A: pupil image functions of the object points over one lenslet,
integrated over pixels.

Scalar wave optics in the paraxial approximation (Berkner et al. 2013, section 2-3-1; Shroff and
Berkner 2013). Columns are shares of the light through the main-lens aperture; nothing is
normalised or thresholded.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.budget import one_thread, spread
from plenocli.base.device import device
from plenocli.base.errors import NumericsError
from plenocli.forward.camera.field import at_field
from plenocli.forward.camera.geometry import geometry
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.propagation.bands import BandFields, band_fields
from plenocli.forward.propagation.models import model_named
from plenocli.forward.propagation.sampling import PSF_CUT_EFFECT
from plenocli.forward.propagation.symmetry import (
    Turn,
    fill_below_diagonal,
    superpixel_orbits,
    turned_planes,
)

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.lenslet_fields import FieldNotes, LensletFields
    from plenocli.forward.propagation.plan import PifPlan

BLOCK_BYTES = 1 << 28
"""Size of a block of columns while a matrix is filled."""
Progress = Callable[[int, int], None]
"""Called with the number of columns that are done and of all."""


@dataclass(frozen=True, kw_only=True)
class LensletWindow:
    """Where the pixels of an off-axis lenslet's own superpixel lie on the sensor.

    lenslet: (row, column) on the array;
    first_pixel: (row, column) of the sensor;
    pixel_shift: (rows, columns) in pixels, from the chief ray to the middle of the window.
    """

    lenslet: tuple[int, int]
    first_pixel: tuple[int, int]
    pixel_shift: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class MatrixNotes:
    """How a system matrix was made, beside its AccuracyRecord.

    model: "ray", "fresnel" or "exact";
    coherent_ring: rings of lenslets whose fields add, as PifPlan has it;
    superpixels: (rows, columns) kept;
    precision: "single" or "double", of the fields;
    nodes: per axis across a "lenslet", a "pixel" and the spread function ("psf"), by band;
    symmetry: (flip rows, flip columns, transpose) that map columns onto columns;
    separable_terms: of the factor tables;
    field_tail: largest root energy of what was cut from the spread function;
    kappa, eps: 1/m, curvature left on a lenslet and defocus of the main lens;
    superpixel_pitch: m;
    quartic_phase_rad: phase that the paraxial model drops at a lenslet's edge;
    diffraction_cells: of a lenslet, per axis;
    energy_min, energy_max: of all columns;
    chief: where the lenslet stands from the axis, m (rows, columns);
    window: of an off-axis lenslet;
    device: the graphics card that compressed products, None for a processor.
    """

    model: str
    coherent_ring: int
    superpixels: tuple[int, int]
    accuracy: float
    estimated_accuracy: float
    precision: str
    nodes: Mapping[str, list[int]]
    error_by_source: Mapping[str, float]
    left_out: tuple[str, ...]
    symmetry: tuple[bool, ...]
    separable_terms: int
    field_tail: float
    kappa: float
    eps: float
    superpixel_pitch: float
    quartic_phase_rad: float
    diffraction_cells: float
    energy_min: float
    energy_max: float
    reasons: tuple[str, ...]
    warnings: tuple[str, ...]
    chief: tuple[float, float] = (0.0, 0.0)
    window: LensletWindow | None = None
    device: str | None = None

    def as_json(self) -> dict[str, Any]:
        """The notes as artefacts hold them: what is known of the window stands among the rest."""
        notes = asdict(self)
        window = notes.pop("window")
        if self.device is None:
            del notes["device"]
        return notes | (window or {})


@dataclass(frozen=True, kw_only=True)
class SystemMatrix:
    """A system matrix.

    A: (band, superpixel, pixel, point), share of the light through the main-lens aperture (filters
        not counted) from a point that lands in a pixel; None where it was written in pieces;
    wavelengths: (band,) m;
    lenslet_offset: (superpixel, 2) row and column relative to the object's own, axial numbers on a
        hexagonal lattice;
    pixel_shape, object_shape: rows, columns;
    column_energy: (band, point);
    accuracy: how accurate it is, and why;
    notes: how it was made.
    """

    A: np.ndarray | None
    wavelengths: np.ndarray
    lenslet_offset: np.ndarray
    pixel_shape: tuple[int, int]
    object_shape: tuple[int, int]
    column_energy: np.ndarray
    accuracy: AccuracyRecord
    notes: MatrixNotes


class PifBuilder:
    """Columns of A at one wavelength on demand; the set-up is shared by all blocks.

    lenslets: the LensletFields that give the energies;
    offsets: (superpixel, 2) rows and columns;
    shape: (superpixels, pixels), points: how many;
    symmetry: (flip rows, flip columns, transpose) that map columns onto columns.
    """

    def __init__(
        self,
        camera: Camera,
        wavelength: float,
        plan: PifPlan,
        *,
        dtype: np.typing.DTypeLike = np.float32,
    ) -> None:
        """Prepare the columns.

        wavelength: m, one of the plan's;
        dtype: of A.
        """
        band = next(b for b in plan.bands if b.wavelength == wavelength)
        self.plan, self.geometry, self.dtype = (
            plan,
            geometry(camera, wavelength, plan.pixel_shift, plan.chief).parted(plan.superpixels),
            np.dtype(dtype),
        )
        camera = at_field(camera, wavelength, plan.chief)
        model = model_named(plan.rung)
        # a library can be told to stay on one thread only once it is loaded
        for library in model.libraries:
            importlib.import_module(library)
        with one_thread():
            parts: list[LensletFields] = [
                band_fields(model, seen, self.geometry, plan, band)
                if plan.band_nodes
                else model.fields(seen, self.geometry, plan, band)
                for seen in polarisations(camera)
            ]
            self.lenslets = parts[0] if len(parts) == 1 else BandFields(parts, [0.5, 0.5])
        # a column's energy, and the light that enters, are known to this
        self._sampling = max(band.sampling, PSF_CUT_EFFECT * band.spread_cut / band.faintest)
        self._entered: np.ndarray | None = None
        self.notes: FieldNotes = self.lenslets.notes
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
            a and b for a, b in zip(self.lenslets.symmetry, self.geometry.mirrors(plan.superpixels))
        ]
        self.symmetry = (flips[0], flips[1], flips[2] and turn)

    def columns(self, points: np.ndarray | slice) -> np.ndarray:
        """A for some object points.

        points: flat indices or a slice.

        Returns (superpixel, pixel, point), a view that may not be contiguous.
        Raises NumericsError if a column holds more energy than entered the lenslets, the sign of
        too few nodes.
        """
        points = np.arange(self.points)[points]
        return self._flat(self._images(points)).transpose(1, 2, 0)

    def blocks(self, size: int | None = None) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """All columns in an order that uses the symmetry.

        size: about how many columns at a time at most (default: a quarter GiB of them).

        Yields (flat indices of points, in no order; A of these as from `columns`). Raises as
        `columns`.
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

    def orbits(self) -> list[tuple[int, list[tuple[int, Turn]]]]:
        """As superpixel_orbits, of this matrix."""
        return superpixel_orbits(self.offsets, self.symmetry)

    @property
    def turns(self) -> bool:
        """Whether rows and columns of the points may be exchanged."""
        return self.symmetry[2] and self.symmetry[0] == self.symmetry[1]

    def whole(self) -> np.ndarray:
        """A at this wavelength, (superpixel, pixel, point). Raises as `columns`."""
        A = np.empty((*self.shape, self.points), self.dtype)
        self.fill(A)
        return A

    def fill(
        self,
        A: np.ndarray,
        *,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Write the whole matrix of this wavelength; the same bytes for any number of threads.

        A: (superpixel, pixel, point), filled;
        progress: called with the number of columns x superpixels that are done.

        Raises as `columns`.
        """
        if not self.lenslets.by_superpixel:
            for points, block in self.blocks(max(8, self.points // 8)):
                A[:, :, points] = block
                if progress:
                    progress(len(points) * len(self.offsets))
            return
        total = np.zeros(self.object_shape)
        for first, members in self.orbits():
            one = _OneSuperpixel(self, first, A[first])
            spread(one.parts, one.compute)
            share = one.complete()
            for index, how in members:
                total += turned_planes(share[None, None], how)[0, 0]
                if index != first:
                    np.copyto(self.planes(A[index]), turned_planes(self.planes(A[first]), how))
                if progress:
                    progress(self.points)
        self.require_all_light(total)

    def pieces(self) -> Iterator[tuple[int, np.ndarray]]:
        """The matrix superpixel by superpixel, in the order of `orbits`.

        Yields (superpixel, A of it (pixel, point)), a work array that the one after the next
        overwrites.
        Models that compute all superpixels of a point at once hold the whole matrix meanwhile.
        Raises as `columns`.
        """
        if not self.lenslets.by_superpixel:
            whole = np.empty((*self.shape, self.points), self.dtype)
            self.fill(whole)
            yield from enumerate(whole)
            return
        slabs, others = (
            cycle(np.empty((2, self.shape[1], self.points), self.dtype)) for _ in range(2)
        )
        total = np.zeros(self.object_shape)
        for slab, (first, members) in zip(slabs, self.orbits()):
            one = _OneSuperpixel(self, first, slab)
            spread(one.parts, one.compute)
            share = one.complete()
            for index, how in members:
                total += turned_planes(share[None, None], how)[0, 0]
                if how == (False, False, False):
                    yield index, slab
                else:
                    other = next(others)
                    np.copyto(self.planes(other), turned_planes(self.planes(slab), how))
                    yield index, other
        self.require_all_light(total)

    def planes(self, slab: np.ndarray) -> np.ndarray:
        """A of one superpixel (pixel, point) by rows and columns of both: a view."""
        return slab.reshape(*self.pixel_shape, *self.object_shape)

    def _seeds(self) -> np.ndarray:
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
        # points that share work stand together
        flat, shared = (i * columns + j)[keep], self.lenslets.shared_axis
        return flat[np.argsort(flat % columns if shared else flat // columns, kind="stable")]

    def _orbit(self, points: np.ndarray, images: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
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

    def _images(self, points: np.ndarray) -> np.ndarray:
        ry, rx = self.plan.superpixels
        out = np.empty((len(points), ry, rx, *self.pixel_shape), self.dtype)
        rows, columns = points // self.object_shape[1], points % self.object_shape[1]
        self.lenslets.columns(rows, columns, out)
        self._guard(rows, columns, out)
        return out

    def _flat(self, images: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(images).reshape(len(images), *self.shape)

    def _guard(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        self.require_light(
            out.sum(axis=(1, 2, 3, 4), dtype=float),
            self.lenslets.incident(rows, columns),
            rows,
            columns,
        )

    def require_all_light(self, sensor: np.ndarray) -> None:
        """As require_light, of all points.

        sensor: (point row, point column) shares of their light.
        """
        if self._entered is None:
            places = (a.ravel() for a in np.indices(self.object_shape))
            self._entered = self.lenslets.incident(*places)
        self.require_light(sensor, self._entered, *np.indices(self.object_shape))

    def require_light(
        self, sensor: np.ndarray, entered: np.ndarray, rows: np.ndarray, columns: np.ndarray
    ) -> None:
        """Check that no point puts more light on the sensor than entered the lenslets.

        sensor, entered: shares of the light of points, all of one shape;
        rows, columns: of these points.

        Raises NumericsError where one does.
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


class _OneSuperpixel:
    """A of one superpixel in parts, each a few columns of points; points that the symmetry of this
    superpixel joins are computed once.
    """

    def __init__(self, builder: PifBuilder, index: int, out: np.ndarray) -> None:
        """`index` of the superpixel, `out` (pixel, point) to fill."""
        (oy, ox), (r, c) = builder.object_shape, builder.offsets[index].tolist()
        sy, sx = (int(n) for n in builder.offsets[index] - builder.offsets[0])
        self._builder, self._planes = builder, builder.planes(out)
        self._mirror_y = builder.symmetry[0] and r == 0
        self._mirror_x = builder.symmetry[1] and c == 0
        self._turn = builder.turns and r == c
        self._rows = (oy + 1) // 2 if self._mirror_y else oy
        self._columns = (ox + 1) // 2 if self._mirror_x else ox
        self._share = np.empty((oy, ox))
        self._energies = builder.lenslets.on_superpixel(sy, sx)
        # a cache line of points at a time; where columns differ in length, or are few, fewer, for
        # threads to share, the longest first
        step = min(8 if self._turn else 16, -(-self._columns // 4))
        self.parts = [
            (start, min(start + step, self._columns)) for start in range(0, self._columns, step)
        ][::-1]

    def compute(self, start: int, stop: int) -> None:
        """Point columns start to stop, all the rows that no symmetry gives."""
        pixels, dtype = self._builder.pixel_shape, self._builder.dtype
        count = stop if self._turn else self._rows
        j, i = (
            a.ravel() for a in np.meshgrid(np.arange(start, stop), np.arange(count), indexing="ij")
        )
        images = np.empty((len(i), *pixels), dtype)
        if self._turn:
            # a block of columns of different lengths: what is beyond their ends comes
            # from the others later
            within = i <= j
            found = np.empty((int(within.sum()), *pixels), dtype)
            self._energies(i[within], j[within], found)
            images[within], images[~within] = found, 0
        else:
            self._energies(i, j, images)
        self._share[:count, start:stop] = (
            images.reshape(stop - start, count, -1).sum(axis=2, dtype=float).T
        )
        self._planes[:, :, :count, start:stop] = images.reshape(
            stop - start, count, *pixels
        ).transpose(2, 3, 1, 0)

    def complete(self) -> np.ndarray:
        """Fill in what symmetry gives, once all parts are there.

        Returns the share of the light of each point (row, column) on this superpixel.
        Raises NumericsError as PifBuilder.columns.
        """
        planes, share, rows, columns = self._planes, self._share, self._rows, self._columns
        oy, ox = share.shape
        if self._turn:
            fill_below_diagonal(planes, share, rows)
        # a row of pixels at a time: what numpy sets aside, where it cannot tell that both sides of
        # an assignment are apart, stays in a cache
        if self._mirror_y:
            for row, mirrored in zip(planes, planes[::-1]):
                row[:, rows:, :columns] = mirrored[:, : oy - rows, :columns][:, ::-1]
            share[rows:, :columns] = share[: oy - rows, :columns][::-1]
        if self._mirror_x:
            for row in planes:
                row[:, :, columns:] = row[::-1, :, : ox - columns][:, :, ::-1]
            share[:, columns:] = share[:, : ox - columns][:, ::-1]
        self._builder.require_all_light(share)
        return share


def build_pif(
    camera: Camera,
    plan: PifPlan,
    *,
    points: slice | None = None,
    progress: Progress | None = None,
) -> SystemMatrix:
    """Compute a system matrix as planned (plenocli.forward.accuracy.dial.plan_pif).

    points: slice of flat point indices, as planned;
    progress: called as progress(done, total) in columns.

    Raises NumericsError where a column holds more energy than entered the lenslets.
    """
    dtype = np.dtype(plan.dtype)
    A = np.empty(plan.shape, dtype)
    count = _ColumnCount(plan, progress)
    tails = []
    for b, band in enumerate(plan.bands):
        builder = PifBuilder(camera, band.wavelength, plan, dtype=dtype)
        if points is None:
            builder.fill(A[b], progress=count)
        else:
            for where, block in _chunks(builder, np.arange(builder.points)[points]):
                A[b][:, :, where] = block
                count(len(where) * len(builder.offsets))
        tails.append(builder.notes.field_tail)
    return described(plan, builder, tails, A.sum(axis=(1, 2), dtype=float), A)


def pif_pieces(
    camera: Camera, plan: PifPlan, *, progress: Progress | None = None
) -> Iterator[tuple[PifBuilder, int, int, np.ndarray]]:
    """The system matrix in pieces, for one too large to hold; arguments as build_pif.

    Yields (builder, band, superpixel, A of it (pixel, point)); the piece after the next overwrites
    the array.
    See PifBuilder.pieces and `described`. Raises as build_pif.
    """
    count = _ColumnCount(plan, progress)
    for b, band in enumerate(plan.bands):
        builder = PifBuilder(camera, band.wavelength, plan, dtype=plan.dtype)
        for index, slab in builder.pieces():
            yield builder, b, index, slab
            count(builder.points)


class _ColumnCount:
    """Progress in columns of A from numbers of columns of single superpixels."""

    def __init__(self, plan: PifPlan, progress: Progress | None) -> None:
        self._superpixels, self._total = plan.shape[1], plan.shape[0] * plan.shape[3]
        self._done, self._report = 0, progress

    def __call__(self, columns: int) -> None:
        self._done += columns
        if self._report:
            self._report(self._done // self._superpixels, self._total)


def described(
    plan: PifPlan,
    builder: PifBuilder,
    tails: Sequence[float],
    energy: np.ndarray,
    A: np.ndarray | None = None,
) -> SystemMatrix:
    """The SystemMatrix of a plan that was carried out.

    builder: of any band;
    tails: the field tails of all bands;
    energy: (band, point) of all columns;
    A: (band, superpixel, pixel, point), None where it was written in pieces.
    """
    return SystemMatrix(
        A=A,
        wavelengths=np.array([band.wavelength for band in plan.bands]),
        lenslet_offset=builder.offsets,
        pixel_shape=builder.pixel_shape,
        object_shape=builder.object_shape,
        column_energy=energy,
        accuracy=plan.accuracy_record(),
        notes=_notes(plan, builder, tails, energy),
    )


def _chunks(builder: PifBuilder, points: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    size = max(1, BLOCK_BYTES // (builder.shape[0] * builder.shape[1] * builder.dtype.itemsize))
    for start in range(0, len(points), size):
        part = points[start : start + size]
        yield np.arange(start, start + len(part)), builder.columns(part)


def _notes(
    plan: PifPlan, builder: PifBuilder, tails: Sequence[float], energy: np.ndarray
) -> MatrixNotes:
    g = builder.geometry
    return MatrixNotes(
        model=plan.model,
        coherent_ring=plan.coherent_ring,
        superpixels=plan.superpixels,
        accuracy=plan.accuracy,
        estimated_accuracy=plan.estimated,
        precision="double" if plan.double else "single",
        nodes={
            "lenslet": [b.lenslet_nodes for b in plan.bands],
            "pixel": [b.pixel_nodes for b in plan.bands],
            "psf": [b.psf_nodes for b in plan.bands],
        },
        error_by_source=plan.split,
        left_out=plan.left_out,
        symmetry=builder.symmetry,
        separable_terms=builder.notes.separable_terms,
        field_tail=max(tails),
        kappa=g.kappa,
        eps=g.eps,
        superpixel_pitch=g.superpixel_pitch,
        quartic_phase_rad=g.quartic_phase,
        diffraction_cells=g.diffraction_cells,
        energy_min=float(energy.min()),
        energy_max=float(energy.max()),
        reasons=plan.reasons,
        warnings=plan.warnings,
        chief=plan.chief,
        device=device(plan.device).name,
    )
