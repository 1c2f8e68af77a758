"""The recipes of CONTRIBUTING.md do what they say, in a copy of the package."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"^```(?:python|toml)\n# (in )?(plenocli/[\w/]+\.(?:py|toml))"
    r"(?:, (before )?(\w+))?\n(.*?)^```",
    re.S | re.M,
)


def recipe(title):
    """(file, how it goes into one that is there, text) of each block of a recipe."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    part = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", text, re.S | re.M)
    for into, file, before, name, code in BLOCK.findall(part[1]):
        yield Path(file), (before, name) if into else None, code


def put(text, before, name, code):
    """A file's text with a block added: at its end, to imports, before a name, or to a table."""
    if name == "end":
        return text + code
    if name == "imports":
        return re.sub(r"^from plenocli", code + "from plenocli", text, count=1, flags=re.M)
    start = re.search(rf"^{name}\b[^=\n]*= [({{]", text, re.M)
    if before:
        return f"{text[: start.start()]}{code}\n\n{text[start.start() :]}"
    head, rest = text[: start.end()], text[start.end() :]
    end = re.search(r"[)}]\n" if rest[0] != "\n" else r"^[)}]", rest, re.M).start()
    entries = rest[:end].rstrip().rstrip(",")
    return f"{head}{entries},\n{code}{rest[end:]}"


def copied(folder):
    """A copy of the package and its tests of the house."""
    ignored = shutil.ignore_patterns("__pycache__", "samples")
    shutil.copytree(ROOT / "plenocli", folder / "plenocli", ignore=ignored)
    (folder / "tests").mkdir()
    shutil.copy(ROOT / "tests" / "test_architecture.py", folder / "tests")
    shutil.copytree(ROOT / "docs", folder / "docs")


def follow(title, folder):
    """Do in a copy what a recipe says."""
    for file, into, code in recipe(title):
        place = folder / file
        assert place.exists() == (into is not None)
        place.write_text(put(place.read_text(), *into, code) if into else code)


def run(folder, *arguments):
    """A finished process of the copy's own plenocli."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


TINY = str(ROOT / "sample_configs" / "tiny.toml")


def house_stands(folder):
    """Whether the copy's layers, rooms and docstrings pass the tests of the house."""
    done = run(folder, "pytest", "-q", "-p", "no:cacheprovider", "tests/test_architecture.py")
    assert done.returncode == 0, done.stdout[-2000:]
    return True


def a_command_works(folder):
    """That of the first recipe."""
    done = run(folder, "plenocli", "f-number", TINY, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"camera": "tiny.toml", "f_number": pytest.approx(8)}
    assert "f-number" in run(folder, "plenocli", "--help").stdout


def a_model_of_propagation_works(folder):
    """That of the second."""
    square = (
        Path(TINY).read_text().replace("[main_lens]", '[main_lens]\naperture_shape = "square"', 1)
    )
    (folder / "square.toml").write_text(square)
    made = run(
        folder,
        "plenocli",
        "simulate-pif",
        "square.toml",
        "--model",
        "ray",
        "--superpixels",
        "1x1",
        "-o",
        "a.h5",
        "--json",
    )
    assert made.returncode == 0, made.stderr
    summary = json.loads(made.stdout)
    assert summary["rung"] == "pinholes" and summary["rank"] == [1]
    assert summary["energy_min"] == summary["energy_max"] == [pytest.approx(1, abs=1e-6)]


def a_method_of_reconstruction_works(folder):
    """That of the third."""
    steps = (
        ("simulate-pif", TINY, "--accuracy", "0.1", "-o", "pif.h5"),
        (
            "capture-sim",
            TINY,
            "--scene",
            "skimage:camera",
            "--pif",
            "pif.h5",
            "--snr",
            "60dB",
            "-o",
            "capture.h5",
        ),
        (
            "reconstruct",
            "capture.h5",
            "--pif",
            "pif.h5",
            "--method",
            "back-projection",
            "--json",
            "-o",
            "image.h5",
        ),
    )
    for step in steps:
        done = run(folder, "plenocli", *step)
        assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)["captures"][0]
    assert summary["method"] == "back-projection" and summary["rule"] == "nothing to choose"
    score = run(
        folder,
        "plenocli",
        "score",
        "image.h5",
        "--truth",
        "capture.h5",
        "--json",
        "-o",
        "score.json",
    )
    assert score.returncode == 0, score.stderr
    assert json.loads(score.stdout)["metrics"]["psnr_db"] > 10


def test_the_recipes_do_what_they_say(tmp_path):
    """One after the other in one copy, which is compiled once."""
    copied(tmp_path)
    for title, works in {
        "Add a command": a_command_works,
        "Add a model of propagation": a_model_of_propagation_works,
        "Add a method of reconstruction": a_method_of_reconstruction_works,
    }.items():
        follow(title, tmp_path)
        works(tmp_path)
    assert house_stands(tmp_path)
