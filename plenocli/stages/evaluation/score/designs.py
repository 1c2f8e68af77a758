"""Calibrations against others and by the classes that they tell apart; dictionaries."""

from __future__ import annotations

from plenocli.base.errors import InputError, UsageError
from plenocli.evaluation.metrics.coherence import CoherenceScore, dictionary_coherence
from plenocli.evaluation.metrics.figures import figures
from plenocli.evaluation.metrics.response import score_response
from plenocli.evaluation.response_score import ComparedResponse, paired_responses
from plenocli.evaluation.results import Result
from plenocli.evaluation.scores import ResultScore
from plenocli.files.read.class_table import read_labelled, require_class
from plenocli.files.results.results import read_response
from plenocli.stages.evaluation.expected import run_expected
from plenocli.stages.evaluation.score.comparison import (
    Comparison,
    Scored,
    nanometres,
)


def score_calibration(response: ComparedResponse, comparison: Comparison) -> Scored:
    """A response against that of another calibration, and by the classes that it tells apart.

    Raises UsageError where there is neither, or no such class.
    """
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
        known = read_labelled(comparison.classes)
        require_class(known, comparison.detect, comparison.classes)
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
    return Scored(
        score=ResultScore(
            name=response.path.name,
            kind="calibration",
            wavelengths_nm=nanometres(bands),
            figures=found,
        )
    )


def score_dictionary(result: Result, comparison: Comparison) -> Scored:
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
    return Scored(
        score=ResultScore(
            name=result.path.name,
            kind=result.kind,
            method=result.method,
            figures=figures(found),
        ),
        drawn=Compared(result=result),
    )
