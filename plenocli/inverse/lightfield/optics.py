"""What makes distances of slopes: of a photographic camera, and of a microscope."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.inverse.lightfield.planes import distance_of, slope_of

if TYPE_CHECKING:
    from plenocli.forward.camera.microscope import Microscope
    from plenocli.forward.camera.model import Camera


@dataclass(frozen=True, kw_only=True)
class Optics:
    """Distances of a camera, m: focal length of the main lens, from it to the lenslets, from these
    to the sensor; pitch of the lenslets on the array.
    """

    focal_length: float
    image_distance: float
    sensor_distance: float
    pitch: float

    @classmethod
    def of(cls, camera: Camera) -> Optics:
        """The distances of a camera."""
        return cls(
            focal_length=camera.main_lens.focal_length,
            image_distance=camera.lenslet_array.distance,
            sensor_distance=camera.sensor.distance,
            pitch=camera.lenslet_array.pitch,
        )

    def slope(self, distance: float) -> float:
        """Of the plane at `distance` m."""
        return slope_of(distance, self.focal_length, self.image_distance, self.sensor_distance)

    def distance(self, slopes: np.ndarray) -> np.ndarray:
        """Of planes of these slopes, m; NaN beyond infinity."""
        found = distance_of(slopes, self.focal_length, self.image_distance, self.sensor_distance)
        return np.where(np.isfinite(found), found, np.nan)

    @property
    def spacing(self) -> float:
        """Of lenslets as seen on the plane that is focused on them, m."""
        inverse = 1 / self.focal_length - 1 / self.image_distance
        return self.pitch / (self.image_distance * inverse) if inverse > 0 else np.nan


@dataclass(frozen=True, kw_only=True)
class MicroscopeOptics:
    """What makes depths of slopes before an objective whose image side is telecentric: a plane at
    the depth z away from the objective has its image M^2 z / n before the lenslets, and the slope
    s = -M^2 z / (n b) at a distance b from the lenslets to the sensor.

    magnification: M, from the specimen to the lenslets.
    index: n, of the specimen.
    sensor_distance: b, m.
    pitch: of the lenslets, m.
    """

    magnification: float
    index: float
    sensor_distance: float
    pitch: float

    @classmethod
    def of(cls, microscope: Microscope) -> MicroscopeOptics:
        """Those of a described microscope."""
        lens = microscope.objective
        return cls(
            magnification=lens.magnification,
            index=lens.specimen_index or lens.medium_index,
            sensor_distance=microscope.sensor.distance,
            pitch=microscope.lenslet_array.pitch,
        )

    @property
    def spacing(self) -> float:
        """Of lenslets as seen in the specimen, m."""
        return self.pitch / self.magnification

    def slope(self, distance: float) -> float:
        """Of the plane at the depth `distance` m."""
        return -distance * self.magnification**2 / (self.index * self.sensor_distance)

    def distance(self, slopes: np.ndarray) -> np.ndarray:
        """Depths of planes of these slopes, m."""
        return -np.asarray(slopes) * self.index * self.sensor_distance / self.magnification**2
