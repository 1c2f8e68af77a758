"""Files that nobody can vouch for are decoded outside: functions run in a child process that is
held within limits and may neither write nor talk to anyone (`confinement`), and send back what they
made of a file. Whatever a file does to it, this process goes on with one message.

The child stays for the next file, so that a batch pays for one start; threads that decode at the
same time have one each. What comes back is JSON and numbers, never objects.
"""

from __future__ import annotations

import atexit
import contextlib
import fcntl
import importlib
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator
from io import BufferedReader
from typing import Any, NoReturn

import numpy as np

from plenocli.base.budget import Budget, budget, set_budget
from plenocli.base.errors import InputError, NumericsError, PlenoError
from plenocli.base.progress import note
from plenocli.files.confinement import confine, grant_seconds

TIMEOUT_S = 120.0
CPU_S = 90
_HEAD_BYTES = 256 << 20
_FIX = "make or copy it again"
_THREADED = ("OpenImageIO", "rawpy", "numba", "distributed")
"""Libraries that may have threads of their own, which a forked child would miss."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
"""Threads map memory."""


def outside(
    function: Callable[..., Any],
    path: str | os.PathLike,
    *arguments: Any,
    seconds: int | None = None,
) -> Any:
    """What function(path, *arguments), of a module's own, returns when the child runs it.

    path: the file that it decodes, given to it as an absolute name.
    arguments: numbers and text.
    seconds: of processor time; CPU_S.

    Returns numbers, text, arrays, and lists and dicts of them.
    Raises the PlenoError of the function, InputError where the file crashed the child or took it
    beyond its limits, MemoryError.
    """
    ask = _asked(function, path, arguments, seconds)
    child, answer = _first(ask, path)
    if answer.get("more"):
        child.end(0)
        raise InputError(_what_happened(0, ValueError()), path, _FIX)
    _rests(child, answer, function)
    return _value(answer, path, ask)


def outside_in_parts(
    function: Callable[..., Any],
    path: str | os.PathLike,
    *arguments: Any,
    seconds: int | None = None,
) -> Iterator[Any]:
    """As `outside`, of a function that yields: each part when it is asked for, so that neither
    process holds more than one or two of them.
    """
    ask = _asked(function, path, arguments, seconds)
    child, answer = _first(ask, path)
    while answer.get("more"):
        try:
            yield _value(answer, path, ask)
            answer = child.hear()
        except TimeoutError:
            raise _too_late(child, path) from None
        except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
            raise InputError(_what_happened(child.end(1), error), path, _FIX) from None
        except BaseException:  # nobody asks for the rest
            child.end(0)
            raise
    _rests(child, answer, function)
    _value(answer, path, ask)


def _asked(
    function: Callable[..., Any],
    path: str | os.PathLike,
    arguments: tuple[Any, ...],
    seconds: int | None,
) -> list[Any]:
    """What a child is told: seconds, module, function, name of the file, arguments."""
    name = os.fspath(path)
    with contextlib.suppress(FileNotFoundError):  # the working directory is gone
        name = os.path.abspath(name)
    told = [seconds or CPU_S, function.__module__, function.__qualname__, os.fsdecode(name)]
    return [*told, *arguments]


def _first(ask: list[Any], path: str | os.PathLike) -> tuple[_Child, dict[str, Any]]:
    """A child, and its first answer."""
    while True:
        try:
            child, is_new = _taken()
        except PlenoError as error:
            raise error.at(path) from error
        try:
            return child, child.ask(ask)
        except TimeoutError:
            raise _too_late(child, path) from None
        except (OSError, EOFError, ValueError, KeyError, TypeError) as error:
            code = child.end(1)
            # else a file before may have left it broken
            if is_new or code == -signal.SIGXCPU:
                raise InputError(_what_happened(code, error), path, _FIX) from None
        except BaseException:  # half of an answer may be on its way
            child.end(0)
            raise


def _rests(child: _Child, answer: dict[str, Any], function: Callable[..., Any]) -> None:
    """The child waits for the next file."""
    with _lock:
        _idle.append(child)
    if answer["missing"] and not function.__module__.startswith("plenocli.files.artefacts"):
        _say_once(" and no ".join(answer["missing"]))


def _too_late(child: _Child, path: str | os.PathLike) -> InputError:
    child.end(0)
    return InputError(f"was not decoded within {TIMEOUT_S:g} s", path, _FIX)


def _what_happened(code: int, error: BaseException) -> str:
    if isinstance(error, (OSError, EOFError)):
        if code < 0:
            return f"made its decoder crash or hit its limits (signal {-code})"
        return f"ended its decoder without an answer (code {code})"
    return f"came back garbled from its decoder ({type(error).__name__})"


def _value(answer: dict[str, Any], path: str | os.PathLike, ask: list[Any]) -> Any:
    """What a function returned, or raised; it knew the file by another name."""
    if "lack" in answer:
        raise MemoryError(answer["lack"])
    if "error" in answer:
        kind, what, fix = answer["error"]
        what = what.replace(ask[3], os.fsdecode(path))
        raise {"NumericsError": NumericsError}.get(kind, InputError)(what, path, fix)
    return answer["value"]


# --- this side ------------------------------------------------------------------------------------


class _Child:
    """A process that decodes.

    memory: bytes that it was granted.
    """

    def __init__(self) -> None:
        self.memory = budget().memory
        ours, theirs = _pair()
        self._socket, self._reader = ours, BufferedReader(ours.makefile("rb", 0), 1 << 16)
        with theirs:
            start = _forked if _may_fork() else _started
            self.pid = start(theirs, self.memory)

    def ask(self, what: list[Any]) -> dict[str, Any]:
        """The answer to [seconds, module, function, arguments ...].

        Raises OSError, EOFError, ValueError, KeyError or TypeError where it is none.
        """
        self._socket.settimeout(TIMEOUT_S)
        self._socket.sendall(json.dumps(what).encode() + b"\n")
        return self.hear()

    def hear(self) -> dict[str, Any]:
        """The next part of the answer; raises as `ask`."""
        line = self._reader.readline(_HEAD_BYTES)
        if not line:
            raise EOFError
        answer = dict(json.loads(line))
        missing = [str(m) for m in answer["missing"]]
        arrays = [self._array(*about) for about in answer["arrays"]]
        return answer | {"missing": missing, "value": _unpacked(answer["value"], arrays)}

    def _array(self, kind: str, shape: list[int]) -> np.ndarray:
        of = np.dtype(kind)
        if of.hasobject or math.prod(map(int, shape)) * of.itemsize > self.memory:
            raise ValueError("no numbers, or too many")
        array = np.empty([int(n) for n in shape], of)
        view = array.reshape(-1).view(np.uint8).data
        while view:
            count = self._reader.readinto(view)
            if not count:
                raise EOFError
            view = view[count:]
        return array

    def end(self, patience: float) -> int:
        """Its exit code, or minus the signal that ended it, after so many s at most; then it
        is killed.
        """
        self._reader.close()
        self._socket.close()
        handle = os.pidfd_open(self.pid) if hasattr(os, "pidfd_open") else None
        if handle is not None:
            if not select.select([handle], [], [], patience)[0]:
                os.kill(self.pid, signal.SIGKILL)
            os.close(handle)
        else:
            time.sleep(patience)
            os.kill(self.pid, signal.SIGKILL)
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def _pair() -> list[socket.socket]:
    """Two connected sockets away from the standard streams, which may be closed."""
    low = socket.socketpair()
    pair = [socket.socket(fileno=fcntl.fcntl(s.fileno(), fcntl.F_DUPFD_CLOEXEC, 3)) for s in low]
    for end in low:
        end.close()
    return pair


_idle: list[_Child] = []
"""Children that wait for a file, the one used last at the end."""
_lock = threading.Lock()
_said: set[str] = set()


def _taken() -> tuple[_Child, bool]:
    """A child within this process's budget, and whether it is new."""
    with _lock:
        while _idle:
            child = _idle.pop()
            if child.memory == budget().memory:
                return child, False
            child.end(0)
    try:
        return _Child(), True
    except OSError as error:
        raise InputError(
            f"cannot be read: no process could be started to decode it ({error.strerror})",
            fix="close other programs, and try again",
        ) from error


@atexit.register
def close() -> None:
    """End the children that wait; only then does the system count what they cost."""
    with _lock:
        while _idle:
            _idle.pop().end(1)


def _forget() -> None:
    """In a forked process: the children are the parent's."""
    global _lock
    _lock = threading.Lock()
    _idle.clear()


os.register_at_fork(after_in_child=_forget)


def _say_once(missing: str) -> None:
    if missing not in _said:
        _said.add(missing)
        note(
            f"this system has no {missing}: what decodes files is held by limits of memory, time "
            "and file size only"
        )


def _may_fork() -> bool:
    """Whether a copy of this process would lack no thread that it needs."""
    if sys.platform != "linux" or threading.active_count() > 1:
        return False
    # OpenBLAS, which numpy loads, knows how to go on in a copy
    return len(os.listdir("/proc/self/task")) == 1 or not any(n in sys.modules for n in _THREADED)


def _forked(theirs: socket.socket, memory: int) -> int:
    """Process id of a copy of this process that serves: nothing is started and imported anew."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # OpenBLAS's threads are not ours
        pid = os.fork()
    if pid:
        os.close(nowhere)
        return pid
    try:
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            if descriptor > 2 and descriptor != theirs.fileno():
                with contextlib.suppress(OSError):
                    os.close(descriptor)
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _serve(theirs, memory)
    finally:
        os._exit(70)


def _started(theirs: socket.socket, memory: int) -> int:
    """Process id of a new Python that serves."""
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; from plenocli.files import outside; "
        f"outside.main({theirs.fileno()}, {memory})"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=[theirs.fileno()],
        env=os.environ | _ONE_THREAD,
    )
    process.returncode = 0  # `end` waits for it
    return process.pid


# --- the other side -------------------------------------------------------------------------------


def main(descriptor: int, memory: int) -> None:
    """Serve on an open socket."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _serve(socket.socket(fileno=descriptor), memory)


def _serve(channel: socket.socket, memory: int) -> NoReturn:
    """Answer until the other end is closed."""
    os.environ.update(_ONE_THREAD)
    set_budget(Budget(memory))
    missing = confine(memory)
    for line in channel.makefile("rb"):
        seconds, module, name, *arguments = json.loads(line)
        grant_seconds(seconds)
        arrays: list[np.ndarray] = []
        try:
            found = getattr(importlib.import_module(module), name)(*arguments)
            if isinstance(found, Generator):
                for part in found:
                    of_part: list[np.ndarray] = []
                    value = _packed(part, of_part)
                    _send(channel, {"missing": missing, "more": True, "value": value}, of_part)
                found = None
            answer = {"value": _packed(found, arrays)}
        except PlenoError as error:
            answer = {"error": [type(error).__name__, error.what, error.fix]}
        except MemoryError as error:
            answer = {"lack": str(error)}
        except Exception as error:  # whatever a library says of a file that it cannot read
            what = f"cannot be decoded ({type(error).__name__}: {error})"
            answer = {"error": ["InputError", what, _FIX]}
        if "value" not in answer:
            arrays.clear()
        _send(channel, {"missing": missing, "value": None} | answer, arrays)
    os._exit(0)


def _send(channel: socket.socket, answer: dict[str, Any], arrays: list[np.ndarray]) -> None:
    answer = answer | {"arrays": [[array.dtype.str, array.shape] for array in arrays]}
    channel.sendall(json.dumps(answer).encode() + b"\n")
    for array in arrays:
        channel.sendall(array.reshape(-1).view(np.uint8).data)


def _packed(value: Any, arrays: list[np.ndarray]) -> Any:
    """A value as JSON, its arrays put aside."""
    if isinstance(value, np.ndarray):
        arrays.append(np.ascontiguousarray(value))
        return {"array": len(arrays) - 1, "shape": value.shape}
    if isinstance(value, dict):
        return {"dict": [[k, _packed(v, arrays)] for k, v in value.items()]}
    if isinstance(value, (list, tuple)):
        return [_packed(v, arrays) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def _unpacked(value: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(value, list):
        return [_unpacked(v, arrays) for v in value]
    if not isinstance(value, dict):
        return value
    if "dict" in value:
        return {str(key): _unpacked(v, arrays) for key, v in value["dict"]}
    return arrays[value["array"]].reshape(value["shape"])
