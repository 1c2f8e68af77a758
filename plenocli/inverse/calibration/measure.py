"""A camera measured: lenslet grid, white, dark and response F from its captures."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.progress import bar, note
from plenocli.base.text import by
from plenocli.forward.sensor.cfa import doubted_array
from plenocli.forward.sensor.detector import ROUNDING, SensorModel
from plenocli.forward.sensor.frames import (
    bad_pixels,
    make_dark,
    merge,
    photon_transfer,
    require_in_reach,
)
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.calibration.calibration import (
    Calibration,
    Sensor,
    White,
    there,
    windows_on,
)
from plenocli.inverse.calibration.measured_response import GatheredResponses, measured_response
from plenocli.inverse.calibration.quality import mean_of_known, quality_of_one
from plenocli.inverse.grid.detect import find_grid
from plenocli.inverse.grid.scenes import find_scene_grid, moved_grid, shifted_mosaic

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.sensor.frames import Dark
    from plenocli.inverse.calibration.calibration import Response, Windows
    from plenocli.inverse.grid.lenslet_grid import LensletGrid

UNEVEN = 0.08
"""Difference of a superpixel's light from its neighbours' that nine in ten of a white image do not
reach: white images of three real and three simulated cameras have 0.016 at most, letters 0.3.
"""
SATURATED = 0.05
"""Share of the white image that may be saturated."""


@dataclass(frozen=True)
class KnownNoise:
    """What is known of a sensor's noise.

    gain: units per electron; None: unknown.
    read_variance: of one dark pixel, units^2; None: unknown.
    source: where they come from, in words.
    """

    gain: float | None
    read_variance: float | None
    source: str

    def filled(self) -> KnownNoise:
        """With the rounding's variance where nothing else is known, and the source of an unknown
        gain said to be unknown.
        """
        return KnownNoise(
            self.gain,
            ROUNDING if self.read_variance is None else self.read_variance,
            "unknown" if self.gain is None else self.source,
        )

    def known(self) -> Noise | None:
        """The noise, with the rounding's where no read noise is known; None without a gain."""
        if self.gain is None:
            return None
        read = ROUNDING if self.read_variance is None else self.read_variance
        return Noise(gain=self.gain, read_variance=read)


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What captures of a camera give.

    grid: with all lenslets that the white image shows.
    calibration: of those that can be used.
    noise: of the sensor, and where it is known from.
    """

    grid: LensletGrid
    calibration: Calibration
    noise: KnownNoise


@dataclass(frozen=True, kw_only=True)
class NarrowBands:
    """Captures under narrow-band light.

    wavelengths: (band,) m, ascending.
    captures: those of a wavelength (m), read when they are asked for.
    radiances: of the sources relative to each other, by wavelength (m); 1 where not given.
    across: the same under light polarised along 90 degrees, where `captures` are under light along
        0 degrees; None: light is not polarised.
    """

    wavelengths: Sequence[float]
    captures: Callable[[float], Sequence[Capture]]
    radiances: Mapping[float, float] = field(default_factory=dict)
    across: Callable[[float], Sequence[Capture]] | None = None


def calibrate(
    whites: Sequence[Capture],
    *,
    darks: Sequence[Capture] = (),
    bands: NarrowBands | None = None,
    scenes: Sequence[Capture] = (),
    grid_error: float = np.inf,
    camera: Camera | None = None,
    response: str = "auto",
    lattice: str = "auto",
    near: tuple[float, float] | None = None,
) -> Measured:
    """Grid, white, dark and (from narrow-band captures) the response F of a camera.

    whites: captures of an evenly lit white, at one or several exposure times; none: the grid comes
        from `scenes` alone, and what all superpixels have in common there is the white reference.
    darks: captures without light.
    bands: captures under narrow-band light; None: no response.
    scenes: captures of any scene; beside whites of another day they tell how lenslets moved since.
    grid_error: px rms, the largest expected error of a grid from scenes that is accepted.
    camera: description, for gain and read noise, how many lenslets there are, and whether a filter
        array parts the superpixels; None: as the captures tell.
    response: "own", "shared", "low-rank" or "auto" (measured_response).
    lattice: "auto", "square" or "hexagonal".
    near: (row, column) px close to any superpixel's centre (plenocli.inverse.grid.detect).

    Raises InputError for captures that do not go together or are saturated, NumericsError where
    there is no lattice or no light, or the error of a grid from scenes is expected to be larger.
    docs/model.md, section 9.
    """
    check_exposure_times(whites)
    first = (whites or scenes)[0]
    for capture in (*whites[1:], *scenes, *darks):
        require_alike(capture, first)
    dark = make_dark(
        [e.mosaic for e in darks], [e.exposure_s for e in darks], first.levels.black, first.shape
    )
    del darks  # whoever read them for this may have them gone
    noise = _told_by(whites, dark, _noise(whites or scenes, dark, camera))
    shots = [_filled(_signal([scene], dark)) for scene in scenes]
    if whites:
        signal = _signal(whites, dark)
        _check_saturation(signal, first)
        if said := doubted_array(signal, first.cfa):
            note(f"warning: the white image: {said}; if the array is another one, say so by --cfa")
        found = _grid(signal, first, camera, lattice, near)
        if scenes:
            found, signal = _moved(found, signal, shots, first.cfa)
    else:
        found = _grid(shots, first, camera, lattice, near)
        signal = np.asarray(np.mean(shots, axis=0), np.float32)
    _check_expected(found, grid_error, bool(whites), len(scenes))
    windows, valid = windows_on(found, first.shape)
    step = 1 if first.cfa == "mono" else 2
    bad = bad_pixels(signal, dark, first.levels.white, step) | np.isnan(signal)
    reference = White.measured(np.where(bad, np.float32(np.nan), signal), windows, valid)
    valid = valid & (there(reference.level) > 0)
    if whites:
        _check_evenness(np.where(valid, there(reference.level), np.nan))
    else:
        reference = _in_common(reference, windows, valid, signal.shape)
    del signal, shots
    grid, measured = replace(found, valid=valid), None
    if bands is not None:
        light = _Light(first, dark, bad)
        measured, noise = _response(bands, light, noise, response, grid, windows)
        if bands.across is not None:
            crossed = replace(bands, captures=bands.across, across=None)
            alike = there(measured.notes)["response"]
            second, noise = _response(crossed, light, noise, alike, grid, windows)
            measured = _of_both(measured, second)
        if measured.shared:
            reference = replace(
                reference, superpixels=mean_of_known(there(reference.superpixels)[valid])
            )
    noise = noise.filled()
    calibration = Calibration(
        grid=grid,
        sensor=_sensor(first, noise),
        windows=windows,
        white=reference,
        dark=dark,
        response=measured,
    )
    return Measured(grid=found, calibration=calibration, noise=noise)


def _signal(group: Sequence[Capture], dark: Dark) -> np.ndarray:
    """Captures of one light as one, without the dark; NaN where all are saturated."""
    first = group[0]
    signal, _ = merge(
        [e.mosaic for e in group],
        [e.exposure_s for e in group],
        dark,
        first.levels.white,
        first.exposure_s,
    )
    return signal


def _filled(signal: np.ndarray) -> np.ndarray:
    """The signal with as much light as anywhere where it is saturated."""
    lost = np.isnan(signal)
    return np.where(lost, np.nanmax(signal), signal) if lost.any() and not lost.all() else signal


def _moved(
    grid: LensletGrid, white: np.ndarray, scenes: Sequence[np.ndarray], cfa: str
) -> tuple[LensletGrid, np.ndarray]:
    """(the grid of a white image where captures of scenes have it, the white image moved along)."""
    found = moved_grid(grid, _filled(white), scenes, cfa)
    error = there(found.grid.expected_error)
    if not found.moved:
        note(
            "lenslets are where the white image has them, as far as the captures tell "
            f"({found.rms:.2f} px, expected error {error:.2f} px)"
        )
        return found.grid, white
    note(
        f"lenslets moved by {found.rms:.2f} px since the white image (expected error {error:.2f} "
        "px)"
    )
    step = np.median((found.grid.centres - grid.centres)[grid.valid], axis=0)
    return found.grid, shifted_mosaic(white, step, cfa)


def _check_expected(grid: LensletGrid, most: float, white: bool, scenes: int) -> None:
    """Refuse a grid from scenes whose expected error is too large."""
    error = grid.expected_error
    if error is None or error <= most:
        return
    raise NumericsError(
        f"the {'motion since the white image' if white else 'grid'} is expected to be off by "
        f"{error:.2f} px rms (lenslets are {grid.pitch.min():.1f} px apart), more than {most:g}: "
        "light is uneven within superpixels where the scene is",
        fix=(
            f"give {'more' if scenes > 1 else 'several'} captures of different scenes or a white "
            f"image{' of the day' if white else ''}, or accept it with --grid-error "
            f"{np.ceil(error * 100 + 1e-9) / 100:.2f}"
        ),
    )


def _in_common(
    reference: White, windows: Windows, valid: np.ndarray, shape: tuple[int, ...]
) -> White:
    """The white reference that is what superpixels which show a scene have in common, at their
    median level: what the camera does to all of them.

    shape: rows and columns of the sensor, px.
    """
    level = there(reference.level)[valid]
    look = np.nanmedian(there(reference.superpixels)[valid] / level[:, None], axis=0)
    white = np.full(shape, np.nan, np.float32)
    for row, column in windows.origin[valid]:
        white[row : row + windows.shape[0], column : column + windows.shape[1]] = np.reshape(
            look * np.median(level), windows.shape
        )
    return replace(
        White.measured(white, windows, valid),
        superpixels=(look * np.median(level)).astype(np.float32),
    )


def _of_both(along: Response, across: Response) -> Response:
    """The response to light that is not polarised, and what polarised light changes, from those to
    light along 0 and along 90 degrees.
    """
    one, two = (np.asarray(part.matrix) for part in (along, across))
    both = (one + two) / 2
    variance = None
    if along.variance is not None and across.variance is not None:
        variance = (along.variance + across.variance) / 4
    quality = quality_of_one(both if both.ndim == 2 else mean_of_known(both))
    return replace(
        along, matrix=both, polarised=(one - two) / 2, variance=variance, quality=quality
    )


def _check_saturation(signal: np.ndarray, white: Capture) -> None:
    """Refuse a white image that lost too many pixels."""
    lost = np.isnan(signal).mean()
    if lost > SATURATED:
        raise InputError(
            f"{lost:.0%} of the white image is saturated",
            white.metadata.path,
            "expose it for less time",
        )


def _check_evenness(level: np.ndarray) -> None:
    """A warning where the light of superpixels (lenslet_row, lenslet_column) jumps from one to the
    next, as that of a scene does.
    """
    around = np.pad(level, 1, constant_values=np.nan)
    beside = [around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]]
    jump = np.abs(level / np.mean(beside, axis=0) - 1)
    jump = jump[np.isfinite(jump)]
    if jump.size and (typical := float(np.percentile(jump, 90))) > UNEVEN:
        note(
            f"warning: light differs by {typical:.0%} from one superpixel to the next, as that of "
            "a scene and no white image does: --scene finds the grid of a photograph and says how "
            "far it may be off"
        )


def _sensor(white: Capture, noise: KnownNoise) -> Sensor:
    """What the numbers mean; noise: with a read variance."""
    return Sensor(
        cfa=white.cfa,
        units=white.units,
        white_level=white.levels.white,
        exposure=white.exposure_s,
        gain_e_per_dn=1 / noise.gain if noise.gain else None,
        read_noise=float(np.sqrt(there(noise.read_variance))),
        notes=f"noise from: {noise.source}",
    )


def check_exposure_times(captures: Sequence[Capture]) -> None:
    """InputError unless all or none of the captures know their exposure time: else their scales
    cannot be compared.
    """
    known = [c for c in captures if c.exposure_s is not None]
    if known and len(known) != len(captures):
        lost = next(c for c in captures if c.exposure_s is None)
        raise InputError(
            f"does not say its exposure time, while {known[0].name} does",
            lost.metadata.path,
            "use files of one kind for all captures",
        )


def require_alike(capture: Capture, like: Capture) -> None:
    """InputError where two captures are not of one camera at one setting: in size, colour filter
    array or units.
    """
    for what, ours, theirs in (
        ("size", by(capture.shape), by(like.shape)),
        ("colour filter array", capture.cfa, like.cfa),
        ("unit", capture.units, like.units),
    ):
        if ours != theirs:
            raise InputError(
                f"has another {what} ({ours}) than {like.name} ({theirs})",
                capture.metadata.path,
                "use captures of one camera at one setting",
            )


def _noise(white: Sequence[Capture], dark: Dark, camera: Camera | None) -> KnownNoise:
    """Gain and read variance as far as the camera description or the files say them."""
    if camera is not None and white[0].units == "DN":
        noise = SensorModel.from_camera(camera).temporal_noise(white[0].exposure_s or 0.0)
        return KnownNoise(noise.gain, noise.read_variance, "camera")
    known = white[0].white_noise
    if known is not None and known.white:
        return KnownNoise(0.0, known.white, "white noise of the simulation")
    return KnownNoise(white[0].levels.gain, None if dark.sigma is None else dark.sigma**2, "file")


def _told_by(group: Sequence[Capture], dark: Dark, noise: KnownNoise) -> KnownNoise:
    """The noise, what is not known of it from two frames of one scene among the
    exposures `group`.
    """
    for a, b in zip(group[::2], group[1::2]):
        if (
            (noise.gain is None or noise.read_variance is None)
            and a.exposure_s == b.exposure_s
            and a.metadata.path != b.metadata.path
        ):
            top, black = a.levels.white, a.levels.black
            limit = 0.9 * (top - np.mean(black)) if np.isfinite(top) else np.inf
            found = photon_transfer(
                a.mosaic - dark.at(a.exposure_s), b.mosaic - dark.at(b.exposure_s), limit
            )
            if found:
                return KnownNoise(
                    found.gain if noise.gain is None else noise.gain,
                    found.read_variance if noise.read_variance is None else noise.read_variance,
                    "photon transfer of repeated frames",
                )
    return noise


def _grid(
    signal: np.ndarray | Sequence[np.ndarray],
    white: Capture,
    camera: Camera | None,
    lattice: str,
    near: tuple[float, float] | None,
) -> LensletGrid:
    """The grid, of as many lenslets as the camera's description or else the capture says.

    signal: of the white image, or those of several captures of scenes.
    """
    parts = camera is not None and camera.filter_array is not None
    pitch = camera.superpixel_pitch / camera.sensor.pixel_pitch if camera and parts else None
    said = camera.lenslet_array.count if camera is not None else None
    count = said or (white.grid.count if white.grid else None)
    try:
        if not isinstance(signal, np.ndarray):
            return find_scene_grid(signal, white.cfa, lattice, near, parts=parts, count=count)
        return find_grid(
            _filled(signal), white.cfa, None, lattice, near, parts=parts, count=count, pitch=pitch
        )
    except (NumericsError, InputError) as error:
        raise error.at(white.metadata.path) from None


class _Light(NamedTuple):
    """What makes signal of band captures: the white capture, the dark, pixels to leave out."""

    white: Capture
    dark: Dark
    bad: np.ndarray


def _response(
    bands: NarrowBands,
    light: _Light,
    noise: KnownNoise,
    asked: str,
    grid: LensletGrid,
    windows: Windows,
) -> tuple[Response, KnownNoise]:
    """(the response: each band's signal over the radiance of its source; the noise, as the captures
    tell it).
    """
    white, dark, bad = light
    reference, wavelengths = white.exposure_s, bands.wavelengths
    brightest = max(float(np.nanmax(white.mosaic)), 1e-30)
    gathered = GatheredResponses(windows, grid.valid, len(wavelengths))
    for k, wavelength in enumerate(bar(wavelengths, len(wavelengths), "bands")):
        group = bands.captures(wavelength)
        for capture in group:
            require_alike(capture, white)
            require_in_reach(capture.mosaic, capture.metadata.path, brightest)
        check_exposure_times([white, *group])
        noise = _told_by(group, dark, noise)
        shares = [
            1.0 if e.exposure_s is None or reference is None else e.exposure_s / reference
            for e in group
        ]
        signal, weight = merge(
            [e.mosaic for e in group],
            [e.exposure_s for e in group],
            dark,
            group[0].levels.white,
            reference,
        )
        signal[bad] = np.nan
        energy = next((r for w, r in bands.radiances.items() if abs(w - wavelength) < 1e-12), 1.0)
        gathered.add(k, wavelength, signal, weight, float(np.mean(shares)), energy)
    known = noise.known()
    variance = None if known is None else gathered.variance(known, dark.variance)
    found = measured_response(
        asked,
        gathered,
        variance,
        wavelengths=np.array(wavelengths),
        centres=grid.centres,
        cfa=white.cfa,
    )
    return found, noise
