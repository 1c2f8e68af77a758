"""show: one picture of a file, or of several: artefacts, EXR, RAW and photographs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import Record, by

if TYPE_CHECKING:
    from plenocli.files.opened_file import OpenedFile
    from plenocli.files.results.matrices import StoredMatrix
    from plenocli.report.drawing import Figures

Place = tuple[int, int]


@dataclass(frozen=True, kw_only=True)
class ShowSummary(Record):
    """What was drawn: the picture, the files and what they are, and the captions in order."""

    output: str
    files: list[str]
    kinds: list[str]
    captions: list[str]


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """What of the files is drawn.

    output: the picture.
    centres: (lenslet_row, lenslet_column, 2) px, over captures.
    points: (row, column) of object points, whose columns of A are shown.
    lenslets: (row, column), whose spectra are shown.
    matrix: whose sensor sees a dictionary.
    """

    output: Path
    centres: np.ndarray | None = None
    points: Sequence[Place] | None = None
    lenslets: Sequence[Place] | None = None
    matrix: StoredMatrix | None = None


def run_show(
    files: Sequence[Path | str],
    output: Path | str | None = None,
    *,
    truth: Path | str | None = None,
    calibration: Path | str | None = None,
    points: Sequence[Place] = (),
    lenslets: Sequence[Place] = (),
    overwrite: bool = False,
) -> ShowSummary:
    """Draw files, folders and patterns of them into one PNG.

    output: default the first file's name with .png, in the current folder.
    truth: what pictures are compared with, as in score.
    calibration: its lenslet grid is drawn over captures.
    points: (row, column) object points whose columns of A are shown.
    lenslets: (row, column) whose spectra are shown.

    Raises InputError for a file that no stage would read, UsageError where points lie outside.
    """
    from plenocli.files.atomic import check_output, publish
    from plenocli.files.opened_file import open_file
    from plenocli.files.read.captures import named_captures
    from plenocli.files.results.matrices import matrix_of
    from plenocli.report.drawing import stacked

    files = named_captures(files, [truth, calibration])
    output = Path(output) if output is not None else Path(f"{files[0].stem}.png")
    inputs = [*files, truth, calibration]
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".png",))
    centres = None if calibration is None else _centres(calibration)
    found = [open_file(file) for file in files]
    kinds = [file.kind for file in found]
    if truth is not None:
        if set(kinds) != {"image"}:
            raise UsageError(
                "only pictures are compared with a truth",
                "--truth",
                "give image files, or leave the option out",
            )
        figures = _compared(files, truth)
    else:
        matrix = next((file for file in found if file.kind == "pif"), None)
        choice = _Choice(
            output=output,
            centres=centres,
            points=points or None,
            lenslets=lenslets or None,
            matrix=None if matrix is None else matrix_of(matrix.stored(), matrix.path),
        )
        figures = [figure for file in found for figure in _FIGURES[file.kind](file, choice)]
    publish(output, stacked(figures), overwrite=overwrite)
    return ShowSummary(
        output=str(output),
        files=[str(f) for f in files],
        kinds=kinds,
        captions=[caption for _, caption in figures],
    )


def _centres(path: Path | str) -> np.ndarray:
    from plenocli.files.read.calibrations import read_calibration

    return read_calibration(path, response=False).grid.centres


def _pif(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.matrices import matrix_of
    from plenocli.report.figures import matrix_figures

    matrix = matrix_of(file.stored(), file.path)
    _require_inside(choice.points, matrix.object_shape, "--point", "object points")
    return matrix_figures(matrix, choice.points)


def _require_inside(
    places: Sequence[Place] | None, shape: tuple[int, int], option: str, what: str
) -> None:
    for row, column in places or ():
        if not (row < shape[0] and column < shape[1]):
            raise UsageError(
                f"{row},{column} is outside {shape[0]} x {shape[1]} {what}", option, "count from 0"
            )


def _capture(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.images.mosaic import stored_capture
    from plenocli.files.scratch import Scratch
    from plenocli.report.figures import capture_figures

    centres = choice.centres
    if centres is None and file.artefact is not None:
        centres = file.artefact.data.get("capture/lenslet_centre")
    with stored_capture(file.path, room=Scratch(choice.output), verify=False) as stored:
        return capture_figures(stored.about, file.path.name, centres, stored)


def _calibration(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.read.calibrations import calibration_of
    from plenocli.report.figures import calibration_figures

    return calibration_figures(calibration_of(file.stored()))


def _dictionary(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.results import result_of
    from plenocli.report.figures import dictionary_figures

    learnt = replace(file.stored(), kind="dictionary")  # a checkpoint holds the same
    return dictionary_figures(result_of(learnt, file.path), file.path.name, choice.matrix)


def _spectra(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.results import read_result
    from plenocli.report.figures import spectra_figures

    result = read_result(file.path)
    _require_inside(choice.lenslets, result.grid, "--lenslet", "lenslets")
    return spectra_figures(result, file.path.name, choice.lenslets)


def _image(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.results import read_result
    from plenocli.report.figures import image_figures, spectra_figures

    result = read_result(file.path)
    if result.wavelengths is not None:
        return spectra_figures(result, file.path.name)[:1]
    return image_figures(result, file.path.name, result.seen)


def _sweep(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.design_tables import designs_of
    from plenocli.report.front import front_figures

    return front_figures(designs_of(file.stored()))


def _lightfield(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.lightfields import lightfield_of
    from plenocli.report.depth.planes import lightfield_figures

    return lightfield_figures(lightfield_of(file.stored()))


def _fit(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.report.figures import fit_figures

    stored = file.stored()
    names = [str(name) for name in stored.attrs["fit"]["names"]]
    parts = ("value", "sigma", "described", "tolerance", "correlation")
    return fit_figures(names, *(stored.data[f"fit/{part}"] for part in parts))


def _kernels(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.stacks import stack_of
    from plenocli.report.depth.volumes import kernel_figures

    return kernel_figures(stack_of(file.stored(), file.path), file.path.name)


def _volume(file: OpenedFile, choice: _Choice) -> Figures:
    from plenocli.files.results.volumes import volume_of
    from plenocli.report.depth.volumes import volume_figures

    return volume_figures(volume_of(file.stored()), file.path.name)


_FIGURES = {
    "pif": _pif,
    "capture": _capture,
    "calibration": _calibration,
    "dictionary": _dictionary,
    "checkpoint": _dictionary,
    "spectra": _spectra,
    "image": _image,
    "sweep": _sweep,
    "lightfield": _lightfield,
    "fit": _fit,
    "pif-stack": _kernels,
    "volume": _volume,
}


def _compared(files: Sequence[Path | str], truth: Path | str) -> Figures:
    """Pictures beside their truth."""
    from plenocli.evaluation.metrics.quality import psnr
    from plenocli.files.results.results import read_block, read_result
    from plenocli.files.results.truths import read_truth
    from plenocli.report.pictures import close_ups, reconstructions

    results = [read_result(file, ("image",)) for file in files]
    several = [file for file, result in zip(files, results) if result.wavelengths is not None]
    if several:
        raise UsageError(
            "has several bands, and pictures of one are compared",
            several[0],
            "score --report draws bands beside their truth",
        )
    true = read_truth(truth, results[0])
    for file, result in zip(files, results):
        if result.plane.shape != true.shape:
            raise InputError(
                f"is a picture of {by(result.plane.shape)}, the first of {by(true.shape)}",
                file,
                "compare pictures of one size",
            )
    entries = [(r.method or r.name, r.plane, f"{psnr(r.plane, true):.2f} dB") for r in results]
    figures = [(reconstructions(entries, true), "Each result above its error.")]
    block = read_block(results[0], truth)
    if block is not None and min(np.floor_divide(true.shape, block)) >= 2:
        figures.append((close_ups(entries, true, block), "Close-up of the middle lenslets."))
    return figures
