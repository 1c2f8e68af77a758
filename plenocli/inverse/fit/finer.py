"""What a finer model of propagation adds to the paraxial matrix of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from plenocli.base.errors import NumericsError, UsageError
from plenocli.forward.accuracy.dial import plan_pif
from plenocli.forward.propagation.system_matrix import build_pif
from plenocli.inverse.fit.optics import CameraFamily

ACCURACY = 3e-4
"""Of the finer matrix, where the dial reaches it."""


def finer_matrix(family: CameraFamily, model: str, values: np.ndarray) -> np.ndarray:
    """(pixel, point) of one lenslet by itself, of the camera with parameters at `values`
    (parameter,).

    model: of propagation, as simulate-pif takes it.
    """
    camera, shift = family.camera_at(values), family.geometry_at(values).pixel_shift
    try:
        plan = plan_pif(camera, model=model, superpixels=(1, 1), coherent_ring=0, accuracy=ACCURACY)
    except (NumericsError, UsageError):
        plan = plan_pif(camera, superpixels=(1, 1), coherent_ring=0)
    moved = shift if shift is not None and any(shift) else None
    built = build_pif(camera, replace(plan, pixel_shift=moved, dtype="float32"))
    if built.A is None:
        raise RuntimeError("a matrix of one lenslet was not held")
    return built.A[0, 0]
