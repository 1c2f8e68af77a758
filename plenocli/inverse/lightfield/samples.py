"""What the usable pixels of a capture saw, each from where it stands behind its lenslet."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Samples:
    """What the usable pixels saw.

    centre: (sample, 2) px, of the pixel's superpixel on the sensor.
    offset: (sample, 2) px, of the pixel from that centre.
    value: (sample,) relative to white.
    pitch: lenslet spacing, px.
    """

    centre: np.ndarray
    offset: np.ndarray
    value: np.ndarray
    pitch: float

    def reach(self) -> float:
        """Farthest usable pixel from its centre, px: half of the pupil's image."""
        return float(np.sqrt((self.offset**2).sum(axis=1).max()))


def collect(
    signal: np.ndarray,
    white: np.ndarray,
    centres: np.ndarray,
    valid: np.ndarray,
    pitch: float,
    threshold: float = 0.5,
) -> Samples:
    """Samples of a mosaic.

    signal, white: (row, column), dark taken off.
    centres: (lenslet_row, lenslet_column, 2) px, row and column.
    valid: (lenslet_row, lenslet_column) bool.
    pitch: lenslet spacing, px.
    threshold: a pixel counts where white is above this share of the brightest of its superpixel,
        and within half a pitch.
    """
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
        np.broadcast_to(centres[:, :, None, None, :], offset.shape)[used],
        offset[used],
        signal[rows, columns][used] / level[used],
        float(pitch),
    )
