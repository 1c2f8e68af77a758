"""score: results against the truth, side by side, as JSON, a table and (on request) the report
page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import repeats_counted, tell
from plenocli.base.tiling import Plane
from plenocli.evaluation.chosen import definitions_of, keep_chosen
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.snr import snr_sensor
from plenocli.evaluation.response_score import ComparedResponse
from plenocli.evaluation.scores import InputFile, ResultScore, ScoreDocument
from plenocli.evaluation.spectra_score import (
    SINGLE,
    SpectraScore,
    over_single_pixel,
)
from plenocli.execution.batch import failed_together
from plenocli.files.results.matrices import matrix_of
from plenocli.files.results.results import (
    read_scored,
    read_whites,
)
from plenocli.files.results.truths import CHART
from plenocli.files.results.volumes import StoredVolume
from plenocli.inverse.lightfield.planes import LightField
from plenocli.stages.evaluation.score.comparison import Comparison, Scored
from plenocli.stages.evaluation.score.depth import score_planes, score_volume
from plenocli.stages.evaluation.score.designs import score_calibration, score_dictionary
from plenocli.stages.evaluation.score.pictures import score_image

SERVES = {
    "classes": ("spectra", "calibration"),
    "detect": ("spectra", "calibration"),
    "learnt": ("spectra", "calibration"),
    "prior": ("calibration",),
    "white": ("spectra",),
}
"""Options -> kinds of results to which they mean something."""


def run_score(
    results: Sequence[Path | str],
    output: Path | str | None,
    *,
    truth: Path | str | None = None,
    report: Path | str | None = None,
    metrics: Sequence[str] = (),
    whites: Sequence[Path | str] = (),
    patches: Path | str | None = None,
    pif: Path | str | None = None,
    capture: Path | str | None = None,
    block: tuple[int, int] | None = None,
    sampling: str = "fit",
    light: str = "D65",
    camera: Path | str | None = None,
    classes: Path | str | None = None,
    detect: str | None = None,
    method: str = "auto",
    prior: Path | str | None = None,
    learnt: bool = False,
    overwrite: bool = False,
    command: str = "",
) -> ScoreDocument:
    """Score every result, write `output` (JSON, None: nothing) and perhaps `report` (HTML).

    results: paths, folders and patterns of them.
    truth: path or scene name, needed but for dictionaries.
    metrics: names of figures' groups, all without any.
    whites: spectra of a white target, frames.
    patches: label map or "colorchecker".
    pif: system matrix (dictionaries need it).
    capture: for its sensor-model SNR.
    block: object samples per lenslet (rows, columns), else from the files.
    sampling: how a photograph became the object, "fit" or "crop".
    light: for colour differences.
    camera: TOML, through whose filters spectra see the truth.
    classes: labelled spectra, a table or a folder (plenocli.files.read.class_table).
    detect: name of the one of them that is looked for.
    method, prior: how spectra of a calibration would be made, for what it lets expect of classes
        (plenocli.stages.evaluation.expected).
    learnt: whether lenslets are judged by how others of their class look.

    One bad result does not stop the others: its message is printed and stands in its place.
    Raises the error of the worst one at the end.
    """
    from plenocli.files.artefacts.provenance import describe_inputs
    from plenocli.files.atomic import check_output, publish, together
    from plenocli.files.read.captures import named_captures
    from plenocli.files.results.scores import json_pieces
    from plenocli.files.seal import publish_sealed

    others = [truth, *whites, patches, pif, capture, camera, classes, prior]
    results = named_captures(results, others)
    inputs = [*results, *others]
    files = [path for path in inputs if _is_file(path)]
    if output is not None:
        check_output(output, overwrite=overwrite, inputs=files, suffixes=(".json",))
    if report is not None:
        check_output(
            report, overwrite=overwrite, inputs=files, others=[output], suffixes=(".html",)
        )
    comparison = _comparison(truth, whites, patches, pif, capture, block, sampling, light, camera)
    comparison = replace(
        comparison, classes=classes, detect=detect, method=method, prior=prior, learnt=learnt
    )
    scored = _score_all(results, comparison, tuple(metrics))
    given = {"classes": classes, "detect": detect, "learnt": learnt, "prior": prior}
    _require_use([name for name, value in (given | {"white": whites}).items() if value], scored)
    errors = [(path, one.failed) for path, one in zip(results, scored) if one.failed is not None]
    if len(errors) == len(results):
        raise failed_together(
            errors, len(results), "results", None, "nothing is written; see the messages above"
        )
    roles = {
        "result": list(results),
        "truth": truth if _is_file(truth) else None,
        "white": list(whites),
        "camera": camera,
        "classes": classes,
        "prior": prior,
        "patches": patches if _is_file(patches) else None,
        "pif": pif,
        "capture": capture,
    }
    document = _document(results, scored, describe_inputs(roles), command)
    with together():
        if output is not None:
            publish_sealed(output, json_pieces(document.as_json()), overwrite=overwrite)
        if report is not None:
            publish(report, _page(document, scored), overwrite=overwrite)
    if errors:
        raise failed_together(
            errors, len(results), "results", output, "the others are scored; see the messages above"
        )
    return document


def _require_use(given: Sequence[str], scored: Sequence[Scored]) -> None:
    """UsageError for an option that means nothing to any result.

    given: names of those of SERVES that were given.
    """
    kinds = {one.score.kind for one in scored if one.failed is None}
    for name in given:
        if kinds and not kinds & set(SERVES[name]):
            raise UsageError(
                f"means nothing to a result that is {' or '.join(sorted(map(str, kinds)))}",
                f"--{name}",
                f"leave it out, or score {' or '.join(SERVES[name])}",
            )


def _is_file(name: Path | str | None) -> bool:
    """Whether a truth or a label map is a file, or a folder of spectra, and not a name."""
    return name is not None and Path(name).exists()


def _page(document: ScoreDocument, scored: Sequence[Scored]) -> bytes:
    from plenocli.report.score_page import score_page

    return score_page(document, [one.drawn for one in scored]).encode()


def _document(
    results: Sequence[Path | str],
    scored: Sequence[Scored],
    inputs: Mapping[str, dict[str, str]],
    command: str,
) -> ScoreDocument:
    """What is written: every result by a label of its own; `inputs`: as a provenance has them."""
    labels = _labels(results)
    named = [replace(one.score, label=label) for one, label in zip(scored, labels, strict=True)]
    return ScoreDocument(
        results=tuple(named),
        definitions=definitions_of(named),
        command=command,
        inputs={role: InputFile(**about) for role, about in inputs.items()},
    )


def _comparison(
    truth: Path | str | None,
    whites: Sequence[Path | str],
    patches: Path | str | None,
    pif: Path | str | None,
    capture: Path | str | None,
    block: tuple[int, int] | None,
    sampling: str,
    light: str,
    camera: Path | str | None,
) -> Comparison:
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.read.cameras import read_camera
    from plenocli.forward.scene.tables import illuminant

    system = read_pif(pif) if pif else None
    illuminant(light, [560e-9])  # an unknown name is refused before any work
    if patches is None and str(truth) == CHART:
        patches = CHART
    matrix = None if system is None else matrix_of(system)
    return Comparison(
        truth=truth,
        whites=read_whites(whites),
        patches=patches,
        lenslet_matrix=None if matrix is None else matrix.own,
        block=block,
        object_shape=None if matrix is None else matrix.object_shape,
        sampling=sampling,
        light=light,
        camera=read_camera(camera) if camera else None,
        sensor_snr=_sensor_snr(capture) if capture else None,
    )


def _score_all(
    results: Sequence[Path | str], comparison: Comparison, groups: tuple[str, ...]
) -> list[Scored]:
    """Every result scored, set against single pixel and reduced to what was asked for; a single
    one raises its error.
    """
    with repeats_counted():
        scored = [_attempt(path, comparison, len(results) == 1) for path in results]
    singles = [one for one in scored if one.score.method == SINGLE and not one.score.error]
    single = singles[0].spectra if len(singles) == 1 else None
    if single is not None:
        scored = [_beside_single_pixel(one, single) for one in scored]
    for number, (path, one) in enumerate(zip(results, scored)):
        if one.failed is not None:
            continue
        try:
            chosen = keep_chosen(one.score.figures, groups)
        except PlenoError as error:
            if len(results) == 1:
                raise
            scored[number] = _failed(path, error)
        else:
            scored[number] = replace(one, score=replace(one.score, figures=chosen))
    return scored


def _attempt(path: Path | str, comparison: Comparison, alone: bool) -> Scored:
    try:
        return _score_one(path, comparison)
    except PlenoError as error:
        if alone:
            raise
        return _failed(path, error)


def _failed(path: Path | str, error: PlenoError) -> Scored:
    """The place of a result that cannot be scored; its error is told."""
    tell(f"plenocli: error: {error}", error=True)
    name = Path(path).name
    return Scored(
        score=ResultScore(name=name, error=str(error).replace(str(path), name)), failed=error
    )


def _beside_single_pixel(one: Scored, single: SpectraScore) -> Scored:
    """Spectra of another method with what they gain over single pixel extraction."""
    if one.spectra is None or one.score.kind != "spectra" or one.score.method == SINGLE:
        return one
    gains = figures(over_single_pixel(one.spectra, single))
    return replace(one, score=replace(one.score, figures={**one.score.figures, **gains}))


def _score_one(path: Path | str, comparison: Comparison) -> Scored:
    """One result, whatever its kind."""
    found = read_scored(path)
    if isinstance(found, ComparedResponse):
        return score_calibration(found, comparison)
    if isinstance(found, StoredVolume):
        return score_volume(path, found, comparison)
    if isinstance(found, LightField):
        return score_planes(path, found, comparison)
    if found.kind == "dictionary":
        return score_dictionary(found, comparison)
    return score_image(found, comparison)


def _sensor_snr(path: Path | str) -> float:
    """Sensor-model SNR of a capture from its mosaic and the noise it says it got, dB."""
    from plenocli.files.artefacts.reading import opened_artefact

    apart = ("capture/mosaic", "capture/scene")
    with opened_artefact(path, "capture", apart) as (capture, stored):
        attrs, mosaic = capture.attrs.get("capture", {}), stored["capture/mosaic"]
    sigma = float(attrs.get("noise_sigma") or 0)
    if not sigma > 0:
        raise InputError(
            "names no noise level",
            path,
            "simulate it with capture-sim --snr, or leave --capture out",
        )
    black = float(np.mean(attrs.get("black") or 0))
    signal = Plane(mosaic.shape, mosaic.window).through(lambda values: values - black)
    return snr_sensor(signal, sigma, noisy=True)


def _labels(paths: Sequence[Path | str]) -> list[str]:
    """Short labels for the table: file stems, with the folder's name where two stems are equal,
    else with a number.
    """
    stems = [Path(path).stem for path in paths]
    labels = (
        stems
        if len(set(stems)) == len(stems)
        else [f"{Path(p).parent.name}/{stem}" for p, stem in zip(paths, stems, strict=True)]
    )
    return [
        label if labels.count(label) == 1 else f"{label} {number}"
        for number, label in enumerate(labels, start=1)
    ]


def table(document: ScoreDocument) -> str:
    """The results side by side as text: one row a metric, one column a result."""
    from plenocli.report.tables import text_table

    return text_table(document)
