"""The house: rooms bottom to top without circles, kernels touch no files, the help
imports nothing heavy.
"""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "plenocli"
ROOMS = (
    "base",
    "forward",
    "inverse",
    "evaluation",
    "files",
    "report",
    "execution",
    "stages",
    "api",
    "cli",
)
"""Bottom to top: a room imports from itself and from those before it."""
KERNELS = ("forward", "inverse", "evaluation")
FILE_LIBRARIES = {
    "h5py",
    "click",
    "OpenImageIO",
    "OpenEXR",
    "rawpy",
    "exifread",
    "tqdm",
    "tifffile",
    "imageio",
    "PIL",
}
MOST_MODULES, MOST_LEVELS = 12, 2
PENDING: set[tuple[str, str]] = set()
"""Arrows up that are being taken away; none may be added."""


@cache
def nodes(path):
    """Imports, calls and named arguments at any depth of a module's code, which is read once."""
    kinds = (ast.Import, ast.ImportFrom, ast.Call, ast.keyword)
    return [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, kinds)]


@cache
def imported(path):
    """Absolute names of everything a module imports, at any depth of its code, and of the modules
    beside it that it names to `later`.
    """
    names = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: relative import"
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "id", None) == "later":
            names |= {f"{name_of(path.parent)}.{a.value}" for a in node.args[:1]}
    return frozenset(names)


def modules(*rooms):
    """Files of these rooms (all of the package without any)."""
    places = [PACKAGE / room for room in rooms] or [PACKAGE]
    return [
        path
        for place in places
        for path in (
            [place.with_suffix(".py")]
            if place.with_suffix(".py").is_file()
            else sorted(place.rglob("*.py"))
        )
    ]


def name_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def arrows():
    """Module -> the modules of the package that it imports anywhere in its code; a package
    counts by its __init__.
    """
    known = {name_of(path): path for path in modules()}
    return {
        name: {
            n for n in imported(path) if n in known and n != name and known[n].name != "__init__.py"
        }
        for name, path in known.items()
    }


def circles(graph):
    """Sets of modules that reach each other."""
    reach = {}
    for start in graph:
        seen, todo = set(), list(graph[start])
        while todo:
            name = todo.pop()
            if name not in seen:
                seen.add(name)
                todo += graph.get(name, ())
        reach[start] = seen
    return {frozenset(b for b in reach[a] if a in reach[b]) for a in graph if a in reach[a]}


def room(name):
    return name.split(".")[1] if name.count(".") else ""


def test_every_room_is_known_and_says_what_belongs_in_it():
    found = {
        path.name if path.is_dir() else path.stem
        for path in PACKAGE.iterdir()
        if path.name[0] != "_" and ((path / "__init__.py").is_file() or path.suffix == ".py")
    }
    assert found <= set(ROOMS)
    for folder in {path.parent for path in modules()} - {PACKAGE}:
        text = ast.get_docstring(ast.parse((folder / "__init__.py").read_text()))
        assert text and 2 <= len(text.splitlines()) <= 5, folder


def test_rooms_are_small_and_shallow():
    for folder in {path.parent for path in modules()}:
        assert len(folder.relative_to(PACKAGE).parts) <= 1 + MOST_LEVELS, folder
        files = [path for path in folder.glob("*.py") if not path.name.startswith("__")]
        assert len(files) <= MOST_MODULES, (folder, len(files))


def test_no_arrow_points_up():
    up = {
        (a, b)
        for a, targets in arrows().items()
        for b in targets
        if room(a) in ROOMS and room(b) in ROOMS and ROOMS.index(room(b)) > ROOMS.index(room(a))
    }
    assert up == PENDING


def test_no_circles():
    assert circles(arrows()) == set()


def test_the_guards_see_what_they_must_refuse(tmp_path):
    bad = tmp_path / "kernel.py"
    bad.write_text("def f():\n    import h5py\n    from plenocli.files.atomic import publish\n")
    assert {"h5py", "plenocli.files.atomic", "plenocli.files.atomic.publish"} <= imported(bad)
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"d"}}) == {
        frozenset("bc"),
        frozenset("d"),
    }


@pytest.mark.parametrize("path", modules(*KERNELS), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_kernels_touch_no_files(path):
    assert not {name.split(".")[0] for name in imported(path)} & FILE_LIBRARIES


@pytest.mark.parametrize("path", modules("cli"), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_commands_only_parse(path):
    allowed = {
        "plenocli.forward.scene.white_reference",
        "plenocli.forward.camera.model",
        "plenocli.forward.camera.microscope",
    }
    names = {n for n in imported(path) if any(n == a or n.startswith(a + ".") for a in allowed)}
    assert not {room(name) for name in imported(path) - names if name.startswith("plenocli.")} & {
        *KERNELS,
        "report",
    }


HEAVY = (
    "numpy",
    "scipy",
    "h5py",
    "colour",
    "matplotlib",
    "pydantic",
    "skimage",
    "rawpy",
    "OpenImageIO",
    "numba",
    "tqdm",
    "distributed",
    "optuna",
)


@pytest.mark.parametrize(
    "command",
    [
        "",
        "simulate-pif",
        "simulate-response",
        "capture-sim",
        "calibrate",
        "demux",
        "learn-dict",
        "reconstruct",
        "score",
        "report",
        "sweep",
        "optimise",
        "inspect",
        "lens",
        "schema",
    ],
)
def test_help_imports_nothing_heavy(command):
    code = (
        "import sys; from plenocli.cli.main import run\n"
        f"assert run({[command, '--help'] if command else ['--help']!r}) == 0\n"
        f"print('HEAVY', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True
    )
    assert done.stdout.splitlines()[-1] == "HEAVY []"
    assert "Usage: plenocli" in done.stdout


def test_no_unsafe_loader_anywhere():
    for path in PACKAGE.rglob("*.py"):
        names = {name.split(".")[0] for name in imported(path)}
        assert not names & {"pickle", "marshal", "shelve", "dill", "yaml"}, path
        for node in nodes(path):
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
