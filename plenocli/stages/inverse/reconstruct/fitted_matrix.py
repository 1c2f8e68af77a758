"""`reconstruct --fit`: the matrix of the camera that fits a capture, in the place of the pif's; and
what a pif that does not fit is likely to have wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import note
from plenocli.inverse.picture.estimators import Estimators
from plenocli.inverse.picture.tiles import Source
from plenocli.stages.inverse.fit_camera import fitted
from plenocli.stages.inverse.reconstruct.recipe import FittedCamera

HIDDEN = 0.2
"""Neighbours' light over the noise up to which a fit does not see it."""

if TYPE_CHECKING:
    from plenocli.inverse.fit.camera_fit import CameraFit
    from plenocli.inverse.picture.lenslet_model import LensletMatrix, Superpixels


def fitted_to(estimators: Estimators, source: Source, where: Path) -> FittedCamera | None:
    """The camera that fits the middle of a capture; None where no camera near the described one
    explains it, which a note says.

    Arguments and errors as of camera_fit.

    source: of the capture's superpixels.
    """
    from plenocli.inverse.fit.fit import MOST_LENSLETS
    from plenocli.inverse.fit.problem import middle_of

    # a fit looks at no more
    data = source.cut(*middle_of(source.count, MOST_LENSLETS))
    fit, model = camera_fit(estimators, data, where)
    if not fit.accepted:
        note(f"--fit: the best {fit.why}; the matrix of the camera as described is used")
        return None
    moved = [p.name for p in fit.parameters if p.measured and abs(p.value - p.described) > p.sigma]
    note(
        f"--fit: {fit.why} (as described {fit.noise_ratio_before:.3g} times); "
        f"other than described: {', '.join(moved) or 'nothing'}"
    )
    return FittedCamera(camera=fit.camera, model=model)


def camera_fit(
    estimators: Estimators, data: Superpixels, where: str | Path
) -> tuple[CameraFit, str]:
    """(the fit of the described camera to a capture, by which model of propagation).

    estimators: by the matrix of the described camera.
    where: path of the capture, for messages.

    Raises UsageError where the pif does not say what camera it was made for, or the camera is of a
    kind that is not fitted; InputError where the noise is not known.
    """
    from plenocli.inverse.fit.problem import CapturedLenslets

    system, options = estimators.system, estimators.options
    if system.origin is None:
        raise UsageError(
            "the pif does not say what camera it was made for", "--fit", "make it anew, or without"
        )
    sigma = options.noise_sigma or data.sigma
    if not sigma:
        raise InputError("does not say how strong its noise is", where, "give --noise-sigma")
    if estimators.coupled:
        raise _neighbours_count(system, data, float(sigma))
    model = "auto"
    if data.accuracy is not None and data.accuracy.model in ("fresnel", "exact"):
        model = data.accuracy.model
    fit = fitted(
        system.origin.camera,
        [CapturedLenslets(data.y, float(sigma), data.saturated)],
        estimators.prior.pictures(data.scene),
        name="--fit",
        model=model,
        seed=options.seed,
    )
    return fit, model


def _neighbours_count(system: LensletMatrix, data: Superpixels, sigma: float) -> UsageError:
    """The refusal of a matrix that knows neighbours: how strong their light is, by an even object,
    and what to do; sigma: of the noise.
    """
    light = system.blocks.sum(axis=2, dtype=float)
    stray = np.linalg.norm(light.sum(axis=0) - system.own.sum(axis=1)) / np.linalg.norm(light)
    strength = float(stray * np.sqrt(np.nanmean(data.y**2)) / sigma)
    advice = "give a pif of --superpixels 1x1: the noise hides their light"
    if strength > HIDDEN:
        advice = "leave it out: such captures are not fitted"
    return UsageError(
        f"a fit knows no neighbours' light, which is about {strength:.2g} times the noise here",
        "--fit",
        advice,
    )


def likely_cause(
    estimators: Estimators, y: np.ndarray, sigma: float, scene: str | None
) -> str | None:
    """What is likely to be wrong with the camera of a pif, and what to do, a sentence; None where
    that is not known or the camera is of a kind that is not fitted.

    y: (lenslet_row, lenslet_column, pixel); sigma: their noise; scene: that training leaves out.
    """
    from plenocli.inverse.fit.causes import coarse_points, likeliest_cause
    from plenocli.inverse.fit.problem import CapturedLenslets

    origin = estimators.system.origin
    if origin is None:
        return None
    try:
        if estimators.coupled:  # what is left of neighbours is no fit's to explain
            return coarse_points(origin.camera)
        return likeliest_cause(
            origin.camera,
            CapturedLenslets(y, sigma),
            estimators.prior.pictures(scene),
            seed=estimators.options.seed,
        )
    except PlenoError:  # a hint, and nothing that a picture depends on
        return None
