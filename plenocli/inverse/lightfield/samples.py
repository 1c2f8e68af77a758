"""What the usable pixels of a capture saw, each from where it stands behind its lenslet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.tiling import EVERYTHING, Plane, bands

AT_ONCE = 1 << 18
"""Samples, or pixels for them, that are worked on together: temporary arrays are no larger."""


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

    def where(self, some: np.ndarray | slice) -> "Samples":
        """Those of the samples that `some` says, (sample,) bool or a slice."""
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
    signal: np.ndarray | Plane,
    white: np.ndarray | Plane,
    centres: np.ndarray,
    valid: np.ndarray,
    pitch: float,
    threshold: float = 0.5,
) -> Samples:
    """Grey samples of a mosaic.

    signal, white: (row, column), dark taken off; white is 0 where a pixel does not count. Bands of
        Planes are read one after the other.
    centres: (lenslet_row, lenslet_column, 2) px, row and column.
    valid: (lenslet_row, lenslet_column) bool.
    pitch: lenslet spacing, px.
    threshold: a pixel counts where white is above this share of the brightest of its superpixel,
        and within half a pitch.
    """
    parts = bands(len(centres), int(AT_ONCE / (centres.shape[1] * pitch**2)))
    if len(parts) > 1:
        return joined(
            [collect(signal, white, centres[r], valid[r], pitch, threshold) for r in parts]
        )
    half = int(pitch // 2)
    steps = np.arange(-half, half + 1)
    near = np.rint(np.where(np.isfinite(centres), centres, -1e6)).astype(int)
    there = near[valid, 0] if valid.any() else np.zeros(1, int)
    top, bottom = (int(n) for n in np.clip([there.min() - half, there.max() + half + 1], 0, None))
    band = slice(top, bottom)
    signal, white = (Plane.of(whole).read(band, EVERYTHING) for whole in (signal, white))
    near = near - (top, 0)
    rows, columns = (
        near[..., axis, None, None] + step
        for axis, step in enumerate(np.meshgrid(steps, steps, indexing="ij"))
    )
    inside = (
        (rows >= 0)
        & (rows < signal.shape[0])
        & (columns >= 0)
        & (columns < signal.shape[1])
        & valid[..., None, None]
    )
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    level = np.where(inside, white[rows, columns], 0.0)
    offset = np.stack([rows, columns], axis=-1) - (centres - (top, 0))[:, :, None, None, :]
    used = (
        inside
        & (level > threshold * level.max(axis=(2, 3), keepdims=True))
        & (np.abs(offset).max(axis=-1) <= pitch / 2)
        & np.isfinite(signal[rows, columns])
    )
    number = np.arange(valid.size, dtype=np.int32).reshape(*valid.shape, 1, 1)
    return Samples(
        centres=centres.reshape(-1, 2),
        lenslet=np.broadcast_to(number, used.shape)[used],
        offset=offset[used].astype(np.float32),
        value=(signal[rows[used], columns[used]] / level[used]).astype(np.float32),
        pitch=float(pitch),
    )
