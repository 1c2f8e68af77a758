"""Light from beyond the planes of a volume: much the same behind all lenslets, and so on the
darkest ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.inverse.volume.measurement import Measurement, Problem
from plenocli.inverse.volume.richardson_lucy import richardson_lucy

DARKEST = 0.05
"""Share of the lenslets that are taken for haze alone."""
FEWEST = 4
"""Of them at least."""
KEPT = 0.95
"""Of their light is taken for haze: they are dark by chance too."""
TIE = 0.1
"""dB that held-out pixels must be predicted worse without haze for it to be left: iterations tell
less of it than the linear estimate, which gains 1.2 where they gain nothing.
"""
TRIED = 30
"""Iterations of Richardson-Lucy that show whether it is."""


def haze(measurement: Measurement) -> np.ndarray:
    """Mean superpixel (pixel,) of the darkest lenslets, none below zero; zero where too few
    lenslets are known whole.
    """
    pixels = measurement.signal.shape[2]
    signal = measurement.signal.reshape(-1, pixels)
    whole = signal
    if measurement.usable is not None:
        usable = measurement.usable.reshape(-1, pixels)
        # pixels at the pupil's edge count behind no lenslet
        whole = signal[usable[:, usable.any(axis=0)].all(axis=1)]
    count = max(FEWEST, int(DARKEST * len(whole)))
    if len(whole) < 4 * FEWEST:
        return np.zeros(pixels)
    darkest = np.argsort(whole.sum(axis=1), kind="stable")[:count]
    return KEPT * np.maximum(whole[darkest].mean(axis=0), 0)


def without_haze(problem: Problem, known: np.ndarray) -> Problem:
    """The problem with the haze (pixel,) as its background, unless that predicts held-out pixels
    worse by more than TIE: then as it is.
    """
    hazy = problem.with_measurement(replace(problem.measurement, background=known))
    if not problem.held.any() or not hazy.measurement.offset.any():
        return problem
    as_it_is, taken_off = (_explained(one) for one in (problem, hazy))
    return hazy if taken_off > as_it_is - TIE else problem


def _explained(problem: Problem) -> float:
    """dB of the held-out pixels' variance, after a few iterations."""
    held = richardson_lucy(problem, TRIED).held_out
    assert held is not None
    return held.explained_db
