"""Commands of plenocli run by the thousand, each in a process of its own, with a fault of choice.

A server process imports plenocli once and forks a child for each command: a crash, a hang or a kill
stays in the child.
"""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

SERVER = Path(__file__).with_name("server.py")


@dataclass(frozen=True)
class Outcome:
    """code: exit status, or minus the signal;
    text: stdout and stderr;
    seconds of wall time;
    cpu: of processor time;
    grown: bytes of peak memory above the server's;
    fired: whether the fault came to pass, notes: what it wrote down.
    """

    code: int
    text: str
    seconds: float
    cpu: float
    grown: int
    hung: bool
    fired: bool
    notes: str


class Runner:
    """`run` a command line; use as a context manager."""

    def __init__(self, modules=()):
        """modules: imported once, not by each command that needs them."""
        environment = os.environ | {"PYTHONPATH": str(SERVER.parents[2])}
        self._server = subprocess.Popen(
            [sys.executable, str(SERVER), *modules],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._server.stdin.close()
        self._server.stdout.close()
        self._server.wait()

    def run(self, arguments, cwd, *, limit=60.0, kill_after=None, fault=None, environment=None):
        """The Outcome of `plenocli ARGUMENTS` in the folder cwd.

        limit: s, then it counts as hung and is killed.
        kill_after: s, then SIGKILL.
        fault: see server.py.
        """
        request = {
            "arguments": [str(a) for a in arguments],
            "cwd": str(cwd),
            "limit": limit,
            "kill_after": kill_after,
            "fault": fault,
            "environment": environment or {},
        }
        self._server.stdin.write(json.dumps(request) + "\n")
        self._server.stdin.flush()
        answer = self._server.stdout.readline()
        if not answer:
            raise RuntimeError("the server of the fault tests ended")
        return Outcome(**json.loads(answer))


def tree(folder):
    """Relative path -> bytes of every file below a folder, but for the journal and seconds that a
    sweep keeps on purpose.
    """
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in sorted(Path(folder).rglob("*"))
        if p.is_file() and p.name not in ("points.jsonl", "measured.csv")
    }


def results(path, name):
    """The files that the command with the result `path` writes, as `tree` gives them where that
    result is called `name`: a sweep's table has a twin.
    """
    twin = Path(path).with_suffix(".csv")
    return {name: Path(path).read_bytes()} | (
        {str(Path(name).with_suffix(".csv")): twin.read_bytes()} if twin.exists() else {}
    )


def is_clean_refusal(outcome, code, *words):
    """Whether a command ended with `code` (or one of several) and one message that names every
    word, without a traceback.
    """
    codes = code if isinstance(code, tuple) else (code,)
    return (
        outcome.code in codes
        and "Traceback" not in outcome.text
        and "internal error" not in outcome.text
        and all(w in outcome.text for w in words)
    )


def mutants(good, count, rng):
    """`count` damaged copies: cut, flipped bits, a zeroed block, a huge number, a piece put in
    twice, a stretch of noise.
    """
    for number in range(count):
        bad = bytearray(good)
        at, length = int(rng.integers(len(good))), int(2 ** rng.uniform(0, 12))
        match number % 6:
            case 0:
                del bad[at:]
            case 1:
                for spot in rng.integers(len(good), size=rng.integers(1, 9)):
                    bad[spot] ^= 1 << int(rng.integers(8))
            case 2:
                bad[at : at + length] = bytes(len(bad[at : at + length]))
            case 3:
                huge = [
                    b"\xff\xff\xff\x7f",
                    b"\xff" * 8,
                    b"\xff\xff\xff\xff\xff\xff\xff\x7f",
                    b"\x7f\xff\xff\xff",
                ][number // 6 % 4]
                bad[at : at + len(huge)] = huge[: len(bad[at : at + len(huge)])]
            case 4:
                bad[at:at] = good[at // 2 : at // 2 + length]
            case 5:
                bad[at : at + length] = rng.bytes(len(bad[at : at + length]))
        if bytes(bad) != good:
            yield bytes(bad)
