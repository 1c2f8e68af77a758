"""Where independent tasks run: in this process, in threads, in processes, or on a Dask cluster
that is there already.

A task is a function of one argument, found by its name in a module of plenocli (threads and this
process take any), that depends on nothing else: the same results come back wherever it runs, to
this process, which is the only one that writes. Whoever asks hands in tasks while there is room and
takes results as they come, in any order. Linear algebra runs in one thread everywhere, because the
last digits of its results depend on how many there are.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

from plenocli import __version__
from plenocli.base.budget import Budget, budget, one_thread, set_budget, within
from plenocli.base.errors import OutputError, PlenoError, UsageError
from plenocli.base.progress import collected_notes, note
from plenocli.base.text import how_to_install

Job = tuple[Any, Callable[[Any], Any], Any]
"""(token, function, task): the result of function(task) comes back with its token."""
ATTEMPTS = 2
"""Times that a task may take its process along before it is given up."""
PATIENCE = "10s"
"""How long a Dask scheduler may take to answer."""
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Lost(OutputError):
    """A task whose worker died with it, again and again: it has no result, and may
    have one another time.
    """


@contextlib.contextmanager
def open_pool(
    workers: int = 1, scheduler: str | None = None, *, threads: bool = False
) -> Iterator[Pool]:
    """A pool for tasks while the block lasts.

    workers: processes beside this one; 1 runs every task here.
    scheduler: address of a Dask scheduler, or the file that it wrote; then its workers serve,
        however many they are.
    threads: workers are threads of this process; those that find no task left work on parts of the
        last ones (plenocli.base.budget.spread).

    Raises UsageError where there is no such scheduler.
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
            yield InProcess()
    elif threads:
        with (
            _one_thread(),
            within(),
            contextlib.closing(_Threads(workers)) as pool,
        ):
            yield pool
    else:
        with (
            _one_thread(),
            _environment(_THREADS),
            contextlib.closing(
                _Executing(lambda: _processes(workers), lambda: 2 * workers)
            ) as pool,
        ):
            yield pool


def run_all(pool: Pool, jobs: Iterable[Job]) -> Iterator[tuple[Any, Any]]:
    """Run jobs, each handed in when there is room for it, so that few results wait.

    pool: where they run.
    jobs: (token, function, task).

    Yields (token, result or PlenoError) as they end.
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
def _one_thread() -> Iterator[None]:
    # SciPy has a library of its own, which the limit does not reach where it is loaded later
    with one_thread(), _environment(_THREADS[1:]):
        yield


def absolute(name: Any) -> Any:
    """A file name that means the same to a process elsewhere; None, and what is no file
    here, as they are.
    """
    return name if name is None or not os.path.exists(name) else type(name)(os.path.abspath(name))


def attempt(function: Callable[..., Any], *task: Any) -> Any:
    """What function(*task) returns, or the PlenoError that it raises."""
    try:
        return function(*task)
    except PlenoError as error:
        return error


def _remotely(
    version: str, granted: Budget, function: Callable[[Any], Any], task: Any
) -> tuple[Any, list[str]]:
    """(result or PlenoError, what it said) of a task in a process that runs nothing but tasks,
    within the Budget `granted`.
    """
    if version != __version__:
        return UsageError(
            f"a worker runs plenocli {__version__}, this is {version}",
            fix="install one version everywhere",
        ), []
    import scipy.linalg.blas  # noqa: F401

    # both for good: other tasks may run beside this one
    one_thread()
    set_budget(replace(granted, threads=1))
    with collected_notes() as said:
        return attempt(function, task), said


def _tell(answer: tuple[Any, list[str]]) -> Any:
    """The result of `_remotely`; what the task said is said here."""
    result, said = answer
    for text in said:
        note(text)
    return result


class Pool(Protocol):
    """Where tasks run.

    far: whether they run where relative file names mean nothing.
    """

    far: bool

    @property
    def room(self) -> bool:
        """Whether another task may be handed in now."""
        ...

    def submit(self, token: Any, function: Callable[[Any], Any], task: Any) -> None:
        """Hand in a task.

        token: what its result is told with.
        function: of one argument, found by its name in a module.
        task: the argument.
        """
        ...

    def next(self) -> tuple[Any, Any]:
        """(token, result or PlenoError) of a task that has ended."""
        ...


class InProcess:
    """A Pool of this process: each task runs when its result is asked for."""

    far = False

    def __init__(self) -> None:
        self._waiting: deque[Job] = deque()

    @property
    def room(self) -> bool:
        """Whether another task may be handed in now."""
        return not self._waiting

    def submit(self, token: Any, function: Callable[[Any], Any], task: Any) -> None:
        """Hand in a task."""
        self._waiting.append((token, function, task))

    def next(self) -> tuple[Any, Any]:
        """(token, result or PlenoError) of a task."""
        token, function, task = self._waiting.popleft()
        return token, attempt(function, task)


class _Executing:
    """A Pool of tasks through an executor of concurrent.futures.

    Where a process dies, the tasks under way run again one at a time, so that the one that kills
    its worker is found: only that one is lost.
    """

    def __init__(
        self,
        start: Callable[[], Executor],
        limit: Callable[[], int],
        call: Callable[..., Any] | None = None,
        explain: Callable[[Exception], PlenoError | None] | None = None,
        far: bool = False,
    ) -> None:
        """start: makes an executor, another one after a death.
        limit: how many tasks may be under way.
        call: what runs function(task) there; by default `_remotely`.
        explain: the PlenoError that an error of the executor stands for, None for a fault of ours.
        far: see Pool.
        """
        self._start, self._limit, self._call, self._explain = start, limit, call, explain
        self.far = far
        self._executor: Executor | None = start()
        self._running: dict[Future, Job] = {}
        self._suspects: deque[Job] = deque()
        self._deaths = 0

    @property
    def room(self) -> bool:
        """Whether another task may be handed in now."""
        return not self._suspects and not self._deaths and len(self._running) < self._limit()

    def submit(self, token: Any, function: Callable[[Any], Any], task: Any) -> None:
        """Hand in a task."""
        call = (
            (self._call, function, task)
            if self._call
            else (_remotely, __version__, budget(), function, task)
        )
        assert self._executor is not None, "the pool is closed"
        try:
            self._running[self._executor.submit(*call)] = (token, function, task)
        except BrokenExecutor:  # a process died since we looked
            self._suspects.append((token, function, task))
            self._renew()

    def next(self) -> tuple[Any, Any]:
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

    def _explained(self, error: Exception) -> PlenoError:
        """The PlenoError that an error of the executor stands for; a fault of
        ours goes on as it is.
        """
        found = self._explain and self._explain(error)
        if not found:
            raise error
        return found

    def _restart(self, job: Job) -> tuple[Any, Lost] | None:
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

    def _renew(self) -> None:
        """New workers; what the old ones had not finished is under suspicion."""
        broken = [
            future
            for future in self._running
            if not future.done() or future.exception() is not None
        ]
        self._suspects.extend(self._running.pop(future) for future in broken)
        _stop(self._executor, True)
        self._executor = self._start()

    def close(self) -> None:
        """Give up what is under way."""
        for future in self._running:
            future.cancel()
        executor, self._executor = self._executor, None
        _stop(executor, bool(self._running))


class _Threads(_Executing):
    """A Pool of threads. Whoever asks for a result while there are fewer tasks than threads has no
    more to hand in: then the budget has threads for parts of those that are left.
    """

    def __init__(self, workers: int) -> None:
        super().__init__(lambda: ThreadPoolExecutor(workers), lambda: workers + 1, attempt)
        self._workers, self._own = workers, budget().threads

    def submit(self, token: Any, function: Callable[[Any], Any], task: Any) -> None:
        """Hand in a task."""
        set_budget(replace(budget(), threads=self._own))
        super().submit(token, function, task)

    def next(self) -> tuple[Any, Any]:
        """(token, result or PlenoError) of a task that has ended."""
        each = self._workers // max(1, sum(not future.done() for future in self._running))
        set_budget(replace(budget(), threads=max(self._own, each)))
        return super().next()


def _stop(executor: Executor | None, busy: bool) -> None:
    """Let an executor go; what it still does is given up."""
    if isinstance(executor, ProcessPoolExecutor):
        for worker in list((executor._processes or {}).values()) if busy else ():
            worker.terminate()
        executor.shutdown(wait=True, cancel_futures=True)
    elif executor is not None:  # threads cannot be ended, they run out; a cluster forgets
        executor.shutdown(wait=False)


# --- processes ------------------------------------------------------------------------------------


def _processes(workers: int) -> ProcessPoolExecutor:
    import multiprocessing

    return ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_become_worker
    )


def _become_worker() -> None:
    """In a new process: the person's Ctrl-C is for the parent, and when that is gone, killed
    even, this one goes too.
    """
    from multiprocessing import connection, parent_process

    signal.signal(signal.SIGINT, signal.SIG_IGN)

    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _environment(names: Sequence[str]) -> Iterator[None]:
    """One thread of linear algebra for libraries, and processes, that are loaded meanwhile: these
    variables are read then.
    """
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})


# --- a Dask cluster -------------------------------------------------------------------------------


@contextlib.contextmanager
def _cluster(scheduler: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as error:
        raise UsageError(
            "--scheduler needs Dask, which is not installed", fix=how_to_install("cluster")
        ) from error
    # tracebacks of a broken connection, of which we say what to do
    for name in ("distributed", "distributed.client", "tornado.application", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    address, security = _address(scheduler)
    try:
        client = Client(address, timeout=PATIENCE, security=security, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise UsageError(
            f"no Dask scheduler answers at {scheduler} ({type(error).__name__})",
            "--scheduler",
            "start one with `dask scheduler`, and workers with `dask worker ADDRESS --nthreads 1`",
        ) from None
    try:
        with client:
            if not client.nthreads():
                note(f"the scheduler at {scheduler} has no workers yet; waiting for the first")
                client.wait_for_workers(1)
            yield client
    except Exception as error:
        of_dask = isinstance(error, OSError) and error.errno is None  # else of a file
        if not of_dask and type(error).__name__ not in _GONE:
            raise
        raise _broken(error) from None


_GONE = ("CancelledError", "FutureCancelledError", "CommClosedError", "ClosedClientError")
"""What Dask raises where its scheduler is gone."""


_TLS = {"ca": "tls_ca_file", "cert": "tls_client_cert", "key": "tls_client_key"}
"""Options of an address, by what Dask calls them."""
_TLS_FIX = "write for example tls://10.0.0.1:8786?ca=ca.pem,cert=cert.pem,key=key.pem"


def _address(scheduler: str) -> tuple[str, Any]:
    """(where a scheduler answers, Dask's Security): an address, or that in the file
    which the scheduler wrote, and after a question mark the files of TLS.
    """
    named, _, after = scheduler.partition("?")
    if os.path.exists(scheduler):
        named, after = scheduler, ""
    address = named
    with contextlib.suppress(OSError, ValueError, TypeError, LookupError):
        address = str(json.loads(Path(named).read_bytes())["address"])
    if not address.startswith(("tcp://", "tls://", "ucx://")):
        raise UsageError(
            f"{scheduler!r} is no address of a Dask scheduler and no whole file that one wrote",
            "--scheduler",
            "write for example tcp://10.0.0.1:8786",
        )
    options = dict(part.partition("=")[::2] for part in after.split(",") if after)
    missing = [name for name in options.values() if not os.path.isfile(name)]
    if options and not address.startswith("tls://") or options.keys() - _TLS.keys() or missing:
        raise UsageError(
            f"{scheduler!r} has options that are not the files of TLS"
            + (f" (there is no {missing[0]})" if missing else ""),
            "--scheduler",
            _TLS_FIX,
        )
    from distributed.security import Security

    # without options, what Dask's own configuration says
    security = Security(**{_TLS[name]: file for name, file in options.items()})
    try:
        has_context = security.get_connection_args("client").get("ssl_context")
    except (OSError, ValueError) as error:
        raise UsageError(
            f"the files of TLS cannot be used ({error})", "--scheduler", _TLS_FIX
        ) from None
    if address.startswith("tls://") and not has_context:
        raise UsageError(f"{scheduler!r} needs the files of TLS", "--scheduler", _TLS_FIX)
    return address, security


def _on_cluster(client: Any) -> _Executing:
    return _Executing(
        lambda: client.get_executor(pure=False),
        lambda: max(2, 2 * sum(client.nthreads().values())),
        explain=_trouble,
        far=True,
    )


def _trouble(error: Exception) -> PlenoError | None:
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
    if name in _GONE:
        return _broken(error)
    return None


def _broken(error: Exception) -> Lost:
    return Lost(
        f"the connection to the Dask scheduler broke ({type(error).__name__})",
        fix="what is finished is kept: run again",
    )
