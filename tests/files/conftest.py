"""Calls of the system that fail on request."""

import errno
import os

import pytest

from plenocli.base.errors import OutputError
from plenocli.files import atomic


@pytest.fixture
def each_failure(monkeypatch):
    """each_failure(call, action): runs action with the first, second, ... call of os.<call> out of
    space, until none is left to fail.

    Yields whether it came through; else OutputError must have given the reason. The first time it
    may not, the last time it must.
    """

    def run(call, action):
        real, outcomes, count, nth = getattr(os, call), [], 1, 0

        def failing(*args, **kwargs):
            nonlocal count
            count += 1
            if count == nth:
                raise OSError(errno.ENOSPC, "No space left on device")
            return real(*args, **kwargs)

        while count >= nth:
            nth, count = nth + 1, 0
            monkeypatch.setattr(atomic.os, call, failing)
            try:
                action()
                outcomes.append(True)
            except OutputError as error:
                outcomes.append(False)
                assert "No space left" in str(error)
            finally:
                monkeypatch.undo()
            yield outcomes[-1]
        assert outcomes[-1] and not outcomes[0]

    return run
