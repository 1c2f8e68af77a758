"""Every plenocli command line in the README, in docs (test_docs runs them) and in the help is
one that the program understands.
"""

import re
import shlex
from pathlib import Path

import pytest

from plenocli.cli.main import COMMANDS, cli

ROOT = Path(__file__).resolve().parents[1]


def joined(text):
    """Text whose lines that end in a backslash go on in the next one."""
    return re.sub(r"\\\n\s*", "", text)


BLOCKS = [
    block
    for page in [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    for block in re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.S | re.M)
]
LINES = sorted(
    {line for block in BLOCKS for line in block.splitlines() if line.startswith("plenocli ")}
)
EXAMPLES = sorted(
    {
        line
        for page in (ROOT / "docs" / "commands").glob("*.md")
        for line in re.findall(r"^ +(plenocli [a-z].*)", joined(page.read_text()), re.M)
    }
)


def test_the_readme_shows_every_command():
    shown = {line.split()[1] for line in LINES}
    assert set(COMMANDS) - shown <= {"schema"}


@pytest.mark.parametrize("line", sorted({*LINES, *EXAMPLES}))
def test_command_lines_parse(line):
    _, name, *arguments = shlex.split(line.partition(" > ")[0])
    command = cli.get_command(None, name)
    if hasattr(command, "commands"):  # a group: its subcommand is what parses
        name, *arguments = arguments
        command = command.commands[name]
    # a click.UsageError for an unknown option or a missing one
    assert command.make_context(name, arguments).params


def test_files_named_in_the_readme_exist():
    text = (ROOT / "README.md").read_text()
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / link).exists(), link
    for name in re.findall(r"\b(?:sample_configs|pipelines|docs)/[\w./]*\w", text):
        assert (ROOT / name).exists(), name
    targets = re.findall(r"^([a-z][a-z0-9-]*):", (ROOT / "Makefile").read_text(), re.M)
    for target in re.findall(r"`make (?:-j2 )?([a-z][\w-]*)`", text):
        assert target in targets, target


def test_python_in_the_documentation_runs(tmp_path, monkeypatch):
    from plenocli.cli.main import run

    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "scientist.md").read_text(), re.S)
    monkeypatch.chdir(tmp_path)
    assert (
        run(
            [
                "simulate-pif",
                str(ROOT / "sample_configs" / "tiny.toml"),
                "--model",
                "ray",
                "--superpixels",
                "3x3",
                "-o",
                "pif.h5",
            ]
        )
        == 0
    )
    for block in blocks:
        names = {}
        exec(block, names)
        assert (
            names["psf"].shape == (13, 13)
            and names["own"].shape == (169, 64)
            and 0.1 < names["psf"].sum() <= 1.001
        )
    assert blocks


def test_places_named_in_the_architecture_and_the_recipes_exist():
    for page in (ROOT / "docs" / "architecture.md", ROOT / "CONTRIBUTING.md"):
        for name in re.findall(r"`((?:\w+/)+[\w.]+)`", page.read_text()):
            places = [ROOT / name, ROOT / "plenocli" / name]
            assert any(place.exists() for place in places), (page.name, name)


def test_the_house_is_drawn_in_forty_lines():
    assert len((ROOT / "docs" / "architecture.md").read_text().splitlines()) <= 45


def test_files_named_in_makefiles_exist():
    for page in (ROOT / "Makefile", *(ROOT / "pipelines").glob("*.mk")):
        named = r"\b(?:tests|pipelines|sample_configs)/[\w./-]+\w"
        for name in re.findall(named, page.read_text()):
            assert (ROOT / name).exists(), (page.name, name)


def test_every_row_of_limits_names_a_test_that_is_there():
    table = (ROOT / "README.md").read_text().partition("## Limits")[2].partition("\n## ")[0]
    rows = [line for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(rows) > 8
    for row in rows:
        *_, last = row.strip("| ").split(" | ")
        named = re.findall(r"`([a-z/_0-9]+\.py)`", last)
        folder = named[0].rpartition("/")[0] if named else ""
        known = [ROOT / "tests" / name for name in named]
        known = [p if "/" in n else ROOT / "tests" / folder / n for p, n in zip(known, named)]
        assert named and all(path.is_file() for path in known), row


def test_each_row_of_the_limits_names_tests_that_are_there():
    rows = (ROOT / "README.md").read_text().partition("\n## Limits\n")[2].partition("\n## ")[0]
    for row in rows.splitlines()[5:]:
        named = re.findall(r"`([\w/]*test_\w+\.py)`", row)
        assert named or not row, row
        for name in named:
            assert any((ROOT / "tests" / room / name).exists() for room in ("", "faults")), name
