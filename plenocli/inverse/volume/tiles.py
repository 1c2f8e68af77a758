"""Arrays of lenslets that are too many at once: windows of them, one beside the other."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.device import CPU, Device
from plenocli.base.linear_maps import BlockCirculant, torus_for
from plenocli.base.progress import bar
from plenocli.forward.volume.stack import Stack
from plenocli.inverse.volume import total_variation
from plenocli.inverse.volume.choose import volume_of, volume_of_part
from plenocli.inverse.volume.haze import haze, without_haze
from plenocli.inverse.volume.lattice import map_of, voxels_of
from plenocli.inverse.volume.measurement import SEEN, Measurement, Problem, lots
from plenocli.inverse.volume.volume import HeldOut, Trial, Volume, predictive_sigma

MOST = 10_000
"""Windows, at most."""


@dataclass(frozen=True, kw_only=True)
class Window:
    """Lenslets that are worked on at once, and what their voxels count beside those of other
    windows: rows and columns (start, stop), weights (row,) and (column,).
    """

    rows: slice
    columns: slice
    row_weight: np.ndarray
    column_weight: np.ndarray

    @property
    def weight(self) -> np.ndarray:
        """(row, column)."""
        return np.multiply.outer(self.row_weight, self.column_weight)


class Tiles:
    """A measurement before kernels, in as few windows as the memory has room for.

    stack: the kernels.
    measurement: of all lenslets.
    method: as volume_of takes it.
    hold_out: share of the pixels that are put aside, the same ones in all windows.
    seed: of which ones.
    where: the kernels' file, for messages.
    device: of their map.
    like: (plane, row, column) before all lenslets, as volume_of takes it.

    Windows overlap by the lenslets that a voxel's light reaches, and fade into each other there.
    All have the same size, and so the same map.

    Raises NumericsError where not even the smallest window has room.
    """

    def __init__(
        self,
        stack: Stack,
        measurement: Measurement,
        method: str,
        *,
        hold_out: float,
        seed: int,
        where: str | Path | None = None,
        device: Device = CPU,
        like: np.ndarray | None = None,
    ) -> None:
        self.device, self.like = device, like
        self.stack, self.measurement, self.method = stack, measurement, method
        self._hold_out, self._seed, self._where = hold_out, seed, where
        count = measurement.signal.shape[:2]
        self.windows = _windows(count, self._several(count), _halo(stack))

    def _several(self, count: Sequence[int]) -> tuple[int, int]:
        """Windows along rows and columns: the fewest that fit."""
        halo, reach = _halo(self.stack), self.stack.reach
        pixels, unknowns = self.stack.A.shape[1], len(self.stack.depth) * self.stack.A.shape[2]
        least, best = math.inf, (1, 1)
        for rows in range(1, count[0] + 1):
            for columns in range(1, count[1] + 1):
                if rows * columns >= min(least, MOST):
                    break
                size = _size(count[0], rows, halo), _size(count[1], columns, halo)
                needed = _needed(self.method, pixels, unknowns, torus_for(size, reach))
                if needed <= budget().memory:
                    least, best = rows * columns, (rows, columns)
        if not math.isfinite(least):
            smallest = _size(count[0], count[0], halo), _size(count[1], count[1], halo)
            budget().require(
                _needed(self.method, pixels, unknowns, torus_for(smallest, reach)),
                f"the map of {smallest[0]} x {smallest[1]} lenslets",
                self._where,
                "take fewer planes or voxels",
            )
        return best

    @cached_property
    def _op(self) -> BlockCirculant:
        window = self.windows[0]
        size = len(window.row_weight), len(window.column_weight)
        return map_of(self.stack, size, self.device)

    @cached_property
    def _draw(self) -> np.ndarray:
        return lots(self._seed, self.measurement.signal.shape)

    def problem(self, window: Window) -> Problem:
        """What is seen in one window."""
        at = window.rows, window.columns
        whole = self.measurement
        part = replace(
            whole,
            signal=whole.signal[at],
            usable=None if whole.usable is None else whole.usable[at],
        )
        return Problem(self._op, part, voxels_of(self.stack), self._hold_out, draw=self._draw[at])

    @cached_property
    def brightest(self) -> Window:
        """The window in which there is most to see, by the variance of its lenslets."""
        usable = self.measurement.usable
        signal = self.measurement.signal
        light = (signal if usable is None else np.where(usable, signal, 0)).sum(axis=2)
        return max(self.windows, key=lambda w: float(light[w.rows, w.columns].var()))

    def of(self, stack: Stack) -> Problem:
        """The brightest window before other kernels, the same pixels put aside."""
        other = copy(self)
        other.stack = stack
        vars(other).pop("_op", None)  # of these kernels
        return other.problem(self.brightest)

    def without_haze(self) -> float:
        """Take the haze that the darkest lenslets show off the measurement, where that predicts
        the held-out pixels of the brightest window better.

        Returns its share of the light, 0 where it was left.
        """
        known = haze(self.measurement)
        problem = without_haze(self.problem(self.brightest), known)
        self.measurement = replace(self.measurement, background=problem.measurement.background)
        taken = float(problem.measurement.offset[problem.counts].mean())
        return taken / float(problem.measurement.signal[problem.counts].mean()) if taken else 0.0

    def volume(self) -> Volume:
        """The volume of all windows; the brightest one decides what "auto" takes and
        whether error bars follow the specimen.

        Raises as volume_of.
        """
        if len(self.windows) == 1:
            return volume_of(self.problem(self.windows[0]), self.method, self.like)
        first = volume_of(self.problem(self.brightest), self.method, self._like(self.brightest))
        found = [
            first if w is self.brightest else volume_of_part(self.problem(w), first, self._like(w))
            for w in bar(self.windows, len(self.windows), "windows")
        ]
        return self._joined(found)

    def _like(self, window: Window) -> np.ndarray | None:
        """What the volume of a window is to be like."""
        return None if self.like is None else self.like[(slice(None), *self._voxels(window))]

    def _voxels(self, window: Window) -> tuple[slice, slice]:
        """Rows and columns of a window's voxels."""
        s, t = self.stack.point_shape
        rows, columns = window.rows, window.columns
        return slice(rows.start * s, rows.stop * s), slice(columns.start * t, columns.stop * t)

    def _joined(self, parts: Sequence[Volume]) -> Volume:
        rows, columns = self.measurement.signal.shape[:2]
        s, t = self.stack.point_shape
        weights = np.zeros((rows * s, columns * t))
        shape = (len(self.stack.depth), *weights.shape)
        value = np.zeros(shape, parts[0].value.dtype)
        sigma = None if parts[0].sigma is None else np.zeros_like(value)
        owner, most = np.zeros((rows, columns), int), np.zeros((rows, columns))
        for number, (window, part) in enumerate(zip(self.windows, parts)):
            voxels = self._voxels(window)
            weight = np.kron(window.weight, np.ones((s, t))).astype(value.dtype)
            weights[voxels] += weight
            value[(slice(None), *voxels)] += weight * part.value
            if sigma is not None and part.sigma is not None:
                sigma[(slice(None), *voxels)] += weight * part.sigma
            at = window.rows, window.columns
            better = window.weight > most[at]
            owner[at] = np.where(better, number, owner[at])
            most[at] = np.maximum(most[at], window.weight)
        value /= weights
        if sigma is not None:
            sigma /= weights
        return replace(
            parts[0],
            value=value,
            sigma=sigma,
            trace=tuple(
                Trial(f"window {number}, {part.trace[-1].what}", part.trace[-1].misfit)
                for number, part in enumerate(parts, 1)
            ),
            background=float(np.mean([part.background for part in parts])),
            prior=_mean_of([part.prior for part in parts if part.prior is not None]),
            held_out=self._held(parts, owner),
            likeness=_mean_of([part.likeness for part in parts if part.likeness is not None]),
        )

    def _held(self, parts: Sequence[Volume], owner: np.ndarray) -> HeldOut | None:
        """Every pixel that was put aside, as the window predicts it in which it is innermost."""
        index, measured, predicted = [], [], []
        for number, (window, part) in enumerate(zip(self.windows, parts)):
            if part.held_out is None:
                return None
            places = part.held_out.index + [window.rows.start, window.columns.start, 0]
            own = owner[places[:, 0], places[:, 1]] == number
            index.append(places[own])
            measured.append(part.held_out.measured[own])
            predicted.append(part.held_out.predicted[own])
        seen, told = np.concatenate(measured), np.concatenate(predicted)
        return HeldOut(
            index=np.concatenate(index),
            measured=seen,
            predicted=told,
            sigma=predictive_sigma(seen, told),
        )


def _mean_of(parts: Sequence[Any]) -> Any:
    """What has numbers for fields, with their means; None of nothing."""
    if not parts:
        return None
    names = vars(parts[0])
    return type(parts[0])(**{n: float(np.mean([vars(p)[n] for p in parts])) for n in names})


def _halo(stack: Stack) -> int:
    """Lenslets on each side that get SEEN of every voxel's light."""
    away = np.abs(stack.lenslet_offset).max(axis=1)
    light = stack.A.sum(axis=1, dtype=float)
    for halo in range(int(away.max()) + 1):
        near = away <= halo
        seen = [light[near & (stack.plane == z)].sum(axis=0).min() for z in range(len(stack.depth))]
        if np.all(np.array(seen) >= SEEN * stack.column_energy.min(axis=1)):
            return halo
    return int(away.max())


def _size(count: int, several: int, halo: int) -> int:
    """Lenslets along an axis of each of several windows."""
    return min(count, math.ceil((count - 2 * halo) / several) + 2 * halo) if several > 1 else count


def _windows(count: Sequence[int], several: tuple[int, int], halo: int) -> list[Window]:
    """Windows of one size, row by row."""
    axes = []
    for n, many in zip(count, several):
        size = _size(n, many, halo)
        starts = sorted({round(i * (n - size) / max(many - 1, 1)) for i in range(many)})
        axes.append([(slice(a, a + size), _weights(a, size, n, halo)) for a in starts])
    return [
        Window(rows=rows, columns=columns, row_weight=down, column_weight=right)
        for rows, down in axes[0]
        for columns, right in axes[1]
    ]


def _weights(start: int, size: int, count: int, halo: int) -> np.ndarray:
    """(lenslet,) 1 inside a window, falling to nothing half a halo from where it ends, unless the
    array ends there.
    """
    place = np.arange(size)
    before = place if start > 0 else np.full(size, count)
    after = size - 1 - place if start + size < count else np.full(size, count)
    fade = max(1, halo // 2)
    inside = np.minimum(before, after) + 0.5 - (halo - fade)
    return np.clip(inside / (2 * fade), 1e-6, 1.0)


def _needed(method: str, pixels: int, unknowns: int, torus: tuple[int, int]) -> int:
    """Bytes that a method takes on a torus, in single precision."""
    frequencies = torus[0] * (torus[1] // 2 + 1)
    whole = BlockCirculant.needed(pixels, unknowns, torus)
    arrays = 48 * torus[0] * torus[1] * (pixels + unknowns)
    gain = 8 * frequencies * pixels * unknowns + 128 * unknowns * (unknowns + pixels)
    most = {"rl": arrays, "lmmse": arrays + gain, "tikhonov": arrays + gain}
    most["tv"] = total_variation.memory(torus, pixels, unknowns)
    return whole + (max(most.values()) if method == "auto" else most[method])
