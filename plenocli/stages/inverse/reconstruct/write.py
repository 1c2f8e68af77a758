"""Pictures as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.tiling import InParts
from plenocli.stages.inverse.reconstruct.recipe import Settings
from plenocli.stages.inverse.reconstruct.solved import PictureSummary, Solved

if TYPE_CHECKING:
    from plenocli.files.artefacts.provenance import Provenance


def write_picture(
    target: Path,
    solved: Solved,
    settings: Settings,
    command: str,
    inputs: dict[str, Any],
    overwrite: bool,
) -> PictureSummary:
    """Write one picture."""
    from plenocli.files.artefacts.provenance import Provenance
    from plenocli.files.bench import clear

    provenance = Provenance(command=command, inputs=inputs, seed=settings.seed)
    summary = solved.summary(target, clipped=settings.clip)
    write = _write_exr if target.suffix == ".exr" else _write_artefact
    write(target, solved, summary, provenance, overwrite)
    clear(target)
    return summary


def _write_exr(
    target: Path, solved: Solved, summary: PictureSummary, provenance: Provenance, overwrite: bool
) -> None:
    from plenocli.files.artefacts.provenance import provenance_texts
    from plenocli.files.images.exr import write_exr
    from plenocli.files.images.spectral_exr import write_spectral_exr

    picture, sigma = _in_memory(solved.found.value), _in_memory(solved.found.sigma)
    attrs = {"method": solved.found.method} | provenance_texts(provenance)
    if picture.ndim == 3:
        write_spectral_exr(
            target, solved.bands, picture, sigma=sigma, attrs=attrs, overwrite=overwrite
        )
    else:
        channels = {"Y": picture} | ({} if sigma is None else {"sigma": sigma})
        channels |= {} if solved.rgb is None else dict(zip("RGB", solved.rgb))
        channels = {name: values.astype(np.float32) for name, values in channels.items()}
        write_exr(target, channels, attrs, overwrite=overwrite)


def _in_memory(values: Any) -> Any:
    return values.whole() if isinstance(values, InParts) else values


def _write_artefact(
    target: Path, solved: Solved, summary: PictureSummary, provenance: Provenance, overwrite: bool
) -> None:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.files.artefacts.writing import write_artefact

    picture, sigma = solved.found.value, solved.found.sigma
    data = {"image/value": picture}
    data |= {} if sigma is None else {"image/sigma": sigma}
    data |= {} if solved.seen is None else {"image/seen": solved.seen.by_point}
    data |= {"image/wavelength": np.array(solved.bands)} if len(picture.shape) == 3 else {}
    data |= {} if solved.rgb is None else {"image/rgb": solved.rgb}
    attrs: dict[str, Any] = {
        "method": solved.found.method,
        "parameters": {k: v for k, v in summary.told().items() if k != "method"},
        "clipped": solved.negative_share if summary.clipped else 0.0,
    }
    if solved.block is not None:
        attrs["notes"] = {"block": list(solved.block)}
    write_artefact(
        target, Artefact("image", data, {"image": attrs}, provenance), overwrite=overwrite
    )
