"""Pictures as files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.tiling import InParts, Plane
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

    parts = {"Y": solved.found.value} | (
        {} if solved.found.sigma is None else {"sigma": solved.found.sigma}
    )
    attrs = {"method": solved.found.method} | provenance_texts(provenance)
    if len(parts["Y"].shape) == 3:
        whole = {n: v.whole() if isinstance(v, InParts) else v for n, v in parts.items()}
        write_spectral_exr(
            target,
            solved.bands,
            whole["Y"],
            sigma=whole.get("sigma"),
            attrs=attrs,
            overwrite=overwrite,
        )
        return
    parts |= {} if solved.rgb is None else dict(zip("RGB", solved.rgb))
    channels = {name: _by_lines(target, values) for name, values in parts.items()}
    write_exr(target, channels, attrs, overwrite=overwrite)


def _by_lines(target: Path, values: np.ndarray | InParts) -> np.ndarray | Plane:
    """A picture of which lines are asked for in any order: of parts from a file beside `target`,
    where it is large.
    """
    from plenocli.files.images.in_bands import put_together
    from plenocli.files.scratch import Scratch

    if not isinstance(values, InParts):
        return values
    parts = (part.astype(np.float32) for part in values.parts())
    return put_together(parts, values.shape, Scratch(target))


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
