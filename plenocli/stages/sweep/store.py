"""Where results of single points are kept while a sweep runs and after it, and how points that are
missing are computed.
"""

from __future__ import annotations

import contextlib
import shutil
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.budget import budget
from plenocli.base.errors import OutputError, PlenoError, UsageError, remedy
from plenocli.base.progress import bar
from plenocli.base.text import how_to_install
from plenocli.execution.pool import Lost, Pool
from plenocli.stages.sweep.point import run_capture, run_matrix, run_point
from plenocli.stages.sweep.task import (
    Job,
    KeptCapture,
    MadeCapture,
    MadeMatrix,
    MatrixCost,
    PointResult,
    SharedCapture,
    SharedMatrix,
    refused,
    remembered,
)

if TYPE_CHECKING:
    from plenocli.stages.sweep.space import DesignPoint

SHARED = ("matrices", "captures")
"""Folders of what points share, while it is needed."""
LACKED_MEMORY = 5
"""Exit code of a point that may have a result within another budget of memory."""


@contextlib.contextmanager
def open_store(
    output: Path | str, plot: Path | None, overwrite: bool, inputs: Sequence[Path | str]
) -> Iterator[Store]:
    """The Store of results beside a table, checked before any work.

    output: the table.
    plot: picture of the front, or None.
    inputs: files that must not be overwritten.

    Raises UsageError, OutputError.
    """
    from plenocli.files.atomic import check_output

    output = Path(output)
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".h5",))
    folder = output.with_suffix(".parts")
    again = overwrite or folder.is_dir()  # what an unfinished run left is ours
    check_output(output.with_suffix(".csv"), overwrite=again, inputs=inputs, others=[output])
    if plot is not None:
        if find_spec("matplotlib") is None:
            raise UsageError(
                "pictures need matplotlib, which is not installed",
                "--plot",
                f"{how_to_install('plot')}, or leave it out",
            )
        others = [output, output.with_suffix(".csv")]
        check_output(plot, overwrite=again, inputs=inputs, others=others, suffixes=(".png",))
    store = Store(folder, output, plot, overwrite, again)
    try:
        yield store
    finally:
        store.close()


class Store:
    """Results by content key in the folder beside OUT: points.jsonl, and while they are needed
    the matrices and captures that points share.
    """

    def __init__(
        self,
        folder: Path,
        output: Path,
        plot: Path | None = None,
        overwrite: bool = False,
        again: bool = False,
    ) -> None:
        """Open or make the folder; `again`: CSV and picture may be overwritten.

        Raises OutputError.
        """
        from plenocli.execution.journal import Journal

        self.folder, self.output, self.plot = folder, output, plot
        self.overwrite, self.again = overwrite, again
        try:
            folder.mkdir(exist_ok=True)
            self.journal = Journal(folder / "points.jsonl")
            shutil.rmtree(folder / "scratch", ignore_errors=True)
            for name in ("scratch", *SHARED):
                (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot be made ({error.strerror})", folder, remedy(error)) from None

    def close(self) -> None:
        """Let go of the folder; scratch files go, and all of it where no point was finished."""
        shutil.rmtree(
            self.folder / "scratch" if self.journal.records else self.folder, ignore_errors=True
        )
        self.journal.close()

    def evaluate(
        self,
        points: Sequence[DesignPoint],
        pool: Pool,
        files: Sequence[str] = (),
        label: str = "points",
    ) -> int:
        """Give every point its result, from the journal or through a pool.

        points: those of one content key are computed once, a matrix or a capture that several
            need is computed once, before them. What was refused within another budget of memory is
            tried again.
        pool: of plenocli.execution.pool.
        files: what tasks read.
        label: of the progress bar.

        Returns the number of points computed.
        Raises OutputError at the end where a worker was lost: all others are done then.
        """
        missing: dict[str, DesignPoint] = {}
        for point in points:
            if point.task is not None and self._known(point.key) is None:
                missing.setdefault(point.key, point)
        groups: dict[str, list[DesignPoint]] = {}
        for point in missing.values():
            groups.setdefault(point.matrix, []).append(point)
        with bar(None, len(missing), label) as progress:
            scratch = None if pool.far else str((self.folder / "scratch").resolve())
            lost = _Work(self, groups, pool, tuple(files), scratch).run(progress)
        if lost:
            raise OutputError(
                f"{len(lost)} of {len(missing)} points have no result: {lost[0]}",
                self.output,
                "the others are kept; run the command again",
            )
        for point in points:
            if point.task is not None:
                point.result = self._known(point.key)
        return len(missing)

    def _known(self, key: str) -> PointResult | None:
        """What the journal has of a point, where that stands."""
        record = self.journal.records.get(key)
        found = remembered(PointResult, record)
        if found is not None and found.status == LACKED_MEMORY:
            return found if dict(record or {}).get("mem_limit") == budget().memory else None
        return found


@dataclass(frozen=True, eq=False)
class _Token:
    """What a job in a pool is for: the matrix of a group, a capture, or one point of a group."""

    group: str = ""
    point: DesignPoint | None = None
    capture: str = ""


@dataclass(eq=False)
class _Shared:
    """A capture that several points need.

    left: points that still need it.
    made: the capture, or why there is none; None before it is there.
    waiting: jobs that wait for it.
    """

    left: int
    made: SharedCapture | PlenoError | Lost | None = None
    waiting: list[tuple[_Token, Job]] = field(default_factory=list)
    under_way: bool = False


class _Work:
    """Points through a pool, those of one matrix or capture after it; at most as many matrices lie
    on the disk as are in use.
    """

    def __init__(
        self,
        store: Store,
        groups: Mapping[str, Sequence[DesignPoint]],
        pool: Pool,
        files: tuple[str, ...],
        scratch: str | None,
    ) -> None:
        self.store, self.pool, self.files, self.scratch = store, pool, files, scratch
        self.groups = {key: list(points) for key, points in groups.items()}
        self.left = {key: len(points) for key, points in groups.items()}
        uses = Counter(p.capture for points in groups.values() for p in points if p.capture)
        self.captures = {key: _Shared(left=count) for key, count in uses.items() if count > 1}
        self.waiting = deque(groups)
        self.ready: deque[tuple[_Token, Callable[[Job], Any], Job]] = deque()
        self.lost: list[Lost] = []
        self.running = 0

    def run(self, progress: Any) -> list[Lost]:
        """Do everything; returns the errors of what was lost."""
        while True:
            while self.pool.room and (self.ready or self.waiting):
                if not self.ready:
                    self._open(self.waiting.popleft())
                    continue  # its points may wait for a capture
                self.pool.submit(*self.ready.popleft())
                self.running += 1
            if not self.running:
                return self.lost
            token, result = self.pool.next()
            self.running -= 1
            if isinstance(result, Lost) and not token.capture:
                self.lost += [result] * (1 if token.point else len(self.groups[token.group]))
            elif isinstance(result, OutputError):
                raise result
            elif token.capture:
                progress.update(self._keep_capture(token.capture, result))
            elif token.point is None:
                progress.update(self._keep_matrix(token.group, result))
            else:
                self._keep(token.group, token.point, result)
                progress.update()

    def _job(self, point: DesignPoint, matrix: SharedMatrix | None = None) -> Job:
        assert point.task is not None  # only points that can be are computed
        return Job(task=point.task, matrix=matrix, files=self.files, scratch=self.scratch)

    def _open(self, group: str) -> None:
        """Make the first jobs of a group ready: its matrix, or its points where that lies there or
        serves one alone.
        """
        points, path = self.groups[group], self._path(group)
        cost = remembered(MatrixCost, self.store.journal.records.get(f"matrix {group}"))
        if cost is not None and path.is_file():
            self._open_points(group, SharedMatrix(str(path.resolve()), cost))
        elif group and len(points) > 1:
            self.ready.append((_Token(group), run_matrix, self._job(points[0])))
        else:
            self._open_points(group, None)

    def _open_points(self, group: str, matrix: SharedMatrix | None) -> None:
        for point in self.groups[group]:
            token, job = _Token(group, point), self._job(point, matrix)
            shared = self.captures.get(point.capture)
            if shared is None:
                self.ready.append((token, run_point, job))
                continue
            shared.waiting.append((token, job))
            if shared.made is None and not shared.under_way:
                self._open_capture(point, shared)
            self._release(shared)

    def _open_capture(self, point: DesignPoint, shared: _Shared) -> None:
        """Find a capture that lies there already, or make its job ready."""
        kept = remembered(KeptCapture, self.store.journal.records.get(f"capture {point.capture}"))
        paths = self._capture_paths(point.capture, 0 if kept is None else kept.files)
        if kept is not None and all(path.is_file() for path in paths):
            shared.made = _located(paths, kept.notes, kept.cpu_seconds)
            return
        shared.under_way = True
        self.ready.append((_Token(capture=point.capture), run_capture, self._job(point)))

    def _release(self, shared: _Shared) -> int:
        """Make the jobs that wait for a capture ready, or refuse them; returns how many were
        refused.
        """
        if shared.made is None:
            return 0
        waiting, shared.waiting = shared.waiting, []
        refusals = 0
        for token, job in waiting:
            assert token.point is not None  # only points wait
            if isinstance(shared.made, SharedCapture):
                self.ready.append((token, run_point, replace(job, capture=shared.made)))
            elif isinstance(shared.made, Lost):
                self.lost.append(shared.made)
            else:
                self._keep(token.group, token.point, shared.made)
                refusals += 1
        return refusals

    def _keep_capture(self, key: str, result: MadeCapture | PlenoError | Lost) -> int:
        """Keep a capture and make the points that wait for it ready; returns how many were
        refused.
        """
        from plenocli.files.atomic import publish

        shared = self.captures[key]
        shared.under_way = False
        if isinstance(result, MadeCapture):
            paths = self._capture_paths(key, len(result.contents))
            for path, content in zip(paths, result.contents):
                publish(path, content, overwrite=True)
            kept = KeptCapture(files=len(paths), notes=result.notes, cpu_seconds=result.cpu_seconds)
            self.store.journal.add(f"capture {key}", asdict(kept))
            shared.made = _located(paths, result.notes, result.cpu_seconds)
        else:
            shared.made = result
        return self._release(shared)

    def _keep_matrix(self, group: str, result: MadeMatrix | PlenoError) -> int:
        """Keep a matrix and make its points ready, or refuse them all; returns how many were
        refused.
        """
        from plenocli.files.atomic import publish

        if isinstance(result, PlenoError):
            for point in self.groups[group]:
                self._keep(group, point, result)
            return len(self.groups[group])
        publish(self._path(group), result.content, overwrite=True)
        self.store.journal.add(f"matrix {group}", asdict(result.cost))
        self._open_points(group, SharedMatrix(str(self._path(group).resolve()), result.cost))
        return 0

    def _keep(self, group: str, point: DesignPoint, result: PointResult | PlenoError) -> None:
        """Keep the result of a point; its matrix goes after the last one of the group."""
        found = refused(result) if isinstance(result, PlenoError) else result
        self.store.journal.add(point.key, asdict(found) | {"mem_limit": budget().memory})
        self.left[group] -= 1
        if not self.left[group]:
            self._path(group).unlink(missing_ok=True)
        shared = self.captures.get(point.capture)
        if shared is not None:
            shared.left -= 1
            if not shared.left and isinstance(shared.made, SharedCapture):
                for path in shared.made.paths:
                    Path(path).unlink(missing_ok=True)

    def _path(self, group: str) -> Path:
        return self.store.folder / "matrices" / f"{group}.h5"

    def _capture_paths(self, key: str, count: int) -> list[Path]:
        return [self.store.folder / "captures" / f"{key}-{i}.h5" for i in range(count)]


def _located(paths: Sequence[Path], notes: tuple[str, ...], seconds: float) -> SharedCapture:
    return SharedCapture(tuple(str(path.resolve()) for path in paths), tuple(notes), seconds)
