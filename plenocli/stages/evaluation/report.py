"""report: one page about everything that lies in a run folder."""

from __future__ import annotations

import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from plenocli.base.errors import PlenoError
from plenocli.base.text import Record

if TYPE_CHECKING:
    from plenocli.files.results.run_folder import RunFile, RunFolder
    from plenocli.report.viewer.panels import Panel

LOOKED_AT = (
    "lightfield",
    "volume",
    "image",
    "spectra",
    "capture",
    "calibration",
    "pif",
    "dictionary",
)
"""Kinds of files with a view beside the report, in this order."""
MOST_VIEWS = 6
"""Of one kind, and groups of results with one truth."""


@dataclass(frozen=True, kw_only=True)
class ReportSummary(Record):
    """What the page shows.

    files: read in the folder, of which `scores` are score documents.
    unreadable: names of those that could not be read.
    sections: names of those that show something.
    view: the page of views beside it, or None.
    """

    output: str
    files: int
    unreadable: list[str]
    scores: int
    sections: list[str]
    view: str | None


def run_report(
    folder: Path | str,
    output: Path | str,
    *,
    title: str | None = None,
    view: Path | str | None = None,
    overwrite: bool = False,
) -> ReportSummary:
    """Write one self-contained page about a run folder.

    folder: with artefacts, EXR, DNG and score documents, at any depth. Files that cannot be read
        are named on the page and in the summary.
    output: .html.
    title: default the name of the folder.
    view: .html, a page of views of its files that the report links to.

    Raises InputError where the folder holds nothing to show, UsageError, OutputError.
    """
    from plenocli.files.atomic import check_output, publish
    from plenocli.files.results.run_folder import RunFolder
    from plenocli.report.run_page import run_page
    from plenocli.report.viewer.page import view_page

    check_output(output, overwrite=overwrite, suffixes=(".html",))
    if view is not None:
        check_output(view, overwrite=overwrite, others=[output], suffixes=(".html",))
    run = RunFolder(folder)
    title = title or f"plenocli report: {run.root.resolve().name}"
    closer = []
    if view is not None:
        panels = _views(run)
        publish(view, view_page(title, panels).encode(), overwrite=overwrite)
        there = quote(os.path.relpath(view, Path(output).parent))
        closer = [(panel.title, f"{there}#p{i}") for i, panel in enumerate(panels)]
    page, sections = run_page(run, title, closer)
    publish(output, page.render().encode(), overwrite=overwrite)
    return ReportSummary(
        output=str(output),
        files=len(run.files),
        unreadable=[name for name, _ in run.unreadable],
        scores=len(run.of_kind("score")),
        sections=sections,
        view=None if view is None else str(view),
    )


def _views(run: RunFolder) -> list[Panel]:
    """Views of the results of a folder: those of one score together, beside their truth; then
    other files of all kinds.
    """
    from plenocli.stages.evaluation.view import VALUES, looked_at

    groups: list[tuple[list[Path], Path | None]] = []
    scored: set[str] = set()
    for file in run.of_kind("score"):
        truth = run.by_digest(file.sources.get("truth"))
        found = [run.by_digest(d) for role, d in file.sources.items() if role.startswith("result")]
        results = [one for one in found if one is not None and one.kind == "image"]
        if truth is not None and results:
            scored |= {one.digest for one in results}
            groups.append(([one.path for one in results], truth.path))
    others: list[RunFile] = []
    for kind in LOOKED_AT:
        others += [one for one in run.of_kind(kind) if one.digest not in scored][:MOST_VIEWS]
    groups = [*groups[:MOST_VIEWS], *(([file.path], None) for file in others)]
    number = sum(len(files) for files, _ in groups)
    panels: list[Panel] = []
    for files, against in groups:
        most = VALUES // number * len(files)
        with suppress(PlenoError):  # the report itself says what cannot be compared or read
            panels += looked_at(files, truth=against, most=most, below=run.root)
    return panels
