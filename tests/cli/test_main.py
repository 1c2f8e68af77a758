"""The error boundary: exit codes, one message, no traceback."""

import errno
import subprocess
import sys

import pytest

from plenocli.base.errors import (
    ConfigError,
    InputError,
    NumericsError,
    OutputError,
    PlenoError,
    UsageError,
)
from plenocli.cli import main as boundary
from plenocli.files.config.camera_file import to_toml
from tests.forward.propagation.cameras import small_camera


@pytest.mark.parametrize(
    "error, code",
    [
        (UsageError("x"), 2),
        (ConfigError("x"), 2),
        (InputError("x"), 3),
        (OutputError("x"), 4),
        (NumericsError("x"), 5),
        (PlenoError("x"), 70),
        (MemoryError("x"), 5),
        (ZeroDivisionError("x"), 70),
        (KeyboardInterrupt(), 130),
    ],
)
def test_every_failure_has_its_exit_code_and_one_message(monkeypatch, capfd, error, code):
    def fail(**_):
        raise error

    monkeypatch.setattr(boundary.cli, "main", fail)
    assert boundary.run([]) == code
    out, err = capfd.readouterr()
    assert out == "" and err.startswith("plenocli: error: ") and "Traceback" not in err


def test_the_traceback_comes_on_request(monkeypatch):
    def fail(**_):
        raise ZeroDivisionError("x")

    monkeypatch.setattr(boundary.cli, "main", fail)
    monkeypatch.setenv("PLENOCLI_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        boundary.run([])


def test_messages_say_where_and_what_to_do():
    assert str(InputError("is empty", "a.h5", "make it again")) == "a.h5: is empty; make it again"


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["simulate-fip"], "simulate-pif"),
        (["capture-sim"], "Missing argument"),
        (["capture-sim", "--nois", "none"], "--noise"),
        (["--wat"], "No such option"),
    ],
)
def test_usage_errors_exit_2_and_suggest(capfd, arguments, message):
    assert boundary.run(arguments) == 2
    assert message in capfd.readouterr().err


def test_help_lists_the_commands_in_the_order_of_the_pipeline(capfd):
    assert boundary.run(["--help"]) == 0
    out = capfd.readouterr().out
    places = [out.index(f"\n  {name} ") for name in boundary.COMMANDS]
    assert places == sorted(places) and "Exit codes" in out


@pytest.mark.parametrize(
    "arguments",
    [
        ["score", "x" * 300, "--truth", "colorchecker", "-o", "OUT"],
        ["score", "a.h5", "--truth", "x" * 300, "-o", "OUT"],
        ["report", "x" * 300, "-o", "OUT.html"],
        ["inspect", "x" * 300],
    ],
)
def test_names_that_no_file_system_takes_are_no_bugs(capfd, tmp_path, arguments):
    assert (
        boundary.run(
            [
                str(tmp_path / {"OUT": "out.json", "OUT.html": "out.html"}[a])
                if a.startswith("OUT")
                else a
                for a in arguments
            ]
        )
        == 3
    )
    assert "name too long" in capfd.readouterr().err


@pytest.mark.parametrize(
    "number, filename, code",
    [
        (errno.ENOSPC, None, 4),
        (errno.EROFS, "out.h5", 4),
        (errno.EACCES, "in.h5", 3),
        (errno.EIO, None, 70),
    ],
)
def test_the_system_s_errors_have_exit_codes(monkeypatch, capfd, number, filename, code):
    def fail(**_):
        raise OSError(number, "sorry", filename)

    monkeypatch.setattr(boundary.cli, "main", fail)
    assert boundary.run([]) == code
    assert "sorry" in capfd.readouterr().err


def test_a_command_that_wrote_an_exr_ends_without_a_word_of_its_library(tmp_path):
    """Which tells on stderr of what a process that ends does not clear away."""
    camera = small_camera(lenslet_array__count=(2, 2))
    (tmp_path / "camera.toml").write_text(to_toml(camera))
    words = ["capture-sim", "camera.toml", "--scene", "skimage:camera", "--superpixels", "1x1"]
    words += ["--coherent-ring", "0", "--accuracy", "3e-2", "--noise", "none", "-o", "out.exr"]
    command = [sys.executable, "-m", "plenocli", "--quiet", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "") and (tmp_path / "out.exr").exists()
