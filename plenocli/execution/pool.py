"""Where independent tasks run: in this process, in threads, in processes, or on a Dask cluster
that is there already.

A task is a function of one argument, found by its name in a module of plenocli (threads and this
process take any), that depends on nothing else: the same results come back wherever it runs, to
this process, which is the only one that writes. Whoever asks hands in tasks while there is room and
takes results as they come, in any order. Linear algebra runs in one thread everywhere, because the
last digits of its results depend on how many there are.
"""

import contextlib
import os
import signal
import threading
from collections import deque
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import replace
from pathlib import Path

from plenocli import __version__
from plenocli.base.budget import budget, set_budget
from plenocli.base.errors import OutputError, PlenoError, UsageError
from plenocli.base.extras import how_to_install
from plenocli.base.progress import heard, note

ATTEMPTS = 2
"""Times that a task may take its process along before it is given up."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Lost(OutputError):
    """A task whose worker died with it, again and again: it has no result, and may
    have one another time.
    """


@contextlib.contextmanager
def open_pool(workers=1, scheduler=None, *, threads=False):
    """A pool for tasks while the block lasts: `submit(token, function, task)`, `next()` -> (token,
    result or PlenoError), `room`.

    workers: processes (threads, where asked for) beside this one; 1 runs every task here.
    scheduler: address of a Dask scheduler, or the file that it wrote; then its workers serve,
        however many they are.
    UsageError where there is none.
    """
    if scheduler is not None:
        with (
            _one_thread(),
            _cluster(scheduler) as client,
            contextlib.closing(_on_cluster(client)) as pool,
        ):
            yield pool
    elif workers == 1:
        with _one_thread():
            yield Here()
    elif threads:
        with (
            _one_thread(),
            contextlib.closing(
                _Executing(lambda: ThreadPoolExecutor(workers), lambda: workers + 1, attempt)
            ) as pool,
        ):
            yield pool
    else:
        with (
            _one_thread(),
            _environment(),
            contextlib.closing(
                _Executing(lambda: _processes(workers), lambda: 2 * workers)
            ) as pool,
        ):
            yield pool


def run_all(pool, jobs):
    """(token, result or PlenoError) of every (token, function, task) of `jobs`, as they
    end; few results wait.
    """
    jobs, left = iter(jobs), 0
    more = True
    while more or left:
        while more and pool.room:
            job = next(jobs, None)
            if job is None:
                more = False
            else:
                pool.submit(*job)
                left += 1
        if left:
            yield pool.next()
            left -= 1


@contextlib.contextmanager
def _one_thread():
    # a library of its own, which the limit below reaches only once it is loaded
    import scipy.linalg.blas  # noqa: F401
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, "blas"):
        yield


def absolute(name):
    """A file name that means the same to a process elsewhere; None, and what is no file
    here, as they are.
    """
    return name if name is None or not os.path.exists(name) else type(name)(os.path.abspath(name))


def attempt(function, *task):
    """What function(*task) returns, or the PlenoError that it raises."""
    try:
        return function(*task)
    except PlenoError as error:
        return error


def _remotely(version, granted, function, task):
    """(result or PlenoError, what it said) of a task in a process that runs nothing but tasks,
    within the Budget `granted`.
    """
    if version != __version__:
        return UsageError(
            f"a worker runs plenocli {__version__}, this is {version}",
            fix="install one version everywhere",
        ), []
    import scipy.linalg.blas  # noqa: F401
    from threadpoolctl import threadpool_limits

    # both for good: other tasks may run beside this one
    threadpool_limits(1, "blas")
    set_budget(replace(granted, threads=1))
    with heard() as said:
        return attempt(function, task), said


def _tell(answer):
    """The result of `_remotely`; what the task said is said here."""
    result, said = answer
    for text in said:
        note(text)
    return result


class Here:
    """Tasks in this process, each when its result is asked for.

    far: whether tasks run where relative file names mean nothing.
    """

    far = False

    def __init__(self):
        self._waiting = deque()

    @property
    def room(self):
        """Whether another task may be handed in now."""
        return not self._waiting

    def submit(self, token, function, task):
        """Hand in a task."""
        self._waiting.append((token, function, task))

    def next(self):
        """(token, result or PlenoError) of a task."""
        token, function, task = self._waiting.popleft()
        return token, attempt(function, task)


class _Executing:
    """Tasks through an executor of concurrent.futures.

    Where a process dies, the tasks under way run again one at a time, so that the one that kills
    its worker is found: only that one is lost.
    """

    def __init__(self, start, limit, call=None, explain=None, far=False):
        self._start, self._limit, self._call, self._explain, self.far = (
            start,
            limit,
            call,
            explain,
            far,
        )
        self._executor, self._running, self._suspects, self._deaths = start(), {}, deque(), 0

    @property
    def room(self):
        """Whether another task may be handed in now."""
        return not self._suspects and not self._deaths and len(self._running) < self._limit()

    def submit(self, token, function, task):
        """Hand in a task."""
        call = (
            (self._call, function, task)
            if self._call
            else (_remotely, __version__, budget(), function, task)
        )
        try:
            self._running[self._executor.submit(*call)] = (token, function, task)
        except BrokenExecutor:  # a process died since we looked
            self._suspects.append((token, function, task))
            self._renew()

    def next(self):
        """(token, result or PlenoError) of a task that has ended."""
        while True:
            if not self._running:
                self.submit(*self._suspects.popleft())
            future = next(iter(wait(self._running, return_when=FIRST_COMPLETED).done))
            job = self._running.pop(future)
            try:
                answer = future.result()
            except BrokenExecutor:
                lost = self._restart(job)
                if lost is not None:
                    return lost
            except Exception as error:
                return job[0], self._explained(error)
            else:
                self._deaths = 0
                return job[0], answer if self._call else _tell(answer)

    def _explained(self, error):
        """The PlenoError that an error of the executor stands for; a fault of
        ours goes on as it is.
        """
        found = self._explain and self._explain(error)
        if not found:
            raise error
        return found

    def _restart(self, job):
        """New workers in place of those that died; (token, Lost) where `job` was alone with
        them, and not for the first time.
        """
        alone = not self._running
        self._suspects.appendleft(job)
        self._renew()
        self._deaths = self._deaths + 1 if alone else 0
        if self._deaths < ATTEMPTS:
            return None
        self._deaths = 0
        return self._suspects.popleft()[0], Lost(
            f"its process died {ATTEMPTS} times (was it killed, or out of memory?)",
            fix="take fewer --workers, or run again",
        )

    def _renew(self):
        """New workers; what the old ones had not finished is under suspicion."""
        broken = [
            future
            for future in self._running
            if not future.done() or future.exception() is not None
        ]
        self._suspects.extend(self._running.pop(future) for future in broken)
        _stop(self._executor, True)
        self._executor = self._start()

    def close(self):
        """Give up what is under way."""
        for future in self._running:
            future.cancel()
        executor, self._executor = self._executor, None
        _stop(executor, bool(self._running))


def _stop(executor, busy):
    """Let an executor go; what it still does is given up."""
    if isinstance(executor, ProcessPoolExecutor):
        for worker in list((executor._processes or {}).values()) if busy else ():
            worker.terminate()
        executor.shutdown(wait=True, cancel_futures=True)
    else:  # threads cannot be ended, they run out; a cluster forgets
        executor.shutdown(wait=False)


# --- processes ------------------------------------------------------------------------------------


def _processes(workers):
    import multiprocessing

    return ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_become_worker
    )


def _become_worker():
    """In a new process: the person's Ctrl-C is for the parent, and when that is gone, killed
    even, this one goes too.
    """
    from multiprocessing import connection, parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch():
        connection.wait([parent_process().sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _environment():
    """One thread of linear algebra for processes started meanwhile: it is read when their
    libraries are loaded.
    """
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


# --- a Dask cluster -------------------------------------------------------------------------------


@contextlib.contextmanager
def _cluster(scheduler):
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError(
            "--scheduler needs Dask, which is not installed", fix=how_to_install("cluster")
        ) from error
    file = not str(scheduler).startswith(("tcp://", "tls://", "ucx://"))
    if file and not Path(scheduler).is_file():
        raise UsageError(
            f"{str(scheduler)!r} is no address of a Dask scheduler and no file that one wrote",
            "--scheduler",
            "write for example tcp://10.0.0.1:8786",
        )
    try:
        client = Client(
            **({"scheduler_file": str(scheduler)} if file else {"address": scheduler}),
            timeout="10s",
            set_as_default=False,
        )
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(
            f"no Dask scheduler answers at {scheduler} ({type(error).__name__})",
            "--scheduler",
            "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None
    with client:
        if not client.nthreads():
            note(f"the scheduler at {scheduler} has no workers yet; waiting for the first")
            client.wait_for_workers(1)
        yield client


def _on_cluster(client):
    return _Executing(
        lambda: client.get_executor(pure=False),
        lambda: max(2, 2 * sum(client.nthreads().values())),
        explain=_trouble,
        far=True,
    )


def _trouble(error):
    """The PlenoError that stands for what a cluster reports; None for a fault of ours."""
    name, text = type(error).__name__, str(error)
    if name == "KilledWorker":
        return Lost(
            "the Dask workers that ran it died, one after the other",
            fix="see their logs (out of memory?), or run again",
        )
    if isinstance(error, ImportError) or "deserializ" in text.lower():
        return UsageError(
            f"a Dask worker cannot load the task ({text.splitlines()[0]})",
            "--scheduler",
            "install the same plenocli and its extras where the workers run",
        )
    if name in ("CancelledError", "FutureCancelledError", "CommClosedError"):
        return Lost(
            f"the connection to the Dask scheduler broke ({name})",
            fix="what is finished is kept: run again",
        )
    return None
