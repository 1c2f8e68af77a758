"""Planes of a refocused capture: their slopes and distances, and what was found on them.

A pixel q beyond the centre c of its superpixel (both px on the sensor) sees through the point U =
-q z2/b of the main lens, z2 in front of the lenslets that stand b in front of the sensor. A point
imaged z' behind the main lens meets there the sensor's picture at

    x = c + s q,    s = (1 + z2/b) (1 - z2/z'),    1/z' = 1/f - 1/z,

whatever pixel saw it: s = 0 is the plane focused on the lenslets, s = 1 the sensor itself, and
points nearer to the camera have s > 0. Refocusing puts every sample at its x. Source:
docs/model.md, "Refocusing and depth"; R. Ng et al., Stanford CTSR 2005-02.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plenocli.inverse.lightfield.samples import Channels


@dataclass(frozen=True, kw_only=True)
class DepthMap:
    """Where the views agree best, (row, column) each, one value a lenslet pitch.

    slope: px per px, NaN where nothing is known.
    confidence: probability that the slope is right within one, the geometric limit; 0 where nothing
        is known.
    sigma: standard deviation of the slope, NaN where nothing is known; None where it was not kept.
    edge: bool, where slopes around differ by the geometric limit or more: one thing hides another,
        and depths are mixtures; None where it was not kept.
    distance: m, as of the light field's planes, NaN beyond infinity; None without a camera.
    distance_sigma: m, standard deviation of it; None where it was not kept.
    beyond: share of the map that has texture but lies beyond the slopes tried; None where it was
        not kept.
    """

    slope: np.ndarray
    confidence: np.ndarray
    sigma: np.ndarray | None = None
    edge: np.ndarray | None = None
    distance: np.ndarray | None = None
    distance_sigma: np.ndarray | None = None
    beyond: float | None = None


@dataclass(frozen=True, kw_only=True)
class Colours:
    """The same pictures in colour.

    channels: what their channels are.
    pictures: (plane, channel, row, column).
    sharp: (channel, row, column), or None.
    views: (view_row, view_column, channel, row, column), NaN where a channel has no samples; or
        None.
    """

    channels: Channels
    pictures: np.ndarray
    sharp: np.ndarray | None = None
    views: np.ndarray | None = None

    def rgb(self, values: np.ndarray) -> np.ndarray:
        """Linear sRGB (3, row, column) of a picture (channel, row, column); NaN where a channel is
        unknown.
        """
        return np.tensordot(self.channels.to_rgb, values, axes=1)


@dataclass(frozen=True, kw_only=True)
class LightField:
    """What refocus makes of one capture.

    pictures: (plane, row, column), relative to white, several points a lenslet pitch; the mean of
        the channels where there are several.
    slopes: (plane,) px per px, rising.
    sharpness: (plane,) mean square gradient.
    distances: (plane,) m in front of the main lens, NaN beyond infinity; of a microscope from the
        plane focused on its lenslets, away from the objective; None without a camera.
    spacing: m between lenslets as seen on the plane focused on them; None without a camera.
    microscope: whether distances are depths before an objective.
    depth: None with fewer than three planes.
    sharp: (row, column), like a picture, everything in focus; None without known depth.
    views: (view_row, view_column, row, column), or None.
    colours: the same in colour; None of a grey capture.
    """

    pictures: np.ndarray
    slopes: np.ndarray
    sharpness: np.ndarray
    distances: np.ndarray | None = None
    spacing: float | None = None
    microscope: bool = False
    depth: DepthMap | None = None
    sharp: np.ndarray | None = None
    views: np.ndarray | None = None
    colours: Colours | None = None


def slope_of(
    distance: float, focal_length: float, image_distance: float, sensor_distance: float
) -> float:
    """Slope s of a plane.

    distance: of the plane in front of the main lens, m; may be inf.
    focal_length: of the main lens, m.
    image_distance: from the main lens to the lenslets, m.
    sensor_distance: from the lenslets to the sensor, m.

    docs/model.md, "Refocusing and depth".
    """
    inverse = 1 / focal_length - (0.0 if np.isinf(distance) else 1 / distance)
    return (1 + image_distance / sensor_distance) * (1 - image_distance * inverse)


def distance_of(
    slope: ArrayLike, focal_length: float, image_distance: float, sensor_distance: float
) -> np.ndarray:
    """Distance of planes in front of the main lens, the inverse of `slope_of`.

    slope: any shape; the others as in `slope_of`, m.

    Returns m, like slope; inf beyond infinity.
    """
    inverse = (
        1 / focal_length
        - (1 - np.asarray(slope, float) / (1 + image_distance / sensor_distance)) / image_distance
    )
    with np.errstate(divide="ignore"):
        return np.where(inverse > 0, 1 / np.where(inverse > 0, inverse, 1.0), np.inf)
