"""Pictures and spectra against the scene, patches and classes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.progress import note
from plenocli.base.text import json_value
from plenocli.base.tiling import Plane
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.quality import PictureScore, score_picture
from plenocli.evaluation.metrics.spectral import PolarisationScore, score_polarisation
from plenocli.evaluation.results import Result
from plenocli.evaluation.scores import ResultScore
from plenocli.evaluation.spectra_score import (
    SpectraScore,
    score_spectra,
)
from plenocli.files.results.results import read_block
from plenocli.files.results.truths import CHART, read_labels, read_true_s1, read_truth
from plenocli.stages.evaluation.score.comparison import Comparison, Scored, classes_of, nanometres


def _polarised(result: Result, truth: Path | str) -> PolarisationScore | None:
    """What spectra tell of polarisation against what the truth says of it."""
    if result.s1 is None or result.quantity != "reflectance":
        return None
    true = read_true_s1(truth, result)
    return None if true is None else score_polarisation(result.s1, true)


def score_image(result: Result, comparison: Comparison) -> Scored:
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
        bands, true = nanometres(result.wavelengths), truth.window()
        _require_values(truth, comparison.truth)
        labels = comparison.patches
        own, patches = score_spectra(
            result,
            true,
            labels=None if labels is None else read_labels(labels, result.grid),
            light=comparison.light,
            whites=comparison.whites,
            needs_reflectance=str(comparison.truth) == CHART,
            classes=classes_of(comparison, result.bands),
            detect=comparison.detect,
            learnt=comparison.learnt,
        )
        spectra = own
        polarised = _polarised(result, comparison.truth)
    sensor = comparison.sensor_snr
    return Scored(
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


def _block(result: Result, comparison: Comparison) -> tuple[int, int] | None:
    """Object samples under a lenslet: as given, else as result, matrix or truth say."""
    return (
        comparison.block
        or result.block
        or comparison.object_shape
        or read_block(result, comparison.truth)
    )


def _score_picture(
    result: Result, truth: Plane, block: tuple[int, int] | None, comparison: Comparison
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

    lowest, highest = np.inf, -np.inf

    def watched(values: np.ndarray) -> np.ndarray:
        nonlocal lowest, highest
        lowest, highest = values.min(initial=lowest), values.max(initial=highest)
        return sound(values)

    score = score_picture(
        result.plane.through(sound), truth.through(watched), block, result.deviation
    )
    if lowest == highest:
        note(
            f"warning: {comparison.truth}: is {lowest:.4g} everywhere on the result's grid: "
            "figures tell how near the result comes to that, and nothing of detail"
        )
    return score


def _require_values(truth: Plane, where: Path | str | None) -> None:
    """InputError for a truth without a finite value."""
    if not any(np.isfinite(truth.window(rows)).any() for rows in truth.in_bands()):
        raise InputError("holds no finite value", where, "name a truth that has values")
