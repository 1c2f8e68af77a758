"""Runs that are stopped once some of their tiles are kept: by an exception, or by SIGKILL in a
process of their own.
"""

import os
import subprocess
import sys

import pytest

from plenocli.files.bench import Bench

KILLED = """
import os, signal, sys
from importlib import import_module
from plenocli.cli.main import run
from plenocli.files.bench import Bench

put, left = Bench.put, int(sys.argv[1])

def killed(self, tile, arrays):
    global left
    put(self, tile, arrays)
    left -= 1
    if not left:
        os.kill(os.getpid(), signal.SIGKILL)

Bench.put = killed
settings, words = sys.argv[2:sys.argv.index("--")], sys.argv[sys.argv.index("--") + 1:]
for setting in settings:
    place, value = setting.split("=")
    module, name = place.split(":")
    setattr(import_module(module), name, eval(value))
sys.exit(run(words))
"""


def stop_after(patch, tiles):
    """From now on, the run is interrupted when it has kept so many tiles."""
    put, left = Bench.put, [tiles]

    def stopped(self, tile, arrays):
        put(self, tile, arrays)
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt

    patch.setattr(Bench, "put", stopped)


def interrupted(command, tiles):
    """Run a command, a function, until it has kept so many tiles; it must not end before."""
    with pytest.MonkeyPatch.context() as patch:
        stop_after(patch, tiles)
        with pytest.raises(KeyboardInterrupt):
            command()


def killed(words, tiles, settings):
    """Run `plenocli` with words in another process, which kills itself by SIGKILL when it has kept
    so many tiles; settings: "module:NAME" -> value that stands there.
    """
    options = [f"{place}={value!r}" for place, value in settings.items()]
    process = subprocess.run(
        [sys.executable, "-c", KILLED, str(tiles), *options, "--", *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
    )
    assert process.returncode == -9, process.stderr


def kept(output):
    """Files of the tiles that lie beside a result, by their names."""
    return {file.name: file for file in output.parent.glob(f".{output.name}.*.tiles/*")}


def damage(file, how):
    """Cut a file's end off, or turn over a bit in its middle."""
    data = bytearray(file.read_bytes())
    if how == "cut":
        del data[-9:]
    else:
        data[-len(data) // 4] ^= 1
    file.write_bytes(data)
