"""Refocused captures and volumes against known depths and volumes."""

from __future__ import annotations

from pathlib import Path

from plenocli.base.errors import InputError, UsageError
from plenocli.evaluation.depth_score import known_depth, score_layered, score_lightfield
from plenocli.evaluation.metrics.depth import DepthScore, LayersScore
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.scores import ResultScore
from plenocli.files.results.volumes import StoredVolume, read_volume, score_stored, volume_of
from plenocli.inverse.lightfield.planes import LightField
from plenocli.stages.evaluation.score.comparison import Comparison, Scored


def score_planes(path: Path | str, field: LightField, comparison: Comparison) -> Scored:
    """The depth that a refocused capture shows against the known one, or against opaque layers.

    Raises InputError where either says no depth.
    """
    try:
        known_depth(field)  # before the truth is looked at
        layers = _layers(comparison.truth)
        score: DepthScore | LayersScore
        if layers is not None:
            assert layers.opacity is not None
            score = score_layered(field, layers.opacity, layers.depth)
        else:
            score = score_lightfield(field, _distance(comparison.truth, path))
    except InputError as error:
        raise error if error.where else error.at(path) from None
    return Scored(
        score=ResultScore(name=Path(path).name, kind="lightfield", figures=figures(score))
    )


def _layers(truth: Path | str | None) -> StoredVolume | None:
    """Opaque layers, where the truth is a file of them."""
    from plenocli.files.artefacts.reading import read_artefact

    if truth is None or Path(truth).suffix != ".h5":
        return None
    found = read_artefact(truth, ("capture", "volume"))
    if found.kind == "capture":
        return None
    layers = volume_of(found)
    if layers.opacity is None:
        raise InputError(
            "is a volume without opaque layers, of which no depth map is made",
            truth,
            "name what capture-sim --layer wrote with --scene-out",
        )
    return layers


def score_volume(path: Path | str, volume: StoredVolume, comparison: Comparison) -> Scored:
    """A volume against the one that is known, without the lenslets along its border that miss
    light.
    """
    if comparison.truth is None:
        raise UsageError(
            "the truth is missing",
            path,
            "name the volume to compare with, as capture-sim --scene-out writes it",
        )
    truth = read_volume(comparison.truth)
    try:
        score = score_stored(volume, truth.value)
    except InputError as error:
        raise error if error.where else error.at(path) from None
    return Scored(
        score=ResultScore(
            name=Path(path).name,
            kind="volume",
            method=volume.method or "",
            figures=figures(score),
        )
    )


def _distance(truth: Path | str | None, path: Path | str) -> float:
    """Of the plane that a refocused capture shows, m: as told, or as the simulated capture says."""
    from plenocli.base.units import UnitError, parse_length
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.config.camera_file import parse_camera

    if truth is None:
        raise UsageError(
            "the truth is missing",
            path,
            "name the plane's distance, such as --truth 620mm, or the simulated capture",
        )
    if not Path(truth).suffix == ".h5":
        try:
            return parse_length(str(truth))
        except UnitError as error:
            raise UsageError(
                f"a refocused capture is compared with the distance of a plane ({error})",
                "--truth",
                "write for example 620mm, or name the simulated capture",
            ) from None
    config = read_artefact(truth, "capture").provenance.config
    if not config:
        raise InputError(
            "does not say from how far it was taken",
            truth,
            "write the distance, such as --truth 620mm",
        )
    return parse_camera(config, truth).object.distance
