"""report: one page about everything that lies in a run folder."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True, kw_only=True)
class ReportSummary:
    """What the page shows.

    files: read in the folder, of which `scores` are score documents.
    unreadable: names of those that could not be read.
    sections: names of those that show something.
    """

    output: str
    files: int
    unreadable: list[str]
    scores: int
    sections: list[str]

    def as_json(self) -> dict[str, Any]:
        """The summary of --json."""
        return asdict(self)


def run_report(
    folder: Path | str, output: Path | str, *, title: str | None = None, overwrite: bool = False
) -> ReportSummary:
    """Write one self-contained page about a run folder.

    folder: with artefacts, EXR, DNG and score documents, at any depth. Files that cannot be read
        are named on the page and in the summary.
    output: .html.
    title: default the name of the folder.

    Raises InputError where the folder holds nothing to show, UsageError, OutputError.
    """
    from plenocli.files.atomic import check_output, publish
    from plenocli.files.results.run_folder import RunFolder
    from plenocli.report.run_page import run_page

    check_output(output, overwrite=overwrite, suffixes=(".html",))
    run = RunFolder(folder)
    page, sections = run_page(run, title or f"plenocli report: {run.root.resolve().name}")
    publish(output, page.render().encode(), overwrite=overwrite)
    return ReportSummary(
        output=str(output),
        files=len(run.files),
        unreadable=[name for name, _ in run.unreadable],
        scores=len(run.of_kind("score")),
        sections=sections,
    )
