"""Other matrices in place of the one at hand: a finer one of the same camera, where its own error
is known to count; that of a camera that was fitted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import NumericsError, PlenoError
from plenocli.base.progress import note
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.camera.model import Camera
from plenocli.forward.propagation.plan import PifPlan
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.picture.lenslet_model import LensletMatrix, gathered

SECONDS = 60.0
"""Time at nominal rates that a finer matrix may take without being asked for: the picture does not
depend on how fast a machine is.
"""
FINEST = 1e-6


def finer_matrix(system: LensletMatrix) -> LensletMatrix | None:
    """The matrix of the same camera by the exact model, in the same accuracy within it.

    Returns None where it is not known what the matrix was computed from, where it is exact, or
    where the exact model does not serve this camera, or takes more than SECONDS or the memory.
    docs/model.md, "Spatial reconstruction".
    """
    origin, record = system.origin, system.accuracy
    if origin is None or record is None or record.model == "exact" or not record.model_error:
        return None
    try:
        plan = _plan(system, origin.camera, origin.wavelengths, "exact")
        if plan.chosen.seconds() > SECONDS or plan.memory > budget().memory / 2:
            return None
        finer = _built(system, origin.camera, plan, origin.weights)
    except PlenoError:  # the matrix at hand serves, with its error
        return None
    note(
        f"the system matrix is off by {record.model_error:.2g} by its own record, more than the "
        f"noise: the exact one of the same camera is used instead (simulate-pif --model exact)"
    )
    return finer


def matrix_of(system: LensletMatrix, camera: Camera, model: str) -> LensletMatrix:
    """The matrix of another camera in the place of `system`: as many neighbours, as accurate.

    camera: with one wavelength.
    model: of propagation, as simulate-pif takes it.

    Raises UsageError or NumericsError where the request cannot be met.
    """
    return _built(system, camera, _plan(system, camera, camera.light.wavelengths, model), None)


def _plan(
    system: LensletMatrix, camera: Camera, wavelengths: tuple[float, ...], model: str
) -> PifPlan:
    rows, columns = (int(n) for n in 2 * np.abs(system.offsets).max(axis=0) + 1)
    asked = None if system.accuracy is None else system.accuracy.estimated
    return plan_pif(
        camera,
        wavelengths=wavelengths,
        superpixels=(rows, columns),
        coherent_ring="auto" if system.origin is None else system.origin.coherent_ring,
        accuracy=max(asked or 0.0, FINEST),
        model=model,
        dtype=np.float64,
    )


def _built(
    system: LensletMatrix, camera: Camera, plan: PifPlan, weights: np.ndarray | None
) -> LensletMatrix:
    matrix = build_pif(camera, plan)
    if matrix.A is None:
        raise NumericsError("the matrix does not fit the memory", fix="give more with --mem-limit")
    return replace(
        system,
        blocks=gathered(matrix.A, weights),
        offsets=np.asarray(matrix.lenslet_offset, int),
        accuracy=plan.accuracy_record(),
        origin=None if system.origin is None else replace(system.origin, camera=camera),
    )
