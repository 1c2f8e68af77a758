"""The options of other commands as sections of a file hold them: [reconstruct] method = "lmmse"
is --method lmmse.
"""

import difflib
from collections.abc import Mapping
from typing import Any

import click

from plenocli.base.errors import UsageError
from plenocli.base.text import shown
from plenocli.cli.commands import load_command

_OURS = {
    "output",
    "overwrite",
    "as_json",
    "workers",
    "scheduler",
    "mem_limit",
    "explain",
    "suffix",
    "report",
    "metrics",
    "scene_out",
    "pif",
    "calibration",
    "truth",
    "reference",
    "camera",
    "grid",
    "whites",
    "darks",
    "bands",
    "radiances",
    "patches",
    "capture",
    "block",
    "near",
}
"""What a chain of stages gives its stages by itself."""


def read_options(stage: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The options of a command, checked and converted as on its command line.

    stage: the command.
    values: option without dashes -> text, number, true or false, or a list for an option
        that may be repeated.

    Returns parameter name -> value.
    Raises UsageError for what the command line would refuse.
    """
    command = load_command(stage)
    known = {
        name.lstrip("-"): p
        for p in command.params
        if isinstance(p, click.Option) and p.name not in _OURS
        for name in p.opts
    }
    found = {}
    for name, value in values.items():
        where = f"{stage}.{name}"
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            raise UsageError(
                "unknown option; "
                + (f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}"),
                where,
            )
        found[known[name].name] = _converted(known[name], value, where)
    return found


def _converted(option: click.Option, value: Any, where: str) -> Any:
    if option.is_flag:
        if not isinstance(value, bool):
            raise UsageError(
                f"{shown(value)} is not true or false", where, "write it without quotes"
            )
        return value
    if isinstance(value, (bool, dict)):
        raise UsageError(
            f"{shown(value)} is neither text nor a number",
            where,
            f"write one; {option.name.replace('_', '-')} is: {option.help}",
        )
    if isinstance(value, list) != option.multiple:
        raise UsageError(
            f"{shown(value)} is {'a list' if isinstance(value, list) else 'no list'}",
            where,
            "give a list" if option.multiple else "give one value",
        )
    try:
        made = [
            option.type.convert(str(v), option, None)
            for v in (value if option.multiple else [value])
        ]
    except click.UsageError as error:
        raise UsageError(error.message.rstrip("."), where, option.help) from None
    return tuple(made) if option.multiple else made[0]
