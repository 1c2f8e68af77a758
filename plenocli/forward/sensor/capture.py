"""A capture: the mosaic of one exposure with all that is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.tiling import Plane
from plenocli.forward.sensor.frames import tiled

if TYPE_CHECKING:
    from pathlib import Path

    from plenocli.forward.sensor.cfa import ColourProfile
    from plenocli.forward.sensor.noise import Noise


@dataclass(frozen=True, kw_only=True)
class Levels:
    """What the numbers of a mosaic mean.

    black: (2, 2) by position, level of no light, units of the mosaic.
    white: level from which on pixels are saturated, units of the mosaic; inf where none is.
    gain: units of the mosaic for one electron, None where unknown.
    """

    black: np.ndarray = field(default_factory=lambda: np.zeros((2, 2)))
    white: float = np.inf
    gain: float | None = None

    def from_pixel(self, row: int, column: int) -> Levels:
        """Those of a part of the sensor that begins at a pixel."""
        return replace(self, black=np.roll(self.black, (-row, -column), axis=(0, 1)))


@dataclass(frozen=True, kw_only=True)
class SuperpixelGrid:
    """Where the superpixels are that a simulated capture was tiled with, as far as its file says.

    shape: (rows, columns) of a superpixel, px.
    count: lenslets (rows, columns).
    centre: (lenslet_row, lenslet_column, 2) true centres, px.
    """

    shape: tuple[int, ...] | None = None
    count: tuple[int, ...] | None = None
    centre: np.ndarray | None = None

    @classmethod
    def tiled(
        cls, count: tuple[int, int], shape: tuple[int, int], lattice: str = "square"
    ) -> SuperpixelGrid:
        """That of `count` superpixels of `shape` pixels side by side; every other row of a
        hexagonal lattice stands half of one to the right.
        """
        first = (np.array(shape) - 1) / 2
        index = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1)
        centre = first + index * np.array(shape)
        if lattice == "hexagonal":
            centre[1::2, :, 1] += shape[1] / 2
        return cls(shape=tuple(shape), count=tuple(count), centre=centre)


@dataclass(frozen=True, kw_only=True)
class CaptureMetadata:
    """Where a capture comes from and what was in front of the camera; None where not known.

    source: kind of file: "raw", "dng", "image", "capture" or "exr"; "simulation" before it has one.
    path: of the file.
    camera: make and model.
    noise_from: who says the noise.
    target: what was in front of the camera.
    illuminant: name of the light.
    band_m: centre of the narrow band that lit the scene, m.
    electrons_per_unit: electrons for one unit of A x, the light of a white object point.
    snr_db: signal-to-noise ratio of the noise that was added, dB.
    scene_shape: object points (rows, columns).
    accuracy: record of a simulated capture's accuracy.
    matrix: SHA-256 of the pif that a simulated capture was made with.
    details: whatever else the file says, by its names.
    """

    source: str = "simulation"
    path: Path | None = None
    camera: str | None = None
    noise_from: str | None = None
    target: str | None = None
    illuminant: str | None = None
    band_m: float | None = None
    electrons_per_unit: float | None = None
    snr_db: float | None = None
    scene_shape: tuple[int, ...] | None = None
    accuracy: dict[str, Any] | None = None
    matrix: str | None = None
    details: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Capture:
    """One exposure of a plenoptic camera, measured or simulated, never demosaiced.

    mosaic: (row, column) values as the sensor reports them; InParts only of a simulation whose
        values are worked out while they are written, a Plane only where they stay in their file.
    units: of the values: "DN", "electron", or "relative": 1 is the light of a white object point
        through the clear pupil.
    cfa: colour filter array, "mono" or the four letters of the top left 2x2 pixels, row by row.
    levels: black, white and gain.
    exposure_s: exposure time, s, None where unknown.
    noise: as far as it is known, in the units of the values; its gain alone where only that is.
    mask: (row, column), True where a pixel counts for nothing; None where all count.
    grid: where its superpixels are, where the capture itself says so.
    profile: what its colours are; None where unknown.
    metadata: where it comes from.
    """

    mosaic: np.ndarray
    units: str = "DN"
    cfa: str = "mono"
    levels: Levels = field(default_factory=Levels)
    exposure_s: float | None = None
    noise: Noise | None = None
    mask: np.ndarray | None = None
    grid: SuperpixelGrid | None = None
    profile: ColourProfile | None = None
    metadata: CaptureMetadata = field(default_factory=CaptureMetadata)

    @property
    def shape(self) -> tuple[int, ...]:
        """(rows, columns) of the sensor."""
        return self.mosaic.shape

    @property
    def name(self) -> str:
        """Name of its file."""
        return self.metadata.path.name if self.metadata.path else "capture"

    @property
    def white_noise(self) -> Noise | None:
        """The noise where it is the same for every signal, else None."""
        return self.noise if self.noise is not None and self.noise.is_white else None

    def window(self, rows: slice, columns: slice) -> Capture:
        """The capture of a part of the sensor."""
        top, left = rows.indices(self.shape[0])[0], columns.indices(self.shape[1])[0]
        return replace(
            self,
            mosaic=Plane.of(self.mosaic).read(rows, columns),
            mask=None if self.mask is None else self.mask[rows, columns],
            levels=self.levels.from_pixel(top, left),
        )

    def signal(self) -> np.ndarray:
        """(row, column) float64 values above the black level; NaN where the mask says so."""
        signal = self.mosaic - tiled(self.levels.black, self.shape, float)
        if self.mask is not None:
            signal[self.mask] = np.nan
        return signal
