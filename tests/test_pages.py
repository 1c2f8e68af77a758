"""The generated pages in docs are those of this program."""

from pathlib import Path

import pytest

from pipelines.pages import pages
from plenocli.cli.main import COMMANDS
from plenocli.files.artefacts.kinds import SCHEMAS

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.mark.parametrize(
    "name, text", pages().items(), ids=lambda v: v if v.endswith(".md") else ""
)
def test_pages_are_up_to_date(name, text):
    assert (DOCS / name).exists() and (DOCS / name).read_text(encoding="utf-8") == text, (
        "run `make docs`"
    )


def test_there_is_a_page_for_every_command_and_a_table_for_every_kind():
    made = pages()
    assert {f"commands/{name}.md" for name in COMMANDS} <= set(made)
    assert (
        all(f"## {kind} (version" in made["files.md"] for kind in SCHEMAS)
        and "plenocli lens import" in made["commands/lens.md"]
    )
    assert sorted(str(p.relative_to(DOCS)) for p in (DOCS / "commands").glob("*.md")) == sorted(
        n for n in made if n.startswith("commands/")
    )
