"""What a system matrix can and cannot tell apart: rank, condition, symmetry, energy.

If the pupil is point-symmetric, the object in focus and the pupil imaged onto the sensor (eps =
kappa = W = 0), object points at +x and -x give the same superpixel of an isolated lenslet: half of
the object is invisible (docs/model.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plenocli.forward.camera.geometry import geometry
from plenocli.forward.propagation.costs import law, priced
from plenocli.forward.propagation.sampling import expected_symmetry
from plenocli.forward.propagation.symmetry import superpixel_orbits

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.propagation.system_matrix import SystemMatrix

NOISE_THRESHOLD = 1e-3
"""Singular values above this share stand out of noise at 60 dB."""
SYMMETRY_WARNING = 1e-3
"""Symmetry defects below this are worth a warning: the antisymmetric half of the
object is all but lost.
"""
LARGEST = 4000
"""Above this many object points singular values are left out: they would take minutes."""
_ROWS = 1024
_FEW_ROWS = 64
"""That stay in a cache."""
_PANEL = 64
"""Columns that the orthogonal reduction takes at a time."""


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What a system matrix can tell apart, by band; None where that was left out.

    energy_min, energy_max: of the columns;
    symmetry_defect: of the object's own superpixel, None where only some points were computed;
    singular_values: (band, value) descending, None (as the next four) above 4000 points;
    resolution: share of the largest below which they are rounding, of the numbers that A is stored
        in or of the decomposition;
    rank: singular values above the resolution;
    rank_60db: those above NOISE_THRESHOLD of the largest;
    condition: largest over smallest, or the inverse of the resolution where the smallest is below
        it, which is then a lower bound;
    warnings: a sentence each.
    """

    energy_min: list[float]
    energy_max: list[float]
    symmetry_defect: list[float] | None = None
    singular_values: np.ndarray | None = None
    resolution: list[float] | None = None
    rank: list[int] | None = None
    rank_60db: list[int] | None = None
    condition: list[float] | None = None
    warnings: tuple[str, ...] = ()

    @property
    def condition_is_bound(self) -> list[bool] | None:
        """Whether a condition is only a lower bound, by band."""
        if self.condition is None or self.resolution is None:
            return None
        return [is_bound(c, r) for c, r in zip(self.condition, self.resolution)]


def is_bound(condition: float, resolution: float) -> bool:
    """Whether a condition is as large as the resolution of singular values lets it be, and so a
    lower bound only.
    """
    return condition * resolution >= 1 - 1e-9


class Spectrum:
    """Singular values of a matrix that comes in pieces of rows, each piece reduced to a triangle
    with those before by orthogonal transformations: to the rounding of double precision, which
    A^T A would keep half the digits of.

    object_shape: (rows, columns) of points;
    symmetry: (flip rows, flip columns, exchange both) of the points, each of which changes the
        whole matrix by a permutation of its rows only: it then falls into blocks of patterns that
        are even and odd.
    """

    def __init__(
        self, object_shape: tuple[int, int], symmetry: Sequence[bool] = (False, False, False)
    ) -> None:
        self._shape = tuple(object_shape)
        self._flips = tuple(symmetry[:2])
        self._turn = bool(symmetry[2]) and symmetry[0] == symmetry[1]
        self._triangles: list[np.ndarray] = []
        self._rows, self._longest, self._squares = 0, 0.0, np.zeros(self._shape)
        self._unit = 0.0

    def add(
        self, part: np.ndarray, times: np.ndarray | int = 1, exchanged: np.ndarray | None = None
    ) -> None:
        """Add rows of the matrix.

        part: (..., point);
        times: how many rows of the whole each stands for, in all orientations together;
        exchanged: as part, the rows that are the same but for rounding and rows and columns of
            points exchanged; None: there are none, or they come by themselves.
        """
        self._unit = float(np.finfo(part.dtype).eps) / 2
        part = part.reshape(-1, part.shape[-1])
        times = np.broadcast_to(times, len(part))
        self._rows += int(times.sum())
        for start in range(0, len(part), _ROWS):
            rows = part[start : start + _ROWS].astype(float)
            if exchanged is not None:
                rows += _exchanged(exchanged[start : start + _ROWS], self._shape)
                rows *= 0.5
            self._longest = max(self._longest, float(np.einsum("rp,rp->r", rows, rows).max()))
            rows *= np.sqrt(times[start : start + _ROWS, None])
            self._squares += np.einsum("rp,rp->p", rows, rows).reshape(self._shape)
            blocks = list(self._blocks(rows.reshape(-1, *self._shape)))
            self._triangles = (
                [_reduced(r, b) for r, b in zip(self._triangles, blocks)]
                if self._triangles
                else [_triangle(b) for b in blocks]
            )

    def values(self) -> np.ndarray:
        """Singular values, descending: as many as the matrix has rows or points, what is less."""
        found = [np.linalg.svd(t, compute_uv=False) for t in self._triangles]
        if self._turn and all(self._flips):
            found.append(found[2])  # patterns even in rows and odd in columns, and the other way
        return np.sort(np.concatenate(found))[::-1][: self._rows]

    def resolution(self, largest: float) -> float:
        """Singular values (absolute) below this are not known.

        largest: singular value.

        Rounding of the numbers of A, independent and even within half a unit in the last place,
        has a spectral norm of at most about the longest column and the longest row of standard
        deviations together [BH]; LAPACK's own rounding is taken as numpy.linalg.matrix_rank does.
        """
        squares = self._squares
        for axis, flip in enumerate(self._flips):
            squares = (squares + np.flip(squares, axis)) / 2 if flip else squares
        squares = (squares + squares.T) / 2 if self._turn else squares
        stored = self._unit / np.sqrt(3) * (np.sqrt(squares.max()) + np.sqrt(self._longest))
        computed = max(self._rows, squares.size) * np.finfo(float).eps * largest
        return float(max(stored, computed))

    def _blocks(self, rows: np.ndarray) -> Iterator[np.ndarray]:
        """The parts (row, coordinate) of rows (row, point row, point column) that do not mix."""
        blocks = [rows]
        for axis, flip in enumerate(self._flips, 1):
            if flip:
                blocks = [half for block in blocks for half in _parities(block, axis)]
        if not self._turn:
            yield from (block.reshape(len(block), -1) for block in blocks)
            return
        if len(blocks) == 1:
            yield from _turn_parities(blocks[0])
            return
        even, mixed, other, odd = blocks
        yield from _turn_parities(even)
        both = np.concatenate([mixed, other.transpose(0, 2, 1)])
        both *= np.sqrt(0.5)
        yield both.reshape(len(both), -1)
        yield from _turn_parities(odd)


def _exchanged(rows: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Rows (row, point) with rows and columns of points exchanged."""
    return rows.reshape(-1, *shape).transpose(0, 2, 1).reshape(len(rows), -1)


def _triangle(rows: np.ndarray) -> np.ndarray:
    """The triangular factor R (value, value) of rows (row, value)."""
    triangle = np.zeros((rows.shape[1],) * 2, order="F")
    factor = np.linalg.qr(rows, mode="r")
    triangle[: len(factor)] = factor
    return triangle


def _reduced(triangle: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The triangular factor R (value, value) of an upper triangle with rows (row, value) below."""
    if not triangle.size:
        return triangle
    from scipy.linalg.lapack import dtpqrt

    reduced, *_, info = dtpqrt(
        0,
        min(_PANEL, len(triangle)),
        triangle,
        np.asfortranarray(rows),
        overwrite_a=True,
        overwrite_b=True,
    )
    if info:
        raise ValueError(f"dtpqrt refuses its argument {-info}")
    return reduced


def _turn_parities(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parts (row, coordinate) of squares (row, n, n) even and odd under exchange of their axes, in
    orthonormal coordinates.
    """
    upper, lower = np.triu_indices(values.shape[1], 1)
    diagonal = np.arange(values.shape[1])
    one, other = values[:, upper, lower], values[:, lower, upper]
    even, odd = (one + other) * np.sqrt(0.5), (one - other) * np.sqrt(0.5)
    return np.concatenate([even, values[:, diagonal, diagonal]], axis=1), odd


def _parities(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Parts even and odd under reversal of an axis, in orthonormal coordinates."""
    size = values.shape[axis]
    first, middle, last = np.array_split(values, [size // 2, (size + 1) // 2], axis)
    mirrored = np.flip(last, axis)
    even, odd = first + mirrored, first - mirrored
    for part in (even, odd):
        part *= np.sqrt(0.5)
    return (np.concatenate([even, middle], axis) if size % 2 else even), odd


def symmetry_defect(own: np.ndarray, pixels: np.ndarray | None = None) -> float:
    """max |A - A'| / max |A| for one superpixel's rows `own` (pixel, point), or some of its pixels;
    A' is A for the object turned by 180 degrees.
    """
    half = (own.shape[1] + 1) // 2
    pixels = np.arange(len(own)) if pixels is None else pixels
    peak = defect = 0.0
    for start in range(0, len(pixels), _FEW_ROWS):
        rows = own[pixels[start : start + _FEW_ROWS]]
        apart = rows[:, :half] - rows[:, ::-1][:, :half]
        peak = max(peak, float(rows.max()), -float(rows.min()))
        defect = max(defect, float(apart.max()), -float(apart.min()))
    return defect / peak if peak > 0 else 0.0


def seconds(camera: Camera, plan: PifPlan) -> float:
    """Seconds of one core that the diagnosis of a planned matrix takes."""
    return len(plan.bands) * priced(law("diagnosis").seconds, features(camera, plan))


def memory(shape: tuple[int, int, int, int]) -> int:
    """Bytes that the diagnosis of a matrix takes beside it: rows with their even and odd parts, and
    what they are reduced to.

    shape: (band, superpixel, pixel, point).
    """
    _, _, pixels, points = shape
    return 8 * points * (5 * min(_ROWS, pixels) + points) if points <= LARGEST else 0


def features(camera: Camera, plan: PifPlan) -> dict[str, float]:
    """What the diagnosis of one band of a planned matrix consists of, for costs.toml: `values` that
    are looked at, `reduced` operations of orthogonal reductions, `decomposed` cubes of the sides of
    triangles.
    """
    at = geometry(camera, plan.bands[0].wavelength, plan.pixel_shift)
    symmetry = expected_symmetry(camera, at, plan.shape)
    points = plan.shape[-1]
    ry, rx = ((n - 1) // 2 for n in plan.superpixels)
    offsets = np.array([(r, c) for r in range(-ry, ry + 1) for c in range(-rx, rx + 1)])
    rows = sum(
        len(_own_pixels(offsets[index], symmetry, at.pixel_shape).pixels)
        for index, _ in superpixel_orbits(offsets, symmetry)
    )
    found: dict[str, float] = {"values": rows * points}
    if points <= LARGEST:
        flips = 2 ** (bool(symmetry[0]) + bool(symmetry[1]))
        widths = [points / flips] * flips
        if symmetry[2]:  # even and odd under exchange; of four parts two are exchanged for one
            split = [points / flips / 2] * 2
            widths = [*split, *split, points / flips] if flips == 4 else split
        found |= {
            "reduced": sum(2 * rows * n**2 for n in widths)
            + (2 * rows * widths[-1] ** 2 if len(widths) == 5 else 0),
            "decomposed": sum(n**3 for n in widths),
        }
    return found


class _OwnPixels(NamedTuple):
    """Pixels that tell all of a superpixel: the first of those that the symmetry of A joins in it.

    times: how many of the superpixel each stands for.
    exchanged: the pixel that each becomes where rows and columns are exchanged, or None.
    """

    pixels: np.ndarray
    times: np.ndarray
    exchanged: np.ndarray | None


def _own_pixels(
    offset: np.ndarray, symmetry: Sequence[bool], pixel_shape: tuple[int, int]
) -> _OwnPixels:
    """The _OwnPixels of the superpixel at an offset (2,)."""
    first = np.arange(pixel_shape[0] * pixel_shape[1]).reshape(pixel_shape)
    for axis in (0, 1):
        if symmetry[axis] and offset[axis] == 0:
            first = np.minimum(first, np.flip(first, axis))
    turns = symmetry[2] and symmetry[0] == symmetry[1] and offset[0] == offset[1]
    pixels, times = np.unique(np.minimum(first, first.T) if turns else first, return_counts=True)
    row, column = np.divmod(pixels, pixel_shape[1])
    return _OwnPixels(pixels, times, column * pixel_shape[1] + row if turns else None)


class PiecewiseDiagnosis:
    """The Diagnosis of a matrix that comes superpixel by superpixel.

    Only the first superpixel of each orbit is looked at (superpixel_orbits), and of one that is its
    own mirror image only a part (_own_pixels): the others hold the same light.
    """

    def __init__(
        self,
        bands: int,
        offsets: np.ndarray,
        pixel_shape: tuple[int, int],
        object_shape: tuple[int, int],
        symmetry: Sequence[bool],
    ) -> None:
        """What is known before the first piece.

        bands: how many;
        offsets: (superpixel, 2);
        pixel_shape, object_shape: rows and columns;
        symmetry: of A, as PifBuilder has it.
        """
        self._own = int(np.flatnonzero((np.asarray(offsets) == 0).all(axis=1))[0])
        self._looked_at = {
            first: (_own_pixels(offsets[first], symmetry, pixel_shape), len(members))
            for first, members in superpixel_orbits(offsets, symmetry)
        }
        self._spectra = [Spectrum(object_shape, symmetry) for _ in range(bands)]
        self._defects = [0.0] * bands
        self._few = int(np.prod(object_shape)) <= LARGEST

    def add(self, band: int, superpixel: int, slab: np.ndarray) -> None:
        """Take one piece into account.

        band, superpixel: numbers of the piece;
        slab: A of it, (pixel, point).
        """
        if superpixel not in self._looked_at:
            return
        own, members = self._looked_at[superpixel]
        if superpixel == self._own:
            self._defects[band] = symmetry_defect(slab, own.pixels)
        if self._few:
            part = slab if len(own.pixels) == len(slab) else slab[own.pixels]
            exchanged = None if own.exchanged is None else slab[own.exchanged]
            self._spectra[band].add(part, own.times * members, exchanged)

    def result(self, energy: np.ndarray) -> Diagnosis:
        """What was found, for column energies (band, point)."""
        return _diagnosis(energy, self._defects, self._spectra if self._few else None)


def describe(matrix: SystemMatrix) -> Diagnosis:
    """Diagnose a system matrix that is held whole."""
    if matrix.A is None:
        raise ValueError("a matrix in pieces is diagnosed by PiecewiseDiagnosis")
    points = matrix.A.shape[-1]
    if points == int(np.prod(matrix.object_shape)):
        diagnosis = PiecewiseDiagnosis(
            len(matrix.A),
            matrix.lenslet_offset,
            matrix.pixel_shape,
            matrix.object_shape,
            matrix.notes.symmetry,
        )
        for band, of_band in enumerate(matrix.A):
            for superpixel, slab in enumerate(of_band):
                diagnosis.add(band, superpixel, slab)
        return diagnosis.result(matrix.column_energy)
    if points > LARGEST:
        return _diagnosis(matrix.column_energy, None, None)
    spectra = []
    for of_band in matrix.A:
        spectra.append(Spectrum((1, points)))
        spectra[-1].add(of_band)
    return _diagnosis(matrix.column_energy, None, spectra)


def _diagnosis(
    energy: np.ndarray, defects: list[float] | None, spectra: Sequence[Spectrum] | None
) -> Diagnosis:
    """The Diagnosis of column energies (band, point), symmetry defects by band and the singular
    values of each band.
    """
    found = Diagnosis(
        energy_min=energy.min(axis=1).tolist(),
        energy_max=energy.max(axis=1).tolist(),
        symmetry_defect=defects,
        warnings=_warnings(energy, defects),
    )
    if spectra is None:
        return found
    values = np.array([spectrum.values() for spectrum in spectra])
    top = np.maximum(values[:, 0], np.finfo(float).tiny)
    floor = np.array([one.resolution(t) for one, t in zip(spectra, top)])
    return replace(
        found,
        singular_values=values,
        resolution=(floor / top).tolist(),
        rank=(values > floor[:, None]).sum(axis=1).tolist(),
        rank_60db=(values > NOISE_THRESHOLD * top[:, None]).sum(axis=1).tolist(),
        condition=(top / np.maximum(values[:, -1], floor)).tolist(),
    )


def _warnings(energy: np.ndarray, defects: list[float] | None) -> tuple[str, ...]:
    if defects is None or energy.shape[1] == 1 or min(defects) >= SYMMETRY_WARNING:
        return ()
    return (
        "half of the object is invisible to an isolated lenslet: points at +x and -x give "
        f"the same superpixel (symmetry defect {min(defects):.1e}); move the sensor off "
        "the pupil's image, as to sensor.distance = "
        "lenslet_array.focal_length, or defocus a little",
    )
