"""Progress on stderr, only where a person watches, and notes that are always worth a line."""

import contextlib
import contextvars
import sys

quiet = False
"""Whether the person asked for silence: no bars, no notes."""
_EAR = contextvars.ContextVar("ear", default=None)


def bar(iterable, total=None, label=""):
    """Wrap `iterable` so that a terminal shows how far it is and how long it will take; silent
    elsewhere, for a single step, and while `heard` listens.
    """
    if quiet or total == 1 or _EAR.get() is not None:
        return _Silent(iterable)
    from tqdm import tqdm

    tqdm.monitor_interval = 0  # no thread that watches the bar
    return tqdm(iterable, total=total, desc=label, file=sys.stderr, disable=None, leave=False)


class _Silent:
    """A bar that nobody sees, without the lock between processes that tqdm makes and a worker
    that is ended would leave behind.
    """

    def __init__(self, iterable):
        self.n, self._iterable = 0, iterable

    def __iter__(self):
        return iter(self._iterable)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def update(self, count=1):
        """Count on."""
        self.n += count


def note(text):
    """One line for the person who started the command: expectations, warnings, choices made."""
    ear = _EAR.get()
    if ear is not None:
        ear.append(text)
    elif not quiet:
        print(f"plenocli: {text}", file=sys.stderr)


@contextlib.contextmanager
def heard():
    """Yield a list that takes the notes of this thread while the block lasts, instead of stderr."""
    ear = []
    token = _EAR.set(ear)
    try:
        yield ear
    finally:
        _EAR.reset(token)
