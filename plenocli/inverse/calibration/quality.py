"""How well responses tell their bands apart."""

from __future__ import annotations

import numpy as np

from plenocli.inverse.calibration.calibration import Quality
from plenocli.inverse.spectra.demultiplex import (
    calibration_bias,
    choose_pixels,
    column_angles,
    condition_number,
)

BLOCK = 256
"""Lenslets that are looked at together."""
BIAS_SAMPLE = 32
"""Lenslets at least on which the bias is told."""


def mean_of_known(values: np.ndarray) -> np.ndarray:
    """Mean over the first axis of the values known; NaN where none is."""
    known = np.isfinite(values)
    with np.errstate(invalid="ignore"):
        return (np.where(known, values, 0).sum(axis=0, dtype=float) / known.sum(axis=0)).astype(
            np.float32
        )


def quality_of_one(response: np.ndarray) -> Quality:
    """Quality of a response (pixel, band) that has no noise."""
    angles = np.asarray(column_angles(response), float)
    return Quality(
        condition=float(condition_number(response)),
        angles=[[float(a) for a in row] for row in angles],
        single_pixel=[int(p) for p in choose_pixels(response)],
    )


def quality_of(
    response: np.ndarray, variance: np.ndarray | None, valid: np.ndarray
) -> tuple[Quality, float | None]:
    """Quality of measured responses, medians over lenslets.

    response: (lenslet_row, lenslet_column, pixel, band), or (pixel, band) for all.
    variance: (pixel, band) of its entries; None: unknown.
    valid: (lenslet_row, lenslet_column), which lenslets count.

    Returns Quality, and the smallest angle between two columns of any F, degrees (None: one band).
    """
    sample = (
        response[None]
        if response.ndim == 2
        else response[valid]
        if not valid.all()
        else response.reshape(-1, *response.shape[-2:])
    )
    blocks = [sample[first : first + BLOCK] for first in range(0, len(sample), BLOCK)]
    condition = np.concatenate([condition_number(one) for one in blocks])
    angles = np.concatenate([column_angles(one) for one in blocks])
    between = angles[(slice(None), *np.triu_indices(response.shape[-1], 1))]
    bias = None
    if variance is not None:
        matrices = calibration_bias(sample[:: max(1, len(sample) // BIAS_SAMPLE)], variance)
        bias = np.median(np.diagonal(matrices, axis1=-2, axis2=-1), axis=0).tolist()
    quality = Quality(
        condition=float(np.median(condition)),
        angles=np.median(angles, axis=0).tolist(),
        single_pixel=[int(p) for p in choose_pixels(mean_of_known(sample))],
        bias=bias,
    )
    return quality, float(between.min()) if between.size else None
