"""A result appears whole or not at all, whatever fails while it is written."""

import os
import signal
import subprocess
import sys
import time

import pytest

from plenocli.base.errors import OutputError, UsageError
from plenocli.files import atomic
from plenocli.files.atomic import check_output, publish


def test_pieces_are_joined_and_nothing_else_is_left(tmp_path):
    publish(tmp_path / "a", [b"one", memoryview(b"two")])
    assert (tmp_path / "a").read_bytes() == b"onetwo" and os.listdir(tmp_path) == ["a"]


def test_an_existing_file_stays_unless_overwrite_is_passed(tmp_path):
    publish(tmp_path / "a", b"old")
    with pytest.raises(UsageError, match="--overwrite"):
        publish(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"old"
    publish(tmp_path / "a", b"new", overwrite=True)
    assert (tmp_path / "a").read_bytes() == b"new"


def test_leftover_of_a_killed_run_is_swept(tmp_path):
    atomic.partial_path(tmp_path / "a").write_bytes(b"x" * 999)
    publish(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new" and os.listdir(tmp_path) == ["a"]


def test_a_link_planted_at_the_temporary_name_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_bytes(b"precious")
    os.symlink(victim, atomic.partial_path(tmp_path / "a"))
    with pytest.raises(OutputError):
        publish(tmp_path / "a", b"new")
    assert victim.read_bytes() == b"precious" and not (tmp_path / "a").exists()


@pytest.mark.parametrize("call", ["write", "fsync", "replace", "ftruncate", "open"])
def test_failing_the_nth_call_leaves_the_old_file_and_no_leftovers(tmp_path, each_failure, call):
    publish(tmp_path / "a", b"old")
    for done in each_failure(call, lambda: publish(tmp_path / "a", [b"new"] * 3, overwrite=True)):
        assert (tmp_path / "a").read_bytes() in (b"old", b"newnewnew") and os.listdir(tmp_path) == [
            "a"
        ]
        if not done and call in ("write", "replace", "ftruncate"):
            assert (tmp_path / "a").read_bytes() == b"old"


def test_short_writes_are_continued(tmp_path, monkeypatch):
    real = os.write
    monkeypatch.setattr(atomic.os, "write", lambda descriptor, view: real(descriptor, view[:3]))
    publish(tmp_path / "a", bytes(range(100)))
    assert (tmp_path / "a").read_bytes() == bytes(range(100))


def test_two_runs_with_one_target_do_not_mix(tmp_path):
    descriptor = atomic._open_partial(atomic.partial_path(tmp_path / "a"))
    with pytest.raises(OutputError, match="another run"):
        publish(tmp_path / "a", b"second")
    os.close(descriptor)
    publish(tmp_path / "a", b"third")
    assert (tmp_path / "a").read_bytes() == b"third"


def test_killed_at_any_moment_the_target_is_old_or_new(tmp_path):
    target = tmp_path / "a"
    code = (
        "import sys; from plenocli.files.atomic import publish\n"
        "print('ready', flush=True)\n"
        "for n in range(10**6): publish(sys.argv[1], [bytes([n % 251]) * (1 << 20)] "
        "* 2, overwrite=True)"
    )
    for round_ in range(6):
        child = subprocess.Popen([sys.executable, "-c", code, str(target)], stdout=subprocess.PIPE)
        child.stdout.readline()
        time.sleep(0.013 * (round_ + 1))
        child.send_signal(signal.SIGKILL)
        child.wait()
        child.stdout.close()
        if target.exists():
            content = target.read_bytes()
            assert len(content) == 2 << 20 and len(set(content)) == 1
    publish(target, b"end", overwrite=True)
    assert os.listdir(tmp_path) == ["a"]


def test_outputs_that_cannot_work_are_refused_before_the_work(tmp_path):
    (tmp_path / "in").write_bytes(b"x")
    with pytest.raises(OutputError, match="is a folder"):
        check_output(tmp_path)
    with pytest.raises(OutputError, match="does not exist"):
        check_output(tmp_path / "no" / "a")
    with pytest.raises(OutputError, match="also an input"):
        check_output(tmp_path / "in", overwrite=True, inputs=[None, tmp_path / "in"])
    with pytest.raises(UsageError, match="--overwrite"):
        check_output(tmp_path / "in")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="ordinary"):
        check_output(tmp_path / "pipe", overwrite=True)
    check_output(tmp_path / "new", inputs=[tmp_path / "in"])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_folder_is_refused(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(0o555)
    with pytest.raises(OutputError, match="read-only"):
        check_output(folder / "a")


def test_names_that_cannot_be_and_suffixes_that_mislead(tmp_path):
    with pytest.raises(OutputError, match="possible file name"):
        # the temporary name beside it would be too long
        check_output(tmp_path / ("y" * 246 + ".h5"))
    with pytest.raises(UsageError, match="written as .h5"):
        check_output(tmp_path / "camera.toml", overwrite=True, suffixes=(".h5",))
    check_output(tmp_path / "pif.h5", suffixes=(".h5",))


def test_a_file_that_appears_meanwhile_stays(tmp_path):
    with pytest.raises(UsageError, match="appeared while the result was computed"):
        with atomic.replacement(tmp_path / "a") as (_, descriptor):
            os.write(descriptor, b"ours")
            (tmp_path / "a").write_bytes(b"theirs")
    assert (tmp_path / "a").read_bytes() == b"theirs" and os.listdir(tmp_path) == ["a"]
