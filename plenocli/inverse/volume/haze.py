"""Light from beyond the planes of a volume: much the same behind all lenslets, and so on the
darkest ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from plenocli.inverse.volume.measurement import Measurement, Problem
from plenocli.inverse.volume.richardson_lucy import richardson_lucy

DARKEST = 0.05
"""Share of the lenslets that are taken for haze alone."""
FEWEST = 4
"""Of them at least."""
WHOLE = 0.8
"""Of the most pixels that a lenslet has known, from which on it is known whole."""
KEPT = 0.95
"""Of their light is taken for haze: they are dark by chance too."""
TIE = 0.1
"""dB that held-out pixels must be predicted worse without haze for it to be left: iterations tell
less of it than the linear estimate, which gains 1.2 where they gain nothing.
"""
CHANCE = 2.0
"""Standard errors by which it must be worse as well: a colour has but few pixels to tell by."""
TRIED = 30
"""Iterations of Richardson-Lucy that show whether it is."""


def haze(measurement: Measurement) -> np.ndarray:
    """Mean superpixel (pixel,) of the darkest lenslets, none below zero; zero where too few
    lenslets are known whole.
    """
    pixels = measurement.signal.shape[2]
    ever, counts = np.zeros(pixels, bool), []
    for part in measurement.in_bands():
        usable = np.isfinite(part)
        ever |= usable.any(axis=0)
        counts.append(usable.sum(axis=1))
    known = np.concatenate(counts)
    # a colour's pixels are now a few more, now a few less of a superpixel's
    whole = known >= WHOLE * known.max()
    if whole.sum() < 4 * FEWEST:
        return np.zeros(pixels)
    # pixels at the pupil's edge count behind no lenslet
    light, seen = _sums(measurement, whole, ever)
    usual = light / np.maximum(seen, 1)
    if usual.sum() <= 0:  # nothing but dark noise, in which there is no haze
        return np.zeros(pixels)
    level = np.full(len(whole), np.inf)
    for numbers, signal, usable in _chosen(measurement, whole, ever):
        level[numbers] = signal.sum(axis=1) / np.maximum(usable @ usual, np.finfo(float).tiny)
    count = max(FEWEST, int(DARKEST * whole.sum()))
    darkest = np.zeros(len(whole), bool)
    darkest[np.argsort(level, kind="stable")[:count]] = True
    light, seen = _sums(measurement, darkest, ever)
    mean = light / np.maximum(seen, 1)
    return KEPT * np.maximum(np.where(seen > 0, mean, level[darkest].mean() * usual), 0)


def _chosen(
    measurement: Measurement, chosen: np.ndarray, ever: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Of each band of lenslets: the numbers of those that are chosen (lenslet,), their signal, 0
    where it is not known, and which pixels count, all those that are known of no lenslet too.

    chosen: (lenslet,) of all; ever: (pixel,) known of some lenslet.
    """
    first = 0
    for part in measurement.in_bands():
        numbers = np.flatnonzero(chosen[first : first + len(part)])
        signal = part[numbers].astype(float)
        known = np.isfinite(signal)
        signal[~known] = 0
        yield first + numbers, signal, known | ~ever
        first += len(part)


def _sums(
    measurement: Measurement, chosen: np.ndarray, ever: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Light (pixel,) of all chosen lenslets, and how many of them count."""
    light, seen = np.zeros(len(ever)), np.zeros(len(ever), int)
    for _, signal, usable in _chosen(measurement, chosen, ever):
        light += signal.sum(axis=0)
        seen += usable.sum(axis=0)
    return light, seen


def without_haze(problem: Problem, known: np.ndarray) -> Problem:
    """The problem with the haze (pixel,) as its background, unless that predicts held-out pixels
    worse by more than TIE and chance: then as it is.
    """
    hazy = problem.with_measurement(replace(problem.measurement, background=known))
    if not problem.held.any() or not hazy.measurement.offset.any():
        return problem
    as_it_is, taken_off = (_errors(one) for one in (problem, hazy))
    worse = taken_off - as_it_is
    sure = worse.mean() > CHANCE * worse.std() / np.sqrt(worse.size)
    by_more = taken_off.mean() > 10 ** (TIE / 10) * as_it_is.mean()
    return problem if sure and by_more else hazy


def _errors(problem: Problem) -> np.ndarray:
    """(n,) squared errors of the held-out pixels, after a few iterations."""
    held = richardson_lucy(problem, TRIED).held_out
    assert held is not None
    return (held.measured - held.predicted) ** 2
