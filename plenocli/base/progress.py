"""Progress on stderr, only where a person watches, and notes that are always worth a line."""

from __future__ import annotations

import contextlib
import contextvars
import os
import re
import sys
from collections.abc import Iterable, Iterator
from typing import Any

from plenocli.base.errors import OutputError
from plenocli.base.text import printable_lines

quiet = False
"""Whether the person asked for silence: no bars, no notes."""
_COLLECTED: contextvars.ContextVar[list[str] | None] = contextvars.ContextVar(
    "collected", default=None
)


@contextlib.contextmanager
def hushed(silent: bool) -> Iterator[None]:
    """Whether there are no bars and no notes, until the block ends."""
    global quiet
    before, quiet = quiet, silent
    try:
        yield
    finally:
        quiet = before


def bar(iterable: Iterable | None, total: int | None = None, label: str = "") -> Any:
    """Wrap an iterable so that a terminal shows how far it is and how long it will take.

    iterable: what is gone through; None where `update` counts.
    total: steps.
    label: what they are.

    Returns an iterable and context manager with `n` and `update`; it is silent off a terminal, for
    a single step, and while notes are collected.
    """
    shown = sys.stderr is not None and sys.stderr.isatty()
    if quiet or total == 1 or not shown or _COLLECTED.get() is not None:
        return _Silent(iterable)
    from tqdm import tqdm

    tqdm.monitor_interval = 0  # no thread that watches the bar
    return tqdm(iterable, total=total, desc=label, file=sys.stderr, leave=False)


class _Silent:
    """A bar that nobody sees, without the lock between processes that tqdm makes and a worker
    that is ended would leave behind.
    """

    def __init__(self, iterable: Iterable | None) -> None:
        self.n, self._iterable = 0, iterable

    def __iter__(self) -> Iterator:
        return iter(() if self._iterable is None else self._iterable)

    def __enter__(self) -> _Silent:
        return self

    def __exit__(self, *_: object) -> None:
        return None

    def update(self, count: int = 1) -> None:
        """Count on."""
        self.n += count


def note(text: str) -> None:
    """One line for the person who started the command: expectations, warnings, choices made."""
    collected = _COLLECTED.get()
    if collected is not None:
        collected.append(text)
    elif not quiet and not (_told and _is_repeat(text)):
        tell(f"plenocli: {text}", error=True)


_told: list[dict[str, list[str]]] = []
"""Of each block of repeats_counted that lasts, the notes of one kind each."""


def _is_repeat(text: str) -> bool:
    """Count a note; whether one of its kind was told."""
    kind = re.sub(r"\S*[\d./]\S*", "#", text)
    alike = _told[-1].setdefault(kind, [])
    alike.append(text)
    return len(alike) > 1


@contextlib.contextmanager
def repeats_counted() -> Iterator[None]:
    """While the block lasts, notes that differ from an earlier one in numbers and names alone are
    counted instead of told; how many there were is told at its end.
    """
    _told.append({})
    try:
        yield
    finally:
        for alike in _told.pop().values():
            if len(alike) > 1:
                note(f"{len(alike)} times in all, with other names and numbers: {alike[0]}")


def tell(text: str, *, error: bool = False) -> None:
    """Write lines to standard output or, for `error`, to stderr: text only, what would control a
    terminal is escaped.

    Nothing that was computed is lost by nobody reading: a reader that went away and a stderr that
    takes nothing are no failure.

    Raises OutputError where standard output cannot be written.
    """
    stream = sys.stderr if error else sys.stdout
    if stream is None:  # closed before we started
        return
    try:
        print(printable_lines(text), file=stream, flush=True)
    except OSError as failure:
        # what is left in its buffer would fail again when the process ends
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if not error and not isinstance(failure, BrokenPipeError):
            raise OutputError(
                f"cannot be written ({failure.strerror})",
                "standard output",
                "files that were to be written are whole",
            ) from None


@contextlib.contextmanager
def collected_notes() -> Iterator[list[str]]:
    """Yield a list that takes the notes of this thread while the block lasts, instead of stderr."""
    collected: list[str] = []
    token = _COLLECTED.set(collected)
    try:
        yield collected
    finally:
        _COLLECTED.reset(token)
