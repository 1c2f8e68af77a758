"""What a predicted calibration lets expect of labelled spectra, before anything is captured."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.expected import (
    METHODS,
    ExpectedScore,
    Optics,
    Processing,
    expected_score,
)
from plenocli.files.read.class_table import read_labelled

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature
    from plenocli.inverse.calibration.calibration import Calibration


def run_expected(
    path: Path,
    classes: Path | str,
    *,
    detect: str | None = None,
    camera: Camera | None = None,
    method: str = "auto",
    prior: Path | str | None = None,
    learnt: bool = False,
) -> ExpectedScore:
    """Expected figures of a calibration that simulate-response made.

    path: of the calibration.
    classes: labelled spectra; detect: the one of them that is looked for.
    camera: the calibrated one; None: as the file describes it.
    method: pinv, wls, lmmse, single-pixel, or auto, which takes the one of least expected error.
    prior: labelled spectra whose mean and covariance lmmse starts from; None: many surfaces.
    learnt: whether classes are known by how the camera shows them.

    Raises InputError where the file does not say what is needed.
    """
    from plenocli.files.read.calibrations import read_described
    from plenocli.forward.scene.light import broadband
    from plenocli.forward.scene.tables import illuminant
    from plenocli.inverse.calibration.calibration import there
    from plenocli.inverse.spectra.bands import by_filter
    from plenocli.inverse.spectra.radiance import light_prior
    from plenocli.inverse.spectra.responses import LensletResponses

    found, described = read_described(path, needs=("response", "windows", "white", "dark"))
    camera = camera or described
    response, bands = there(found.response), there(found.response).wavelengths
    if camera is None or not response.predicted or found.sensor.gain is None:
        raise InputError(
            "was not predicted from a description of the camera, which tells the light of every "
            "wavelength",
            path,
            "make one with simulate-response",
        )
    found = by_filter(found, camera)
    known = read_labelled(classes, bands)
    light = broadband(camera, lambda w: illuminant(camera.light.illuminant, w))
    optics, matrix = _optics(found, camera, light)
    start = light_prior(
        LensletResponses.of(found), None if prior is None else read_labelled(prior, bands)
    )
    spectra = known.at(light.wavelengths)
    tried = METHODS if method == "auto" else (method,)
    scores = [
        expected_score(
            optics,
            Processing(response=matrix, method=one, prior=start),
            known.labels,
            spectra,
            detect,
            learnt,
        )
        for one in tried
        if one != "lmmse" or start is not None or method == one
    ]
    return min(scores, key=lambda score: score.rmse_expected)


def _optics(found: Calibration, camera: Camera, light: Quadrature) -> tuple[Optics, np.ndarray]:
    """The superpixel that most lenslets have, and its F (pixel, band)."""
    from plenocli.files.results.truths import through_filters
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.response_prediction import PredictionOptions, ResponsePrediction
    from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds
    from plenocli.inverse.calibration.calibration import there

    response, sensor = there(found.response), found.sensor
    kinds = SuperpixelKinds.of_camera(camera)
    some = np.argwhere((kinds.kind == kinds.commonest) & kinds.valid & found.grid.valid)[0]
    matrix = response.matrix if response.shared else response.matrix[tuple(some)]
    prediction = ResponsePrediction(camera, PredictionOptions(), kinds, "the camera")
    signal = prediction.spectral_signal(light, sensor.exposure)[0][kinds.commonest]

    def alone(wavelength: float) -> np.ndarray:
        return np.asarray(light.wavelengths == wavelength, float)[None]

    bands = response.wavelengths
    truth = (
        np.stack([np.interp(bands, light.wavelengths, one) for one in np.eye(len(signal[0]))], 1)
        if camera.filter_array is None
        else through_filters(alone, camera, bands)[:, 0]
    )
    noise = Noise(gain=sensor.gain or 0.0, read_variance=sensor.read_variance)
    return Optics(signal=signal, truth=truth, noise=noise), matrix
