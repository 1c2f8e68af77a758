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


class FinerModel:
    """Matrices of a family of cameras by a model of propagation of the dial, for one lenslet by
    itself.
    """

    def __init__(self, family: CameraFamily, model: str) -> None:
        """model: "auto", "fresnel" or "exact", as simulate-pif takes it."""
        self._family, self._model = family, model

    def matrix(self, values: np.ndarray) -> np.ndarray:
        """(pixel, point) at `values` (parameter,)."""
        camera = self._family.camera_at(values)
        shift = self._family.geometry_at(values).pixel_shift
        try:
            plan = plan_pif(
                camera, model=self._model, superpixels=(1, 1), coherent_ring=0, accuracy=ACCURACY
            )
        except (NumericsError, UsageError):
            plan = plan_pif(camera, superpixels=(1, 1), coherent_ring=0)
        moved = shift if shift is not None and any(shift) else None
        built = build_pif(camera, replace(plan, pixel_shift=moved, dtype="float32"))
        if built.A is None:
            raise RuntimeError("a matrix of one lenslet was not held")
        return built.A[0, 0]
