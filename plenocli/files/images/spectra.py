"""Spectra behind lenslets as files, an artefact or a spectral EXR: written in one place."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.files.artefacts.container import Artefact
from plenocli.files.artefacts.provenance import Provenance, provenance_texts, read_provenance_texts
from plenocli.files.artefacts.reading import read_artefact
from plenocli.files.artefacts.writing import write_artefact
from plenocli.files.images.spectral_exr import read_spectral_exr, write_spectral_exr
from plenocli.inverse.spectra.spectra import Spectra


def write_spectra(
    path: str | Path,
    spectra: Spectra,
    provenance: Provenance,
    *,
    reference: str | Path | None = None,
    overwrite: bool = False,
) -> None:
    """Write spectra: an artefact where `path` ends in .h5, else a spectral EXR.

    reference: capture of the white reference, whose name is noted.

    Raises UsageError, OutputError.
    """
    if Path(path).suffix == ".h5":
        _write_artefact(path, spectra, provenance, reference, overwrite)
    else:
        _write_exr(path, spectra, provenance, overwrite)


def _parameters(spectra: Spectra) -> dict[str, Any]:
    trace = spectra.trace
    return {
        "registration": None if trace.registration is None else trace.registration.as_json(),
        "warning": trace.warning,
        "asked": trace.asked,
        "reason": trace.reason,
        "reference_reflectance": spectra.reference_reflectance,
    }


def _write_artefact(
    path: str | Path,
    spectra: Spectra,
    provenance: Provenance,
    reference: str | Path | None,
    overwrite: bool,
) -> None:
    attrs = {
        "quantity": spectra.quantity,
        "method": spectra.method,
        "reference": None if reference is None else Path(reference).name,
        "parameters": _parameters(spectra),
    }
    data = {
        "spectra/value": spectra.value.astype(np.float32),
        "spectra/sigma": spectra.sigma.astype(np.float32),
        "spectra/wavelength": spectra.wavelength,
        "spectra/residual": spectra.residual,
        "spectra/s1": spectra.s1,
        "spectra/s1_sigma": spectra.s1_sigma,
    }
    write_artefact(
        path, Artefact("spectra", data, {"spectra": attrs}, provenance), overwrite=overwrite
    )


def _write_exr(path: str | Path, spectra: Spectra, provenance: Provenance, overwrite: bool) -> None:
    from plenocli.forward.scene.colour import preview_rgb

    value, sigma = spectra.value.astype(np.float32), spectra.sigma.astype(np.float32)
    texts = {
        "method": spectra.method,
        "parameters": json.dumps(_parameters(spectra), sort_keys=True),
    } | provenance_texts(provenance)
    whole = np.nan_to_num(value)
    if spectra.quantity == "reflectance":
        rgb = preview_rgb(spectra.wavelength, whole)
    else:  # no light is taken off: shown under the one that was there
        rgb = preview_rgb(spectra.wavelength, whole / max(float(whole.max()), 1e-30), "E")
        texts["emissiveUnits"] = "relative"
    write_spectral_exr(
        path,
        spectra.wavelength,
        value,
        spectra.quantity,
        rgb=rgb,
        sigma=sigma,
        others={
            name: values.astype(np.float32)
            for name, values in (("s1", spectra.s1), ("s1_sigma", spectra.s1_sigma))
            if values is not None
        },
        attrs=texts,
        overwrite=overwrite,
    )


@dataclass(frozen=True)
class Origin:
    """How a file of spectra came about.

    inputs: name and digest of each file that was read, by its role.
    asked: the method asked for.
    registered: whether somebody looked for motion.
    """

    inputs: dict[str, Any]
    asked: str
    registered: bool


def read_origin(path: str | Path) -> Origin:
    """How the spectra of a file came about.

    Raises InputError, KeyError, TypeError or ValueError where the file does not say it.
    """
    if Path(path).suffix == ".h5":
        artefact = read_artefact(path, "spectra")
        inputs, parameters = artefact.provenance.inputs, artefact.attrs["spectra"]["parameters"]
    else:
        attrs = read_spectral_exr(path).attrs
        inputs, parameters = read_provenance_texts(attrs).inputs, json.loads(attrs["parameters"])
    return Origin(inputs, parameters["asked"], parameters["registration"] is not None)
