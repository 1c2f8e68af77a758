"""plenocli init: what it writes is what the repository holds, and it takes nothing away."""

import json
from pathlib import Path

import pytest

from plenocli.cli.main import run
from plenocli.stages.forward.init import samples

ROOT = Path(__file__).resolve().parents[2]
HOME = ROOT / "sample_configs"
FOUND = [path for part in ("*.toml", "*/*.toml", "*/*.csv") for path in HOME.glob(part)]
SAMPLES = {str(p.relative_to(HOME)): p.read_bytes() for p in FOUND}


def test_the_samples_are_those_of_the_repository_and_the_makefile_comes_last() -> None:
    found = {sample.name: sample.content for sample in samples()}
    assert list(found)[-1] == "Makefile" and len(found) > 10
    assert found == SAMPLES | {"Makefile": (HOME / "Makefile").read_bytes()}


@pytest.mark.parametrize(
    "words, folder", [([], "plenocli-start"), (["mine"], "mine"), (["."], ".")]
)
def test_the_files_are_written_and_listed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: list[str],
    folder: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(["init", *words, "--json"]) == 0
    made = json.loads(capfd.readouterr().out)
    assert made["folder"] == folder and set(made["files"]) == {*SAMPLES, "Makefile"}
    there = {p: p.read_bytes() for p in (tmp_path / folder).rglob("*") if p.is_file()}
    written = {str(p.relative_to(tmp_path / folder)): text for p, text in there.items()}
    assert set(written) == set(made["files"]) and written.items() >= SAMPLES.items()
    assert run(["simulate-pif", f"{folder}/tiny.toml", "--explain"]) == 0


def test_a_file_that_is_there_stays_and_nothing_is_written_beside_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lenses").mkdir()
    mine = tmp_path / "lenses" / "triplet.toml"
    mine.write_text("mine")
    assert run(["init", "."]) == 2
    assert "lenses/triplet.toml: exists already; pass --overwrite" in capfd.readouterr().err
    assert sorted(tmp_path.rglob("*")) == [mine.parent, mine] and mine.read_text() == "mine"
    assert run(["init", ".", "--overwrite"]) == 0
    assert mine.read_bytes() == SAMPLES["lenses/triplet.toml"]


REFUSED = [("a/b", None), ("a", "a"), ("a", "a/lenses"), ("a", "a/tiny.toml/x"), ("x" * 300, None)]


@pytest.mark.parametrize("name, there", REFUSED)
def test_a_folder_that_cannot_be_is_refused(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
    there: str | None,
) -> None:
    monkeypatch.chdir(tmp_path)
    if there:
        (tmp_path / there).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / there).write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert run(["init", name]) == 4 and "folder" in capfd.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


def test_an_installation_without_samples_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("plenocli.stages.forward.init.files", lambda package: tmp_path)
    assert run(["init", str(tmp_path / "start")]) == 3
    assert "samples: is missing in this installation" in capfd.readouterr().err
