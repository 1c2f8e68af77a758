"""Reads one JSON request a line, runs `plenocli` in a forked child, answers with one JSON line.

See harness.py. Modules that the command line names are imported before, once; what is not named, a
command that needs it imports by itself.

A fault is {"call": name of a function of os, "nth": which call fails first, "error": errno name,
"False" for what it returns or "KILL", "lasting": whether all later calls fail too, "of": another
module that holds the function}; {"call": "bytes", "nth": room on the disk}; {"call": "filesize",
"nth": bytes a file may have}; {"call": "memory", "nth": bytes of memory beyond what is in use};
{"call": "array"}, the nth numpy array gets no memory; {"call": "short"}, writes that take only a
part; {"call": "without", "module": name}, a module that is not installed. With {"places": True} the
notes also say where messages are made, as file:line words.
"""

import errno
import fcntl
import importlib
import json
import mmap
import os
import pkgutil
import resource
import select
import signal
import sys
import time

WRITERS = ("write", "pwrite", "writev", "pwritev")


def main():
    """Serve until stdin ends."""
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    _import_everything(sys.argv[1:])
    channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        channel.write(json.dumps(_serve(json.loads(line))) + "\n")
        channel.flush()


def _import_everything(names):
    import plenocli

    for name in names:
        importlib.import_module(name)

    for module in pkgutil.walk_packages(plenocli.__path__, "plenocli."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    import h5py  # noqa: F401


def _serve(request):
    # a pipe takes the messages: a limit of file sizes does not hold for it
    (heard, said), fired = os.pipe(), _Notes()
    fcntl.fcntl(said, fcntl.F_SETPIPE_SZ, 1 << 20)
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    child = os.fork()
    if child == 0:
        _child(request, said, fired)
    os.setpgid(child, child)
    handle = os.pidfd_open(child)
    limit = request["kill_after"] if request["kill_after"] is not None else request["limit"]
    ended = bool(select.select([handle], [], [], limit)[0])
    if not ended:
        os.killpg(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    answer = {
        "code": os.waitstatus_to_exitcode(status),
        "text": _drain(heard, said).decode("utf-8", "replace"),
        "seconds": time.perf_counter() - start,
        "cpu": usage.ru_utime + usage.ru_stime,
        "grown": max(0, usage.ru_maxrss - before) * 1024,
        "hung": not ended and request["kill_after"] is None,
    }
    os.close(handle)
    notes = fired.text()
    return answer | {"fired": bool(notes), "notes": notes}


class _Notes:
    """What the command and its own children write down, in memory that all of them share: a child
    that decodes files closes what it inherits and may not write.
    """

    def __init__(self):
        self._memory = mmap.mmap(-1, 1 << 20)

    def add(self, text):
        """Append; what has no room is lost."""
        at, data = self._number(0), text.encode()
        if 16 + at + len(data) <= len(self._memory):
            self._memory[16 + at : 16 + at + len(data)] = data
            self._memory[0:8] = (at + len(data)).to_bytes(8, "little")

    def count(self):
        """How often this was called, by any of them."""
        number = self._number(8) + 1
        self._memory[8:16] = number.to_bytes(8, "little")
        return number

    def text(self):
        """All that was added; closes it."""
        text = self._memory[16 : 16 + self._number(0)].decode()
        self._memory.close()
        return text

    def _number(self, at):
        return int.from_bytes(self._memory[at : at + 8], "little")


def _drain(reader, writer):
    """What is in a pipe; closes it."""
    os.set_blocking(reader, False)
    os.close(writer)
    parts = []
    try:
        while part := os.read(reader, 1 << 20):
            parts.append(part)
    except BlockingIOError:  # a grandchild still holds the other end
        pass
    os.close(reader)
    return b"".join(parts)


def _child(request, said, fired):
    code = 99
    try:
        os.chdir(request["cwd"])
        os.dup2(said, 1)
        os.dup2(said, 2)
        os.environ.update(request["environment"])
        if request["fault"]:
            _arm(request["fault"], fired)
        import warnings

        warnings.simplefilter("error", RuntimeWarning)
        from plenocli.cli.main import run

        code = run(request["arguments"])
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def _arm(fault, fired):
    """Make the nth call of a function fail, before the command starts."""
    if fault.get("places"):
        from tests.messages import listen

        listen(lambda place: fired.add(f"{place} "))
    if "call" not in fault:
        return None
    number = getattr(errno, fault.get("error", "ENOSPC"), None)
    if fault["call"] == "without":
        within = [m for m in sys.modules if m.startswith(fault["module"] + ".")]
        return sys.modules.update(dict.fromkeys([fault["module"], *within]))
    if fault["call"] == "bytes":
        return _arm_bytes(fault["nth"], number, fired)
    if fault["call"] == "filesize":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (fault["nth"], resource.RLIM_INFINITY))
        return fired.add("x ")
    if fault["call"] == "memory":
        with open("/proc/self/status") as table:
            used = next(int(line.split()[1]) << 10 for line in table if line.startswith("VmData"))
        # not of the address space: that would take the stack too, without which nothing
        # can be told to anyone
        return resource.setrlimit(
            resource.RLIMIT_DATA, (used + fault["nth"], resource.RLIM_INFINITY)
        )
    if fault["call"] == "array":
        return _arm_arrays(fault["nth"], fault.get("lasting"), fired)
    if fault["call"] == "short":
        return _arm_short(fired)
    home = importlib.import_module(fault.get("of", "os"))
    real, seen = getattr(home, fault["call"]), 0

    def failing(*arguments, **named):
        nonlocal seen
        if fault["call"] in WRITERS and _is_console(arguments[0]):
            return real(*arguments, **named)
        seen += 1
        if seen == fault["nth"] or (fault.get("lasting") and seen > fault["nth"]):
            fired.add("x ")
            if fault["error"] == "KILL":
                os.kill(os.getpid(), signal.SIGKILL)
            if number is None:
                return False
            raise OSError(number, os.strerror(number))
        return real(*arguments, **named)

    setattr(home, fault["call"], failing)


def _is_console(descriptor):
    return descriptor in (1, 2)


def _arm_bytes(room, number, fired):
    """A disk with room for so many bytes: short writes up to the last byte, then the error."""
    left = room
    for name in ("write", "pwrite"):
        real = getattr(os, name)

        def full(descriptor, view, *rest, real=real):
            nonlocal left
            if _is_console(descriptor):
                return real(descriptor, view, *rest)
            if left <= 0 and len(view):
                fired.add("x ")
                raise OSError(number, os.strerror(number))
            written = real(descriptor, memoryview(view).cast("B")[:left], *rest)
            left -= written
            return written

        setattr(os, name, full)


def _arm_arrays(nth, lasting, fired):
    """numpy's memory comes from functions of ours; the nth piece, here or in a child that
    decodes, and perhaps all that follow, is refused.
    """
    import ctypes

    import numpy

    size, address = ctypes.c_size_t, ctypes.c_void_p
    libc = ctypes.CDLL(None)
    for name in ("malloc", "calloc", "realloc"):
        getattr(libc, name).restype = address

    def granted():
        seen = fired.count()
        refused = seen == nth or (lasting and seen > nth)
        if seen == nth:
            fired.add("x ")
        return not refused

    kinds = {
        "malloc": (address, size),
        "calloc": (address, size, size),
        "realloc": (address, address, size),
        "free": (address, address, size),
    }
    calls = {
        "malloc": lambda _, count: libc.malloc(size(count)) if granted() else None,
        "calloc": lambda _, many, each: libc.calloc(size(many), size(each)) if granted() else None,
        "realloc": lambda _, old, count: (
            libc.realloc(address(old), size(count)) if granted() else None
        ),
    }

    types = {
        name: ctypes.CFUNCTYPE(None if name == "free" else address, *arguments)
        for name, arguments in kinds.items()
    }

    class Handler(ctypes.Structure):
        _fields_ = [
            ("name", ctypes.c_char * 127),
            ("version", ctypes.c_uint8),
            ("context", address),
            *types.items(),
        ]

    made = {name: types[name](call) for name, call in calls.items()}
    # nothing is given back: arrays are freed while numpy's exception stands, which a function
    # in Python would lose
    handler = Handler(b"faulty", 1, None, **made, free=ctypes.cast(libc.getpid, types["free"]))
    python = ctypes.pythonapi
    python.PyCapsule_New.restype, python.PyCapsule_New.argtypes = (
        ctypes.py_object,
        [address, ctypes.c_char_p, address],
    )
    python.PyCapsule_GetPointer.restype, python.PyCapsule_GetPointer.argtypes = (
        address,
        [ctypes.py_object, ctypes.c_char_p],
    )
    table = ctypes.cast(
        python.PyCapsule_GetPointer(numpy._core._multiarray_umath._ARRAY_API, None),
        ctypes.POINTER(address),
    )
    capsule = python.PyCapsule_New(ctypes.addressof(handler), b"mem_handler", None)
    # PyDataMem_SetHandler
    ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object)(table[304])(capsule)
    _kept.append((handler, capsule))


_kept = []
"""What must live as long as the process."""


def _arm_short(fired):
    """Every write takes 1 to 7000 bytes only."""
    for name in ("write", "pwrite"):
        real, count = getattr(os, name), [0]

        def short(descriptor, view, *rest, real=real, count=count):
            count[0] += 1
            if _is_console(descriptor):
                return real(descriptor, view, *rest)
            fired.add("x ")
            return real(descriptor, memoryview(view).cast("B")[: 1 + count[0] * 997 % 7000], *rest)

        setattr(os, name, short)


if __name__ == "__main__":
    main()
