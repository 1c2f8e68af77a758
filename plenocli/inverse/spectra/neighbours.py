"""What a lenslet throws on its own superpixel and on its neighbours': predicted from a description
of the camera, scaled to the response that was measured. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.inverse.registration.smooth_response import DEGREE

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.inverse.calibration.calibration import Calibration

POINTS = 3
"""Object points of a lenslet's field, a side."""
REACH = 5
"""Superpixels a side that light of a lenslet is followed to."""
LEAST_SHARE = 1e-4
"""Of a lenslet's light on another superpixel, below which it is left out."""
SCALES = 0.5, 2.0
"""By which predicted light is brought to the measured response at most."""
DIM = 0.01
"""Share of a band's brightest pixel below which nothing is scaled."""
KNOWN_TO = 0.03
"""Accuracy that is asked of the prediction."""
UNLIKE = 0.5
"""Relative (L2) difference of predicted and measured F from which the description is another's."""


@dataclass(frozen=True, kw_only=True)
class NeighbourLight:
    """Light of the object points behind one lenslet on the superpixels about it, in the unit of F:
    an even object of radiance 1 in a band gives F, summed over superpixels and points.

    offsets: (superpixel, 2), rows and columns from the lenslet's own, which is among them.
    light: (superpixel, pixel, point, band), points of the field row by row.
    """

    offsets: np.ndarray
    light: np.ndarray

    @property
    def own(self) -> np.ndarray:
        """(superpixel,), which of them is the lenslet's own."""
        return (self.offsets == 0).all(axis=1)

    @property
    def rings(self) -> np.ndarray:
        """(ring, superpixel): those beside the own one, and those further away."""
        far = np.abs(self.offsets).max(axis=1)
        return np.stack([far == 1, far > 1])

    def weighted(self, factors: np.ndarray) -> NeighbourLight:
        """With factors (ring,) of the neighbours' light, the sum over superpixels kept."""
        weight = 1 + (np.asarray(factors) - 1) @ self.rings
        light = self.light * weight[:, None, None, None]
        own = np.flatnonzero(self.own)[0]
        lost = (self.light - light).sum(axis=(0, 2)) / light.shape[2]
        light[own] = light[own] + lost[:, None]
        return replace(self, light=light)

    def moved(self, shift: np.ndarray, window: tuple[int, int]) -> NeighbourLight:
        """Displaced by parts of a pixel.

        shift: (2,) px, rows and columns.
        window: rows and columns of a superpixel, px.
        """
        from scipy.ndimage import shift as displaced

        if not np.any(shift):
            return self
        reach = np.abs(self.offsets).max(axis=0)
        first = (self.offsets + reach) * np.array(window)
        tall, wide = (2 * reach + 1) * np.array(window)
        light = np.empty_like(self.light)
        for place in np.ndindex(self.light.shape[2:]):
            picture = np.zeros((tall, wide))
            parts = [
                (slice(row, row + window[0]), slice(column, column + window[1]))
                for row, column in first
            ]
            for k, part in enumerate(parts):
                picture[part] = self.light[(k, slice(None), *place)].reshape(window)
            picture = displaced(picture, shift, order=DEGREE)
            for k, part in enumerate(parts):
                light[(k, slice(None), *place)] = picture[part].ravel()
        return replace(self, light=light)

    def coupled(self, response: np.ndarray) -> np.ndarray:
        """F of each superpixel for one radiance a lenslet, F being their sum.

        response: F (pixel, band), NaN where unknown.

        Returns (superpixel, pixel, band).
        """
        blocks = self.light.sum(axis=2)
        blocks[self.own] = 0
        blocks[self.own] = np.nan_to_num(response) - blocks.sum(axis=0)
        return blocks

    def fine(self, response: np.ndarray) -> np.ndarray:
        """As `coupled` for each object point: (superpixel, pixel, point, band), whose sum over
        superpixels and points is F where the prediction is within a factor of two of it.
        """
        f, total = np.nan_to_num(response), self.light.sum(axis=(0, 2))
        lit = total > DIM * total.max(axis=0)
        scale = np.where(lit, f / np.where(lit, total, 1), 1)
        return self.light * np.clip(scale, *SCALES)[:, None]


def neighbour_light(camera: Camera, calibration: Calibration) -> NeighbourLight:
    """Predict it by the finest model that a system matrix is made with.

    camera: its description.
    calibration: with windows and a response, whose bands are asked for.

    Raises ConfigError where there is no prediction for these lenslets, or it is none of them.
    """
    from plenocli.forward.accuracy.dial import pif_builder
    from plenocli.inverse.calibration.calibration import there

    wavelengths = there(calibration.response).wavelengths
    measured = _typical(calibration)
    _check(camera, calibration)
    sampled = _in_thirds(camera)
    bands, offsets = [], np.zeros((0, 2), int)
    for wavelength in wavelengths:
        builder = pif_builder(
            sampled, float(wavelength), superpixels=(REACH, REACH), accuracy=KNOWN_TO
        )
        offsets = builder.offsets
        matrix = np.concatenate([block for _, block in builder.blocks()], axis=2)
        bands.append(_thirds(matrix, sampled))
    light = np.stack(bands, axis=-1) * _colours(camera, calibration)[:, None]
    total = light.sum(axis=(0, 2))
    scale = np.nansum(measured, axis=0) / np.maximum(
        np.where(np.isfinite(measured), total, 0).sum(axis=0), 1e-300
    )
    light, total = light * scale, total * scale
    apart = np.linalg.norm(np.nan_to_num(measured - total)) / np.linalg.norm(
        np.nan_to_num(measured)
    )
    if not apart < UNLIKE:
        raise ConfigError(
            f"the described camera's response differs by {apart:.0%} from the calibrated one",
            "camera",
            "give the description of the camera that was calibrated",
        )
    share = light.sum(axis=(1, 2)) / light.sum(axis=(0, 1, 2))
    kept = (share.max(axis=1) >= LEAST_SHARE) | (offsets == 0).all(axis=1)
    return NeighbourLight(offsets=offsets[kept], light=light[kept])


def _typical(calibration: Calibration) -> np.ndarray:
    """F (pixel, band) of all lenslets, or the mean of their own ones."""
    from plenocli.inverse.calibration.calibration import there
    from plenocli.inverse.calibration.quality import mean_of_known

    matrix = there(calibration.response).matrix
    return np.asarray(
        matrix if matrix.ndim == 2 else mean_of_known(matrix[calibration.grid.valid]), float
    )


def _check(camera: Camera, calibration: Calibration) -> None:
    """ConfigError where the lenslets cannot be predicted."""
    from plenocli.inverse.calibration.calibration import there

    windows, grid = there(calibration.windows), calibration.grid
    why = None
    if grid.lattice != "square" or camera.lenslet_array.lattice != "square":
        why = "lenslets on a hexagonal lattice"
    elif tuple(camera.sensor.pixels_per_lenslet) != tuple(windows.shape):
        why = (
            f"superpixels of {camera.sensor.pixels_per_lenslet[0]} x "
            f"{camera.sensor.pixels_per_lenslet[1]} px, calibrated ones have "
            f"{windows.shape[0]} x {windows.shape[1]}"
        )
    elif camera.sensor.cfa != calibration.sensor.cfa:
        why = f"the colour filter array {camera.sensor.cfa}, calibrated: {calibration.sensor.cfa}"
    elif calibration.sensor.cfa != "mono" and np.ptp(windows.origin[grid.valid] % 2, axis=0).any():
        why = "windows that start on different colours of the filter array"
    if why is not None:
        raise ConfigError(
            f"neighbours' light is not predicted for {why}", "camera", "demultiplex without it"
        )


def _in_thirds(camera: Camera) -> Camera:
    """The camera with a number of object points that divides into POINTS a side."""
    samples = tuple(max(1, round(n / POINTS)) * POINTS for n in camera.object.samples_per_lenslet)
    return camera.replace(**{"object.samples_per_lenslet": samples})


def _thirds(matrix: np.ndarray, camera: Camera) -> np.ndarray:
    """(superpixel, pixel, point) of POINTS x POINTS points, each the sum over its part."""
    rows, columns = (n // POINTS for n in camera.object.samples_per_lenslet)
    parts = matrix.reshape(*matrix.shape[:2], POINTS, rows, POINTS, columns)
    return parts.sum(axis=(3, 5), dtype=float).reshape(*matrix.shape[:2], -1)


def _colours(camera: Camera, calibration: Calibration) -> np.ndarray:
    """Efficiency (pixel, band) of the pixels under their colours."""
    from plenocli.forward.sensor.cfa import cfa_map, sensitivity
    from plenocli.inverse.calibration.calibration import there

    windows = there(calibration.windows)
    letters, efficiency = sensitivity(camera, there(calibration.response).wavelengths)
    row, column = windows.origin[calibration.grid.valid][0] % 2
    where = cfa_map(windows.shape, camera.sensor.cfa, (int(row), int(column))).ravel()
    return efficiency[[letters.index(letter) for letter in where]]
