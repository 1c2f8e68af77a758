"""What people expect of a command line: completion, progress on a terminal and nowhere else,
silence on request, no colours.
"""

import fcntl
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from plenocli.cli.main import run

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {k: v for k, v in os.environ.items() if not k.startswith("_PLENOCLI")} | {
    "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
    "PYTHONPATH": str(ROOT),
    "OMP_NUM_THREADS": "1",
}
PLENOCLI = [sys.executable, "-m", "plenocli"]


def completed(words, shell="bash", **more):
    """What completion offers after `words`, of which the last is unfinished."""
    asked = {
        "_PLENOCLI_COMPLETE": f"{shell}_complete",
        "COMP_WORDS": " ".join(words),
        "COMP_CWORD": str(len(words) - 1),
    } | more
    return subprocess.run(
        ["plenocli"], env=ENVIRONMENT | asked, capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.mark.skipif(
    shutil.which("plenocli", path=ENVIRONMENT["PATH"]) is None,
    reason="plenocli is not installed as a command",
)
def test_completion_knows_commands_options_values_and_files(tmp_path):
    assert completed(["plenocli", "simu"]) == ["plain,simulate-pif", "plain,simulate-response"]
    assert completed(["plenocli", "lens", "sh"]) == ["plain,show"]
    assert completed(["plenocli", "reconstruct", "--ov"]) == [
        "plain,--overlap",
        "plain,--overwrite",
    ]
    assert completed(["plenocli", "reconstruct", "--method", "t"]) == [
        "plain,tikhonov",
        "plain,tsvd",
        "plain,tv",
    ]
    assert completed(["plenocli", "demux", "--calibration", "c"]) == ["file,c"]
    assert "tikhonov" in completed(["plenocli", "reconstruct", "--method", "t"], "zsh")
    assert "plain,tikhonov" in completed(
        ["plenocli", "reconstruct", "--method", "t"], "fish", COMP_CWORD="t"
    )
    for shell, words in {
        "bash": "complete -o nosort -F",
        "zsh": "#compdef plenocli",
        "fish": "complete --no-files --command plenocli",
    }.items():
        script = subprocess.run(
            ["plenocli"],
            env=ENVIRONMENT | {"_PLENOCLI_COMPLETE": f"{shell}_source"},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        assert words in script
        if shutil.which(shell):
            (tmp_path / shell).write_text(script)
            subprocess.run([shell, "-n", str(tmp_path / shell)], check=True)
    installed = subprocess.run(
        ["bash", "-c", 'eval "$(_PLENOCLI_COMPLETE=bash_source plenocli)"; complete -p plenocli'],
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "_plenocli_completion" in installed.stdout
    if shutil.which("fish"):
        asked = f"source {tmp_path / 'fish'}; complete -C 'plenocli reconstruct --method t'"
        assert subprocess.run(
            ["fish", "-c", asked], env=ENVIRONMENT, capture_output=True, text=True, check=True
        ).stdout.split() == ["tikhonov", "tsvd", "tv"]


def on_a_terminal(command, folder, environment):
    """(exit code, what a person at a terminal saw)."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    child = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=theirs, stdout=theirs, stderr=theirs
    )
    os.close(theirs)
    seen = b""
    try:
        while part := os.read(ours, 65536):
            seen += part
    except OSError:  # the child closed its end
        pass
    os.close(ours)
    return child.wait(), seen.decode()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A sweep of two points, for which there is something to say."""
    made = tmp_path_factory.mktemp("habits")
    text = (ROOT / "sample_configs" / "tiny.toml").read_text()
    for old, new in [
        ("[8, 8]", "[4, 4]"),
        ("[13, 13]", "[9, 9]"),
        ('"26 um"', '"18 um"'),
        ('"208 um"', '"144 um"'),
        ("[5, 5]", "[3, 3]"),
    ]:
        text = text.replace(old, new)
    (made / "camera.toml").write_text(text)
    (made / "sweep.toml").write_text(
        'camera = "camera.toml"\n'
        "[vary]\n"
        '"main_lens.f_number" = [5, 6, 8]\n'
        "[simulate-pif]\n"
        'model = "ray"\n'
        'superpixels = "1x1"\n'
        "[capture-sim]\n"
        'snr = "40 dB"\n'
        "[reconstruct]\n"
        'method = "tikhonov"\n'
    )
    return made


def test_progress_with_the_time_that_is_left_on_a_terminal_only_and_never_in_colour(folder):
    sweep = [*PLENOCLI, "sweep", "sweep.toml", "--overwrite", "-o", "seen.h5"]
    code, seen = on_a_terminal(
        sweep, folder, ENVIRONMENT | {"NO_COLOR": "1", "TERM": "xterm-256color"}
    )
    assert code == 0, seen
    assert re.search(r"points: .*\d+/3 \[\d\d:\d\d<\d\d:\d\d", seen), (
        "done, total, time spent < time left"
    )
    assert not re.search(r"\x1b\[[\d;]*m", seen)
    shutil.rmtree(folder / "seen.parts")
    piped = subprocess.run(
        sweep, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert "points:" not in piped.stderr and "\r" not in piped.stderr


@pytest.mark.parametrize("workers", [pytest.param("1", marks=pytest.mark.slow), "2"])
def test_quiet_reaches_the_workers(folder, workers):
    """With --overlap 3 and a matrix without neighbours every capture has something to say."""
    out = folder / f"quiet{workers}.h5"
    command = ["sweep", "sweep.toml", "--workers", workers, "-o", str(out)]
    done = subprocess.run(
        [*PLENOCLI, "--quiet", *command],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stderr) == (0, "")
    pictures = folder / f"pictures{workers}"
    if not (folder / "pif.h5").exists():
        camera, by_rays = str(folder / "camera.toml"), ["--model", "ray", "--superpixels", "1x1"]
        assert run(["simulate-pif", camera, *by_rays, "-o", str(folder / "pif.h5")]) == 0
        for seed in "12":
            asked = ["--scene", "skimage:coins", *by_rays, "--snr", "60dB", "--seed", seed]
            view = str(folder / f"view{seed}.h5")
            assert run(["capture-sim", camera, *asked, "-o", view]) == 0
    loud = [
        *PLENOCLI,
        "reconstruct",
        "view1.h5",
        "view2.h5",
        "--pif",
        "pif.h5",
        "--method",
        "tikhonov",
        "--overlap",
        "3",
        "--workers",
        workers,
        "--overwrite",
        "-o",
        str(pictures),
    ]
    told = subprocess.run(
        loud, cwd=folder, env=ENVIRONMENT, capture_output=True, text=True, check=True
    )
    assert "plenocli:" in told.stderr, "there is something to be quiet about"
    quiet = subprocess.run(
        [*loud[:3], "--quiet", *loud[3:]],
        cwd=folder,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=True,
    )
    assert quiet.stderr == "" and quiet.stdout == told.stdout


def test_what_is_misspelt_is_guessed(folder):
    for words, guess in {
        ("reconstrukt",): "reconstruct",
        ("lens", "shwo"): "show",
        ("demux", "--calibratoin", "c.h5"): "--calibration",
    }.items():
        done = subprocess.run(
            [*PLENOCLI, *words], cwd=folder, env=ENVIRONMENT, capture_output=True, text=True
        )
        assert done.returncode == 2 and "Did you mean" in done.stderr and guess in done.stderr
