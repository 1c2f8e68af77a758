"""Values as JSON knows them, shapes and values as a person writes them, and commands that install
what is missing.
"""

import json
import math
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, is_dataclass
from typing import Any


@dataclass(frozen=True)
class Record:
    """What stands in artefacts and summaries as its fields by name."""

    def as_json(self) -> dict[str, Any]:
        """The fields by name."""
        return {field.name: _by_name(getattr(self, field.name)) for field in fields(self)}


def _by_name(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_by_name(item) for item in value]
    if hasattr(value, "as_json"):
        return value.as_json()
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else value


def json_value(value: Any) -> Any:
    """A copy without what JSON lacks: arrays become lists, paths text, and numbers that are not
    finite None (an infinite PSNR: no error at all).
    """
    if isinstance(value, dict):
        return {printable(str(key)): json_value(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_value(item) for item in value]
    if hasattr(value, "tolist"):
        return json_value(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, (int, type(None))):
        return value
    return printable_lines(str(value))


def printable(text: str, keep: str = "") -> str:
    """Text that a terminal, a page or a file can take: what controls a terminal (ESC, line breaks,
    marks that turn the direction of writing) and bytes of a name that are no UTF-8 are shown
    escaped, as Python writes them; `keep`: characters that stay.
    """
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c in keep else _escaped(c) for c in text)


def printable_lines(text: str) -> str:
    """`printable`, but for line breaks and tabs."""
    return printable(text, keep="\n\t")


def utf8(text: str) -> bytes:
    """Text for a file; bytes of a name that are no UTF-8 are written as \\udcXX."""
    return text.encode("utf-8", "backslashreplace")


def _escaped(character: str) -> str:
    lone_byte = 0xDC80 <= ord(character) <= 0xDCFF  # how Python keeps a byte that is no UTF-8
    return f"\\x{ord(character) - 0xDC00:02x}" if lone_byte else ascii(character)[1:-1]


def counted(count: int, what: str) -> str:
    """`count` of something, whose plural has an s."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def by(shape: Iterable[int]) -> str:
    """ "4 x 6" of (4, 6)."""
    return " x ".join(str(int(n)) for n in shape)


def shown(value: object) -> str:
    """A value of a TOML file as it may stand there."""
    return json.dumps(value, ensure_ascii=False, default=str)


def how_to_install(extra: str) -> str:
    """The command that installs the packages of an extra, by their own names and least versions.

    extra: a name of [project.optional-dependencies], such as "plot".

    Returns text such as "pip install 'matplotlib>=3.9'".
    The name plenocli is never in it: on an index it could be anybody's.
    """
    from importlib import metadata

    try:
        declared = metadata.requires("plenocli") or []
    except metadata.PackageNotFoundError:  # run from its sources
        declared = []
    parted = (line.partition(";") for line in declared)
    wanted = re.compile(rf"\bextra == ['\"]{re.escape(extra)}['\"]")
    found = [f"'{package.strip()}'" for package, _, marker in parted if wanted.search(marker)]
    if not found:
        return f"install what pyproject.toml lists as {extra}"
    return f"pip install {' '.join(found)}"
