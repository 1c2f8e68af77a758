"""A capture as a light field: planes, depth and views from its superpixels' samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import InputError
from plenocli.inverse.lightfield import refocus as focus
from plenocli.inverse.lightfield.depth import all_in_focus, depth, depth_in_reach
from plenocli.inverse.lightfield.planes import LightField, distance_of, slope_of
from plenocli.inverse.lightfield.samples import Samples, collect

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

RANGE = 3.0
"""Slopes from -RANGE to RANGE are searched first where no distances are given: a lenslet's width of
parallax across the pupil is one.
"""
WIDER = 4
"""Times its first width to which a range that grows is reckoned with, for memory."""
PIXEL_BYTES, PLANE_BYTES = 126, 1
"""Memory for each pixel of the capture, and for each of its pixels and each plane (measured)."""


def usual_slopes(planes: int = 13) -> np.ndarray:
    """(plane,) slopes from -RANGE to RANGE, px per px."""
    return np.linspace(-RANGE, RANGE, planes)


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Distances of a camera, m: focal length of the main lens, from it to the lenslets, from these
    to the sensor.
    """

    focal_length: float
    image_distance: float
    sensor_distance: float

    @classmethod
    def of(cls, camera: Camera) -> Optics:
        """The distances of a camera."""
        return cls(
            focal_length=camera.main_lens.focal_length,
            image_distance=camera.lenslet_array.distance,
            sensor_distance=camera.sensor.distance,
        )

    def slope(self, distance: float) -> float:
        """Of the plane at `distance` m."""
        return slope_of(distance, self.focal_length, self.image_distance, self.sensor_distance)

    def distance(self, slopes: np.ndarray) -> np.ndarray:
        """Of planes of these slopes, m; NaN beyond infinity."""
        found = distance_of(slopes, self.focal_length, self.image_distance, self.sensor_distance)
        return np.where(np.isfinite(found), found, np.nan)


def refocused(
    samples: Samples,
    shape: tuple[int, int],
    slopes: np.ndarray,
    *,
    views: int = 3,
    optics: Optics | None = None,
    grow: bool = False,
) -> LightField:
    """Planes, depth map and views of the samples of a capture.

    shape: (rows, columns) of a picture, in lenslet pitches.
    slopes: (plane,) px per px, rising; a depth map needs at least three.
    views: along each side, 0 for none.
    optics: turns slopes into distances.
    grow: widens evenly spaced slopes, three or more, until what has texture is within them.

    docs/model.md, "Refocusing and depth".
    """
    found = None
    if len(slopes) >= 3 and grow:
        found, slopes = depth_in_reach(samples, slopes.tolist(), shape)
    elif len(slopes) >= 3:
        found = depth(samples, slopes.tolist(), shape)
    pictures = np.stack([focus.refocus(samples, slope, shape)[0] for slope in slopes])
    if found is not None and optics is not None:
        found = replace(found, distance=optics.distance(found.slope))
    return LightField(
        pictures=pictures,
        slopes=slopes,
        sharpness=np.array([focus.sharpness(p) for p in pictures]),
        distances=None if optics is None else optics.distance(slopes),
        depth=found,
        sharp=None if found is None else all_in_focus(samples, found.slope, shape),
        views=focus.views(samples, views, shape) if views else None,
    )


def samples_of(
    capture: Capture,
    calibration: Calibration | None = None,
    *,
    planes: int = 1,
    where: str | Path | None = None,
) -> tuple[Samples, tuple[int, int]]:
    """Samples of a capture, along a calibration's grid or the tiles that it tells of itself.

    calibration: with the white image of this sensor; None: the capture was simulated.
    planes: that will be made of them, for the memory that they need.
    where: the calibration's file, for messages.

    Returns the samples and (rows, columns) of a picture, in lenslet pitches.
    Raises InputError for colour mosaics, and where lenslets or light are missing; NumericsError
    where memory does not suffice.
    """
    shot, path = capture, capture.metadata.path
    budget().require(
        shot.mosaic.size * (PIXEL_BYTES + PLANE_BYTES * planes),
        "refocusing",
        path,
        "cut the capture",
    )
    if shot.cfa != "mono":
        raise InputError(
            f"has the colour filter array {shot.cfa}; refocusing takes grey captures",
            path,
            "demultiplex it first",
        )
    samples = _along_tiles(shot) if calibration is None else _along_grid(shot, calibration, where)
    if samples.value.size == 0:
        raise InputError(
            "has no lit superpixel on the grid",
            path,
            "check the white image and the calibration",
        )
    # pitches are measured
    rows, columns = (max(1, int(np.ceil(n / samples.pitch - 0.1))) for n in shot.shape)
    return samples, (rows, columns)


def _along_grid(shot: Capture, calibration: Calibration, path: str | Path | None) -> Samples:
    """Samples along the grid of a calibration, relative to its white image."""
    white = calibration.white
    if white is None or white.flat is None or white.flat.shape != shot.shape:
        raise InputError(
            "holds no white image of this sensor",
            path,
            "calibrate with the white image of the camera that took the capture",
        )
    signal = shot.mosaic - (0.0 if calibration.dark is None else calibration.dark.mean)
    # the flat image is 1 in every superpixel: what light each has comes back
    if white.level is not None:
        signal = signal / float(np.nanmedian(white.level))
    grid = calibration.grid
    return collect(
        signal, np.nan_to_num(white.flat), grid.centres, grid.valid, float(np.mean(grid.pitch))
    )


def _along_tiles(shot: Capture) -> Samples:
    """Samples along the superpixels that a simulated capture tells of, relative to what all of
    them have in common, which stands for a white image.
    """
    size = shot.grid.shape if shot.grid else None
    if size is None:
        raise InputError(
            "does not say where its lenslets are",
            shot.metadata.path,
            "give --calibration (from calibrate) with the white image of this camera",
        )
    count = [shot.shape[axis] // size[axis] for axis in (0, 1)]
    signal = shot.signal()
    mean = signal.reshape(count[0], size[0], count[1], size[1]).mean(axis=(0, 2))
    places = ((np.arange(n) + 0.5) * s - 0.5 for n, s in zip(count, size))
    return collect(
        signal / mean.max(),
        np.tile(mean / mean.max(), count),
        np.stack(np.meshgrid(*places, indexing="ij"), axis=-1),
        np.ones(count, bool),
        float(np.mean(size)),
    )
