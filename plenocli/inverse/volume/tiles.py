"""Arrays of lenslets that are too many at once: windows of them, one beside the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.device import CPU, Device
from plenocli.base.linear_maps import BlockCirculant, torus_for
from plenocli.base.progress import bar
from plenocli.base.tiling import Room, bands
from plenocli.forward.volume.stack import Stack
from plenocli.inverse.volume import total_variation
from plenocli.inverse.volume.choose import as_before, volume_of
from plenocli.inverse.volume.haze import haze, without_haze
from plenocli.inverse.volume.lattice import map_of, voxels_of
from plenocli.inverse.volume.measurement import AT_ONCE, SEEN, Measurement, Problem, put_aside
from plenocli.inverse.volume.volume import HeldOut, Trial, Volume, predictive_sigma

MOST = 10_000
"""Windows, at most."""
FULL = 0.92
"""Of the memory of the largest windows that fit, what windows take at least: it is then much the
same for all sensors.
"""
DEARER = 1.5
"""Times the least work, above which smaller windows are taken after all."""
HELD_BYTES = 12
"""Memory for a pixel that was put aside, while windows are worked on."""
Keep = Callable[[int, Callable[[], Volume]], Volume]
"""What gives the volume of the window of a number: as an earlier run left it, or as it is made."""


def made(number: int, make: Callable[[], Volume]) -> Volume:
    """A Keep that keeps nothing."""
    return make()


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
    """A measurement before kernels, in one window or as many as the memory makes necessary.

    stack: the kernels.
    measurement: of all lenslets.
    method: as volume_of takes it.
    hold_out: share of the pixels that are put aside, the same ones in all windows.
    seed: of which ones.
    where: the kernels' file, for messages.
    device: of their map.
    like: (plane, row, column) before all lenslets, as volume_of takes it; may stay in a file.
    room: for the volume, plane by plane, that windows are joined to; zero at first.
    keep: of the volumes of several windows, an attribute; nothing is kept where it is not set.

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
        like: Any = None,
        room: Room = np.zeros,
    ) -> None:
        self.device, self.like, self.room = device, like, room
        self.stack, self.measurement, self.method = stack, measurement, method
        self._hold_out, self._seed, self._where = hold_out, seed, where
        self.keep: Keep = made
        count = measurement.signal.shape[:2]
        self.windows = _windows(count, self._side(count), _halo(stack))

    def _side(self, count: Sequence[int]) -> tuple[int, int]:
        """Lenslets (rows, columns) of a window: all where they fit, else, of the windows that take
        nearly as much memory as the largest that fit, those that are the least work.
        """
        halo, reach = _halo(self.stack), self.stack.reach
        pixels, planes = self.stack.A.shape[1], len(self.stack.depth)
        unknowns = planes * self.stack.A.shape[2]
        kept = HELD_BYTES * self._hold_out * math.prod(count) * pixels + self.stack.A.nbytes

        def needed(side: tuple[int, int]) -> float:
            torus = torus_for(side, reach)
            return kept + _needed(self.method, pixels, unknowns, planes, torus)

        every, smallest = (count[0], count[1]), (_least(count[0], halo), _least(count[1], halo))
        if needed(every) <= budget().memory:
            return every
        fitting = dict[tuple[int, int], tuple[float, int]]()
        for rows in _sides(count[0], halo, lambda n: torus_for((n, 1), reach)[0]):
            for columns in _sides(count[1], halo, lambda n: torus_for((1, n), reach)[1]):
                side = rows, columns
                if (taken := needed(side)) > budget().memory:
                    break
                several = math.prod(_several(n, s, halo) for n, s in zip(count, side))
                if several <= MOST:
                    fitting[side] = taken, several * math.prod(torus_for(side, reach))
        if not fitting:
            budget().require(
                max(needed(smallest), budget().memory + 1),
                f"the map of {smallest[0]} x {smallest[1]} lenslets",
                self._where,
                "take fewer planes or voxels",
            )
        least, most = (pick(row[n] for row in fitting.values()) for n, pick in ((1, min), (0, max)))
        full = [side for side, (taken, _) in fitting.items() if taken >= FULL * most]
        side = min(full, key=lambda side: fitting[side][1])
        if fitting[side][1] > DEARER * least:
            return min(fitting, key=lambda side: fitting[side][1])
        return side

    @cached_property
    def _op(self) -> BlockCirculant:
        window = self.windows[0]
        size = len(window.row_weight), len(window.column_weight)
        return map_of(self.stack, size, self.device)

    def problem(self, window: Window) -> Problem:
        """What is seen in one window."""
        at = window.rows, window.columns
        aside = put_aside(self._hold_out, self._seed, self.measurement.signal.shape, *at)
        return Problem(self._op, self.measurement.window(*at), voxels_of(self.stack), aside=aside)

    @cached_property
    def brightest(self) -> Window:
        """The window in which there is most to see, by the variance of its lenslets."""
        sums = [np.nansum(part, axis=1, dtype=float) for part in self.measurement.in_bands()]
        light = np.concatenate(sums).reshape(self.measurement.signal.shape[:2])
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
            only = self.windows[0]
            found = volume_of(self.problem(only), self.method, self._like(only))
            del self._op
            return found
        brightest, like = self.brightest, self._like(self.brightest)
        best = next(n for n, window in enumerate(self.windows) if window is brightest)
        first = self.keep(best, lambda: volume_of(self.problem(brightest), self.method, like))
        again, joined = as_before(first), _Joined(self, bars=first.sigma is not None)

        def make(window: Window) -> Volume:
            return again(self.problem(window), self._like(window))

        for number, window in enumerate(bar(self.windows, len(self.windows), "windows")):
            part = first if number == best else self.keep(number, partial(make, window))
            joined.add(number, part)
        vars(self).pop("_op", None)  # its memory is that of all pixels that were put aside
        return joined.volume()

    def _like(self, window: Window) -> np.ndarray | None:
        """What the volume of a window is to be like."""
        return None if self.like is None else self.like[(slice(None), *self.voxels(window))]

    def voxels(self, window: Window) -> tuple[slice, slice]:
        """Rows and columns of a window's voxels."""
        s, t = self.stack.point_shape
        rows, columns = window.rows, window.columns
        return slice(rows.start * s, rows.stop * s), slice(columns.start * t, columns.stop * t)


class _Joined:
    """The volume of all windows, to which each adds its own as it comes.

    tiles: the windows.
    bars: whether their volumes have a sigma.
    """

    def __init__(self, tiles: Tiles, *, bars: bool) -> None:
        self._tiles = tiles
        rows, columns = tiles.measurement.signal.shape[:2]
        s, t = tiles.stack.point_shape
        shape = len(tiles.stack.depth), rows * s, columns * t
        self._value = tiles.room(shape)
        self._sigma = tiles.room(shape) if bars else None
        weights, self._owner = np.zeros((rows, columns)), np.zeros((rows, columns), np.int32)
        most = np.zeros((rows, columns))
        for number, window in enumerate(tiles.windows):
            at, weight = (window.rows, window.columns), window.weight
            weights[at] += weight
            self._owner[at] = np.where(weight > most[at], number, self._owner[at])
            most[at] = np.maximum(most[at], weight)
        self._weights = weights
        self._told: list[Volume] = []
        self._aside: list[tuple[np.ndarray, ...]] = []

    def add(self, number: int, part: Volume) -> None:
        """Take in the volume of the window of a number, one after the other."""
        window = self._tiles.windows[number]
        at = slice(None), *self._tiles.voxels(window)
        share = window.weight / self._weights[window.rows, window.columns]
        weight = np.kron(share, np.ones(self._tiles.stack.point_shape)).astype(part.value.dtype)
        self._value[at] += weight * part.value
        if self._sigma is not None and part.sigma is not None:
            self._sigma[at] += weight * part.sigma
        if part.held_out is not None:
            self._aside.append(self._own(number, part.held_out))
        nothing = np.empty((0, 0, 0))
        self._told.append(replace(part, value=nothing, sigma=None, held_out=None))

    def _own(self, number: int, held: HeldOut) -> tuple[np.ndarray, ...]:
        """Of the pixels that were put aside in a window, as far as it is the one in which they are
        innermost: their numbers before all lenslets, measured and predicted.
        """
        window, shape = self._tiles.windows[number], self._tiles.measurement.signal.shape
        row, column, pixel = held.index.T
        places = row + window.rows.start, column + window.columns.start, pixel
        own = self._owner[places[:2]] == number
        flat = np.ravel_multi_index(tuple(place[own] for place in places), shape)
        values = (values[own].astype(np.float32) for values in (held.measured, held.predicted))
        return flat.astype(np.min_scalar_type(math.prod(shape))), *values

    def volume(self) -> Volume:
        """That of all windows."""
        parts = self._told
        return replace(
            parts[0],
            value=self._value,
            sigma=self._sigma,
            trace=tuple(
                Trial(f"window {number}, {part.trace[-1].what}", part.trace[-1].misfit)
                for number, part in enumerate(parts, 1)
            ),
            background=float(np.mean([part.background for part in parts])),
            prior=_mean_of([part.prior for part in parts if part.prior is not None]),
            held_out=self._held() if len(self._aside) == len(parts) else None,
            likeness=_mean_of([part.likeness for part in parts if part.likeness is not None]),
        )

    def _held(self) -> HeldOut:
        """Every pixel that was put aside."""
        flat, measured, predicted = (np.concatenate(parts) for parts in zip(*self._aside))
        self._aside.clear()
        index = np.empty((len(flat), 3), np.int32)
        for some in bands(len(flat), AT_ONCE):
            places = np.unravel_index(flat[some], self._tiles.measurement.signal.shape)
            index[some] = np.stack(places, axis=1)
        return HeldOut(
            index=index,
            measured=measured,
            predicted=predicted,
            sigma=predictive_sigma(measured, predicted),
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


def _least(count: int, halo: int) -> int:
    """Lenslets along an axis of the smallest windows."""
    return min(count, 2 * halo + 1)


def _several(count: int, side: int, halo: int) -> int:
    """Windows of `side` lenslets along an axis of `count`."""
    return 1 if side >= count else math.ceil((count - 2 * halo) / (side - 2 * halo))


def _sides(count: int, halo: int, torus: Callable[[int], int]) -> list[int]:
    """Lenslets along an axis of windows, rising: of those on a torus of one length the largest."""
    largest = {torus(n): n for n in range(_least(count, halo), count + 1)}
    return sorted(largest.values())


def _windows(count: Sequence[int], side: tuple[int, int], halo: int) -> list[Window]:
    """Windows of one size, row by row."""
    axes = []
    for n, size in zip(count, side):
        many = _several(n, size, halo)
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


def _needed(method: str, pixels: int, unknowns: int, planes: int, torus: tuple[int, int]) -> int:
    """Bytes that a method takes on a torus, in single precision; unknowns: of all planes."""
    frequencies = torus[0] * (torus[1] // 2 + 1)
    spectrum, making = BlockCirculant.needed(pixels, unknowns, torus, parts=planes)
    arrays = 48 * torus[0] * torus[1] * (pixels + unknowns)
    gain = 8 * frequencies * pixels * unknowns + 128 * unknowns * (unknowns + pixels)
    most = {"rl": arrays, "lmmse": arrays + gain, "tikhonov": arrays + gain}
    most["tv"] = total_variation.memory(torus, pixels, unknowns)
    work = max(most.values()) if method == "auto" else most[method]
    return spectrum + max(making, work)
