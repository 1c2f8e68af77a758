"""How near a volume comes to the one that is known, and to the pixels that were put aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.text import by

BARS = 1.959964
"""Standard deviations that hold 95 % of normal errors."""
ALIKE = 1 / 7
"""Fourier shell correlation up to which two volumes count as alike."""
HALF, ROUND = 0.5, 3.0
"""Of its light, at which a bead ends, and how many times longer than wide it may be."""
MOST_BEADS = 500
"""That are measured."""
BRIGHT = 0.1
"""Of the brightest voxel, from which on a voxel is the object's."""

DEFINITIONS = {
    "volume_correlation": "correlation with the truth, voxel by voxel",
    "volume_snr_db": (
        "mean square of the truth over that of the error, after one scale for all voxels, dB"
    ),
    "lateral_resolution_m": (
        "period across the axis from which on the Fourier shell correlation with the truth is "
        "below 1/7"
    ),
    "axial_resolution_m": "the same along the axis",
    "bead_width_m": (
        "full width at half maximum across the axis at the truth's beads, the median: its "
        "brightest places from which it falls to half in all directions, at most three times as "
        "far in one as in another; NaN where it falls to half at none of them"
    ),
    "bead_depth_m": "the same along the axis",
    "volume_z_rms": "root mean square of error over stated standard deviation",
    "volume_coverage": "share of the voxels within their 95 % bars",
    "object_coverage": "the same of those above a tenth of the brightest",
    "held_out_db": "of the variance of pixels that were put aside, dB",
    "held_out_coverage": "share of them within 95 % bars, by quartile of brightness",
}


@dataclass(frozen=True, kw_only=True)
class BarsScore:
    """How well the error bars hold; see DEFINITIONS."""

    volume_z_rms: float
    volume_coverage: float
    object_coverage: float


@dataclass(frozen=True, kw_only=True)
class BeadsScore:
    """How wide beads are; see DEFINITIONS."""

    bead_width_m: float
    bead_depth_m: float


@dataclass(frozen=True, kw_only=True)
class VolumeScore:
    """Figures of a volume against the truth; see DEFINITIONS. None where it has no bars, or nothing
    was put aside.
    """

    volume_correlation: float
    volume_snr_db: float
    lateral_resolution_m: float
    axial_resolution_m: float
    beads: BeadsScore | None = None
    bars: BarsScore | None = None
    held_out_db: float | None = None
    held_out_coverage: list[float] | None = None


def score_volume(
    value: np.ndarray,
    truth: np.ndarray,
    spacing: tuple[float, float, float],
    *,
    sigma: np.ndarray | None = None,
    held_out_db: float | None = None,
    held_out_coverage: list[float] | None = None,
) -> VolumeScore:
    """Score a volume.

    value, truth, sigma: (plane, row, column).
    spacing: m between planes, rows and columns.
    held_out_db, held_out_coverage: as the volume says itself.

    Raises InputError where the two differ in size, or one is the same everywhere.
    """
    if value.shape != truth.shape:
        raise InputError(
            f"has {by(value.shape)} voxels, the truth {by(truth.shape)}",
            fix="compare volumes of the same planes and lenslets",
        )
    found, known = value.astype(float), truth.astype(float)
    if not (np.ptp(found) > 0 and np.ptp(known) > 0):
        raise InputError("is the same everywhere, or its truth is", fix="check both files")
    scale = float((found * known).sum() / (found**2).sum())
    power = float((known**2).mean())
    missed = max(float(((scale * found - known) ** 2).mean()), 1e-30 * power)
    lateral, axial = resolutions(found, known, spacing)
    return VolumeScore(
        volume_correlation=float(np.corrcoef(found.ravel(), known.ravel())[0, 1]),
        volume_snr_db=float(10 * np.log10(power / missed)),
        lateral_resolution_m=lateral,
        axial_resolution_m=axial,
        beads=_beads(found, known, spacing),
        bars=None if sigma is None else _bars(found - known, known, sigma.astype(float)),
        held_out_db=held_out_db,
        held_out_coverage=held_out_coverage,
    )


def _bars(error: np.ndarray, truth: np.ndarray, sigma: np.ndarray) -> BarsScore:
    z = np.abs(error) / np.maximum(sigma, np.finfo(float).tiny)
    bright = truth > BRIGHT * truth.max()
    return BarsScore(
        volume_z_rms=float(np.sqrt(np.mean(z**2))),
        volume_coverage=float(np.mean(z < BARS)),
        object_coverage=float(np.mean(z[bright] < BARS)) if bright.any() else float("nan"),
    )


def _beads(
    found: np.ndarray, truth: np.ndarray, spacing: tuple[float, float, float]
) -> BeadsScore | None:
    """Widths of a volume where the truth has beads; None where it has none."""
    from scipy.ndimage import maximum_filter

    peaks = (truth == maximum_filter(truth, 5)) & (truth > HALF * truth.max())
    widths = []
    for place in np.argwhere(peaks)[:MOST_BEADS]:
        true = _widths(truth, place, spacing)
        if np.all(np.isfinite(true)) and true.max() <= ROUND * true.min():
            widths.append(_widths(found, place, spacing))
    if not widths:
        return None
    depth, rows, columns = (
        float(np.median(axis[np.isfinite(axis)])) if np.isfinite(axis).any() else float("nan")
        for axis in np.array(widths).T
    )
    return BeadsScore(bead_width_m=float(np.sqrt(rows * columns)), bead_depth_m=depth)


def _widths(
    volume: np.ndarray, place: np.ndarray, spacing: tuple[float, float, float]
) -> np.ndarray:
    """Full widths at half maximum (3,) m through the voxel at `place`; infinite where the volume
    ends before.
    """
    widths = []
    for axis, step in enumerate(spacing):
        line = np.moveaxis(volume, axis, 0)[(slice(None), *np.delete(place, axis))]
        middle = int(place[axis])
        half, width = HALF * line[middle], 0.0
        for side in (line[middle::-1], line[middle:]):
            below = np.flatnonzero(side <= half)
            if not below.size or half <= 0:
                width = np.inf
                break
            last = int(below[0])
            width += last - (half - side[last]) / (side[last - 1] - side[last])
        widths.append(width * step)
    return np.array(widths)


def resolutions(
    found: np.ndarray, truth: np.ndarray, spacing: tuple[float, float, float]
) -> tuple[float, float]:
    """Periods (m) across and along the axis from which on shells of the two volumes' Fourier
    transforms correlate below ALIKE; that of the voxels where they do everywhere.

    Shells are cylinders across the axis and pairs of planes along it. van Heel and Schatz 2005.
    """
    a, b = (np.fft.fftn(volume - volume.mean()) for volume in (found, truth))
    z, y, x = np.meshgrid(
        *(np.fft.fftfreq(n, d) for n, d in zip(found.shape, spacing)), indexing="ij"
    )
    across = np.hypot(y, x)
    widths = (1 / (max(found.shape[1:]) * max(spacing[1:])), 1 / (found.shape[0] * spacing[0]))
    tops = (0.5 / max(spacing[1:]), 0.5 / spacing[0])
    lateral, axial = (
        _limit(a, b, frequency, width, top)
        for frequency, width, top in zip((across, np.abs(z)), widths, tops)
    )
    return lateral, axial


def _limit(a: np.ndarray, b: np.ndarray, frequency: np.ndarray, width: float, top: float) -> float:
    """Period of the first shell whose correlation is below ALIKE."""
    shell = np.rint(frequency / width).astype(int)
    inside = frequency <= top
    count = int(shell[inside].max()) + 1

    def summed(values: np.ndarray) -> np.ndarray:
        return np.bincount(shell[inside], values[inside], count)

    together = summed((a * b.conj()).real)
    alone = np.sqrt(summed(np.abs(a) ** 2) * summed(np.abs(b) ** 2))
    correlation = np.divide(together, alone, out=np.zeros(count), where=alone > 0)
    below = np.flatnonzero(correlation[1:] < ALIKE)
    return 1 / ((below[0] + 1) * width) if below.size else 1 / top
