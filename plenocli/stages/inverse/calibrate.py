"""calibrate: lenslet grid, white, dark and response F of a camera from its captures."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, NumericsError, UsageError
from plenocli.base.progress import bar, note
from plenocli.files.read.series import check_exposure_times, read_series, true_centres
from plenocli.forward.sensor.capture import Capture
from plenocli.forward.sensor.noise import ROUNDING, Noise

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.frames import Dark
    from plenocli.inverse.grid.lenslet_grid import LensletGrid
    from plenocli.inverse.spectra.calibration import Calibration, Response, Windows

Name = str | os.PathLike[str]
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
class ResponseSummary:
    """What calibrate says of a response F.

    bands_nm: (band,) nm.
    condition, angles_deg, bias: plenocli.inverse.spectra.calibration.Quality.
    columns: how it came about, in words.
    response: "own", "shared" or "low-rank".
    """

    bands_nm: list[float]
    condition: float
    columns: str
    response: str
    angles_deg: list[list[float]]
    bias: list[float] | None


@dataclass(frozen=True, kw_only=True)
class CalibrateSummary:
    """What calibrate found.

    output: the calibration file.
    lattice, pitch_px, angle_deg, rms_px, model: of plenocli.inverse.grid.lenslet_grid.LensletGrid.
    residual_median_px, residual_worst_px, residual_worst_lenslet: distances of measured centres
        from the lattice.
    lenslets: how many can be used.
    array: rows and columns of lenslets.
    window: rows and columns of a superpixel's window, px.
    noise: where gain and read noise come from, in words.
    gain_dn_per_e: None where it is not known.
    response: None without --band captures.
    deviation_px: root mean square distance from the true centres, of a simulated capture.
    """

    output: str
    lattice: str
    pitch_px: list[float]
    angle_deg: float
    rms_px: float
    model: str
    residual_median_px: float
    residual_worst_px: float
    residual_worst_lenslet: list[int]
    lenslets: int
    array: list[int]
    window: list[int]
    noise: str
    gain_dn_per_e: float | None
    response: ResponseSummary | None = None
    deviation_px: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary as --json prints it: one flat object, without what there is none of."""
        flat = asdict(self)
        response = flat.pop("response")
        if flat["deviation_px"] is None:
            del flat["deviation_px"]
        return flat | (response or {})


def run_calibrate(
    output: Name,
    *,
    whites: Sequence[Name],
    darks: Sequence[Name] = (),
    bands: Sequence[tuple[float, Name]] = (),
    radiances: Sequence[tuple[float, float]] = (),
    camera: Name | None = None,
    response: str = "auto",
    lattice: str = "auto",
    cfa: str | None = None,
    near: tuple[float, float] | None = None,
    overwrite: bool = False,
    command: str = "",
) -> CalibrateSummary:
    """Calibrate a camera and write `output`.

    whites, darks: captures.
    bands: (wavelength m, capture) pairs, several a band allowed.
    radiances: (wavelength m, relative radiance of that source) pairs, 1 where not given.
    camera: TOML for gain and read noise.
    response: own, shared, low-rank or auto (plenocli.inverse.spectra.measured_response).
    lattice: auto, square or hexagonal.
    cfa: colour filter array of PNG and TIFF mosaics (default: the camera's, else mono).
    near: (row, column) px close to any superpixel's centre (see find_grid).

    Raises InputError for files, NumericsError where there is no lattice or no light.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.calibrations import write_calibration
    from plenocli.files.read.cameras import camera_files, read_camera

    bands = sorted(bands, key=lambda pair: pair[0])
    if unknown := [w for w, _ in radiances if not any(abs(w - band) < 1e-12 for band, _ in bands)]:
        raise UsageError(
            f"--band-radiance names {unknown[0] * 1e9:g} nm, of which there is no --band"
        )
    roles = {"white": list(whites), "dark": list(darks), "camera": camera, **_band_roles(bands)}
    check_output(
        output,
        overwrite=overwrite,
        inputs=[*whites, *darks, camera, *(path for _, path in bands)],
        suffixes=(".h5",),
    )
    description = read_camera(camera) if camera else None
    roles |= camera_files(camera, description) if camera else {}
    cfa = cfa or (description.sensor.cfa if description else None)
    found, calibration, noise = _calibrated(
        Captures(
            whites=whites,
            darks=darks,
            bands=bands,
            radiances=dict(radiances),
            cfa=cfa,
            camera=description,
        ),
        response,
        lattice,
        near,
    )
    summary = _summary(output, found, calibration, noise, whites[0])
    write_calibration(
        output,
        calibration,
        Provenance(
            command, describe_inputs(roles), None, to_toml(description) if description else ""
        ),
        overwrite=overwrite,
    )
    return summary


@dataclass(frozen=True, kw_only=True)
class Captures:
    """What a camera is calibrated from; as run_calibrate's arguments.

    radiances: wavelength m -> relative radiance.
    camera: its description, for gain and read noise.
    """

    whites: Sequence[Name]
    darks: Sequence[Name]
    bands: Sequence[tuple[float, Name]]
    radiances: dict[float, float]
    cfa: str | None
    camera: Camera | None


def _calibrated(
    captures: Captures, response: str, lattice: str, near: tuple[float, float] | None
) -> tuple[LensletGrid, Calibration, KnownNoise]:
    """(the grid as it was found, the calibration, the noise and where it is known from)."""
    from plenocli.forward.sensor.frames import bad_pixels, make_dark, merge
    from plenocli.inverse.spectra.calibration import Calibration, Sensor, White, windows_on
    from plenocli.inverse.spectra.quality import mean_of_known

    white = read_series(captures.whites, cfa=captures.cfa)
    dark_frames = read_series(captures.darks, white[0], captures.cfa)
    check_exposure_times(white)
    first = white[0]
    dark = make_dark(
        [e.mosaic for e in dark_frames],
        [e.exposure_s for e in dark_frames],
        first.levels.black,
        first.shape,
    )
    del dark_frames
    noise = _told_by(white, dark, _noise(white, dark, captures.camera))
    signal, _ = merge(
        [e.mosaic for e in white],
        [e.exposure_s for e in white],
        dark,
        first.levels.white,
        first.exposure_s,
    )
    if np.isnan(signal).mean() > SATURATED:
        raise InputError(
            f"{np.isnan(signal).mean():.0%} of the white image is saturated",
            first.metadata.path,
            "expose it for less time",
        )
    found = _grid(signal, first, lattice, near)
    windows, valid = windows_on(found, first.shape)
    step = 1 if first.cfa == "mono" else 2
    bad = bad_pixels(signal, dark, first.levels.white, step) | np.isnan(signal)
    reference = White.measured(np.where(bad, np.float32(np.nan), signal), windows, valid)
    valid = valid & (reference.level > 0)
    del signal
    grid, measured = replace(found, valid=valid), None
    if captures.bands:
        measured, noise = _response(captures, white, dark, bad, noise, response, grid, windows)
        if measured.shared:
            reference = replace(reference, superpixels=mean_of_known(reference.superpixels[valid]))
    noise = noise.filled()
    sensor = Sensor(
        cfa=first.cfa,
        units=first.units,
        white_level=first.levels.white,
        exposure=first.exposure_s,
        gain_e_per_dn=1 / noise.gain if noise.gain else None,
        read_noise=float(np.sqrt(noise.read_variance)),
        notes=f"noise from: {noise.source}",
    )
    calibration = Calibration(
        grid=grid, sensor=sensor, windows=windows, white=reference, dark=dark, response=measured
    )
    return found, calibration, noise


def _band_roles(bands: Sequence[tuple[float, Name]]) -> dict[str, list[Name]]:
    roles: dict[str, list[Name]] = {}
    for wavelength, path in bands:
        roles.setdefault(f"band {wavelength * 1e9:.6g}nm", []).append(path)
    return roles


def _noise(white: list[Capture], dark: Dark, camera: Camera | None) -> KnownNoise:
    """Gain and read variance as far as the camera description or the files say them."""
    from plenocli.forward.sensor.noise import SensorModel

    if camera is not None and white[0].units == "DN":
        noise = SensorModel.from_camera(camera).noise
        return KnownNoise(noise.gain, noise.read_variance, "camera")
    known = white[0].white_noise
    if known is not None and known.white:
        return KnownNoise(0.0, known.white, "white noise of the simulation")
    return KnownNoise(white[0].levels.gain, None if dark.sigma is None else dark.sigma**2, "file")


def _told_by(group: list[Capture], dark: Dark, noise: KnownNoise) -> KnownNoise:
    """The noise, what is not known of it from two frames of one scene among the
    exposures `group`.
    """
    from plenocli.forward.sensor.frames import photon_transfer

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
    signal: np.ndarray, white: Capture, lattice: str, near: tuple[float, float] | None
) -> LensletGrid:
    from plenocli.inverse.grid.detect import find_grid

    try:
        return find_grid(
            np.where(np.isnan(signal), np.nanmax(signal), signal), white.cfa, None, lattice, near
        )
    except (NumericsError, InputError) as error:
        raise error.at(white.metadata.path) from None


def _response(
    captures: Captures,
    white: list[Capture],
    dark: Dark,
    bad: np.ndarray,
    noise: KnownNoise,
    asked: str,
    grid: LensletGrid,
    windows: Windows,
) -> tuple[Response, KnownNoise]:
    """(the response: each band's signal over the radiance of its source; the noise, as the captures
    tell it).
    """
    from plenocli.forward.sensor.frames import merge
    from plenocli.inverse.spectra.measured_response import GatheredResponses, measured_response

    wavelengths = list(dict.fromkeys(w for w, _ in captures.bands))
    reference, cfa = white[0].exposure_s, white[0].cfa
    gathered = GatheredResponses(windows, grid.valid, len(wavelengths))
    for k, wavelength in enumerate(bar(wavelengths, len(wavelengths), "bands")):
        group = read_series([p for w, p in captures.bands if w == wavelength], white[0], cfa)
        check_exposure_times([white[0], *group])
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
        energy = next(
            (r for w, r in captures.radiances.items() if abs(w - wavelength) < 1e-12), 1.0
        )
        gathered.add(k, wavelength, signal, weight, np.mean(shares), energy)
    known = noise.known()
    variance = None if known is None else gathered.variance(known, dark.variance)
    found = measured_response(
        asked,
        gathered,
        variance,
        wavelengths=np.array(wavelengths),
        centres=grid.centres,
        cfa=cfa,
    )
    return found, noise


def _summary(
    output: Name,
    found: LensletGrid,
    calibration: Calibration,
    noise: KnownNoise,
    white: Name,
) -> CalibrateSummary:
    """found: the grid with all lenslets that the white image shows."""
    row, column = np.unravel_index(
        np.nanargmax(np.where(found.valid, found.residual, np.nan)), found.valid.shape
    )
    grid, response = calibration.grid, calibration.response
    return CalibrateSummary(
        output=str(output),
        lattice=found.lattice,
        pitch_px=[float(p) for p in found.pitch],
        angle_deg=found.angle,
        rms_px=found.rms,
        model=found.model,
        residual_median_px=float(np.nanmedian(found.residual[found.valid])),
        residual_worst_px=float(found.residual[row, column]),
        residual_worst_lenslet=[int(row), int(column)],
        lenslets=int(grid.valid.sum()),
        array=list(grid.valid.shape),
        window=list(calibration.windows.shape),
        noise=noise.source,
        gain_dn_per_e=noise.gain,
        response=None if response is None else _response_summary(response),
        deviation_px=_deviation(grid, white),
    )


def _response_summary(response: Response) -> ResponseSummary:
    return ResponseSummary(
        bands_nm=[float(w * 1e9) for w in response.wavelengths],
        condition=response.quality.condition,
        columns=response.notes["text"],
        response=response.notes["response"],
        angles_deg=response.quality.angles,
        bias=response.quality.bias,
    )


def _deviation(grid: LensletGrid, white: Name) -> float | None:
    """Root mean square distance, px, of the lenslets from where a simulated capture knows them to
    be; None for others.
    """
    from scipy.spatial import cKDTree

    truth = true_centres(white)
    if truth is None:
        return None
    miss, _ = cKDTree(truth.reshape(-1, 2)).query(grid.centres[grid.valid])
    deviation = float(np.sqrt(np.mean(miss**2)))
    note(f"the simulated capture knows its centres: found within {deviation:.4f} px rms")
    return deviation
