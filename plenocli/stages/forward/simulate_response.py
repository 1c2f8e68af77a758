"""simulate-response: the response matrix F of every superpixel, predicted from the
description of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import bar, note

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.sensor.response_prediction import (
        PredictionNotes,
        PredictionOptions,
        ResponsePrediction,
    )
    from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds
    from plenocli.inverse.calibration.calibration import Calibration

Name = str | Path
SAME_PITCH = 0.02
"""Share by which the pitch of a grid may differ from the description's without a word."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line says beyond the camera.

    wavelengths: m, centres of the bands (empty: the camera's).
    bandwidth: m, full width at half maximum of each band.
    spectral_step: m, of white light; None: as the filters need.
    exposure: s; None: the camera's white exposure.
    model, own_field, accuracy, superpixels, coherent_ring:
        plenocli.forward.sensor.response_prediction.PredictionOptions.
    """

    wavelengths: tuple[float, ...] = ()
    bandwidth: float = 0.0
    spectral_step: float | None = None
    exposure: float | None = None
    model: str = "auto"
    own_field: bool = False
    accuracy: float | None = None
    superpixels: Any = "auto"
    coherent_ring: Any = "auto"

    def options(self) -> PredictionOptions:
        """How F is computed."""
        from plenocli.forward.sensor.response_prediction import PredictionOptions

        return PredictionOptions(
            **{one.name: getattr(self, one.name) for one in fields(PredictionOptions)}
        )


@dataclass(frozen=True, kw_only=True)
class ResponseSummary:
    """What was predicted.

    output: the calibration file.
    bands_nm: (band,) nm.
    lenslets: how many can be used.
    array: rows and columns of lenslets.
    window: rows and columns of a superpixel, px.
    kinds: how many kinds of superpixels there are.
    condition, angles_deg: plenocli.inverse.calibration.calibration.Quality.
    smallest_angle_deg: between two columns of F; None: there is one band.
    notes: plenocli.forward.sensor.response_prediction.PredictionNotes.
    """

    output: str
    bands_nm: list[float]
    lenslets: int
    array: list[int]
    window: list[int]
    kinds: int
    condition: float
    angles_deg: list[list[float]]
    smallest_angle_deg: float | None
    notes: PredictionNotes

    def as_json(self) -> dict[str, Any]:
        """The summary as --json prints it: one flat object."""
        flat = {one.name: getattr(self, one.name) for one in fields(self)}
        return flat | flat.pop("notes").as_json()


def run_simulate_response(
    camera_path: Name,
    output: Name,
    settings: Settings,
    *,
    grid: Name | None = None,
    overwrite: bool = False,
    command: str = "",
) -> ResponseSummary:
    """Predict F and write it as a calibration that demux takes.

    Columns are scaled as captures of simulated narrow-band light are: each band by itself fills the
    brightest pixel to 80 % of full well in the white exposure.
    grid: a calibration whose lenslets, white, dark and noise are kept; without one they follow from
        the camera.

    Raises ConfigError for the camera, InputError for the grid, UsageError for options that exclude
    each other.
    """
    from plenocli.files.artefacts.provenance import Provenance, describe_inputs
    from plenocli.files.atomic import check_output
    from plenocli.files.config.camera_file import to_toml
    from plenocli.files.read.calibrations import read_calibration, write_calibration
    from plenocli.files.read.cameras import camera_files, read_camera
    from plenocli.forward.sensor.response_prediction import ResponsePrediction
    from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds

    check_output(output, overwrite=overwrite, inputs=[camera_path, grid], suffixes=(".h5",))
    camera = read_camera(camera_path)
    measured = read_calibration(grid, response=False) if grid else None
    kinds = (
        _measured_kinds(measured, camera, grid)
        if grid and measured
        else SuperpixelKinds.of_camera(camera)
    )
    prediction = ResponsePrediction(camera, settings.options(), kinds, camera_path)
    bands = tuple(sorted(set(settings.wavelengths))) or camera.light.wavelengths
    known = measured or _described(camera, prediction, settings)
    seconds = settings.exposure if measured else known.sensor.exposure
    signals, more = [], []
    for lamp in _narrow(bands, settings):
        signals.append(prediction.white_signal(lamp, seconds, lamp=True)[0])
        more.append(prediction.polarised_signal(lamp, seconds))
    matrix = np.stack(signals, axis=-1)
    apart = [one for one in more if one is not None]
    polarised = np.stack(apart, axis=-1) if apart else None
    notes = prediction.notes(bands)
    calibration = _with_response(known, kinds, matrix, polarised, bands, notes)
    provenance = Provenance(
        command=command,
        inputs=describe_inputs(camera_files(camera_path, camera) | {"grid": grid}),
        seed=None,
        config=to_toml(camera),
        accuracy=prediction.accuracy.as_json(),
    )
    write_calibration(output, calibration, provenance, overwrite=overwrite)
    return _summary(output, calibration, kinds, notes)


def _narrow(bands: tuple[float, ...], settings: Settings) -> list[Quadrature]:
    from plenocli.forward.scene.light import narrow_band

    return bar(
        [narrow_band(wavelength, settings.bandwidth) for wavelength in bands], len(bands), "bands"
    )


def _white(camera: Camera, settings: Settings) -> Quadrature:
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant

    return broadband(
        camera,
        lambda wavelengths: illuminant(camera.light.illuminant, wavelengths),
        settings.spectral_step,
    )


def _measured_kinds(measured: Calibration, camera: Camera, path: Name) -> SuperpixelKinds:
    """The windows of a calibration's lenslets."""
    from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds

    cfa = measured.sensor.cfa
    if cfa != camera.sensor.cfa:
        raise InputError(
            f"has the colour filter array {cfa}, the camera {camera.sensor.cfa}",
            path,
            "correct sensor.cfa",
        )
    grid, windows, dark = measured.grid, measured.windows, measured.dark
    if windows is None or dark is None or dark.mean.ndim != 2:
        raise InputError(
            "does not say where its windows and its dark image are", path, "make it with calibrate"
        )
    for measured_pitch, pitch in zip(
        grid.pitch,
        (camera.superpixel_pitch * camera.lenslet_array.row_spacing, camera.superpixel_pitch),
    ):
        if abs(measured_pitch * camera.sensor.pixel_pitch / pitch - 1) > SAME_PITCH:
            note(
                f"warning: lenslets are {measured_pitch:.4g} px apart in the grid, "
                f"{pitch / camera.sensor.pixel_pitch:.4g} px by the camera's description"
            )
    middles = windows.origin + (np.array(windows.shape) - 1) / 2
    return SuperpixelKinds.sorted(
        centres=grid.centres,
        origin=windows.origin,
        window=windows.shape,
        valid=grid.valid,
        sensor_shape=dark.mean.shape,
        shift=np.where(grid.valid[..., None], middles - grid.centres, 0.0),
        cfa=cfa,
    )


def _described(camera: Camera, prediction: ResponsePrediction, settings: Settings) -> Calibration:
    """A calibration without errors, and without a response: the grid of the description, its
    white, its black level.
    """
    from plenocli.forward.sensor.detector import SensorModel
    from plenocli.forward.sensor.frames import Dark
    from plenocli.inverse.calibration.calibration import Calibration, Sensor, White, Windows
    from plenocli.inverse.grid.lenslet_grid import LensletGrid

    sensor, array, kinds = camera.sensor, camera.lenslet_array, prediction.kinds
    signal, exposure = prediction.white_signal(_white(camera, settings), settings.exposure)
    pitch = (
        np.array([camera.superpixel_pitch * array.row_spacing, camera.superpixel_pitch])
        / sensor.pixel_pitch
    )
    right = 0.0 if array.lattice == "square" else pitch[1] / 2
    model = SensorModel.from_camera(camera)
    read_noise = model.temporal_noise(exposure).sigma
    black = sensor.black_level + model.gain * model.dark_current * exposure
    return Calibration(
        grid=LensletGrid(
            lattice=array.lattice,
            pitch=pitch,
            angle=0.0,
            basis=np.array([[pitch[0], right], [0.0, pitch[1]]]),
            model="description",
            centres=kinds.centres,
            valid=kinds.valid,
            residual=np.where(kinds.valid, 0.0, np.nan),
            rms=0.0,
        ),
        sensor=Sensor(
            cfa=sensor.cfa,
            units="DN",
            white_level=float(model.white_level),
            exposure=exposure,
            gain_e_per_dn=1 / sensor.gain,
            read_noise=read_noise,
            notes="predicted",
        ),
        windows=Windows(kinds.origin, kinds.window),
        white=White.predicted(signal, kinds),
        dark=Dark(
            mean=np.full(kinds.sensor_shape, black, np.float32),
            black=np.full((2, 2), float(sensor.black_level)),
            exposure=exposure,
            sigma=read_noise,
        ),
    )


def _with_response(
    known: Calibration,
    kinds: SuperpixelKinds,
    matrix: np.ndarray,
    polarised: np.ndarray | None,
    bands: tuple[float, ...],
    notes: PredictionNotes,
) -> Calibration:
    """The calibration with F = `matrix` (kind, pixel, band), and what it has more of polarised
    light.
    """
    from plenocli.inverse.calibration.calibration import Response
    from plenocli.inverse.calibration.quality import quality_of_one

    # what a description leaves out is spread evenly over the superpixel: it is not
    # known where it lies
    error = np.array(notes.error) * np.sqrt(np.mean(matrix.astype(float) ** 2, axis=(0, 1)))
    response = Response(
        matrix=kinds.by_lenslet(matrix),
        variance=np.tile(error**2, (matrix.shape[1], 1)),
        wavelengths=np.array(bands),
        polarised=None if polarised is None else kinds.by_lenslet(polarised),
        quality=quality_of_one(matrix[kinds.commonest]),
        notes=notes.as_json(),
    )
    return replace(known, response=response)


def _summary(
    output: Name, calibration: Calibration, kinds: SuperpixelKinds, notes: PredictionNotes
) -> ResponseSummary:
    from plenocli.inverse.calibration.calibration import there

    response, valid = there(calibration.response), calibration.grid.valid
    bands, quality = len(response.wavelengths), there(response.quality)
    between = np.array(quality.angles)[np.triu_indices(bands, 1)]
    return ResponseSummary(
        output=str(output),
        bands_nm=[float(w * 1e9) for w in response.wavelengths],
        lenslets=int(valid.sum()),
        array=list(valid.shape),
        window=list(kinds.window),
        kinds=len(kinds.shifts),
        condition=quality.condition,
        angles_deg=quality.angles,
        smallest_angle_deg=float(between.min()) if bands > 1 else None,
        notes=notes,
    )
