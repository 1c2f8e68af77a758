"""Whatever a file does to the process that decodes it ends as one message, and that process can do
nothing but compute, read and answer.
"""

import errno
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from plenocli.base.budget import Budget, within
from plenocli.base.errors import InputError, NumericsError
from plenocli.files import outside as outside_module
from plenocli.files.outside import outside

ROOT = Path(__file__).resolve().parents[2]

# --- what a decoder might be made to do; all run outside ------------------------------------------


def crash(_):
    os.kill(os.getpid(), signal.SIGSEGV)


def abort(_):
    os.abort()


def spin(_):
    while True:
        pass


def wait(_):
    time.sleep(600)


def leave(_):
    os._exit(7)


def take_memory(_):
    bytearray(1 << 30)


def answer_garbage(_):
    _answer(b"[1, 2\n\0\0")


def answer_too_little(_):
    _answer(b'{"missing": [], "arrays": [["<u2", [30, 30]]], "value": {"array": 0}}\n12')


def answer_too_much(_):
    _answer(b'{"missing": [], "arrays": [["<f8", [1000000000, 1000000000]]], "value": 1}\n')


def answer_objects(_):
    _answer(b'{"missing": [], "arrays": [["|O", [1]]], "value": 1}\n\0\0\0\0\0\0\0\0')


def _answer(text):
    """What a decoder that was taken over may send."""
    for descriptor in range(3, 64):
        try:
            os.write(descriptor, text)
        except OSError:
            continue
    os._exit(0)


def pid(_):
    return os.getpid()


def refuse(path, kind):
    raise {"input": InputError, "numbers": NumericsError}[kind]("is strange", path, "mend it")


def stumble(_):
    raise KeyError("a bug")


def several(path, number):
    return {
        "name": path,
        "numbers": [number, float("inf"), None, True],
        "arrays": (np.arange(6, dtype="<u2").reshape(2, 3), np.empty((0, 3)), np.float64(0.5)),
        "nothing": {},
        "one": np.array(2.5),
        "large": np.full((3000, 1000), 7.25),
    }


def ways_out(path):
    """Name of each forbidden deed -> its errno, or 0 where it was done."""
    deeds = {
        "make a file": lambda: open(f"{path}.new", "wb"),
        "append": lambda: open(path, "ab"),
        "cut": lambda: os.truncate(path, 0),
        "make a folder": lambda: os.mkdir(f"{path}.folder"),
        "remove": lambda: os.unlink(path),
        "rename": lambda: os.rename(path, f"{path}.other"),
        "link": lambda: os.link(path, f"{path}.link"),
        "change permissions": lambda: os.chmod(path, 0o777),
        "change times": lambda: os.utime(path, (0, 0)),
        "TCP": lambda: socket.create_connection(("127.0.0.1", 9), timeout=1),
        "UDP": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM),
        "local socket": lambda: socket.socket(socket.AF_UNIX),
        "start a program": lambda: os.posix_spawn("/bin/true", ["true"], {}),
    }
    found = {}
    for name, deed in deeds.items():
        try:
            deed()
            found[name] = 0
        except OSError as error:
            found[name] = error.errno
    return found


# --- tests ----------------------------------------------------------------------------------------


@pytest.fixture(params=["forked", pytest.param("started", marks=pytest.mark.slow)], autouse=True)
def way(request, monkeypatch):
    """Both ways to start a child, each test with new ones; `test_both_ways` is not slow."""
    outside_module.close()
    monkeypatch.setattr(outside_module, "_may_fork", lambda: request.param == "forked")
    yield request.param
    outside_module.close()


@pytest.fixture
def path(tmp_path):
    (tmp_path / "x").write_bytes(b"x")
    return tmp_path / "x"


HOSTILE = {
    crash: "crash or hit its limits .signal 11",
    abort: "crash or hit its limits .signal 6",
    spin: "crash or hit its limits .signal (24|9)",
    leave: "without an answer .code 7",
    answer_garbage: "garbled",
    answer_too_little: "without an answer",
    answer_too_much: "garbled",
    answer_objects: "garbled",
    stumble: "cannot be decoded .KeyError: 'a bug'",
}


WARM = (crash, spin)  # a file before may have left it broken: all but time is tried anew


@pytest.mark.parametrize(
    "deed, is_first",
    [*((deed, True) for deed in HOSTILE if deed is not spin), *((deed, False) for deed in WARM)],
    ids=lambda value: getattr(value, "__name__", "cold" if value else "warm"),
)
def test_whatever_a_file_does_is_one_message_and_the_next_is_read(path, deed, is_first):
    if not is_first:
        outside(pid, path)
    with pytest.raises(InputError, match=HOSTILE[deed]) as caught:
        outside(deed, path, seconds=1)
    assert caught.value.where == str(path)
    assert outside(pid, path) != os.getpid()
    assert path.read_bytes() == b"x" and len(list(path.parent.iterdir())) == 1


def test_it_waits_no_longer_than_it_says(path, monkeypatch):
    monkeypatch.setattr(outside_module, "TIMEOUT_S", 0.2)
    with pytest.raises(InputError, match="not decoded within 0.2 s"):
        outside(wait, path)


def test_memory_is_that_of_the_budget(path):
    with within(Budget(64 << 20)), pytest.raises(MemoryError):
        outside(take_memory, path)
    with within(Budget(2 << 30)):
        assert outside(take_memory, path) is None


@pytest.mark.parametrize("kind, error", [("input", InputError), ("numbers", NumericsError)])
def test_refusals_come_back_as_they_are_with_the_name_as_it_was_given(
    path, kind, error, monkeypatch
):
    monkeypatch.chdir(path.parent)
    with pytest.raises(error, match="^x: is strange; mend it$"):
        outside(refuse, "x", kind)


def test_values_come_back_as_they_were(tmp_path):
    name = os.fsdecode(os.fsencode(tmp_path) + b"/\xff\x1b\n")
    found = outside(several, name, 3)
    assert found["name"] == name and found["numbers"] == [3, float("inf"), None, True]
    first, empty, number = found["arrays"]
    np.testing.assert_array_equal(first, np.arange(6).reshape(2, 3), strict=False)
    assert first.dtype == np.uint16 and empty.shape == (0, 3) and number == 0.5
    assert found["nothing"] == {} and found["one"].shape == () and found["one"] == 2.5
    assert found["large"].shape == (3000, 1000) and (found["large"] == 7.25).all()


def test_both_ways(path, monkeypatch):
    for may_fork in (True, False):
        outside_module.close()
        monkeypatch.setattr(outside_module, "_may_fork", lambda may=may_fork: may)
        assert outside(several, path, 3)["numbers"][0] == 3
        with pytest.raises(InputError, match="signal 11"):
            outside(crash, path)
        assert outside(pid, path) > 0


def test_one_child_decodes_file_after_file(path):
    assert len({outside(pid, path) for _ in range(5)}) == 1
    with within(Budget(1 << 30)):  # which is not what the first was granted
        assert len({outside(pid, path) for _ in range(2)}) == 1


def test_threads_do_not_wait_for_each_other(path):
    found, start = [], threading.Barrier(3)

    def ask():
        start.wait()
        found.append(outside(nap, path))

    threads = [threading.Thread(target=ask) for _ in range(3)]
    before = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(found)) == 3 and time.perf_counter() - before < 60


def nap(_):
    time.sleep(0.3)
    return os.getpid()


def test_a_child_that_was_killed_between_two_files_costs_none_of_them(path):
    os.kill(outside(pid, path), signal.SIGKILL)
    assert outside(pid, path) > 0


def test_an_interrupted_answer_is_not_taken_for_the_next(path, monkeypatch):
    """Ctrl-C while a file is decoded."""
    previous = signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    try:
        outside(pid, path)
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            outside(nap, path)
    finally:
        signal.signal(signal.SIGALRM, previous)
    assert outside(several, path, 1)["numbers"][0] == 1


def test_it_can_neither_write_nor_talk_nor_start_anything(path):
    lacks = subprocess.run(
        [
            sys.executable,
            "-c",
            "from plenocli.files.confinement import confine; print(confine(1 << 30))",
        ],
        capture_output=True,
        text=True,
        cwd=ROOT,
    ).stdout.strip()
    if lacks != "[]":
        pytest.skip(f"this system has no {lacks}")
    before = path.stat()
    found = outside(ways_out, path)
    assert {
        name for name, number in found.items() if number not in (errno.EPERM, errno.EACCES)
    } == (set())
    assert path.stat() == before and len(list(path.parent.iterdir())) == 1


def test_what_a_system_lacks_is_said_once(path, monkeypatch, capsys):
    answer = {"missing": ["Landlock"], "arrays": [], "value": 1}
    monkeypatch.setattr(outside_module, "_said", set())
    monkeypatch.setattr(outside_module._Child, "ask", lambda self, what: answer)
    for _ in range(2):
        outside(pid, path)
    assert capsys.readouterr().err.count("this system has no Landlock") == 1


def test_nothing_is_left_when_the_process_ends(path):
    """Neither at its end nor when it is killed."""
    code = (
        "import sys, os; from tests.files.test_outside import pid; from plenocli.files.outside "
        "import outside; print(outside(pid, sys.argv[1]), flush=True); "
        "sys.stdin.read(); os.kill(os.getpid(), int(sys.argv[2]) or 0)"
    )
    for number in (0, signal.SIGKILL):
        done = subprocess.Popen(
            [sys.executable, "-c", code, str(path), str(int(number))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            cwd=ROOT,
        )
        child = int(done.stdout.readline())
        done.communicate()
        for _ in range(100):
            if not os.path.exists(f"/proc/{child}"):
                break
            time.sleep(0.1)
        assert not os.path.exists(f"/proc/{child}")
