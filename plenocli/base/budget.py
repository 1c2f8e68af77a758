"""How much memory, and how many threads, this process may use: one object, asked by whoever is
about to take some; and work on several threads.

The command line sets it from --mem-limit; tasks in other processes get that of the process that
hands them out.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import copy_context
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.memory import size_text

if TYPE_CHECKING:
    from concurrent.futures import Future

    from threadpoolctl import ThreadpoolController

T = TypeVar("T")
U = TypeVar("U")

EXPANSION = 1 << 15
"""Times its own size that a whole file can declare: deflate packs 1032 bytes into one, and a pixel
of one bit is read as three bytes of colour.
"""


@dataclass(frozen=True)
class Budget:
    """What this process may use.

    memory: bytes for data, beside what interpreter and libraries take.
    threads: that work at the same time.
    """

    memory: int
    threads: int = 1

    def require(
        self,
        needed: float,
        what: str,
        where: object = None,
        fewer: str = "take less of it",
    ) -> None:
        """NumericsError, before a long computation, where it needs more memory than there is.

        needed: bytes.
        what: the computation in words, the subject of "needs".
        where: the file or option that the message names.
        fewer: what to do beside raising the limit.
        """
        if needed > self.memory:
            raise NumericsError(
                f"{what} needs about {size_text(needed)}, more than the limit of "
                f"{size_text(self.memory)}",
                where,
                f"{fewer}, or raise --mem-limit to {size_text(1.05 * needed)}",
            )

    def require_reading(self, path: str | os.PathLike, needed: float, why: str = "") -> None:
        """NumericsError where reading the file at `path` takes more than there is.

        needed: bytes.
        why: of that, for the message.
        """
        if needed > self.memory:
            raise NumericsError(
                f"needs about {size_text(needed)} to be read, more than the limit of "
                f"{size_text(self.memory)}{why}",
                path,
                f"raise --mem-limit to {size_text(1.05 * needed)}",
            )

    def require_declared(
        self,
        path: str | os.PathLike,
        declared: int,
        needed: float,
        part: str = "",
        *,
        why: str = "",
    ) -> None:
        """Refuse a file before its values are read, where they do not fit.

        declared: bytes of values that its header declares.
        needed: bytes that reading them takes.
        part: up to where in the file, for the message.
        why: reading takes so much, likewise.

        Raises NumericsError where memory is all that is missing, InputError where the file is far
        too small for what it declares.
        """
        if needed <= self.memory:
            return
        if declared > EXPANSION * Path(path).stat().st_size:
            raise InputError(
                f"declares {size_text(declared)} of data{part} in a file of "
                f"{size_text(Path(path).stat().st_size)}, above the memory limit of "
                f"{size_text(self.memory)}",
                path,
                "make or copy it again; it is damaged, or made to fill the memory",
            )
        self.require_reading(path, needed, why)


def machine_budget() -> Budget:
    """Half of the machine's memory, and one thread."""
    return Budget(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2)


_current: Budget | None = None


def budget() -> Budget:
    """The Budget of this process; machine_budget() until somebody sets another."""
    return machine_budget() if _current is None else _current


def set_budget(new: Budget) -> None:
    """From now on `new` holds for this process, in all its threads."""
    global _current
    _current = new


@contextlib.contextmanager
def within(new: Budget | None = None) -> Iterator[None]:
    """`new` holds until the block ends, and so does whatever is set meanwhile."""
    global _current
    before = _current
    if new is not None:
        set_budget(new)
    try:
        yield
    finally:
        _current = before


def on_threads(count: int) -> contextlib.AbstractContextManager[None]:
    """A context in which the budget has `count` threads."""
    return within(replace(budget(), threads=count))


def one_thread() -> contextlib.AbstractContextManager:
    """A context in which products and decompositions of matrices stay on the thread that asks for
    them: idle threads that wait for the next product cost many times its processor time. It holds
    from where it is asked for.
    """
    return linear_algebra().limit(limits=1, user_api="blas")


def linear_algebra() -> ThreadpoolController:
    """The libraries of linear algebra that are loaded. They are looked for again where a module
    has been imported since, which is how they come: to look takes milliseconds, and a sweep of
    small cameras asks hundreds of times a second.
    """
    return _libraries(len(sys.modules))


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


def spread(parts: Sequence[tuple], work: Callable[..., object]) -> None:
    """work(*part) for all parts, on as many threads as the budget has."""
    threads = budget().threads
    with one_thread():
        if threads <= 1 or len(parts) < 2:
            for part in parts:
                work(*part)
            return
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(threads) as pool:
            # each in what is set where it is asked for: whoever collects notes gets theirs
            for done in [pool.submit(copy_context().run, work, *part) for part in parts]:
                done.result()


def spread_in_turn(
    groups: Sequence[tuple[Sequence[tuple], Callable[[], object]]], work: Callable[..., object]
) -> None:
    """For each group (parts, end) work(*part) for all parts, and then end(), on as many threads as
    the budget has: who finds no part left in a group goes on with the next one while it ends. No
    more groups are worked on at a time than there are threads.
    """
    if budget().threads <= 1:
        for parts, end in groups:
            spread(parts, work)
            spread([()], end)
        return
    from concurrent.futures import ThreadPoolExecutor, wait

    def end_after(coming: list[Future], end: Callable[[], object]) -> None:
        wait(coming)  # all of them are begun: threads take them in order
        for part in coming:
            part.result()
        end()

    with one_thread(), ThreadPoolExecutor(budget().threads) as pool:
        ends = []
        for parts, end in groups:
            coming = [pool.submit(copy_context().run, work, *part) for part in parts]
            ends.append(pool.submit(copy_context().run, end_after, coming, end))
        for done in ends:
            done.result()


def both(one: Callable[[], T], other: Callable[[], U]) -> tuple[T, U]:
    """What two functions give, at the same time where the budget has threads."""
    found: dict[int, Any] = {}

    def make(number: int, work: Callable[[], Any]) -> None:
        found[number] = work()

    spread([(0, one), (1, other)], make)
    return found[0], found[1]


def ahead(items: Iterable[T]) -> Iterator[T]:
    """The same items; each is made while the one before is used, where the budget has threads."""
    if budget().threads <= 1:
        yield from items
        return
    from concurrent.futures import ThreadPoolExecutor

    coming = iter(items)
    with ThreadPoolExecutor(1) as pool:

        def begun() -> Future[list[T]]:
            return pool.submit(copy_context().run, lambda: list(islice(coming, 1)))

        item = begun()
        while found := item.result():
            item = begun()
            yield found[0]
