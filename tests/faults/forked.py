"""Processes to be killed by the thousand: a warm Python that has plenocli and Dask imported forks
one for each request, in a process group of choice, so that a kill costs no start of Python.

As a program (`forked.py SOCKET`) it serves; `Forks` is the tests' side; SHIM stands in for
`plenocli` in the recipes of a real `make`.
"""

import asyncio
import contextlib
import ctypes
import importlib
import json
import os
import pkgutil
import select
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

ROOT = str(Path(__file__).resolve().parents[2])
SHIM = """#!{python} -SI
import json, os, socket, sys
s = socket.socket(socket.AF_UNIX); s.connect({address!r})
s.sendall(json.dumps(["plenocli", sys.argv[1:], os.getcwd(), os.getpgrp()]).encode() + b"\\n")
said = s.makefile("rb").read().split()
sys.exit(int(said[1]) if len(said) > 1 else 99)
"""


class Forked:
    """A process that was forked; it leads a process group of its own."""

    def __init__(self, connection):
        self._connection, self._said = connection, connection.makefile("rb")
        self.pid = int(self._said.readline())
        self._line = None  # its exit code, once it has ended; empty where it was killed

    def ended(self, seconds=0.0):
        """Whether it ends within so many s."""
        if self._line is None and select.select([self._connection], [], [], seconds)[0]:
            self._line = self._said.readline()
            self._said.close()
            self._connection.close()
        return self._line is not None

    def kill(self):
        """Kill it and all of its group; returns when they are gone."""
        _kill_group(self.pid)
        self.code(60)

    def code(self, seconds):
        """Its exit code, or None where it was killed; TimeoutError if it goes on for longer."""
        if not self.ended(seconds):
            raise TimeoutError
        return int(self._line) if self._line else None


class Started:
    """The same of a real program, from the start of its Python."""

    def __init__(self, command, cwd, log):
        with open(log, "ab") as file:
            self._process = subprocess.Popen(
                command,
                cwd=cwd,
                env=os.environ | {"PYTHONPATH": ROOT, "OMP_NUM_THREADS": "1"},
                stdout=file,
                stderr=file,
                process_group=0,
            )

    def ended(self, seconds=0.0):
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(seconds)
        return self._process.poll() is not None

    def kill(self):
        _kill_group(self._process.pid)
        self._process.wait()
        _kill_group(self._process.pid)  # whom it had started just then

    def code(self, seconds):
        code = self._process.wait(seconds)
        return None if code == -signal.SIGKILL else code


class Programs:
    """`start`s real programs in place of forks."""

    def __init__(self, folder):
        self.folder = folder

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def start(self, what, arguments, cwd):
        words = {
            "plenocli": ["-m", "plenocli"],
            "scheduler": "-m dask scheduler --host 127.0.0.1 --port 0 --no-dashboard".split(),
            "worker": "-m dask worker --nthreads 1 --no-nanny --no-dashboard".split(),
        }[what]
        words += [] if what == "plenocli" else ["--scheduler-file"]
        command = [sys.executable, *words, *map(str, arguments)]
        return Started(command, cwd, self.folder / f"{what}.log")


class Forks:
    """`start` processes; use as a context manager. What each kind says goes to KIND.log."""

    def __init__(self, folder):
        self.folder, self.address = folder, folder / "s"
        environment = os.environ | {"PYTHONPATH": ROOT, "OMP_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, __file__, str(self.address)], env=environment, cwd=folder
        )

    def __enter__(self):
        deadline = time.monotonic() + 300
        while not self.address.exists():
            assert self._server.poll() is None and time.monotonic() < deadline
            time.sleep(0.05)
        return self

    def __exit__(self, *_):
        self._server.kill()
        self._server.wait()

    def start(self, what, arguments, cwd):
        """Fork one: 'plenocli' with its arguments, or 'scheduler' or 'worker' of Dask with the file
        of the scheduler.
        """
        connection = socket.socket(socket.AF_UNIX)
        connection.connect(str(self.address))
        request = [what, [str(a) for a in arguments], str(cwd), 0]
        connection.sendall(json.dumps(request).encode() + b"\n")
        return Forked(connection)

    def shim(self, folder):
        """Put a `plenocli` into a folder that asks here, and stays in the group of who calls it."""
        path = folder / "plenocli"
        path.write_text(SHIM.format(python=sys.executable, address=str(self.address)))
        path.chmod(0o755)

    def make(self, arguments, cwd, bin):
        """A real make, which leads a group of its own."""
        path = f"PATH={bin}:{os.environ['PATH']}"
        return Started(["env", path, "make", *arguments], cwd, self.folder / "make.log")


def _kill_group(group):
    """Until nobody is left who could join it."""
    with contextlib.suppress(ProcessLookupError, PermissionError):
        for _ in range(3):
            os.killpg(group, signal.SIGKILL)
            time.sleep(0.002)


# --- the server -----------------------------------------------------------------------------------


def main(address):
    """Serve until killed, or the parent is gone."""
    os.nice(10)  # hundreds of short processes leave the machine to others
    import distributed
    import h5py  # noqa: F401

    import plenocli

    for module in pkgutil.walk_packages(plenocli.__path__, "plenocli."):
        if not module.name.endswith("__main__"):
            importlib.import_module(module.name)
    # ten seconds for a scheduler to come back would be an hour
    real = distributed.Client.__init__
    distributed.Client.__init__ = lambda self, *given, **named: real(
        self, *given, **named | {"timeout": "1s"}
    )
    parent = os.getppid()
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for them
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address + ".new")
    listener.listen(64)
    os.rename(address + ".new", address)
    while os.getppid() == parent:
        if not select.select([listener], [], [], 5)[0]:
            continue
        connection, _ = listener.accept()
        if os.fork() == 0:
            listener.close()
            try:
                _serve(connection, Path(address).parent)
            finally:
                os._exit(98)
        connection.close()


def _serve(connection, logs):
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # with the server, and so with the tests
    what, arguments, cwd, group = json.loads(connection.makefile("rb").readline())
    os.setpgid(0, group)
    if group and select.select([connection], [], [], 0)[0]:
        return  # who asked was killed meanwhile
    os.chdir(cwd)
    descriptor = os.open(logs / f"{what}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    connection.sendall(b"%d\n" % os.getpid())
    code = {"plenocli": _plenocli, "scheduler": _scheduler, "worker": _worker}[what](arguments)
    sys.stdout.flush()
    sys.stderr.flush()
    connection.sendall(b"%d\n" % code)
    os._exit(0)


def _plenocli(arguments):
    from plenocli.cli.main import run

    return run(arguments)


def _scheduler(arguments):
    from distributed import Scheduler

    async def serve():
        where = {"host": "127.0.0.1", "port": 0, "dashboard": False}
        async with Scheduler(**where, scheduler_file=arguments[0]) as scheduler:
            await scheduler.finished()

    asyncio.run(serve())
    return 0


def _worker(arguments):
    from distributed import Worker

    from plenocli.files import outside

    # what decodes files is forked while there is one thread: later it would be a start of Python
    outside._idle.append(outside._taken()[0])

    async def serve():
        where = {"scheduler_file": arguments[0], "local_directory": str(Path(arguments[0]).parent)}
        async with Worker(**where, nthreads=1, dashboard=False) as worker:
            await worker.finished()

    asyncio.run(serve())
    return 0


if __name__ == "__main__":
    main(sys.argv[1])
