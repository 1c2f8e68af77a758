"""What a system matrix can and cannot tell apart: rank, condition, symmetry, energy.

If the pupil is point-symmetric, the object in focus and the pupil imaged onto the sensor (eps =
kappa = W = 0), object points at +x and -x give the same superpixel of an isolated lenslet: half of
the object is invisible (docs/model.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.propagation.symmetry import superpixel_orbits

if TYPE_CHECKING:
    from plenocli.forward.propagation.system_matrix import SystemMatrix

RANK_THRESHOLD = 1e-6
"""Singular values below this share of the largest do not count towards the rank: the rounding of
a single-precision A.
"""
NOISE_THRESHOLD = 1e-3
"""Singular values above this share stand out of noise at 60 dB."""
SYMMETRY_WARNING = 1e-3
"""Symmetry defects below this are worth a warning: the antisymmetric half of the
object is all but lost.
"""
LARGEST = 4000
"""Above this many object points singular values are left out: they would take minutes."""
_DIRECT = 400
_ROWS = 1024
_RESOLUTION = 3e-8


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """What a system matrix can tell apart, by band; None where that was left out.

    energy_min, energy_max: of the columns;
    symmetry_defect: of the object's own superpixel, None where only some points were computed;
    singular_values: (band, value) descending, None (as the next three) above 4000 points;
    rank: singular values above RANK_THRESHOLD of the largest;
    rank_60db: those above NOISE_THRESHOLD of it;
    condition: largest over smallest, a lower bound where the smallest is under 3e-8 of it;
    warnings: a sentence each.
    """

    energy_min: list[float]
    energy_max: list[float]
    symmetry_defect: list[float] | None = None
    singular_values: np.ndarray | None = None
    rank: list[int] | None = None
    rank_60db: list[int] | None = None
    condition: list[float] | None = None
    warnings: tuple[str, ...] = ()


class Spectrum:
    """Singular values of a matrix that comes in pieces of rows, through A^T A in double precision.

    object_shape: (rows, columns) of points;
    flips: (rows, columns) whether turning the object over changes the whole matrix by a permutation
        of its rows only: A^T A then falls into blocks for points even and odd in that direction.
    """

    def __init__(
        self, object_shape: tuple[int, int], flips: Sequence[bool] = (False, False)
    ) -> None:
        self._shape, self._flips = tuple(object_shape), flips
        self._grams: list[np.ndarray] = []

    def add(self, part: np.ndarray, times: int = 1, turned: int = 0) -> None:
        """Add rows of the matrix.

        part: (..., point);
        times: how often;
        turned: how often with rows and columns of points exchanged.
        """
        part = part.reshape(-1, *self._shape)
        grams: list[np.ndarray] = []
        for start in range(0, len(part), _ROWS):
            blocks = [part[start : start + _ROWS].astype(float)]
            for axis, flip in enumerate(self._flips, 1):
                blocks = (
                    [half for block in blocks for half in _parities(block, axis)]
                    if flip
                    else blocks
                )
            shapes = [block.shape[1:] for block in blocks]
            blocks = [block.reshape(len(block), -1) for block in blocks]
            grams = _added(grams, [block.T @ block for block in blocks])
        # exchanging rows and columns exchanges even-odd with odd-even
        pairs = [0, 2, 1, 3] if len(grams) == 4 else range(len(grams))
        total = [times * gram for gram in grams]
        if turned:
            total = _added(total, [turned * _exchanged(grams[k], shapes[k]) for k in pairs])
        self._grams = _added(self._grams, total)

    def values(self) -> np.ndarray:
        """Singular values, descending; those under 3e-8 of the largest are
        reported as that bound.
        """
        values = np.sort(np.concatenate([np.linalg.eigvalsh(gram) for gram in self._grams]))[::-1]
        return np.sqrt(np.maximum(values, _RESOLUTION**2 * max(values[0], 0)))


def _added(total: list[np.ndarray], parts: list[np.ndarray]) -> list[np.ndarray]:
    """Sums of arrays, where there is something to add to already."""
    return [old + new for old, new in zip(total, parts)] if total else parts


def _exchanged(gram: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The Gram matrix of points (rows, columns) as one of points (columns, rows)."""
    rows, columns = shape
    return gram.reshape(rows, columns, rows, columns).transpose(1, 0, 3, 2).reshape(gram.shape)


def _parities(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Parts even and odd under reversal of an axis, in orthonormal coordinates."""
    low, high = np.array_split(values, [(values.shape[axis] + 1) // 2], axis)
    count = high.shape[axis]
    first, middle = np.array_split(low, [count], axis)
    mirrored = np.flip(high, axis)
    return np.concatenate([(first + mirrored) * np.sqrt(0.5), middle], axis), (
        first - mirrored
    ) * np.sqrt(0.5)


def singular_values(matrix: np.ndarray) -> np.ndarray:
    """Singular values (descending, float64) of one band, (..., point): rows may have
    any leading shape.

    Small matrices by LAPACK; larger ones as Spectrum does it, which resolves values down to
    3e-8 of the largest.
    """
    matrix = matrix.reshape(-1, matrix.shape[-1])
    if matrix.shape[1] <= _DIRECT or len(matrix) < matrix.shape[1]:
        return np.linalg.svd(matrix.astype(float), compute_uv=False)
    spectrum = Spectrum((1, matrix.shape[1]))
    spectrum.add(matrix)
    return spectrum.values()


def symmetry_defect(own: np.ndarray) -> float:
    """max |A - A'| / max |A| for one superpixel's rows `own` (pixel, point); A' is A for the
    object turned by 180 degrees.
    """
    peak = np.abs(own).max()
    half = (own.shape[1] + 1) // 2
    return float(np.abs(own[:, :half] - own[:, ::-1][:, :half]).max() / peak) if peak > 0 else 0.0


class PiecewiseDiagnosis:
    """The Diagnosis of a matrix that comes superpixel by superpixel.

    Only the first superpixel of each orbit is looked at (superpixel_orbits), and only half of one
    that mirrors itself: the others hold the same light.
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
        self._pixel_shape = tuple(pixel_shape)
        self._mirrors = (
            (np.asarray(offsets) == 0)
            & np.array(symmetry[:2])
            & (np.array(self._pixel_shape) % 2 == 0)
        )
        self._own = int(np.flatnonzero((np.asarray(offsets) == 0).all(axis=1))[0])
        self._times = {
            first: (sum(not how[0] for _, how in members), sum(how[0] for _, how in members))
            for first, members in superpixel_orbits(offsets, symmetry)
        }
        self._spectra = [Spectrum(object_shape, symmetry[:2]) for _ in range(bands)]
        self._defects = [0.0] * bands
        self._few = int(np.prod(object_shape)) <= LARGEST

    def add(self, band: int, superpixel: int, slab: np.ndarray) -> None:
        """Take one piece into account.

        band, superpixel: numbers of the piece;
        slab: A of it, (pixel, point).
        """
        if superpixel == self._own:
            self._defects[band] = symmetry_defect(slab)
        if self._few and superpixel in self._times:
            rows, columns = (
                n // 2 if mirrors else n
                for n, mirrors in zip(self._pixel_shape, self._mirrors[superpixel])
            )
            part = slab.reshape(*self._pixel_shape, -1)[:rows, :columns]
            self._spectra[band].add(
                part,
                *(n * 2 ** int(self._mirrors[superpixel].sum()) for n in self._times[superpixel]),
            )

    def result(self, energy: np.ndarray) -> Diagnosis:
        """What was found, for column energies (band, point)."""
        values = np.array([spectrum.values() for spectrum in self._spectra]) if self._few else None
        return _diagnosis(energy, self._defects, values)


def describe(matrix: SystemMatrix) -> Diagnosis:
    """Diagnose a system matrix that is held whole."""
    if matrix.A is None:
        raise ValueError("a matrix in pieces is diagnosed by PiecewiseDiagnosis")
    points = matrix.A.shape[-1]
    whole = points == int(np.prod(matrix.object_shape))
    if whole and points > _DIRECT:
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
    own = int(np.flatnonzero((np.asarray(matrix.lenslet_offset) == 0).all(axis=1))[0])
    return _diagnosis(
        matrix.column_energy,
        [symmetry_defect(band[own]) for band in matrix.A] if whole else None,
        np.array([singular_values(band) for band in matrix.A]) if points <= LARGEST else None,
    )


def _diagnosis(
    energy: np.ndarray, defects: list[float] | None, values: np.ndarray | None
) -> Diagnosis:
    """The Diagnosis of column energies (band, point), symmetry defects by band and singular
    values (band, value).
    """
    found = Diagnosis(
        energy_min=energy.min(axis=1).tolist(),
        energy_max=energy.max(axis=1).tolist(),
        symmetry_defect=defects,
        warnings=_warnings(energy, defects),
    )
    if values is None:
        return found
    top = np.maximum(values[:, :1], np.finfo(float).tiny)
    with np.errstate(divide="ignore"):
        condition = [float(c) for c in top[:, 0] / values[:, -1]]
    return replace(
        found,
        singular_values=values,
        rank=[int(n) for n in (values > RANK_THRESHOLD * top).sum(axis=1)],
        rank_60db=[int(n) for n in (values > NOISE_THRESHOLD * top).sum(axis=1)],
        condition=condition,
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
