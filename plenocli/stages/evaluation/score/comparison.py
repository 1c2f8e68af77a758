"""What results are held against, and what is found of one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import PlenoError, UsageError
from plenocli.evaluation.results import WhiteTarget
from plenocli.evaluation.scores import ResultScore
from plenocli.evaluation.spectra_score import SpectraScore
from plenocli.files.read.class_table import read_labelled, require_class

if TYPE_CHECKING:
    from plenocli.evaluation.metrics.classes import Classes
    from plenocli.forward.camera.model import Camera
    from plenocli.report.score_page import Compared


@dataclass(frozen=True, kw_only=True)
class Comparison:
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
class Scored:
    """One result with what the page draws of it; spectra: typed, to be set against single pixel."""

    score: ResultScore
    drawn: Compared | None = None
    spectra: SpectraScore | None = None
    failed: PlenoError | None = None


def classes_of(comparison: Comparison, bands: np.ndarray) -> Classes | None:
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
    require_class(known, comparison.detect, comparison.classes)
    seen = (
        known.at(bands)
        if camera is None
        else through_filters(lambda w: known.at(w).T, camera, bands)[:, 0].T
    )
    return Classes.of_spectra(known.labels, seen)


def nanometres(wavelengths: np.ndarray) -> tuple[float, ...]:
    """Wavelengths (band,) m, as scores tell them, nm."""
    return tuple(round(float(w) * 1e9, 6) for w in wavelengths)
