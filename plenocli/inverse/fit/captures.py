"""Captures as a fit takes them: superpixels in units of the described camera's matrix."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError
from plenocli.inverse.fit.problem import CapturedLenslets, described_matrix
from plenocli.inverse.picture.lenslet_model import LensletMatrix
from plenocli.inverse.picture.superpixels import superpixels

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.sensor.capture import Capture
    from plenocli.inverse.calibration.calibration import Calibration


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
    system = LensletMatrix(
        path=Path(path or "capture"),
        blocks=np.asarray(described_matrix(camera), float)[None],
        offsets=np.zeros((1, 2), int),
        pixel_shape=camera.sensor.pixels_per_lenslet,
        object_shape=camera.object.samples_per_lenslet,
    )
    data = superpixels(capture, system, calibration, where=where)
    sigma = data.sigma if noise_sigma is None else noise_sigma
    if sigma is None or not sigma > 0:
        raise InputError("does not say how strong its noise is", path, "give --noise-sigma")
    y = np.array(data.y, float)
    y[~np.isfinite(y).all(axis=2)] = 0
    if not y.any():
        raise InputError("holds no light that a fit could look at", path, "give another capture")
    return CapturedLenslets(y, sigma)


def believed_model(model: str, captures: Sequence[Capture]) -> str:
    """The model of propagation behind captures: what simulated ones say, where `model` is "auto"
    and they agree.
    """
    made = {str((one.metadata.accuracy or {}).get("model")) for one in captures}
    if model == "auto" and len(made) == 1 and made <= {"fresnel", "exact"}:
        return made.pop()
    return model
