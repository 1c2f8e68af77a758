"""score: results against the truth, side by side, as JSON, a table and (on request) the report
page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, PlenoError, UsageError
from plenocli.base.progress import note
from plenocli.base.text import json_value
from plenocli.base.tiling import Plane
from plenocli.evaluation.chosen import definitions_of, keep_chosen
from plenocli.evaluation.depth_score import known_depth, score_layered, score_lightfield
from plenocli.evaluation.metrics.coherence import CoherenceScore, dictionary_coherence
from plenocli.evaluation.metrics.depth import DepthScore, LayersScore
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.quality import PictureScore, score_picture
from plenocli.evaluation.metrics.response import score_response
from plenocli.evaluation.metrics.snr import snr_sensor
from plenocli.evaluation.metrics.spectral import PolarisationScore, score_polarisation
from plenocli.evaluation.response_score import ComparedResponse, paired_responses
from plenocli.evaluation.results import Result, WhiteTarget
from plenocli.evaluation.scores import InputFile, ResultScore, ScoreDocument
from plenocli.evaluation.spectra_score import (
    SINGLE,
    SpectraScore,
    over_single_pixel,
    score_spectra,
)
from plenocli.execution.batch import failed_together
from plenocli.files.read.class_table import read_labelled
from plenocli.files.results.matrices import matrix_of
from plenocli.files.results.results import (
    read_block,
    read_response,
    read_scored,
    read_whites,
)
from plenocli.files.results.truths import CHART, read_labels, read_true_s1, read_truth
from plenocli.files.results.volumes import StoredVolume, read_volume, score_stored, volume_of
from plenocli.inverse.lightfield.planes import LightField
from plenocli.stages.evaluation.expected import run_expected

if TYPE_CHECKING:
    from plenocli.evaluation.metrics.classes import Classes
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.labelled import LabelledSpectra
    from plenocli.report.score_page import Compared


@dataclass(frozen=True, kw_only=True)
class _Comparison:
    """What a result is compared with; files are read once.

    truth: path or scene name, or None.
    whites: method -> spectra of a white target.
    patches: label map or "colorchecker", or None.
    lenslet_matrix: A (pixel, point) of the object's own superpixel, or None.
    block: (rows, columns) of object samples under a lenslet, where they are given.
    object_shape: the same as the system matrix tells it.
    sensor_snr: of the capture, dB, or None.
    classes: labelled spectra, or None; detect: the class that is looked for.
    method, prior: how a calibration's spectra would be made, plenocli.stages.evaluation.expected.
    learnt: whether classes are known by how the camera shows them.
    """

    truth: Path | str | None
    whites: Mapping[str, WhiteTarget]
    patches: Path | str | None
    lenslet_matrix: np.ndarray | None
    block: tuple[int, int] | None
    object_shape: tuple[int, int] | None
    sampling: str
    light: str
    camera: Camera | None
    sensor_snr: float | None
    classes: Path | str | None = None
    detect: str | None = None
    method: str = "auto"
    prior: Path | str | None = None
    learnt: bool = False


@dataclass(frozen=True, kw_only=True)
class _Scored:
    """One result with what the page draws of it; spectra: typed, to be set against single pixel."""

    score: ResultScore
    drawn: Compared | None = None
    spectra: SpectraScore | None = None
    failed: PlenoError | None = None


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


def _is_file(name: Path | str | None) -> bool:
    """Whether a truth or a label map is a file, or a folder of spectra, and not a name."""
    return name is not None and Path(name).exists()


def _page(document: ScoreDocument, scored: Sequence[_Scored]) -> bytes:
    from plenocli.report.score_page import score_page

    return score_page(document, [one.drawn for one in scored]).encode()


def _document(
    results: Sequence[Path | str],
    scored: Sequence[_Scored],
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
) -> _Comparison:
    from plenocli.files.artefacts.shards import read_pif
    from plenocli.files.read.cameras import read_camera
    from plenocli.forward.scene.tables import illuminant

    system = read_pif(pif) if pif else None
    illuminant(light, [560e-9])  # an unknown name is refused before any work
    if patches is None and str(truth) == CHART:
        patches = CHART
    matrix = None if system is None else matrix_of(system)
    return _Comparison(
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
    results: Sequence[Path | str], comparison: _Comparison, groups: tuple[str, ...]
) -> list[_Scored]:
    """Every result scored, set against single pixel and reduced to what was asked for; a single
    one raises its error.
    """
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


def _attempt(path: Path | str, comparison: _Comparison, alone: bool) -> _Scored:
    try:
        return _score_one(path, comparison)
    except PlenoError as error:
        if alone:
            raise
        return _failed(path, error)


def _failed(path: Path | str, error: PlenoError) -> _Scored:
    """The place of a result that cannot be scored; its error is told."""
    note(f"error: {error}")
    name = Path(path).name
    return _Scored(
        score=ResultScore(name=name, error=str(error).replace(str(path), name)), failed=error
    )


def _beside_single_pixel(one: _Scored, single: SpectraScore) -> _Scored:
    """Spectra of another method with what they gain over single pixel extraction."""
    if one.spectra is None or one.score.kind != "spectra" or one.score.method == SINGLE:
        return one
    gains = figures(over_single_pixel(one.spectra, single))
    return replace(one, score=replace(one.score, figures={**one.score.figures, **gains}))


def _score_one(path: Path | str, comparison: _Comparison) -> _Scored:
    """One result, whatever its kind."""
    found = read_scored(path)
    if isinstance(found, ComparedResponse):
        return _score_calibration(found, comparison)
    if isinstance(found, StoredVolume):
        return _score_volume(path, found, comparison)
    if isinstance(found, LightField):
        return _score_planes(path, found, comparison)
    if found.kind == "dictionary":
        return _score_dictionary(found, comparison)
    return _score_image(found, comparison)


def _score_calibration(response: ComparedResponse, comparison: _Comparison) -> _Scored:
    if comparison.truth is None and comparison.classes is None:
        raise UsageError(
            "the truth is missing",
            response.path,
            "name with --truth the calibration to compare with, or with --classes spectra to be "
            "told apart",
        )
    bands, found = response.wavelengths, {}
    if comparison.truth is not None:
        pair = paired_responses(response, read_response(comparison.truth))
        bands, found = pair.wavelengths, figures(score_response(pair.first, pair.second))
    if comparison.classes is not None:
        _require_class(comparison, read_labelled(comparison.classes))
        expected = run_expected(
            response.path,
            comparison.classes,
            detect=comparison.detect,
            camera=comparison.camera,
            method=comparison.method,
            prior=comparison.prior,
            learnt=comparison.learnt,
        )
        found |= figures(expected)
    return _Scored(
        score=ResultScore(
            name=response.path.name,
            kind="calibration",
            wavelengths_nm=_nanometres(bands),
            figures=found,
        )
    )


def _score_planes(path: Path | str, field: LightField, comparison: _Comparison) -> _Scored:
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
    return _Scored(
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


def _score_volume(path: Path | str, volume: StoredVolume, comparison: _Comparison) -> _Scored:
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
    return _Scored(
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


def _polarised(result: Result, truth: Path | str) -> PolarisationScore | None:
    """What spectra tell of polarisation against what the truth says of it."""
    if result.s1 is None or result.quantity != "reflectance":
        return None
    true = read_true_s1(truth, result)
    return None if true is None else score_polarisation(result.s1, true)


def _score_image(result: Result, comparison: _Comparison) -> _Scored:
    """A picture, or spectra, against the truth."""
    from plenocli.report.score_page import Compared

    if comparison.truth is None:
        raise UsageError(
            "the truth is missing",
            result.path,
            (
                "name it with --truth: a capture, photograph, spectral EXR, image, "
                "spectra or colorchecker"
            ),
        )
    truth = read_truth(comparison.truth, result, comparison.sampling, comparison.camera)
    block, patches, spectra, polarised = None, None, None, None
    bands: tuple[float, ...] = ()
    if result.wavelengths is None:
        block = _block(result, comparison)
        own: PictureScore | SpectraScore = _score_picture(result, truth, block, comparison)
    else:
        bands, true = _nanometres(result.wavelengths), truth.window()
        _require_values(truth, comparison.truth)
        labels = comparison.patches
        own, patches = score_spectra(
            result,
            true,
            labels=None if labels is None else read_labels(labels, result.grid),
            light=comparison.light,
            whites=comparison.whites,
            needs_reflectance=str(comparison.truth) == CHART,
            classes=_classes(comparison, result.bands),
            detect=comparison.detect,
            learnt=comparison.learnt,
        )
        spectra = own
        polarised = _polarised(result, comparison.truth)
    sensor = comparison.sensor_snr
    return _Scored(
        score=ResultScore(
            name=result.path.name,
            kind=result.kind,
            method=result.method,
            wavelengths_nm=bands,
            figures={
                **figures(own),
                **({} if polarised is None else figures(polarised)),
                **figures(result.told),
                **({} if sensor is None else {"snr_sensor_db": json_value(sensor)}),
            },
            patches=patches,
        ),
        drawn=Compared(result=result, truth=truth, block=block),
        spectra=spectra,
    )


def _classes(comparison: _Comparison, bands: np.ndarray) -> Classes | None:
    """What is to be told apart, in bands (m), seen as the truth is: at their centres, or through
    the filters of the camera.
    """
    from plenocli.evaluation.metrics.classes import Classes
    from plenocli.files.results.truths import through_filters

    if comparison.classes is None:
        if comparison.detect is not None:
            raise UsageError(
                "looks for one of the classes of --classes", "--detect", "give --classes"
            )
        return None
    known, camera = read_labelled(comparison.classes, bands), comparison.camera
    _require_class(comparison, known)
    seen = (
        known.at(bands)
        if camera is None
        else through_filters(lambda w: known.at(w).T, camera, bands)[:, 0].T
    )
    return Classes.of_spectra(known.labels, seen)


def _require_class(comparison: _Comparison, known: LabelledSpectra) -> None:
    """UsageError where a class is looked for that there is none of."""
    if comparison.detect not in (None, *known.labels):
        raise UsageError(
            f"{comparison.detect} is no class of {comparison.classes}",
            "--detect",
            f"choose one of {', '.join(dict.fromkeys(known.labels))}",
        )


def _nanometres(wavelengths: np.ndarray) -> tuple[float, ...]:
    return tuple(round(float(w) * 1e9, 6) for w in wavelengths)


def _block(result: Result, comparison: _Comparison) -> tuple[int, int] | None:
    """Object samples under a lenslet: as given, else as result, matrix or truth say."""
    return (
        comparison.block
        or result.block
        or comparison.object_shape
        or read_block(result, comparison.truth)
    )


def _score_picture(
    result: Result, truth: Plane, block: tuple[int, int] | None, comparison: _Comparison
) -> PictureScore:
    if block is not None and any(n % b for n, b in zip(result.grid, block, strict=True)):
        raise UsageError(
            (
                f"{result.grid[0]} x {result.grid[1]} points are no whole number of {block[0]} "
                f"x {block[1]} blocks"
            ),
            result.path,
            "correct --block",
        )

    def sound(values: np.ndarray) -> np.ndarray:
        if not np.isfinite(values).all():
            _require_values(truth, comparison.truth)
            raise InputError(
                "holds values that are not finite",
                result.path,
                "reconstruct again; pictures have no gaps",
            )
        return values

    return score_picture(result.plane.through(sound), truth.through(sound), block, result.deviation)


def _require_values(truth: Plane, where: Path | str | None) -> None:
    """InputError for a truth without a finite value."""
    if not any(np.isfinite(truth.window(rows)).any() for rows in truth.in_bands()):
        raise InputError("holds no finite value", where, "name a truth that has values")


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


def _score_dictionary(result: Result, comparison: _Comparison) -> _Scored:
    """Coherence of the atoms with the matrix of their own superpixel, scaled as the dictionary was
    learnt with.
    """
    from plenocli.report.score_page import Compared

    matrix = comparison.lenslet_matrix
    if matrix is None:
        raise UsageError(
            "the coherence of a dictionary depends on the system matrix",
            result.path,
            "name it with --pif pif.h5",
        )
    if matrix.shape[1] != len(result.values):
        raise InputError(
            f"has atoms of {len(result.values)} points, the matrix has {matrix.shape[1]}",
            result.path,
            "name the matrix it was learnt for",
        )
    found: CoherenceScore = dictionary_coherence(
        matrix / matrix.dtype.type(result.scale), result.values.astype(matrix.dtype, copy=False)
    )
    return _Scored(
        score=ResultScore(
            name=result.path.name,
            kind=result.kind,
            method=result.method,
            figures=figures(found),
        ),
        drawn=Compared(result=result),
    )


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
