"""Where results of single points are kept while a sweep runs and after it, and how points that
are missing are computed.
"""

import contextlib
import shutil
from collections import deque
from importlib.util import find_spec
from pathlib import Path

from plenocli.base.budget import budget
from plenocli.base.errors import OutputError, PlenoError, UsageError
from plenocli.base.extras import how_to_install
from plenocli.base.progress import bar
from plenocli.execution.pool import Lost
from plenocli.stages.sweep.point import refused, run_matrix, run_point


@contextlib.contextmanager
def open_store(output, plot, overwrite, inputs):
    """The Store of results beside `output`, checked before any work."""
    from plenocli.files.atomic import check_output

    output = Path(output)
    check_output(output, overwrite=overwrite, inputs=inputs, suffixes=(".h5",))
    folder = output.with_suffix(".parts")
    again = overwrite or folder.is_dir()  # what an unfinished run left is ours
    check_output(output.with_suffix(".csv"), overwrite=again, inputs=inputs)
    if plot is not None:
        if find_spec("matplotlib") is None:
            raise UsageError(
                "pictures need matplotlib, which is not installed",
                "--plot",
                f"{how_to_install('plot')}, or leave it out",
            )
        check_output(plot, overwrite=again, inputs=inputs, suffixes=(".png",))
    store = Store(folder, output, plot, overwrite, again)
    try:
        yield store
    finally:
        store.close()


class Store:
    """Results by content key in the folder beside OUT: points.jsonl, and while they are needed
    the matrices that points share.
    """

    def __init__(self, folder, output, plot=None, overwrite=False, again=False):
        from plenocli.execution.journal import Journal

        self.folder, self.output, self.plot, self.overwrite, self.again = (
            folder,
            output,
            plot,
            overwrite,
            again,
        )
        try:
            folder.mkdir(exist_ok=True)
            self.journal = Journal(folder / "points.jsonl")
            shutil.rmtree(folder / "scratch", ignore_errors=True)
            for name in ("scratch", "matrices"):
                (folder / name).mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(
                f"cannot be made ({error.strerror})", folder, "check the folder and its permissions"
            ) from None

    def close(self):
        """Let go of the folder; scratch files go, and all of it where no point was finished."""
        shutil.rmtree(
            self.folder / "scratch" if self.journal.records else self.folder, ignore_errors=True
        )
        self.journal.close()

    def evaluate(self, rows, pool, files=(), label="points"):
        """Give every row its result, from the journal or through `pool`; returns the number
        of points computed.

        Rows of one content key are computed once, a matrix that several need is computed
        once, before them.
        files: what tasks read;
        What was refused within another budget of memory is tried again.
        OutputError at the end where a worker was lost: all others are done then.
        """
        todo = {}
        for row in rows:
            known = self.journal.records.get(row.key)
            if (
                row.task is not None
                and row.key not in todo
                and (
                    known is None
                    or (known["status"] == 5 and known.get("mem_limit") != budget().memory)
                )
            ):
                todo[row.key] = row
        groups = {}
        for row in todo.values():
            groups.setdefault(row.matrix, []).append(row)
        with bar(None, len(todo), label) as progress:
            scratch = None if pool.far else str((self.folder / "scratch").resolve())
            lost = _Work(
                self,
                groups,
                pool,
                {"scratch": scratch, "files": list(files)},
            ).run(progress)
        if lost:
            raise OutputError(
                f"{len(lost)} of {len(todo)} points have no result: {lost[0]}",
                self.output,
                "the others are kept; run the command again",
            )
        for row in rows:
            if row.task is not None:
                row.result = self.journal.records[row.key]
        return len(todo)


class _Work:
    """Points through a pool, those of one matrix after it; at most as many matrices lie on the
    disk as are in use.
    """

    def __init__(self, store, groups, pool, surroundings):
        self.store, self.pool, self.surroundings = store, pool, surroundings
        self.groups, self.waiting, self.ready = (
            {key: list(rows) for key, rows in groups.items()},
            deque(groups),
            deque(),
        )
        self.left = {key: len(rows) for key, rows in groups.items()}
        self.lost, self.running = [], 0

    def run(self, progress):
        """Do everything; returns the errors of what was lost."""
        while True:
            while self.pool.room and (self.ready or self.waiting):
                if not self.ready:
                    self._open(self.waiting.popleft())
                self.pool.submit(*self.ready.popleft())
                self.running += 1
            if not self.running:
                return self.lost
            (kind, key, row), result = self.pool.next()
            self.running -= 1
            if isinstance(result, Lost):
                self.lost += [result] * (1 if kind == "point" else len(self.groups[key]))
            elif isinstance(result, OutputError):
                raise result
            elif kind == "matrix":
                progress.update(self._matrix(key, result))
            else:
                self._done(key, row, result)
                progress.update()

    def _open(self, key):
        """Make the first tasks of a group ready: its matrix, or its points where that lies there
        or serves one alone.
        """
        rows, path = self.groups[key], self._path(key)
        info = self.store.journal.records.get(f"matrix {key}")
        if info is not None and path.is_file():
            self._points(key, str(path.resolve()), info)
        elif len(rows) > 1:
            self.ready.append((("matrix", key, None), run_matrix, rows[0].task | self.surroundings))
        else:
            self._points(key, None, None)

    def _points(self, key, path, info):
        for row in self.groups[key]:
            self.ready.append(
                (
                    ("point", key, row),
                    run_point,
                    row.task | self.surroundings | {"matrix": path, "info": info},
                )
            )

    def _matrix(self, key, result):
        """Keep a matrix and make its points ready, or refuse them all; returns how
        many were refused.
        """
        from plenocli.files.atomic import publish

        if isinstance(result, PlenoError):
            for row in self.groups[key]:
                self._done(key, row, refused(result))
            return len(self.groups[key])
        publish(self._path(key), result["content"], overwrite=True)
        self.store.journal.add(f"matrix {key}", result["info"])
        self._points(key, str(self._path(key).resolve()), result["info"])
        return 0

    def _done(self, key, row, result):
        if isinstance(result, PlenoError):
            result = refused(result)
        self.store.journal.add(row.key, result | {"mem_limit": budget().memory})
        self.left[key] -= 1
        if not self.left[key]:
            self._path(key).unlink(missing_ok=True)

    def _path(self, key):
        return self.store.folder / "matrices" / f"{key}.h5"
