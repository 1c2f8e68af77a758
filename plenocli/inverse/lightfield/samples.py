"""What the usable pixels of a capture saw, each from where it stands behind its lenslet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.tiling import bands

AT_ONCE = 1 << 18
"""Samples, or pixels for them, that are worked on together: temporary arrays are no larger."""
TEMPORARY_BYTES = 85
"""Memory for each of them (measured)."""


@dataclass(frozen=True, kw_only=True)
class Channels:
    """Colours that samples have.

    names: of the channels, letters or wavelengths.
    to_rgb: (3, channel) linear sRGB of them, white where all are 1.
    weights: (channel,) shares of the light that each has of white; their sum is 1.
    wavelengths: (channel,) m, where channels are bands that each saw through a part of the pupil;
        None for colours of pixels.
    """

    names: tuple[str, ...]
    to_rgb: np.ndarray
    weights: np.ndarray
    wavelengths: np.ndarray | None = None


@dataclass(frozen=True, kw_only=True)
class Samples:
    """What the usable pixels saw.

    centres: (lenslet, 2) px, of superpixels on the sensor.
    lenslet: (sample,) int32, which of them each belongs to.
    offset: (sample, 2) float32 px, of the pixel from that centre.
    value: (sample,) float32, relative to white.
    pitch: lenslet spacing, px.
    channel: (sample,) int8, which of `channels`; None with these.
    channels: None for grey samples.
    """

    centres: np.ndarray
    lenslet: np.ndarray
    offset: np.ndarray
    value: np.ndarray
    pitch: float
    channel: np.ndarray | None = None
    channels: Channels | None = None

    @property
    def centre(self) -> np.ndarray:
        """(sample, 2) px, of the superpixel of each."""
        return self.centres[self.lenslet]

    def reach(self) -> float:
        """Farthest usable pixel from its centre, px: half of the pupil's image."""
        parts = (self.offset[part].astype(float) for part in bands(len(self.offset), AT_ONCE))
        return float(np.sqrt(max((part**2).sum(axis=1).max() for part in parts)))

    def where(self, some: np.ndarray | slice) -> Samples:
        """Those of the samples that `some` says, (sample,) bool, numbers or a slice."""
        channel = None if self.channel is None else self.channel[some]
        return replace(
            self,
            lenslet=self.lenslet[some],
            offset=self.offset[some],
            value=self.value[some],
            channel=channel,
        )

    def parts(self) -> list[np.ndarray | slice]:
        """Which samples each channel has; of grey ones all."""
        if self.channels is None or self.channel is None:
            return [slice(None)]
        return [self.channel == number for number in range(len(self.channels.names))]


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What is known of all samples of a capture.

    reach: farthest usable pixel from its centre, px: half of the pupil's image.
    each: (channel,) samples of a lenslet that has some, on average.
    mean, square: (channel,) of their values and the squares of these.
    """

    reach: float
    each: np.ndarray
    mean: np.ndarray
    square: np.ndarray


@dataclass(frozen=True, kw_only=True)
class SampleBands:
    """Samples of a capture in bands of lenslets, those of some rows of a picture each, which are
    made when they are asked for.

    shape: (rows, columns) of a picture, in lenslet pitches.
    pitch: lenslet spacing, px.
    channels: None for grey samples.
    rows: of a picture, of each band; they follow each other. What has its centre beyond the picture
        is in the first or the last.
    read: number of a band -> its samples, one part a channel.
    held: bytes of the images that they are made of, as far as these are in memory.
    where: the file that messages name.
    """

    shape: tuple[int, int]
    pitch: float
    channels: Channels | None
    rows: tuple[slice, ...]
    read: Callable[[int], tuple[Samples, ...]]
    held: int = 0
    where: str | Path | None = None

    @classmethod
    def of(cls, samples: Samples, shape: tuple[int, int]) -> SampleBands:
        """Those of samples in memory; shape: of a picture."""
        cell = picture_rows(samples.centres, samples.pitch, shape[0])[samples.lenslet]
        order = np.argsort(cell, kind="stable")
        rows = bands(shape[0], int(AT_ONCE * shape[0] / max(len(cell), 1)))
        ends = np.searchsorted(cell[order], [0, *(part.stop for part in rows)])

        def read(number: int) -> tuple[Samples, ...]:
            own = samples.where(order[ends[number] : ends[number + 1]])
            return tuple(
                replace(own.where(some), channel=None, channels=None) for some in own.parts()
            )

        return cls(
            shape=shape,
            pitch=samples.pitch,
            channels=samples.channels,
            rows=tuple(rows),
            read=read,
            held=sum(v.nbytes for v in (samples.lenslet, samples.offset, samples.value)),
        )

    @property
    def count(self) -> int:
        """Of the channels, one of grey samples."""
        return 1 if self.channels is None else len(self.channels.names)

    def points(self, step: int) -> list[slice]:
        """Rows of a picture of `step` points a pitch, of each band."""
        return [slice(step * rows.start, step * rows.stop) for rows in self.rows]

    def __iter__(self) -> Iterator[tuple[Samples, ...]]:
        return (self.read(number) for number in range(len(self.rows)))

    @cached_property
    def survey(self) -> Survey:
        """What all bands come to. Raises InputError where no pixel is lit."""
        farthest, sums = 0.0, np.zeros((self.count, 4))
        for parts in self:
            for total, part in zip(sums, parts):
                if len(part.value):
                    farthest = max(farthest, part.reach())
                    lit = np.count_nonzero(np.bincount(part.lenslet))
                    value = part.value.astype(float)
                    total += np.array([len(value), lit, value.sum(), (value**2).sum()])
        if not sums[:, 0].any():
            raise unlit(self.where)
        number, lenslets, total, square = np.maximum(sums, [1, 1, -np.inf, 0]).T
        return Survey(
            reach=farthest, each=number / lenslets, mean=total / number, square=square / number
        )


def unlit(where: str | Path | None) -> InputError:
    """The error of a capture of which no pixel is lit; where: its file."""
    fix = "check the white image and the calibration"
    return InputError("has no lit superpixel on the grid", where, fix)


def picture_rows(centres: np.ndarray, pitch: float, count: int) -> np.ndarray:
    """(lenslet,) row of a picture, of `count`, in which each centre (lenslet, 2) px lies."""
    return np.clip(np.floor(centres[:, 0] / pitch).astype(int), 0, count - 1)


def joined(parts: Sequence[Samples], channels: Channels | None = None) -> Samples:
    """Samples of all parts in their order, one part a channel where there are channels."""
    counts = [len(part.value) for part in parts]
    channel = np.repeat(np.arange(len(parts), dtype=np.int8), counts)
    before = np.cumsum([0, *(len(part.centres) for part in parts[:-1])])
    return Samples(
        centres=np.concatenate([part.centres for part in parts]),
        lenslet=np.concatenate(
            [part.lenslet + np.int32(first) for part, first in zip(parts, before)]
        ),
        offset=np.concatenate([part.offset for part in parts]),
        value=np.concatenate([part.value for part in parts]),
        pitch=parts[0].pitch,
        channel=None if channels is None else channel,
        channels=channels,
    )


def collect(
    signal: np.ndarray,
    white: np.ndarray,
    centres: np.ndarray,
    valid: np.ndarray,
    pitch: float,
    threshold: float = 0.5,
) -> Samples:
    """Grey samples of a mosaic.

    signal, white: (row, column), dark taken off; white is 0 where a pixel does not count.
    centres: (..., 2) px, row and column, of lenslets.
    valid: (...) bool.
    pitch: lenslet spacing, px.
    threshold: a pixel counts where white is above this share of the brightest of its superpixel,
        and within half a pitch.
    """
    found = centres[valid]
    half = int(pitch // 2)
    steps = np.arange(-half, half + 1)
    near = np.rint(found).astype(int)
    sides = np.array(signal.shape)
    at = near[:, :, None] + steps  # (lenslet, axis, step)
    away = at - found[:, :, None]
    inside = (at >= 0) & (at < sides[:, None])
    at = np.clip(at, 0, np.maximum(sides - 1, 0)[:, None])
    index = at[:, 0, :, None] * signal.shape[1] + at[:, 1, None, :]
    level = white.ravel()[index] if index.size else np.zeros(index.shape)
    if not inside.all():
        level = np.where(inside[:, 0, :, None] & inside[:, 1, None, :], level, 0.0)
    inside &= np.abs(away) <= pitch / 2
    used = level > threshold * level.max(axis=(1, 2), keepdims=True)
    used &= inside[:, 0, :, None] & inside[:, 1, None, :]
    seen = signal.ravel()[index[used]]
    finite = np.isfinite(seen)
    lenslet, row, column = (numbers[finite] for numbers in np.nonzero(used))
    return Samples(
        centres=found,
        lenslet=lenslet.astype(np.int32),
        offset=np.stack([away[lenslet, 0, row], away[lenslet, 1, column]], -1).astype(np.float32),
        value=(seen[finite] / level[used][finite]).astype(np.float32),
        pitch=float(pitch),
    )
