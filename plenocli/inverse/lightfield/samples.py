"""What the usable pixels of a capture saw, each from where it stands behind its lenslet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from plenocli.base.tiling import bands

AT_ONCE = 1 << 21
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

    centre: (sample, 2) px, of the pixel's superpixel on the sensor.
    offset: (sample, 2) px, of the pixel from that centre.
    value: (sample,) relative to white.
    pitch: lenslet spacing, px.
    channel: (sample,) which of `channels`; None with these.
    channels: None for grey samples.
    """

    centre: np.ndarray
    offset: np.ndarray
    value: np.ndarray
    pitch: float
    channel: np.ndarray | None = None
    channels: Channels | None = None

    def reach(self) -> float:
        """Farthest usable pixel from its centre, px: half of the pupil's image."""
        return float(np.sqrt((self.offset**2).sum(axis=1).max()))

    def where(self, some: np.ndarray | slice) -> "Samples":
        """Those of the samples that `some` says, (sample,) bool or a slice."""
        channel = None if self.channel is None else self.channel[some]
        return replace(
            self,
            centre=self.centre[some],
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
    channel = np.repeat(np.arange(len(parts)), [len(part.value) for part in parts])
    return Samples(
        centre=np.concatenate([part.centre for part in parts]),
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
    offset = np.stack([rows, columns], axis=-1) - centres[:, :, None, None, :]
    used = (
        inside
        & (level > threshold * level.max(axis=(2, 3), keepdims=True))
        & (np.abs(offset).max(axis=-1) <= pitch / 2)
        & np.isfinite(signal[rows, columns])
    )
    return Samples(
        centre=np.broadcast_to(centres[:, :, None, None, :], offset.shape)[used],
        offset=offset[used],
        value=signal[rows, columns][used] / level[used],
        pitch=float(pitch),
    )
