"""System matrices that capture-sim computes, kept for other targets before the same camera."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import plenocli
from plenocli.files.kept import is_kept, kept
from plenocli.forward.sensor.exposure.matrices import (
    AnyMatrix,
    StoredField,
    StoredMatrix,
    build_matrix,
    in_memory,
)
from plenocli.forward.sensor.exposure.options import ExposureOptions

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

LARGEST = 128 << 20
"""Bytes of a matrix up to which it is kept, and held whole; at most a SHARE of the memory."""
SHARE = 16
_NAME = "matrix of a capture"
_OTHER = {"seed", "noise", "exposure", "field_nodes"}
"""Options that matrices do not depend on."""


@dataclass(frozen=True)
class KeptMatrices:
    """Builds matrices, or takes them from an earlier run.

    files: digests of what the camera's description names, by role.
    """

    files: Mapping[str, str]

    def build(self, camera: Camera, wavelength: float, options: ExposureOptions) -> AnyMatrix:
        """As build_matrix; the same values whether a matrix was kept or not."""
        from plenocli.base.budget import budget

        inputs = self._inputs(camera, wavelength, options)
        built = None if is_kept(_NAME, inputs) else build_matrix(camera, wavelength, options)
        if isinstance(built, StoredField):
            return built
        pixels = int(np.prod(camera.sensor.pixels_per_lenslet))
        points = int(np.prod(camera.object.samples_per_lenslet)) * options.refine**2
        most = min(LARGEST, budget().memory // SHARE)
        if built is not None and 8 * len(built.offsets) * pixels * points > most:
            return built

        def whole() -> tuple[np.ndarray, ...]:
            made = built or build_matrix(camera, wavelength, options)
            assert not isinstance(made, StoredField)
            return in_memory(made, pixels, points).matrix, made.offsets.astype(np.float64)

        matrix, offsets = kept(_NAME, inputs, whole)
        return StoredMatrix(matrix.astype(np.float32), offsets.astype(int))

    def missing(self, camera: Camera, wavelengths: np.ndarray, options: ExposureOptions) -> int:
        """At how many wavelengths no matrix was kept."""
        return sum(not is_kept(_NAME, self._inputs(camera, w, options)) for w in wavelengths)

    def _inputs(
        self, camera: Camera, wavelength: float, options: ExposureOptions
    ) -> list[np.ndarray]:
        """All that a matrix depends on: the code, the camera, and what is asked."""
        asked = {k: v for k, v in asdict(options).items() if k not in _OTHER}
        told = [_code(), dict(self.files), camera.model_dump(mode="json"), float(wavelength), asked]
        return [np.frombuffer(json.dumps(told, sort_keys=True).encode(), np.uint8)]


@cache
def _code() -> str:
    """Digest of the modules that matrices come from."""
    home = Path(plenocli.__file__).parent / "forward"
    sources = sorted([*home.rglob("*.py"), *home.rglob("*.toml")])
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
