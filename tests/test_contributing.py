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
BLOCK = re.compile(r"^```python\n# (in )?(plenocli/[\w/]+\.py)(?:, (\w+))?\n(.*?)^```", re.S | re.M)


def recipe(title):
    """(whether it goes into a file that is there, file, name of a table, text) of each block."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    part = re.search(rf"^## {title}\n(.*?)(?=^## |\Z)", text, re.S | re.M)
    return [
        (bool(into), Path(file), table, code) for into, file, table, code in BLOCK.findall(part[1])
    ]


def followed(title, folder):
    """A copy of the package and its tests of the house in which a recipe was followed."""
    ignored = shutil.ignore_patterns("__pycache__", "samples")
    shutil.copytree(ROOT / "plenocli", folder / "plenocli", ignore=ignored)
    (folder / "tests").mkdir()
    shutil.copy(ROOT / "tests" / "test_architecture.py", folder / "tests")
    shutil.copytree(ROOT / "docs", folder / "docs")
    for into, file, table, code in recipe(title):
        place = folder / file
        if into:
            head, start, tail = re.split(
                rf"^({table}\b[^=\n]*= [({{]\n)", place.read_text(), 1, re.M
            )
            body, end = re.split(r"^(?=[)}])", tail, maxsplit=1, flags=re.M)
            place.write_text(head + start + body + code + end)
        else:
            assert not place.exists()
            place.write_text(code)
    return folder


def run(folder, *arguments):
    """A finished process of the copy's own plenocli."""
    environment = os.environ | {"PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", *arguments]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)


@pytest.fixture
def tiny():
    return str(ROOT / "sample_configs" / "tiny.toml")


def house_stands(folder):
    """Whether the copy's layers, rooms and docstrings pass the tests of the house."""
    done = run(folder, "pytest", "-q", "-p", "no:cacheprovider", "tests/test_architecture.py")
    assert done.returncode == 0, done.stdout[-2000:]
    return True


def test_a_command(tmp_path, tiny):
    folder = followed("Add a command", tmp_path)
    done = run(folder, "plenocli", "f-number", tiny, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == {"camera": "tiny.toml", "f_number": pytest.approx(8)}
    assert "f-number" in run(folder, "plenocli", "--help").stdout
    assert house_stands(folder)
