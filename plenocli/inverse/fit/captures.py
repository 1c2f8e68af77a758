"""Captures as a fit takes them: superpixels in units of the described camera's matrix, whose
defective and saturated pixels count for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.fit.problem import CapturedLenslets, described_matrix
from plenocli.inverse.picture.estimators import Estimators, Options
from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels
from plenocli.inverse.picture.nuisances.clean import clean
from plenocli.inverse.picture.nuisances.veil import VeilFound
from plenocli.inverse.picture.superpixels import superpixels

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration

TURNED = 0.02
"""px: how far a grid's rotation may move a superpixel's corner before that is told."""


def captured_lenslets(
    capture: Capture,
    camera: Camera,
    calibration: Calibration | None = None,
    *,
    noise_sigma: float | None = None,
    where: str | Path | None = None,
) -> CapturedLenslets:
    """What a fit takes of a capture.

    camera: as described.
    calibration: along whose lenslet grid superpixels are cut out; without it as the capture says.
    noise_sigma: standard deviation of the noise in units of A x; None as the capture says.
    where: the calibration's file, for messages.

    Raises InputError where sizes disagree, the noise is not known or there is no light.
    """
    path = capture.metadata.path
    if calibration is not None:
        tell_rotation(calibration.grid.angle, camera.sensor.pixels_per_lenslet)
    system = _lenslet_matrix(camera, described_matrix(camera), path or "capture")
    data = superpixels(capture, system, calibration, where=where)
    sigma = data.sigma if noise_sigma is None else noise_sigma
    if sigma is None or not sigma > 0:
        raise InputError("does not say how strong its noise is", path, "give --noise-sigma")
    if not np.nan_to_num(data.y).any():
        raise InputError("holds no light that a fit could look at", path, "give another capture")
    return CapturedLenslets(np.asarray(data.y, float), sigma, data.saturated)


def tell_rotation(angle: float, shape: tuple[int, int]) -> None:
    """A note of what a grid that is turned by `angle` (degrees) does to superpixels of `shape`
    (rows, columns): their places are known, their pixels stay upright.
    """
    turn = math.radians(angle)
    corner = abs(turn) * math.hypot(*shape) / 2
    if corner > TURNED:
        note(
            f"the lenslets are turned by {1e3 * turn:+.2g} mrad against the pixels: superpixels "
            "are cut out where they are, but no parameter turns their pixels, whose corners are "
            f"off by {corner:.2g} px"
        )


class Mender:
    """Fills in what captures do not tell, as LMMSE under a matrix has it: pixels that are not
    known, defective or saturated.
    """

    def __init__(self, camera: Camera, pictures: Sequence[np.ndarray], seed: int) -> None:
        """camera: of the captures; pictures, seed: as in fit_camera."""
        self._camera, self._pictures, self._seed = camera, pictures, seed
        self._estimators: Estimators | None = None

    def mended(self, capture: CapturedLenslets, matrix: np.ndarray) -> CapturedLenslets:
        """A capture without the pixels that count for nothing, itself where there are none.

        matrix: (pixel, point).
        """
        seen = Superpixels(
            y=capture.y, noise=Noise.of_sigma(capture.sigma), saturated=capture.saturated
        )
        cleaned = clean(self._under(matrix), seen)
        lost = [f for f in cleaned.findings if not isinstance(f, VeilFound)]
        if not any(finding.found for finding in lost):
            return capture
        return CapturedLenslets(cleaned.data.y, capture.sigma)

    def _under(self, matrix: np.ndarray) -> Estimators:
        system = _lenslet_matrix(self._camera, matrix)
        if self._estimators is None:
            self._estimators = Estimators(system, Options(seed=self._seed), lambda scene: [])
            self._estimators.prior.pictures_of[None] = [("", p) for p in self._pictures]
        else:
            self._estimators = self._estimators.with_matrix(system)
        return self._estimators


def _lenslet_matrix(camera: Camera, matrix: np.ndarray, path: str | Path = "") -> LensletMatrix:
    return LensletMatrix(
        path=Path(path),
        blocks=np.asarray(matrix, float)[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=camera.sensor.pixels_per_lenslet,
        object_shape=camera.object.samples_per_lenslet,
    )


def believed_model(model: str, captures: Sequence[Capture]) -> str:
    """The model of propagation behind captures: what simulated ones say, where `model` is "auto"
    and they agree.
    """
    made = {str((one.metadata.accuracy or {}).get("model")) for one in captures}
    if model == "auto" and len(made) == 1 and made <= {"fresnel", "exact"}:
        return made.pop()
    return model
