"""Every example of every --help: all are parsed, and demux's run on small files."""

import shlex
import shutil
from pathlib import Path

import click
import pytest

from plenocli.cli.main import cli


def commands(group, context, words=()):
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if isinstance(command, click.Group):
            yield from commands(command, context, (*words, name))
        else:
            yield (*words, name), command


def examples():
    """(command line's words, its command), one for each example."""
    for words, command in commands(cli, click.Context(cli)):
        text = (command.help or "").replace("\\\n", " ")
        for line in text.splitlines():
            if line.split()[: len(words) + 1] == ["plenocli", *words]:
                found = shlex.split(line.split(" > ")[0])
                yield found[1:], found[1 + len(words) :], command


EXAMPLES = list(examples())


def test_there_are_examples_of_nearly_all_commands():
    assert len(EXAMPLES) > 40


@pytest.mark.parametrize(("line", "arguments", "command"), EXAMPLES, ids=lambda v: None)
def test_an_example_is_parsed(line, arguments, command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = [word.replace("*", "1") for word in arguments]
    for word in arguments:
        path = Path(word.split("=")[-1])
        if not word.startswith("-") and ":" not in word:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.suffix and not path.exists():
                path.touch()
            elif not path.suffix:
                path.mkdir(exist_ok=True)
    assert command.make_context(" ".join(line), arguments).params


DEMUX = [line for line, *_ in EXAMPLES if line[0] == "demux" and "--scheduler" not in line]


@pytest.mark.parametrize("line", DEMUX, ids=" ".join)
def test_an_example_of_demux_runs(line, stages, runner, tmp_path):
    folder, _ = stages
    (tmp_path / "captures").mkdir()
    shutil.copy(folder / "calibration.h5", tmp_path / "cal.h5")
    shutil.copy(folder / "colour.toml", tmp_path / "camera.toml")
    shutil.copy(folder / "white.dng", tmp_path / "white.dng")
    for name in ("chart.dng", "captures/1.dng", "captures/2.dng"):
        shutil.copy(folder / "colorchecker.dng", tmp_path / name)
    (tmp_path / "paints.csv").write_text("nm,rust,moss\n400,0.1,0.2\n700,0.6,0.3\n")
    words = [word.replace(".NEF", ".dng") for word in line]
    found = [p for w in words for p in (sorted(tmp_path.glob(w)) if "*" in w else [w])]
    outcome = runner.run(found, tmp_path, limit=120)
    assert outcome.code == 0, outcome.text
