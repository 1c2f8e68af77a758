"""Several captures in one run: where each result goes, which are finished already, and what
happens when some fail.
"""

import contextlib
import csv
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plenocli.base.errors import OutputError, PlenoError, UsageError
from plenocli.base.progress import bar, repeats_counted, tell
from plenocli.execution.pool import Pool, absolute, attempt, run_all

SUMMARY = "summary"
"""Name of the files that say what became of every capture, without .json and .csv."""


@dataclass(frozen=True)
class Batch:
    """What becomes of several captures.

    output: a file, or a folder.
    several: whether it is a folder.
    jobs: (capture, target), all of them.
    todo: those that were not finished before.
    """

    output: Path
    several: bool
    jobs: list[tuple[Path, Path]]
    todo: list[tuple[Path, Path]]


def plan_batch(
    captures: Iterable[str | Path],
    output: str | Path,
    suffix: str,
    what: str,
    *,
    overwrite: bool,
    inputs: Sequence[str | Path | None],
    suffixes: Sequence[str] = (".exr", ".h5"),
) -> Batch:
    """Where the result of each capture goes.

    captures: one goes to the file `output`, several, or one to a name without a suffix, to a
        folder, which is made.
    output: that file or folder.
    suffix: of results in a folder; they have the names of their captures.
    what: the result in words, for messages, such as "spectra are".
    overwrite: results that are there already are made again, not skipped.
    inputs: all files that are read, which no result may replace.
    suffixes: that a single result may have.

    Raises UsageError, OutputError.
    """
    from plenocli.files.atomic import check_output

    shots, output = [Path(c) for c in captures], Path(output)
    # Path.is_dir raises where a name is too long
    if len(shots) == 1 and output.suffix and not os.path.isdir(output):
        if output.suffix not in suffixes:
            known = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
            raise UsageError(
                f"{what} written as {known}, not {output.suffix}",
                output,
                "change the suffix of OUT",
            )
        check_output(output, overwrite=overwrite, inputs=inputs)
        jobs = [(shots[0], output)]
        return Batch(output, False, jobs, jobs)
    if os.path.exists(output) and not os.path.isdir(output):
        raise OutputError("is a file; several captures go to a folder", output, "name a folder")
    targets = [output / (capture.stem + suffix) for capture in shots]
    read = [i for i in inputs if i is not None and os.path.exists(i)]
    for target in targets:
        if os.path.exists(target) and any(os.path.samefile(target, i) for i in read):
            raise OutputError("is also an input of this command", target, "give another folder")
        same = [c for c, t in zip(shots, targets) if t == target]
        if len(same) > 1:
            raise UsageError(
                f"captures {', '.join(str(c) for c in same)} would all become {target.name}",
                fix="rename one, or use two folders",
            )
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"the folder cannot be made ({error.strerror})", output, "make its parent folder first"
        ) from None
    jobs = list(zip(shots, targets))
    return Batch(output, True, jobs, [job for job in jobs if overwrite or not job[1].exists()])


def outcomes(
    batch: Batch, pool: Pool, work: Callable[[Path], Any], write: Callable[[Any, Path, Path], Any]
) -> Iterator[tuple[Path, Any]]:
    """Do what a batch has to do; not many more results than workers are held.

    pool: where work(capture) runs.
    write: (what work returned, capture, target) -> report; runs in this process, so that there is
        one writer, and at once, so that a run that is killed loses no finished result.

    Yields (capture, report or PlenoError) as they end.
    """
    with bar(None, len(batch.todo), "captures") as progress:
        for (capture, target), done in run_all(
            pool, ((job, work, absolute(job[0]) if pool.far else job[0]) for job in batch.todo)
        ):
            yield (
                capture,
                done if isinstance(done, PlenoError) else attempt(write, done, capture, target),
            )
            progress.update()


@dataclass(frozen=True)
class BatchSummary:
    """What a batch did.

    output: file or folder.
    skipped: captures that were finished before.
    reports: what `write` returned of each of the others, in the order of the captures.
    """

    output: str
    skipped: int
    reports: tuple[Any, ...]


class PartialFailure(Exception):
    """What caused the error of a batch that failed in part: what it did nevertheless.

    done: the captures that did not fail; their reports have as_json().
    errors: (capture, error) of the others.
    """

    def __init__(self, done: BatchSummary, errors: Sequence[tuple[Path, PlenoError]]) -> None:
        super().__init__(f"{len(errors)} captures failed")
        self.done, self.errors = done, errors

    def as_json(self) -> dict[str, Any]:
        """What --json prints: the summary of a batch, and `failed`."""
        return {
            "output": self.done.output,
            "done": len(self.done.reports),
            "skipped": self.done.skipped,
            "captures": [report.as_json() for report in self.done.reports],
            "failed": [{"capture": str(path), "error": str(e)} for path, e in self.errors],
        }


def summarise(batch: Batch, ended: Iterable[tuple[Path, Any]]) -> BatchSummary:
    """The summary of a batch whose captures have ended, in any order.

    A capture that fails does not stop the others: its message is printed at once.

    batch: what was to be done.
    ended: (capture, report or PlenoError), as `outcomes` yields them.

    Raises at the end an error with the exit code of the worst, caused by a PartialFailure; that of
    a single capture as it is.
    """
    reports: list[tuple[Path, Any]] = []
    errors: list[tuple[Path, PlenoError]] = []
    with repeats_counted() if batch.several else contextlib.nullcontext():
        for capture, outcome in ended:
            if not isinstance(outcome, PlenoError):
                reports.append((capture, outcome))
            elif not batch.several:
                raise outcome
            else:
                tell(f"plenocli: error: {outcome}", error=True)
                errors.append((capture, outcome))
    order = {capture: number for number, (capture, _) in enumerate(batch.jobs)}
    reports.sort(key=lambda pair: order[pair[0]])
    errors.sort(key=lambda pair: order[pair[0]])
    done = BatchSummary(
        str(batch.output), len(batch.jobs) - len(batch.todo), tuple(report for _, report in reports)
    )
    if batch.several:
        _write_summary(batch, dict(reports), dict(errors))
    if errors:
        raise failed_together(
            errors,
            len(batch.jobs),
            "captures",
            batch.output,
            f"{len(batch.jobs) - len(errors)} are done; see the messages above",
        ) from PartialFailure(done, errors)
    return done


def _write_summary(
    batch: Batch, reports: Mapping[Path, Any], errors: Mapping[Path, PlenoError]
) -> None:
    """Write SUMMARY.json and SUMMARY.csv (without what has parts of its own) beside the results: a
    row for every capture, what an earlier run said of those that were finished before.
    """
    from plenocli.base.text import json_value
    from plenocli.files.atomic import publish
    from plenocli.files.images.raw import captured_at

    path = batch.output / f"{SUMMARY}.json"
    try:
        known = {row["capture"]: row for row in json.loads(path.read_text())["captures"]}
    except (OSError, ValueError, KeyError, TypeError):
        known = {}
    rows = []
    for capture, target in batch.jobs:
        row: dict[str, Any] = {"capture": str(capture), "output": str(target)}
        if capture in reports:
            row |= {"state": "done", "error": None, "captured": captured_at(capture)}
            row |= reports[capture].as_json() | row
        elif capture in errors:
            row |= {"state": "failed", "error": str(errors[capture])}
        else:
            row |= known.get(str(capture), {}) | row | {"state": "finished before", "error": None}
        rows.append(json_value(row))
    document = json.dumps({"captures": rows}, indent=1, ensure_ascii=False, allow_nan=False)
    flat = [{k: v for k, v in row.items() if not isinstance(v, dict)} for row in rows]
    table = io.StringIO()
    names = list(dict.fromkeys(name for row in flat for name in row))
    writer = csv.DictWriter(table, names, lineterminator="\n")
    writer.writeheader()
    for row in flat:
        writer.writerow({k: json.dumps(v) if isinstance(v, list) else v for k, v in row.items()})
    publish(path, document.encode() + b"\n", overwrite=True)
    publish(path.with_suffix(".csv"), table.getvalue().encode(), overwrite=True)


def failed_together(
    errors: Sequence[tuple[str | Path, PlenoError]],
    total: int,
    things: str,
    where: object,
    fix: str,
) -> PlenoError:
    """One error for several that were told already; its exit code is that of the worst.

    errors: (path, error).
    total: how many things there were, failed or not.
    things: what they are, such as "captures".
    where, fix: as in PlenoError.
    """
    worst = max((error for _, error in errors), key=lambda error: error.exit_code)
    return type(worst)(
        f"{len(errors)} of {total} {things} failed: "
        f"{', '.join(Path(path).name for path, _ in errors)}",
        where,
        fix,
    )
