"""What a volume is made from: superpixels, their noise, which of them count, and the voxels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.linear_maps import BlockCirculant
from plenocli.base.random_streams import skip, stream
from plenocli.base.tiling import BAND, bands
from plenocli.inverse.volume.volume import HeldOut, predictive_sigma

AT_ONCE = 4 * BAND
"""Pixels that are looked at together, where all are."""
DARK = 1e-2
"""Share of the brightest pixel's light below which a pixel of the superpixel counts for nothing."""
SEEN = 0.9
"""Share of a voxel's light that lenslets see, from which on it is inside."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """Superpixels of one exposure.

    signal: (lenslet_row, lenslet_column, pixel), in units of A x; NaN where a pixel is dead or
        saturated. What all lenslets see may stay in a file, such as
        plenocli.files.scratch.ScratchRows; it is looked at window by window.
    read_variance: of every pixel, squared units of the signal.
    gain: variance of the photons' noise over the signal, units of the signal; 0 where the noise
        does not grow with it.
    background: signal without any specimen: a number, or (pixel,) for all superpixels.
    """

    signal: Any
    read_variance: float
    gain: float = 0.0
    background: np.ndarray | float = 0.0

    @property
    def noise_is_known(self) -> bool:
        """Whether the measurement says how much noise it has."""
        return self.read_variance > 0 or self.gain > 0

    @property
    def offset(self) -> np.ndarray:
        """The background of every pixel, like signal; a view."""
        return np.broadcast_to(np.asarray(self.background, float), self.signal.shape)

    def window(self, rows: slice, columns: slice) -> Measurement:
        """What some of the lenslets see, in memory."""
        return replace(self, signal=self.signal[rows, columns])

    def in_bands(self) -> Iterator[np.ndarray]:
        """The signal (lenslet, pixel) of some rows of lenslets after the other."""
        rows, columns, pixels = self.signal.shape
        for some in bands(rows, AT_ONCE // (columns * pixels)):
            yield self.signal[some, :].reshape(-1, pixels)

    def variance(self, signal: np.ndarray) -> np.ndarray:
        """Variance of pixels that get `signal` of the specimen, (.., pixel) or a number."""
        whole = signal + np.asarray(self.background)
        return self.read_variance + self.gain * np.maximum(whole, 0)


@dataclass(frozen=True)
class Voxels:
    """The fine lattice: unknown = plane * points + row of a lenslet's points * columns + column.

    point_shape: (rows, columns) of points in a lenslet.
    pitch: spacing of columns of points, m.
    depths: (plane,) m, in order.
    row_spacing: of rows of points, in pitches.
    """

    point_shape: tuple[int, int]
    pitch: float
    depths: tuple[float, ...]
    row_spacing: float = 1.0

    @property
    def unknowns(self) -> int:
        """Of a lenslet."""
        return len(self.depths) * self.point_shape[0] * self.point_shape[1]

    def picture(self, x: np.ndarray) -> np.ndarray:
        """(lenslet_row, lenslet_column, unknown) -> (plane, row, column)."""
        (rows, columns), (s, t) = x.shape[:2], self.point_shape
        parts = x.reshape(rows, columns, -1, s, t).transpose(2, 0, 3, 1, 4)
        return parts.reshape(-1, rows * s, columns * t)

    def lenslets(self, picture: np.ndarray) -> np.ndarray:
        """(plane, row, column) -> (lenslet_row, lenslet_column, unknown)."""
        planes, (s, t) = len(picture), self.point_shape
        parts = picture.reshape(planes, -1, s, picture.shape[2] // t, t).transpose(1, 3, 0, 2, 4)
        return parts.reshape(parts.shape[0], parts.shape[1], -1)


def put_aside(
    share: float, seed: int, shape: tuple[int, ...], rows: slice, columns: slice
) -> np.ndarray:
    """Which pixels of a window are put aside, like its signal: those that they are in all windows.

    share: of the pixels, 0..1.
    seed: of the draw.
    shape: of the signal of all lenslets.
    rows, columns: of the window.
    """
    (top, bottom, _), (left, right, _) = rows.indices(shape[0]), columns.indices(shape[1])
    lots, line = stream(seed, "volume-hold-out"), shape[1] * shape[2]
    skip(lots, top * line + left * shape[2])
    aside = np.empty((bottom - top, right - left, shape[2]), bool)
    for row in aside:
        np.less(lots.random(row.shape), share, out=row)
        skip(lots, line - row.size)
    return aside


class Problem:
    """A measurement before its map, with some pixels put aside.

    op: the map; its range is the measurement's array.
    measurement: what was seen.
    voxels: of the map's unknowns.
    hold_out: share of the usable pixels that no solver sees.
    seed: of which ones.
    aside: like the measurement's signal, which ones they are, instead.

    `signal`, `counts` and `held` are (lenslet_row, lenslet_column, pixel): the specimen's light,
    whether a pixel is fitted, and whether it was put aside.

    Raises ValueError where shapes do not fit together, NumericsError where no pixel counts.
    """

    def __init__(
        self,
        op: BlockCirculant,
        measurement: Measurement,
        voxels: Voxels,
        hold_out: float = 0.05,
        seed: int = 0,
        aside: np.ndarray | None = None,
    ) -> None:
        if measurement.signal.shape != op.range.shape or voxels.unknowns != op.domain.shape[2]:
            raise ValueError(
                f"a map from {op.domain.shape} to {op.range.shape} does not fit a signal of "
                f"{measurement.signal.shape} and {voxels.unknowns} unknowns a lenslet"
            )
        self.op, self.measurement, self.voxels = op, measurement, voxels
        if aside is None:
            everything = slice(None)
            aside = put_aside(hold_out, seed, measurement.signal.shape, everything, everything)
        self._aside = aside
        self.signal = (measurement.signal - measurement.offset).astype(op.dtype)
        usable = np.isfinite(self.signal) & (
            self.light_on_pixels > DARK * self.light_on_pixels.max()
        )
        self.signal[~usable] = 0
        self.held = usable & aside
        self.counts = usable & ~self.held
        if not self.counts.any():
            raise NumericsError(
                "no pixel of the capture is left to make a volume of", None, "hold out fewer pixels"
            )

    def with_measurement(self, measurement: Measurement) -> Problem:
        """The same with another measurement of the same pixels, the same ones put aside."""
        return Problem(self.op, measurement, self.voxels, aside=self._aside)

    @cached_property
    def light_on_pixels(self) -> np.ndarray:
        """(pixel,): light of an even object, on every pixel of a superpixel."""
        return self.op.spectrum[0].real.sum(axis=1)

    @cached_property
    def seen(self) -> np.ndarray:
        """(lenslet_row, lenslet_column, unknown) on the torus: share of a voxel's light that falls
        on the lenslets.
        """
        all_light = self.op.spectrum[0].real.sum(axis=0)
        ones = np.ones(self.op.range.shape, self.op.dtype)
        return self.op.adjoint(ones) / np.maximum(all_light, np.finfo(np.float32).tiny)

    @property
    def margin(self) -> int:
        """Lenslets from the border on which some voxels' light is not seen."""
        rows, columns = self.op.range.shape[:2]
        least = self.seen[:rows, :columns].min(axis=2)
        most = (min(rows, columns) - 1) // 2
        for margin in range(most):
            if least[margin : rows - margin, margin : columns - margin].min() >= SEEN:
                return margin
        return most

    def inside(self, x: np.ndarray) -> np.ndarray:
        """(plane, row, column) picture of what is before the lenslets, of x on the torus."""
        rows, columns = self.op.range.shape[:2]
        return self.voxels.picture(x[:rows, :columns])

    def misfit(self, prediction: np.ndarray) -> float:
        """Mean square error of held-out pixels over their variance about their mean; NaN where
        none was held out.
        """
        if not self.held.any():
            return float("nan")
        truth = self.signal[self.held].astype(float)
        return float(np.mean((truth - prediction[self.held]) ** 2) / max(np.var(truth), 1e-300))

    def judged(self, prediction: np.ndarray) -> HeldOut | None:
        """The pixels that were put aside, beside what is predicted of them (like signal)."""
        if not self.held.any():
            return None
        offset = self.measurement.offset[self.held]
        measured, predicted = self.signal[self.held] + offset, prediction[self.held] + offset
        return HeldOut(
            index=np.argwhere(self.held),
            measured=measured,
            predicted=predicted,
            sigma=predictive_sigma(measured, predicted),
        )
