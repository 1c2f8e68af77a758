"""TOML text against a pydantic class: every violation in words, with its path and the
nearest known key.
"""

import re
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from plenocli.base.errors import ConfigError

_NAME = r"""(?:"[^"\n]*"|'[^'\n]*'|[\w-]+)"""


_DEEP_KEY = re.compile(rf"^\s*\[{{0,2}}\s*{_NAME}(?:\s*\.\s*{_NAME}){{20}}", re.MULTILINE)


_DOTTED = rf"({_NAME}(?:\s*\.\s*{_NAME})*)"
_TABLE = re.compile(rf"\s*(\[{{1,2}})\s*{_DOTTED}\s*\]{{1,2}}\s*(?:#.*)?$")
_KEY = re.compile(rf"\s*{_DOTTED}\s*=")


_MOST_LINES = 40

Model = TypeVar("Model", bound=BaseModel)


def parse_toml(
    text: str,
    where: object,
    model: type[Model],
    *,
    prepare: Callable[[dict[str, Any]], dict[str, Any]] = lambda data: data,
) -> Model:
    """What a pydantic class makes of TOML text.

    text: TOML.
    where: the file, for messages.
    model: the class.
    prepare: what is made of the tables before the class sees them.

    Raises ConfigError that lists every violation with its path.
    """
    if _DEEP_KEY.search(text):  # the standard parser takes time as the square of the depth
        raise ConfigError("is nested too deep", where, "mend the line")
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise ConfigError("is nested too deep", where, "mend the line") from None
    except ValueError as error:  # also a number with too many digits
        raise ConfigError(f"is not TOML: {_short(str(error))}", where, "mend the line") from None
    try:
        return model.model_validate(prepare(data))
    except ValidationError as error:
        raise violations(error, where, model, text) from None


def violations(
    error: ValidationError, where: object, model: type[BaseModel], text: str = ""
) -> ConfigError:
    """The ConfigError that lists everything a pydantic ValidationError found, with its line.

    text: the TOML, empty where the tables came from elsewhere.
    """
    line_of = _lines(text)
    found = error.errors()
    within = Counter(e["loc"][:-1] for e in found)
    # a list whose items are all wrong is not too short beside that
    found = [e for e in found if not (e["type"] == "too_short" and within[e["loc"]])]
    lines = [_short(_sentence(e, model)) + _on_line(e["loc"], line_of) for e in found]
    count = f"{len(lines)} {'violation' if len(lines) == 1 else 'violations'}"
    if len(lines) > _MOST_LINES:
        lines[_MOST_LINES:] = ["..."]
    return ConfigError(f"{count}\n  " + "\n  ".join(lines), where)


def _short(text: str) -> str:
    """A message that quotes what may be a megabyte, in a few lines."""
    return text if len(text) <= 400 else f"{text[:200]} ... {text[-150:]}"


def _sentence(error: Any, model: type[BaseModel]) -> str:
    """One violation in words: path, what is wrong, and the nearest known key
    where a key is unknown.
    """
    path = [str(p) for p in error["loc"]]
    if error["type"] == "extra_forbidden":
        import difflib

        known = known_keys(path[:-1], model)
        near = difflib.get_close_matches(path[-1], known, 1, 0.5)
        hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}"
        return f"{'.'.join(path)}: unknown key; {hint}"
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "missing":
        message = "is missing"
    return f"{'.'.join(path) or model.__name__.lower()}: {message}"


def _lines(text: str) -> dict[tuple[str, ...], int]:
    """Numbers of the lines on which tables and keys of TOML text first stand, by their names and,
    for one of an array of tables, its place in it.
    """
    found: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    arrays: Counter[tuple[str, ...]] = Counter()
    for number, line in enumerate(text.splitlines(), 1):
        if header := _TABLE.match(line):
            table = name = _names(header[2])
            if header[1] == "[[":
                table = name = (*name, str(arrays[name]))
                arrays[name[:-1]] += 1
        elif key := _KEY.match(line):
            name = table + _names(key[1])
        else:
            continue
        found.setdefault(name, number)
    return found


def _names(dotted: str) -> tuple[str, ...]:
    return tuple(name.strip("\"'") for name in re.findall(_NAME, dotted))


def _on_line(path: Sequence[str | int], line_of: Mapping[tuple[str, ...], int]) -> str:
    """The line of the key that a violation is about, or of what holds it: nothing where it is not
    told by name.
    """
    names = tuple(map(str, path))
    found = (line_of.get(names[:n]) for n in range(len(names), 0, -1))
    number = next((n for n in found if n), None)
    return "" if number is None else f" (line {number})"


def known_keys(path: list[str], model: type[BaseModel]) -> list[str]:
    """Names that a section knows; `path` as in a pydantic error location."""
    for name in path:
        if name.isdigit() or name not in model.model_fields:
            continue
        kinds = [
            a
            for a in _leaves(model.model_fields[name].annotation)
            if isinstance(a, type) and issubclass(a, BaseModel)
        ]
        model = kinds[0] if kinds else model
    return list(model.model_fields)


def _leaves(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", ())
    return [leaf for a in arguments for leaf in _leaves(a)] if arguments else [annotation]
