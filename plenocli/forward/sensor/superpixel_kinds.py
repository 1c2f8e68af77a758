"""Superpixels that see their lenslet alike: at one place within their pixels, and on the same
colours of the mosaic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.sensor.superpixel import inside

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

SAME_PLACE = 3
"""Decimals of a pixel to which places count: a thousandth is far below what a grid is known to."""


@dataclass(frozen=True, kw_only=True)
class SuperpixelKinds:
    """Superpixel windows on a sensor, sorted by what they see.

    centres: (lenslet_row, lenslet_column, 2) px.
    origin: (lenslet_row, lenslet_column, 2), first pixels.
    window: rows and columns, px.
    valid: (lenslet_row, lenslet_column), which windows lie on the sensor.
    sensor_shape: rows and columns of the mosaic.
    shifts: (kind, 2) px, from a superpixel's centre to its window's middle.
    phases: (kind, 2), of the colour filter array at the first pixel.
    kind: (lenslet_row, lenslet_column), which of these a lenslet has.
    """

    centres: np.ndarray
    origin: np.ndarray
    window: tuple[int, int]
    valid: np.ndarray
    sensor_shape: tuple[int, int]
    shifts: np.ndarray
    phases: np.ndarray
    kind: np.ndarray

    @classmethod
    def sorted(
        cls,
        *,
        centres: np.ndarray,
        origin: np.ndarray,
        window: tuple[int, int],
        valid: np.ndarray,
        sensor_shape: tuple[int, int],
        shift: np.ndarray,
        cfa: str,
    ) -> SuperpixelKinds:
        """The kinds among windows.

        shift: (lenslet_row, lenslet_column, 2) px, from centres to the windows' middles.
        cfa: "mono" or four letters. The others as the fields.
        """
        phase = np.zeros_like(origin) if cfa == "mono" else origin % 2
        keys = np.concatenate([np.round(shift, SAME_PLACE), phase], axis=-1).reshape(-1, 4)
        kinds, number = np.unique(keys[valid.ravel()], axis=0, return_inverse=True)
        kind = np.zeros(valid.shape, int)
        kind[valid] = number.ravel()
        return cls(
            centres=centres,
            origin=origin,
            window=window,
            valid=valid,
            sensor_shape=sensor_shape,
            shifts=kinds[:, :2] + 0.0,
            phases=kinds[:, 2:].astype(int),
            kind=kind,
        )

    @classmethod
    def of_camera(cls, camera: Camera) -> SuperpixelKinds:
        """The windows of all lenslets of a description on the sensor's raster, nearest to their
        chief rays.
        """
        from plenocli.forward.camera.geometry import lenslet_shift

        count, window = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
        found = [lenslet_shift(camera, r, c) for r in range(count[0]) for c in range(count[1])]
        origin = np.array([(row, column) for row, column, _ in found]).reshape(*count, 2)
        shift = np.array([shift for *_, shift in found]).reshape(*count, 2)
        shape = count[0] * window[0], count[1] * window[1]
        return cls.sorted(
            centres=origin + (np.array(window) - 1) / 2 - shift,
            origin=origin,
            window=window,
            valid=inside(origin, window, shape),
            sensor_shape=shape,
            shift=shift,
            cfa=camera.sensor.cfa,
        )

    @property
    def alike(self) -> bool:
        """Whether all superpixels are of one kind."""
        return len(self.shifts) == 1

    @property
    def commonest(self) -> int:
        """The kind that most lenslets have."""
        return int(np.argmax(np.bincount(self.kind[self.valid])))

    def by_lenslet(self, values: np.ndarray) -> np.ndarray:
        """Values (kind, ...) of the one kind there is, or (lenslet_row, lenslet_column, ...)
        float32, NaN at lenslets that are not valid.
        """
        if self.alike:
            return values[0]
        out = values[self.kind].astype(np.float32)
        out[~self.valid] = np.nan
        return out
