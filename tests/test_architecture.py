"""The layers: kernels touch no files, lower rooms do not know upper ones, the help imports nothing heavy."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "plenocli"
KERNELS = ("optics", "sensor", "scene", "operators", "solvers", "metrics", "accuracy")
FILES = {"h5py", "click", "OpenImageIO", "OpenEXR", "rawpy", "exifread", "tqdm", "tifffile", "imageio", "PIL"}
UPPER = {"plenocli.cli", "plenocli.stages", "plenocli.artefacts", "plenocli.report"}
BUILD_ONLY = {PACKAGE / "scene" / "make_tables.py"}


def imported(path):
    """Absolute names of everything a module imports, at any depth of its code."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import"
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def modules(*rooms):
    return [path for room in rooms for path in sorted((PACKAGE / room).rglob("*.py")) if path not in BUILD_ONLY]


@pytest.mark.parametrize("path", modules(*KERNELS), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_kernels_touch_no_files(path):
    names = imported(path)
    assert not {name.split(".")[0] for name in names} & FILES
    assert not {".".join(name.split(".")[:2]) for name in names} & UPPER


def test_the_guard_sees_what_it_must_refuse(tmp_path):
    bad = tmp_path / "kernel.py"
    bad.write_text("def f():\n    import h5py\n    from plenocli.artefacts import read_artefact\n")
    assert {"h5py", "plenocli.artefacts"} <= imported(bad)


@pytest.mark.parametrize("path", modules("artefacts", "config"), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_files_and_descriptions_do_not_know_the_stages(path):
    assert not {".".join(name.split(".")[:2]) for name in imported(path)} & {"plenocli.cli", "plenocli.stages"}


@pytest.mark.parametrize("path", modules("cli"), ids=lambda p: p.name)
def test_commands_only_parse(path):
    banned = {f"plenocli.{room}" for room in (*KERNELS, "artefacts")}
    assert not {".".join(name.split(".")[:2]) for name in imported(path)} & banned


HEAVY = ("numpy", "scipy", "h5py", "colour", "matplotlib", "pydantic", "skimage", "rawpy", "OpenImageIO", "numba", "tqdm", "distributed", "optuna")


@pytest.mark.parametrize("command", ["", "simulate-pif", "simulate-response", "capture-sim", "calibrate", "demux", "learn-dict", "reconstruct", "score", "report", "sweep", "optimise", "inspect", "lens", "schema"])
def test_help_imports_nothing_heavy(command):
    code = (
        "import sys; from plenocli.cli.main import run\n"
        f"assert run({[command, '--help'] if command else ['--help']!r}) == 0\n"
        f"print('HEAVY', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.splitlines()[-1] == "HEAVY []"
    assert "Usage: plenocli" in done.stdout


def test_no_unsafe_loader_anywhere():
    for path in PACKAGE.rglob("*.py"):
        names = {name.split(".")[0] for name in imported(path)}
        assert not names & {"pickle", "marshal", "shelve", "dill", "yaml"}, path
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in ("eval", "exec"), path
            if isinstance(node, ast.keyword) and node.arg == "allow_pickle":
                assert isinstance(node.value, ast.Constant) and node.value.value is False, path


def test_docstrings_cite_sections_that_exist():
    titles = set(re.findall(r"^## \d+\. (.+)$", (ROOT / "docs" / "model.md").read_text(), re.M))
    numbers = set(re.findall(r"^## (\d+)\.", (ROOT / "docs" / "model.md").read_text(), re.M))
    cited = 0
    for path in PACKAGE.rglob("*.py"):
        text = re.sub(r"\s+", " ", path.read_text())
        for title in re.findall(r'docs/model\.md, "([^"]+)"', text):
            assert title in titles, f"{path}: docs/model.md has no section {title!r}"
            cited += 1
        for number in re.findall(r"docs/model\.md,? (?:section )(\d+)", text):
            assert number in numbers, f"{path}: docs/model.md has no section {number}"
            cited += 1
    assert cited > 5
