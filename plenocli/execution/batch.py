"""Several captures in one run: where each result goes, which are finished already, and what
happens when some fail.
"""

import os
from dataclasses import dataclass
from pathlib import Path

from plenocli.base.errors import OutputError, PlenoError, UsageError
from plenocli.base.progress import bar, note
from plenocli.execution.pool import absolute, attempt, run_all


@dataclass(frozen=True)
class Batch:
    """jobs, todo: (capture, target) pairs, all of them and those not finished before;
    several: whether `output` is a folder.
    """

    output: Path
    several: bool
    jobs: list
    todo: list


def plan_batch(captures, output, suffix, what, *, overwrite, inputs):
    """Batch of `captures` (paths): one goes to the file `output`, several, or one to a name without
    a suffix, to a folder, each to its own name with `suffix`.

    The folder is made; in it finished results are skipped unless overwrite.
    what: the result in words, for messages, such as "spectra are".
    inputs: all files that are read, which no result may replace. Errors: UsageError, OutputError.
    """
    from plenocli.files.atomic import check_output

    captures, output = [Path(c) for c in captures], Path(output)
    # Path.is_dir raises where a name is too long
    if len(captures) == 1 and output.suffix and not os.path.isdir(output):
        if output.suffix not in (".exr", ".h5"):
            raise UsageError(
                f"{what} written as .exr or .h5, not {output.suffix}",
                output,
                "change the suffix of OUT",
            )
        check_output(output, overwrite=overwrite, inputs=inputs)
        jobs = [(captures[0], output)]
        return Batch(output, False, jobs, jobs)
    if os.path.exists(output) and not os.path.isdir(output):
        raise OutputError("is a file; several captures go to a folder", output, "name a folder")
    targets = [output / (capture.stem + suffix) for capture in captures]
    read = [i for i in inputs if i is not None and os.path.exists(i)]
    for target in targets:
        if os.path.exists(target) and any(os.path.samefile(target, i) for i in read):
            raise OutputError("is also an input of this command", target, "give another folder")
        same = [c for c, t in zip(captures, targets) if t == target]
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
    jobs = list(zip(captures, targets))
    return Batch(output, True, jobs, [job for job in jobs if overwrite or not job[1].exists()])


def outcomes(batch, pool, work, write):
    """(capture, report or PlenoError) of every job to do, as they end.

    work(capture) runs in `pool` (stages.scheduler), write(what it returned, capture, target) in
    this process, so that there is one writer, at once, so that a run that is killed loses no
    finished result. Not many more results than workers are held.
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


def summarise(batch, outcomes):
    """Summary dict of (capture, report or PlenoError) pairs, which may come in any order; its lists
    follow that of the captures.

    A capture that fails does not stop the others: its message is printed at once, and an error with
    the exit code of the worst is raised at the end. The error of a single capture
    is raised as it is.
    """
    reports, errors = [], []
    for capture, outcome in outcomes:
        if not isinstance(outcome, PlenoError):
            reports.append((capture, outcome))
        elif not batch.several:
            raise outcome
        else:
            note(f"error: {outcome}")
            errors.append((capture, outcome))
    order = {capture: number for number, (capture, _) in enumerate(batch.jobs)}
    reports, errors = (sorted(part, key=lambda pair: order[pair[0]]) for part in (reports, errors))
    if errors:
        raise failed_together(
            errors,
            len(batch.jobs),
            "captures",
            batch.output,
            f"{len(batch.jobs) - len(errors)} are done; see the messages above",
        )
    return {
        "output": str(batch.output),
        "done": len(reports),
        "skipped": len(batch.jobs) - len(batch.todo),
        "captures": [report for _, report in reports],
    }


def failed_together(errors, total, things, where, fix):
    """One error for the (path, PlenoError) pairs of the `things` that failed, each told already;
    its exit code is that of the worst.
    """
    worst = max((error for _, error in errors), key=lambda error: error.exit_code)
    return type(worst)(
        (
            f"{len(errors)} of {total} {things} failed: "
            f"{', '.join(Path(path).name for path, _ in errors)}"
        ),
        where,
        fix,
    )
