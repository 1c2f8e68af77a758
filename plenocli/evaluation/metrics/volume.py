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
class VolumeScore:
    """Figures of a volume against the truth; see DEFINITIONS. None where it has no bars, or nothing
    was put aside.
    """

    volume_correlation: float
    volume_snr_db: float
    lateral_resolution_m: float
    axial_resolution_m: float
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
    error = scale * found - known
    lateral, axial = resolutions(found, known, spacing)
    return VolumeScore(
        volume_correlation=float(np.corrcoef(found.ravel(), known.ravel())[0, 1]),
        volume_snr_db=float(10 * np.log10((known**2).mean() / (error**2).mean())),
        lateral_resolution_m=lateral,
        axial_resolution_m=axial,
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
