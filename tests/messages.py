"""Where plenocli makes a message for its user, and at which of these places a test was."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "plenocli"
MAKERS = re.compile(
    r"(\w+\.)?(UsageError|ConfigError|InputError|OutputError|NumericsError|BadParameter|"
    r"fail|require|require_reading|require_declared)"
)


@cache
def all_places():
    """ "file:first line" -> last line of every statement of the package that makes a message."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and MAKERS.fullmatch(ast.unparse(node.func)):
                found[f"{path.relative_to(PACKAGE)}:{node.lineno}"] = node.end_lineno
    return found


def shown_places(reached):
    """Which of all_places are among "file:line" words; other words do not count."""
    lines = {
        (file, int(line))
        for file, _, line in (word.rpartition(":") for word in reached if ":" in word)
    }
    return {
        place
        for place, last in all_places().items()
        for file, _, first in [place.rpartition(":")]
        if any((file, n) in lines for n in range(int(first), last + 1))
    }


def listen(tell):
    """From now on every message that is made says tell("file:line") for each frame of the
    package on its way.
    """
    import click

    from plenocli.base.errors import PlenoError

    home = f"{PACKAGE}/"

    def noted(real):
        def make(self, *arguments, **named):
            frame = sys._getframe(1)
            while frame:
                if frame.f_code.co_filename.startswith(home):
                    tell(f"{frame.f_code.co_filename.removeprefix(home)}:{frame.f_lineno}")
                frame = frame.f_back
            real(self, *arguments, **named)

        return make

    for kind in (PlenoError, click.UsageError):
        kind.__init__ = noted(kind.__init__)
