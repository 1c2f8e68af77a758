"""What a lenslet throws on its own superpixel and on its neighbours': predicted from a description
of the camera, scaled to the response that was measured. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.base.progress import note
from plenocli.forward.camera.geometry import finely_sampled, geometry
from plenocli.forward.camera.pupil import polarised
from plenocli.forward.propagation.response import uniform_response, valid_for
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.registration.smooth_response import DEGREE
from plenocli.inverse.spectra.field_modes import FieldModes, field_modes
from plenocli.inverse.spectra.responses import LensletResponses

if TYPE_CHECKING:
    from collections.abc import Iterator

    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.inverse.calibration.calibration import Calibration

POINTS = 12
"""Object points of a lenslet's field, a side, that light is told apart of."""
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
RINGS = 2
FACTOR_SPREAD = 0.5
"""Of the neighbours' light, near and far: standard deviation of a factor before a capture is looked
at.
"""
OPTICS_SPREAD = 0.01
"""The same of the sensor's distance and the filters' size, relative, before F is looked at."""
OPTICS_MOST = 4.0
"""Of these by which F changes them at most."""
CLOSED_TO = 0.007
"""Relative (L2) accuracy of the closed form of F beside a measured one."""
UNLIKE = 0.5
"""Relative (L2) difference of predicted and measured F from which the description is another's."""


@dataclass(frozen=True, kw_only=True)
class NeighbourLight:
    """Light of the object points behind one lenslet on the superpixels about it, in the unit of F:
    an even object of radiance 1 in a band gives F, summed over superpixels and points.

    offsets: (superpixel, 2), rows and columns from the lenslet's own, which is among them.
    light: (superpixel, pixel, mode, band).
    changes: (change, superpixel, pixel, mode, band), what may be wrong with it, by one standard
        deviation.
    modes: of the points of the field.
    camera: whose light it is.
    """

    offsets: np.ndarray
    light: np.ndarray
    changes: np.ndarray
    modes: FieldModes
    camera: Camera

    @property
    def own(self) -> int:
        """Which superpixel is the lenslet's own."""
        return int(np.flatnonzero((self.offsets == 0).all(axis=1))[0])

    @property
    def share(self) -> np.ndarray:
        """(band,), of the light of even fields that falls on other superpixels than their own."""
        light = self._even(self.light).sum(axis=1)
        return 1 - light[self.own] / light.sum(axis=0)

    def changed(self, amounts: np.ndarray) -> NeighbourLight:
        """With `changes` by amounts (change,), in standard deviations."""
        return replace(self, light=self.light + np.tensordot(amounts, self.changes, 1))

    def moved(self, shift: np.ndarray, calibration: Calibration) -> NeighbourLight:
        """Displaced by parts of a pixel, which is predicted: beside a lenslet's own light, whose
        edges are sharper than pixels, no spline tells what little of it goes further.

        shift: (2,) px, rows and columns.
        calibration: that it was predicted for.
        """
        if not np.any(shift):
            return self
        fitted = self.camera.fitted
        row, column = (np.zeros(2) if fitted is None else np.array(fitted.pixel_shift)) - shift
        # what a description holds is at most half a pixel
        down, right = (int(np.sign(n)) if abs(n) > 0.5 else 0 for n in (row, column))
        there = self.camera.with_fit((float(row - down), float(column - right)), 0.0)
        offsets, light = _predicted(there, calibration, self.modes, (down, right))
        kept = (offsets[:, None] == self.offsets).all(axis=-1).any(axis=1)
        offsets, light = offsets[kept], light[kept]
        changes = np.concatenate([_sizes(offsets, light), self.changes[RINGS:]])
        return replace(self, offsets=offsets, light=light, changes=changes)

    def coupled(self, response: np.ndarray) -> np.ndarray:
        """F of each superpixel for one radiance a lenslet, F being their sum.

        response: F (pixel, band), NaN where unknown.

        Returns (superpixel, pixel, band).
        """
        return self._kept(self._even(self.fine(response)), np.nan_to_num(response))

    def coupled_changes(self) -> np.ndarray:
        """What `changes` do to `coupled`: (change, superpixel, pixel, band)."""
        return np.stack([self._kept(self._even(change), 0.0) for change in self.changes])

    def _even(self, light: np.ndarray) -> np.ndarray:
        """(superpixel, pixel, band) of fields that are 1."""
        return np.einsum("opmk,m->opk", light, self.modes.even)

    def _kept(self, blocks: np.ndarray, total: np.ndarray | float) -> np.ndarray:
        """Blocks whose sum is `total` by what the own one has."""
        blocks[self.own] = 0
        blocks[self.own] = total - blocks.sum(axis=0)
        return blocks

    def fine(self, response: np.ndarray) -> np.ndarray:
        """As `coupled` for each mode: (superpixel, pixel, mode, band), of which even fields make F
        where the prediction is within a factor of two of it.
        """
        f, total = np.nan_to_num(response), self._even(self.light).sum(axis=0)
        lit = total > DIM * total.max(axis=0)
        scale = np.where(lit, f / np.where(lit, total, 1), 1)
        return self.light * np.clip(scale, *SCALES)[:, None]


def neighbour_light(camera: Camera, calibration: Calibration) -> NeighbourLight:
    """Predict it by the finest model that a system matrix is made with.

    camera: its description, of which the measured response corrects the sensor's distance and the
        size of filters or pupil: where it has light, the light of neighbours lies likewise.
    calibration: with windows and a response, whose bands are asked for.

    Raises ConfigError where there is no prediction for these lenslets, or it is none of them.
    """
    from plenocli.forward.accuracy.dial import seconds_here
    from plenocli.forward.accuracy.explain import LONG, duration

    _check(camera, calibration)
    measured, camera = _typical(calibration), _as_measured(camera, calibration)
    seconds = 3 * sum(seconds_here(plan.chosen) for *_, plan in _planned(camera, calibration))
    if seconds > LONG:
        note(f"neighbours' light is predicted first, in about {duration(seconds)} on one core")
    offsets, points = _predicted(camera, calibration)
    total = points.sum(axis=(0, 2), dtype=float)
    measured, apart = np.nan_to_num(measured), np.nan_to_num(measured - total)
    apart = np.linalg.norm(apart) / np.linalg.norm(measured)
    if not apart < UNLIKE:
        raise ConfigError(
            f"the described camera's response differs by {apart:.0%} from the calibrated one",
            "camera",
            "give the description of the camera that was calibrated",
        )
    share = points.sum(axis=(1, 2)) / points.sum(axis=(0, 1, 2))
    modes = field_modes(points)
    light = np.moveaxis(np.tensordot(points, modes.basis, (2, 0)), -1, 2)
    optics = [
        _predicted(_other_optics(camera, one), calibration, modes)[1] - light for one in np.eye(2)
    ]
    changes = np.concatenate([_sizes(offsets, light), optics])
    kept = (share.max(axis=1) >= LEAST_SHARE) | (offsets == 0).all(axis=1)
    return NeighbourLight(
        offsets=offsets[kept],
        light=light[kept],
        changes=changes[:, kept],
        modes=modes,
        camera=camera,
    )


def _sizes(offsets: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Changes (RINGS, superpixel, pixel, point, band) of how much light is beside the lenslet, and
    further away.
    """
    ring = np.minimum(np.abs(offsets).max(axis=1), RINGS)
    rings = np.arange(1, RINGS + 1)[:, None]
    return FACTOR_SPREAD * (ring == rings)[:, :, None, None, None] * light


def _as_measured(camera: Camera, calibration: Calibration) -> Camera:
    """The camera whose even response is nearest to the measured one, each other length of the
    sensor's distance and of the filters against it; as described where there is no closed form.
    """
    from scipy.optimize import least_squares

    if valid_for(camera, "fresnel"):
        return camera
    measured, colours = _in_narrow_bands(calibration), _colours(camera, calibration)
    colours = np.where(np.isfinite(measured), colours, 0)
    measured = np.nan_to_num(measured)

    def apart(amounts: np.ndarray) -> np.ndarray:
        even = _even(_by_band(_other_optics(camera, amounts), calibration), np.zeros(2)) * colours
        even *= (even * measured).sum(axis=0) / (even**2).sum(axis=0)
        left = (even - measured) / np.linalg.norm(measured)
        return np.append(left.ravel() / CLOSED_TO, amounts)

    limits = (-OPTICS_MOST, OPTICS_MOST)
    found = least_squares(apart, np.zeros(2), bounds=limits, diff_step=0.05, x_scale=1.0, xtol=1e-3)
    return _other_optics(camera, found.x)


def _predicted(
    camera: Camera,
    calibration: Calibration,
    modes: FieldModes | None = None,
    whole: tuple[int, int] = (0, 0),
) -> tuple[np.ndarray, np.ndarray]:
    """(offsets, light) of NeighbourLight for all superpixels that are followed, as bright in each
    band as the calibrated response: by as many object points as a field has diffraction cells,
    since fewer leave fringes, and too little light on neighbours. Of the points of a field, row by
    row, where there are no modes. On pixels that lie `whole` (rows, columns) further than the
    camera says.
    """
    from plenocli.forward.propagation.system_matrix import PifBuilder

    measured, bands = _in_narrow_bands(calibration), []
    offsets = np.zeros((0, 2), int)
    for wavelength, sampled, plan in _planned(camera, calibration):
        builder = PifBuilder(sampled, wavelength, plan)
        offsets = builder.offsets
        found = _by_part(builder.whole(), sampled)
        bands.append((found if modes is None else found @ modes.basis).astype(np.float32))
    shape = there(calibration.windows).shape
    light = _further(np.stack(bands, axis=-1), offsets, whole, shape)
    light = light * _colours(camera, calibration)[:, None].astype(np.float32)
    even = np.ones(POINTS**2) if modes is None else modes.even
    known = np.einsum("opmk,m,pk->k", light, even, np.isfinite(measured))
    light *= np.nansum(measured, axis=0) / np.maximum(known, 1e-300)
    return offsets, _mixed(light, calibration)


def _further(
    light: np.ndarray, offsets: np.ndarray, whole: tuple[int, int], shape: tuple[int, int]
) -> np.ndarray:
    """Light (superpixel, pixel, ...) on the pixels that lie `whole` (rows, columns) further: beyond
    a window of `shape` pixels on those of the next one, and none beyond the last.
    """
    if not any(whole):
        return light
    image = light.reshape(len(offsets), *shape, *light.shape[2:])
    place = {tuple(offset): k for k, offset in enumerate(offsets.tolist())}
    rows, columns = (np.divmod(np.arange(n) + step, n) for n, step in zip(shape, whole))
    out = np.zeros_like(image)
    for (row, column), k in place.items():
        for down, right in itertools.product(np.unique(rows[0]), np.unique(columns[0])):
            seen = place.get((row + int(down), column + int(right)))
            if seen is not None:
                to = np.ix_(rows[0] == down, columns[0] == right)
                out[k][to] = image[seen][np.ix_(rows[1], columns[1])][to]
    return out.reshape(light.shape)


def _planned(camera: Camera, calibration: Calibration) -> Iterator[tuple[float, Camera, PifPlan]]:
    """The wavelength (m) of each band, the camera with its object points, and how to compute their
    columns.
    """
    from plenocli.forward.accuracy.dial import plan_pif

    for wavelength, seen in _by_band(camera, calibration):
        sampled = _in_parts(finely_sampled(seen, wavelength))
        settings: Any = {"superpixels": (REACH, REACH), "accuracy": KNOWN_TO}
        yield wavelength, sampled, plan_pif(sampled, wavelengths=(wavelength,), **settings)


def _by_band(camera: Camera, calibration: Calibration) -> list[tuple[float, Camera]]:
    """The wavelength (m) of each band of the response, and the camera in its light."""
    response = there(calibration.response)
    states = np.full(len(response.wavelengths), np.nan)
    states = states if response.states is None else response.states
    return [
        (float(w), camera if np.isnan(state) else polarised(camera, f"{state:.0f} deg"))
        for w, state in zip(response.wavelengths, states)
    ]


def _other_optics(camera: Camera, amounts: np.ndarray) -> Camera:
    """The camera with a sensor further away, and with larger filters or pupil, each by so many
    standard deviations.
    """
    filters, (longer, larger) = camera.filter_array, 1 + OPTICS_SPREAD * amounts
    pupil = (
        {"main_lens.aperture_diameter": camera.main_lens.aperture_diameter * larger}
        if filters is None or filters.size is None
        else {"filter_array.size": filters.size * larger}
    )
    return camera.replace(**{"sensor.distance": camera.sensor.distance * longer}, **pupil)


def _even(bands: list[tuple[float, Camera]], displacement: np.ndarray) -> np.ndarray:
    """Closed form of F (pixel, band), not as bright, with the light displaced by (2,) px."""
    found = [uniform_response(seen, w, "fresnel", [-displacement])[0] for w, seen in bands]
    return np.stack(found, axis=-1)


class MovingResponse:
    """What one response of all lenslets becomes where the light is displaced by parts of a pixel:
    predicted in closed form, as sampled edges of filters tell too little to be interpolated.

    camera: its description.
    calibration: with one response for all.

    Raises ConfigError where there is no closed form.
    """

    def __init__(self, camera: Camera, calibration: Calibration) -> None:
        """Predict the response where it is."""
        why = valid_for(camera, "fresnel")
        if why is not None or calibration.sensor.cfa != "mono":
            raise ConfigError(why or "a colour filter array", "camera", "leave it to splines")
        self.calibration, self.bands = calibration, _by_band(camera, calibration)
        self.measured = _in_narrow_bands(calibration)
        here = _even(self.bands, np.zeros(2))
        self.scale = np.nansum(self.measured, axis=0) / here.sum(axis=0)
        self.here = here * self.scale
        self.window = there(calibration.windows).shape

    def at(self, displacement: np.ndarray) -> np.ndarray:
        """F (pixel, band) with the light displaced by (rows, columns) px: what the closed form has
        wrong goes with it.
        """
        found = _even(self.bands, displacement) * self.scale + self._wrong(displacement)
        return _mixed(found, self.calibration)

    def variance(self, displacement: np.ndarray) -> np.ndarray:
        """Of `at`, (pixel, band): half of what makes the difference if the wrong stays."""
        from scipy.ndimage import uniform_filter

        apart = self._wrong(displacement) - self._wrong(np.zeros(2))
        apart = _mixed(apart, self.calibration) ** 2
        near = uniform_filter(apart.reshape(*self.window, -1), (3, 3, 0))
        return np.asarray(near.reshape(apart.shape) / 2)

    def _wrong(self, displacement: np.ndarray) -> np.ndarray:
        from scipy.ndimage import shift

        wrong = (self.measured - self.here).reshape(*self.window, -1)
        if np.any(displacement):
            wrong = shift(np.nan_to_num(wrong), (*displacement, 0), order=DEGREE)
        return np.asarray(wrong.reshape(self.measured.shape))

    def slopes(self, displacement: np.ndarray, step: float = 0.02) -> np.ndarray:
        """Derivatives (2, pixel, band) of `at` by rows and columns, per px."""
        ways = step * np.eye(2)
        return np.stack(
            [(self.at(displacement + w) - self.at(displacement - w)) / (2 * step) for w in ways]
        )


def _typical(calibration: Calibration) -> np.ndarray:
    """F (pixel, band) as LensletResponses has it."""
    return np.asarray(LensletResponses.of(calibration).typical, float)


def _in_narrow_bands(calibration: Calibration) -> np.ndarray:
    """`_typical` as it was measured, before its columns were mixed."""
    mixture = there(calibration.response).mixture
    typical = _typical(calibration)
    return typical if mixture is None else typical @ np.linalg.inv(mixture)


def _mixed(columns: np.ndarray, calibration: Calibration) -> np.ndarray:
    """Of light of narrow bands (..., band), as the calibration's response is."""
    mixture = there(calibration.response).mixture
    return columns if mixture is None else columns @ mixture.astype(columns.dtype)


def _check(camera: Camera, calibration: Calibration) -> None:
    """ConfigError where the lenslets cannot be predicted."""
    windows, grid = there(calibration.windows), calibration.grid
    optics = [geometry(camera, w) for w in there(calibration.response).wavelengths]
    spread = max(1 + one.blur / one.D2 for one in optics)
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
    elif spread > REACH:
        why = (
            f"a main lens so far out of focus that an object point's light meets {spread:.0f} "
            f"lenslets in a row, of which {REACH} are followed"
        )
    if why is not None:
        raise ConfigError(
            f"neighbours' light is not predicted for {why}", "camera", "demultiplex without it"
        )


def _in_parts(camera: Camera) -> Camera:
    """The camera with a number of object points that divides into POINTS a side."""
    samples = tuple(math.ceil(n / POINTS) * POINTS for n in camera.object.samples_per_lenslet)
    return camera.replace(**{"object.samples_per_lenslet": samples})


def _by_part(matrix: np.ndarray, camera: Camera) -> np.ndarray:
    """(superpixel, pixel, point) of POINTS x POINTS points, each the sum over its part."""
    rows, columns = (n // POINTS for n in camera.object.samples_per_lenslet)
    parts = matrix.reshape(*matrix.shape[:2], POINTS, rows, POINTS, columns)
    return parts.sum(axis=(3, 5), dtype=float).reshape(*matrix.shape[:2], -1)


def _colours(camera: Camera, calibration: Calibration) -> np.ndarray:
    """Efficiency (pixel, band) of the pixels under their colours."""
    from plenocli.forward.sensor.cfa import cfa_map, sensitivity

    windows = there(calibration.windows)
    letters, efficiency = sensitivity(camera, there(calibration.response).wavelengths)
    row, column = windows.origin[calibration.grid.valid][0] % 2
    where = cfa_map(windows.shape, camera.sensor.cfa, (int(row), int(column))).ravel()
    return efficiency[[letters.index(letter) for letter in where]]
