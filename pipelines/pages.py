"""The documentation's pages that come from the program itself: one for each command from its help,
one of the file format from its tables.

`make docs` writes them; a test compares them with the program.
"""

import sys
from pathlib import Path

import click

from plenocli.cli.main import COMMANDS, Pipeline, cli


def pages():
    """Relative path -> Markdown text of every generated page."""
    from plenocli.files.artefacts.kinds import SCHEMAS
    from plenocli.files.artefacts.schema import markdown

    made = {f"commands/{name}.md": _page(name) for name in COMMANDS}
    links = "\n".join(
        f"- [{name}]({name}.md): {_command(name).get_short_help_str(200)}" for name in COMMANDS
    )
    made["commands/README.md"] = (
        f"# Commands\n\nIn the order of the pipeline; each has `--help`.\n\n{links}\n"
    )
    made["files.md"] = markdown(SCHEMAS)
    return made


def _command(name):
    return Pipeline.get_command(cli, click.Context(cli), name)


def _page(name):
    parts = [f"# plenocli {name}"]
    for words, command in _leaves(_command(name), (name,)):
        context = click.Context(
            command,
            info_name=" ".join(("plenocli", *words)),
            max_content_width=110,
            terminal_width=110,
        )
        if len(words) > 1:
            parts.append(f"## plenocli {' '.join(words)}")
        parts.append(f"```text\n{command.get_help(context)}\n```")
    return "\n\n".join(parts) + "\n"


def _leaves(command, words):
    found = [(words, command)]
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            found += _leaves(command.get_command(click.Context(command), name), (*words, name))
    return found


def main(folder):
    """Write every page below `folder`."""
    for name, text in pages().items():
        path = Path(folder) / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1])
