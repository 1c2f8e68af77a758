"""A finer matrix of the same camera, where the one at hand is known to be the error that counts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import PlenoError
from plenocli.base.progress import note
from plenocli.forward.accuracy.dial import plan_pif, seconds_here
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.picture.lenslet_model import LensletMatrix, gathered

SECONDS = 60.0
"""Time that a finer matrix may take without being asked for."""
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
    reach = 2 * np.abs(system.offsets).max(axis=0) + 1
    try:
        plan = plan_pif(
            origin.camera,
            wavelengths=origin.wavelengths,
            superpixels=(int(reach[0]), int(reach[1])),
            coherent_ring=origin.coherent_ring,
            accuracy=max(record.estimated or 0.0, FINEST),
            model="exact",
            dtype=np.float64,
        )
        if seconds_here(plan.chosen) > SECONDS or plan.memory > budget().memory / 2:
            return None
        matrix = build_pif(origin.camera, plan)
    except PlenoError:  # the matrix at hand serves, with its error
        return None
    if matrix.A is None or not np.array_equal(matrix.lenslet_offset, system.offsets):
        return None
    note(
        f"the system matrix is off by {record.model_error:.2g} by its own record, more than the "
        f"noise: the exact one of the same camera is used instead (simulate-pif --model exact)"
    )
    return replace(
        system,
        blocks=gathered(matrix.A, origin.weights),
        accuracy=plan.accuracy_record(),
        origin=None,
    )
