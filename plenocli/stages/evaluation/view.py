"""view: one page in which files are looked at: focus, views, spectra, slices, comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import Record, by

if TYPE_CHECKING:
    from plenocli.evaluation.results import Result
    from plenocli.files.opened_file import OpenedFile
    from plenocli.report.viewer.panels import Panel

VALUES = 1_500_000
"""Values on a page: 16 bits each and a third more as text are 4 MB before they are compressed."""


@dataclass(frozen=True, kw_only=True)
class ViewSummary(Record):
    """What the page shows: files and what they are, titles of its panels, and its size."""

    output: str
    files: list[str]
    kinds: list[str]
    panels: list[str]
    size_bytes: int


@dataclass(frozen=True, kw_only=True)
class _Choice:
    """With what files are looked at, and how many values each may show."""

    truth: Path | str | None
    calibration: Path | str | None
    most: int


def run_view(
    files: Sequence[Path | str],
    output: Path | str,
    *,
    truth: Path | str | None = None,
    calibration: Path | str | None = None,
    title: str | None = None,
    overwrite: bool = False,
) -> ViewSummary:
    """Write one self-contained page in which files are looked at.

    files: artefacts, EXR, RAW, DNG, photographs; folders and patterns of them.
    output: .html.
    truth: what pictures and spectra are compared with, as in score.
    calibration: lenslets and white image of captures.
    title: default the names of the files.

    Raises InputError for a file that no stage would read or whose kind has no view, UsageError,
    OutputError.
    """
    from plenocli.files.atomic import check_output, publish
    from plenocli.files.opened_file import open_file
    from plenocli.files.read.captures import named_captures
    from plenocli.report.viewer.page import view_page

    files = named_captures(files, [truth, calibration])
    inputs = [*files, truth, calibration]
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".html",))
    found = [open_file(file) for file in files]
    for file in found:
        _require_view(file)
    choice = _Choice(truth=truth, calibration=calibration, most=VALUES // len(found))
    names = ", ".join(dict.fromkeys(file.path.name for file in found[:3]))
    more = f" and {len(found) - 3} more" if len(found) > 3 else ""
    panels = _panels(found, choice)
    page = view_page(title or names + more, panels).encode()
    publish(output, page, overwrite=overwrite)
    return ViewSummary(
        output=str(output),
        files=[str(file) for file in files],
        kinds=[file.kind for file in found],
        panels=[panel.title for panel in panels],
        size_bytes=len(page),
    )


def looked_at(files: Sequence[Path], *, truth: Path | None, most: int, below: Path) -> list[Panel]:
    """Panels of files, named by their places below a folder.

    truth: of all of them, or None.
    most: values that they may show.
    """
    from plenocli.files.opened_file import open_file

    found = [open_file(file) for file in files]
    choice = _Choice(truth=truth, calibration=None, most=most // len(files))
    home = files[0].parent.relative_to(below).as_posix()
    panels = _panels(found, choice)
    return [replace(panel, title=f"{home}/{panel.title}".removeprefix("./")) for panel in panels]


def _require_view(file: OpenedFile) -> None:
    if file.kind not in _VIEWS:
        raise InputError(
            f"is of kind {file.kind}, which has no view; {', '.join(_VIEWS)} have",
            file.path,
            "plenocli show draws it, plenocli inspect lists what it holds",
        )


def _panels(found: Sequence[OpenedFile], choice: _Choice) -> list[Panel]:
    """Panels in the order of the files; pictures of one truth and size share a panel."""
    if choice.truth is None:
        return [panel for file in found for panel in _VIEWS[file.kind](file, choice)]
    from plenocli.files.results.results import read_result
    from plenocli.report.viewer.panels import picture_panels, spectra_panels

    results = [read_result(file.path, ("image", "spectra")) for file in found]
    together: dict[tuple[int, ...], list[Result]] = {}
    panels = []
    for result in results:
        if result.wavelengths is None:
            together.setdefault(result.values.shape, []).append(result)
        else:
            panels += spectra_panels(result, _truth(choice.truth, result), choice.most)
    for group in together.values():
        most = choice.most * len(group)
        panels += picture_panels(group, _truth(choice.truth, group[0]), most)
    return panels


def _truth(truth: Path | str, result: Result) -> Any:
    from plenocli.files.results.truths import read_truth

    true = read_truth(truth, result).window()
    if true.shape != result.values.shape:
        raise UsageError(
            f"is a picture of {by(result.values.shape)}, its truth of {by(true.shape)}",
            result.path,
            "compare pictures of one size",
        )
    return true


def _capture(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.images.mosaic import read_capture
    from plenocli.files.read.calibrations import read_calibration
    from plenocli.inverse.lightfield.gather import samples_of
    from plenocli.report.viewer.panels import capture_panels

    capture = read_capture(file.path)
    samples = None
    if choice.calibration is not None:
        calibration = read_calibration(choice.calibration, response=False)
        samples = samples_of(capture, calibration, where=choice.calibration)
    elif capture.grid is not None and capture.grid.shape is not None:
        samples = samples_of(capture)
    return capture_panels(capture, file.path.name, samples, choice.most)


def _lightfield(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.results.lightfields import lightfield_of, pupil_and_pitch
    from plenocli.report.viewer.panels import lightfield_panels

    stored = file.stored()
    size = pupil_and_pitch(stored)
    return lightfield_panels(lightfield_of(stored), file.path.name, size, choice.most)


def _result(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.results.results import read_result
    from plenocli.report.viewer.panels import picture_panels, spectra_panels

    result = read_result(file.path, ("image", "spectra"))
    if result.wavelengths is None:
        return picture_panels([result], None, choice.most)
    return spectra_panels(result, None, choice.most)


def _volume(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.results.volumes import volume_of
    from plenocli.report.viewer.panels import volume_panels

    return volume_panels(volume_of(file.stored()), file.path.name, choice.most)


def _calibration(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.read.calibrations import calibration_of
    from plenocli.report.viewer.panels import calibration_panels

    return calibration_panels(calibration_of(file.stored()), file.path.name, choice.most)


def _matrix(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.results.matrices import matrix_of
    from plenocli.report.viewer.panels import matrix_panels

    return matrix_panels(matrix_of(file.stored(), file.path), file.path.name, choice.most)


def _dictionary(file: OpenedFile, choice: _Choice) -> list[Panel]:
    from plenocli.files.results.results import result_of
    from plenocli.report.viewer.panels import dictionary_panels

    learnt = replace(file.stored(), kind="dictionary")  # a checkpoint holds the same
    return dictionary_panels(result_of(learnt, file.path), choice.most)


_VIEWS = {
    "capture": _capture,
    "lightfield": _lightfield,
    "image": _result,
    "spectra": _result,
    "volume": _volume,
    "calibration": _calibration,
    "pif": _matrix,
    "dictionary": _dictionary,
    "checkpoint": _dictionary,
}
