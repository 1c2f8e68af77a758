"""A fitted camera, into its artefact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.inverse.fit.camera_fit import CameraFit


def fit_artefact(fit: CameraFit, provenance: Provenance) -> Artefact:
    """The artefact of a fit."""
    from dataclasses import replace

    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.config.camera_file import to_toml

    data = {
        "fit/value": np.array([p.value for p in fit.parameters]),
        "fit/sigma": np.array([p.sigma for p in fit.parameters]),
        "fit/described": np.array([p.described for p in fit.parameters]),
        "fit/tolerance": np.array([p.tolerance for p in fit.parameters]),
        "fit/correlation": fit.correlation,
    }
    attrs: dict[str, Any] = {
        "names": [p.name for p in fit.parameters],
        "units": [p.unit for p in fit.parameters],
        "inseparable": [list(pair) for pair in fit.inseparable],
        "noise_ratio": fit.noise_ratio,
        "noise_ratio_before": fit.noise_ratio_before,
        "model_error": fit.model_error,
        "lenslets": fit.lenslets,
    }
    attrs |= {} if fit.turned is None else {"turned": fit.turned}
    return Artefact("fit", data, {"fit": attrs}, replace(provenance, config=to_toml(fit.camera)))
