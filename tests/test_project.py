"""What makes it a project that others can take: its papers agree with each other and with the
package, and nobody is sent to an index for plenocli."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import NoReturn

import pytest

from plenocli import __version__
from plenocli.base.text import how_to_install

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PLACES = ("plenocli", "docs", "pipelines", "sample_configs", "tests")
KINDS = (".py", ".md", ".mk", ".toml", ".txt")
TEXTS = [p for place in PLACES for p in (ROOT / place).rglob("*") if p.suffix in KINDS]
TEXTS += [*ROOT.glob("*.md"), ROOT / "Makefile", ROOT / "sample_configs" / "Makefile"]


def test_version_and_licence_are_the_same_everywhere() -> None:
    cited = dict(
        re.findall(
            r"^(version|license|cff-version): (.+)$", (ROOT / "CITATION.cff").read_text(), re.M
        )
    )
    assert cited == {"version": __version__, "license": PROJECT["license"], "cff-version": "1.2.0"}
    assert re.search(r"^## \[(.+?)\]", (ROOT / "CHANGELOG.md").read_text(), re.M)[1] == __version__
    assert (
        all((ROOT / name).is_file() for name in PROJECT["license-files"])
        and "BSD 3-Clause" in (ROOT / "LICENSE").read_text()
    )


def test_the_citation_is_whole() -> None:
    yaml = pytest.importorskip("yaml")
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(cited) and cited[
        "type"
    ] == "software"
    assert [a["name"] for a in cited["authors"]] == [a["name"] for a in PROJECT["authors"]]
    (paper,) = cited["references"]
    assert paper["title"] == "End-to-end System Model for Plenoptic Cameras"
    assert [a["family-names"] for a in paper["authors"]] == ["Berkner", "Meng", "Shroff", "Tosic"]


def test_what_the_tables_hold_is_in_the_notices() -> None:
    import numpy as np

    (table,) = (ROOT / "plenocli").rglob("tables.npz")
    with np.load(table) as file:
        found = {name.rpartition("/")[0] for name in file.files}
    illuminants = {f"illuminant/{name}" for name in ("A", "D50", "D65", "E")}
    cameras = {"camera/Nikon 5100 (NPL)", "camera/Sigma SDMerill (NPL)"}
    known = {"chart", "surfaces", "observer"} | illuminants | cameras
    assert found == known, "say in THIRD_PARTY.md where it comes from"
    assert "Copyright 2013 Colour Developers" in (ROOT / "THIRD_PARTY.md").read_text()


def test_an_extra_is_installed_by_the_names_of_its_packages() -> None:
    for extra in ("plot", "cluster", "optimise", "lens", "ml"):
        packages = [f"'{package}'" for package in PROJECT["optional-dependencies"][extra]]
        assert how_to_install(extra) == f"pip install {' '.join(packages)}"


def test_without_metadata_the_list_itself_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def none(name: str) -> NoReturn:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", none)
    assert how_to_install("plot") == "install what pyproject.toml lists as plot"


def test_every_hint_is_about_an_extra_that_there_is() -> None:
    call = re.compile(r"how_to_install\(['\"](\w+)['\"]\)")
    code = (path.read_text() for path in (ROOT / "plenocli").rglob("*.py"))
    asked = {extra for text in code for extra in call.findall(text)}
    assert asked and asked <= set(PROJECT["optional-dependencies"])


def test_nobody_is_told_to_install_plenocli_by_its_name() -> None:
    tool, name = (
        r"(pip3?|pipx|uv|conda)( tool)? (install|run|add)",
        r"(?<![\w/.-])plenocli(?![\w/.-])",
    )
    sent = re.compile(rf"{tool} [^\n`]*?{name}")
    assert sent.search("pip install 'plenocli[plot]'") and sent.search("pipx install plenocli")
    assert not sent.search("pip install dist/plenocli-0.2.0-py3-none-any.whl")
    telling = [p for p in TEXTS if sent.search(p.read_text(encoding="utf-8"))]
    assert telling == [ROOT / "tests" / "test_project.py"], "itself only"


def _name(requirement: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[<>=\[ ;]", requirement)[0]).lower()


def test_every_package_of_the_environment_has_one_version_and_its_hashes() -> None:
    """`make env` takes nothing else: requirements.txt is constraints.txt with hashes, and holds
    what pyproject.toml asks for; `make requirements` makes it anew.
    """
    blocks = re.split(r"\n(?=\S)", (ROOT / "requirements.txt").read_text().strip())
    found = {_name(block): block for block in blocks}
    assert len(found) == len(blocks)
    for name, block in found.items():
        hashes = re.findall(r"--hash=sha256:[0-9a-f]{64}\b", block)
        assert hashes and len(hashes) == block.count("--hash"), name
    constraints = (ROOT / "constraints.txt").read_text().split()
    pinned = dict(re.split("==", line) for line in constraints)
    pinned = {_name(name): version for name, version in pinned.items()}
    assert {name: re.search(r"==([^ ;]+)", block)[1] for name, block in found.items()} == {
        name: pinned.get(name) for name in found
    }
    extra = PROJECT["optional-dependencies"]
    asked = PROJECT["dependencies"] + [
        one for name in ("plot", "fast", "ml", "dev") for one in extra[name]
    ]
    assert {_name(one) for one in asked} <= set(found)
    recipe = (ROOT / "Makefile").read_text()
    assert "--require-hashes -r requirements.txt" in recipe and "--no-deps" in recipe
