"""Every shared option once, with its unit and default in its help, and the parameter
types that read units.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from plenocli.base.errors import PlenoError
from plenocli.base.progress import tell
from plenocli.base.text import json_value, printable
from plenocli.base.units import (
    UnitError,
    format_duration,
    format_length,
    parse_bytes,
    parse_decibel,
    parse_duration,
    parse_length,
    parse_number,
    parse_wavelength,
)


class _Quantity(click.ParamType):
    """A number with its unit, read by one of the parsers of plenocli.base.units."""

    def __init__(
        self,
        name: str,
        parse: Callable[[str], float],
        minimum: float | None = None,
        exclusive: bool = False,
        show: Callable[[float], str] = lambda value: format(value, ".12g"),
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> None:
        self.name, self.show = name, show
        self._parse, self._minimum, self._exclusive, self._limits = (
            parse,
            minimum,
            exclusive,
            limits,
        )

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Text in the units that the command line takes; a default that is a
        number stays as it is.
        """
        if not isinstance(value, str):
            return value
        try:
            number = self._parse(value)
        except UnitError as error:
            self.fail(str(error), param, ctx)
        low = self._minimum
        if low is not None and (number < low or (self._exclusive and number == low)):
            self.fail(
                f"{value!r} must be {'above' if self._exclusive else 'at least'} {low:g}",
                param,
                ctx,
            )
        if number and not self._limits[0] <= number <= self._limits[1]:
            self.fail(
                (
                    f"{value!r} is outside {self.show(self._limits[0])} ... "
                    f"{self.show(self._limits[1])}"
                ),
                param,
                ctx,
            )
        return number


# what lies outside the limits is a slip, and would overflow somewhere deep inside
LENGTH = _Quantity(
    "length",
    parse_length,
    0.0,
    exclusive=True,
    show=lambda value: format_length(value).replace(" ", ""),
    limits=(1e-12, 100e-6),
)
DISTANCE = _Quantity(
    "length", parse_length, 0.0, exclusive=True, show=LENGTH.show, limits=(1e-6, 1e6)
)
PLANE = _Quantity("length", parse_length, show=LENGTH.show, limits=(1e-9, 1e6))
WAVELENGTH = _Quantity("length", parse_wavelength, show=LENGTH.show)
DECIBEL = _Quantity(
    "decibel", parse_decibel, show=lambda value: f"{value:.12g}dB", limits=(-300.0, 300.0)
)
LOSS = _Quantity(
    "decibel", parse_decibel, 0.0, exclusive=True, show=DECIBEL.show, limits=(1e-3, 100.0)
)
BYTES = _Quantity("bytes", parse_bytes, 0, exclusive=True)
DURATION = _Quantity(
    "duration",
    parse_duration,
    0.0,
    exclusive=True,
    show=lambda value: format_duration(value).replace(" ", ""),
    limits=(1e-9, 1e6),
)
POSITIVE = _Quantity("number", parse_number, 0.0, exclusive=True, limits=(1e-30, 1e12))
NON_NEGATIVE = _Quantity("number", parse_number, 0.0, limits=(1e-30, 1e12))


def positive(text: str) -> float:
    """A number within the limits of POSITIVE; click's BadParameter otherwise."""
    return POSITIVE.convert(text, None, None)


FRACTION = _Quantity("number", parse_number, 0.0, exclusive=True, limits=(1e-30, 1.0))
SHARE = _Quantity("number", parse_number, 0.0, exclusive=True, limits=(1e-3, 0.5))


class Nodes(click.ParamType):
    """An odd number of places along an axis, or auto where that is on offer."""

    def __init__(self, *, auto: bool) -> None:
        self._auto, self.name = auto, "auto|ODD" if auto else "ODD"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | str:
        """As click.ParamType.convert."""
        if isinstance(value, int) or (self._auto and value == "auto"):
            return value
        if value not in {str(n) for n in range(3, 34, 2)}:
            known = "auto or an odd number" if self._auto else "an odd number"
            self.fail(f"{value!r} is not {known} from 3 to 33, such as 5", param, ctx)
        return int(value)


class Whole(click.IntRange):
    """A whole number within bounds."""

    name = "integer"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """An int; other text is refused with an example."""
        try:
            int(value)
        except ValueError:
            example = max(1, int(self.min or 0))
            self.fail(f"{value!r} is no whole number; write for example {example}", param, ctx)
        return super().convert(value, param, ctx)


class Workers(Whole):
    """How many work at the same time; auto: one for each core that this process may use."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """An int."""
        if value == "auto":
            return len(os.sched_getaffinity(0))
        return super().convert(value, param, ctx)


class Grid(click.ParamType):
    """Two whole numbers such as 3x3, or one of the given words."""

    name = "ROWSxCOLUMNS"

    def __init__(self, *words: str) -> None:
        self._words = words

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, int] | str:
        """(rows, columns), or the word itself."""
        if not isinstance(value, str) or value in self._words:
            return value
        parts = value.lower().split("x")
        if len(parts) == 2 and all(p.isdigit() and 0 < int(p) < 100000 for p in parts):
            return int(parts[0]), int(parts[1])
        self.fail(
            f"{value!r} is not a grid; write for example {'|'.join((*self._words, '3x3'))}",
            param,
            ctx,
        )


class Place(click.ParamType):
    """A row and a column, counted from 0, such as 5,0."""

    name = "ROW,COLUMN"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[int, ...]:
        """(row, column)."""
        parts = value.split(",") if isinstance(value, str) else value
        if len(parts) == 2 and all(str(p).strip().isdigit() and int(p) < 100000 for p in parts):
            return tuple(int(p) for p in parts)
        self.fail(f"{value!r} is no row and column; write for example 5,0", param, ctx)


PLACE = Place()


class Pair(click.ParamType):
    """KEY=VALUE with a length as the key, such as 450nm=capture.h5 or 450nm=0.8."""

    def __init__(self, value_name: str, convert_value: Callable[[str], Any]) -> None:
        self.name, self._convert = f"WAVELENGTH={value_name}", convert_value

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, Any]:
        """(length in m, converted value)."""
        if not isinstance(value, str):
            return value
        key, equals, rest = value.partition("=")
        if not equals or not rest:
            self.fail(
                (
                    f"{value!r} is not {self.name}; write for example "
                    f"450nm={'band450.dng' if self._convert is Path else '0.8'}"
                ),
                param,
                ctx,
            )
        try:
            return parse_wavelength(key), self._convert(rest)
        except (UnitError, ValueError) as error:
            self.fail(str(error), param, ctx)


class Ring(click.ParamType):
    """A whole number of rings, or auto."""

    name = "auto|0|1|2..."

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> int | str:
        """ "auto", or the number."""
        if value == "auto" or isinstance(value, int):
            return value
        if not value.isdigit() or int(value) > 20:
            self.fail(
                f"{value!r} is not auto or a whole number from 0 to 20, such as 1", param, ctx
            )
        return int(value)


class File(click.Path):
    """A path with a name: an empty one, often a shell variable that is not set, would mean
    the current folder, and '-' a stream.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value == "":
            self.fail("the file name is empty", param, ctx)
        if value == "-" and not self.allow_dash:
            self.fail(
                "files are checked and sealed, so that '-' is none of them: name a file (--json "
                "prints a summary to standard output, score -o - its JSON; ./- is a file of that "
                "name)",
                param,
                ctx,
            )
        return super().convert(value, param, ctx)


FILE = File(path_type=Path)


def input_path(name: str, **settings: Any) -> Callable:
    """A positional input file; its existence is checked by the reader, so that the exit code is
    3 and the message says what is wrong.
    """
    return click.argument(name, type=FILE, **settings)


prior = click.option(
    "--prior",
    type=FILE,
    help=(
        "Labelled spectra (as score --classes takes them) whose mean and covariance lmmse starts "
        "from, instead of those of many surfaces."
    ),
)
output = click.option(
    "-o",
    "--output",
    required=True,
    type=FILE,
    metavar="OUT",
    help="File to write; a folder when there are several inputs.",
)
table_output = click.option(
    "-o",
    "--output",
    required=True,
    type=FILE,
    metavar="OUT",
    help="Table to write, .h5; the same goes beside it as .csv.",
)
front_plot = click.option(
    "--plot", type=FILE, help="Also draw the front, such as front.png; needs matplotlib."
)
overwrite = click.option(
    "--overwrite", is_flag=True, help="Replace OUT if it exists (refused by default)."
)
as_json = click.option(
    "--json", "as_json", is_flag=True, help="Print the summary as one line of JSON on stdout."
)
seed = click.option(
    "--seed",
    type=Whole(0, 2**63 - 1),
    default=0,
    show_default=True,
    help="Seed of every random number; the same seed gives the same bytes.",
)
workers = click.option(
    "--workers",
    type=Workers(1, 1024),
    default=1,
    show_default=True,
    help=(
        "Processes or threads to use, or auto: one for each core. The results do not depend on it."
    ),
)
scheduler = click.option(
    "--scheduler",
    metavar="ADDRESS",
    help=(
        "Use the workers of this Dask scheduler instead, such as tcp://10.0.0.1:8786, or the file "
        "it wrote; the results are the same."
    ),
)


def _grant(ctx: click.Context, param: click.Parameter, value: int | None) -> None:
    """What --mem-limit says holds for this process from now on."""
    from dataclasses import replace

    from plenocli.base.budget import budget, machine_budget, set_budget
    from plenocli.base.memory import hold

    memory = machine_budget().memory if value is None else int(value)
    set_budget(replace(budget(), memory=memory))
    hold(memory)


mem_limit = click.option(
    "--mem-limit",
    type=BYTES,
    expose_value=False,
    callback=_grant,
    help=(
        "Memory for data, such as 4GiB; default half of the machine's. What needs more is refused, "
        "and nobody gets more. Interpreter and libraries come on top: 384 MiB, and 80 MiB a core."
    ),
)


coherent_ring = click.option(
    "--coherent-ring",
    type=Ring(),
    default="auto",
    show_default=True,
    help=(
        "Rings of lenslets, beyond those of the superpixels kept and those under the blur, whose "
        "fields are summed too, all on every superpixel; 0 is the paper's isolated lenslet."
    ),
)


def model(help: str) -> Callable:
    """--model, a kind of propagation (those of plenocli.forward.propagation.models)."""
    kinds = click.Choice(["auto", "ray", "fresnel", "exact"])
    return click.option("--model", type=kinds, default="auto", show_default=True, help=help)


def superpixels(meaning: str) -> Callable:
    """--superpixels with its meaning for one command."""
    return click.option(
        "--superpixels",
        type=Grid("auto"),
        default="auto",
        show_default=True,
        help=f"{meaning}: auto, 1x1, 3x3.",
    )


def file_type(first: str, second: str) -> Callable:
    """--format, the suffix of each result where OUT is a folder; the first is the default."""
    return click.option(
        "--format",
        "suffix",
        type=click.Choice([first, second]),
        default=first,
        show_default=True,
        help="File type when OUT is a folder.",
    )


def device(what: str) -> Callable:
    """--device, where a command's large arrays are; what: is done there, for its help."""
    return click.option(
        "--device",
        type=click.Choice(["cpu", "cuda"]),
        default="cpu",
        show_default=True,
        help=f"{what}; cuda is a graphics card, by PyTorch.",
    )


def command_line(ctx: click.Context) -> str:
    """The command as typed, without folders and without options left at their default: it goes
    into the artefact.
    """
    words = [f"plenocli {ctx.info_name}"]
    for parameter in ctx.command.params:
        value: Any = ctx.params.get(parameter.name or "")
        source = ctx.get_parameter_source(parameter.name)
        if source is None or source.name == "DEFAULT" or parameter.name in _UNRECORDED:
            continue
        for one in value if parameter.multiple or parameter.nargs == -1 else [value]:
            flag = [] if isinstance(parameter, click.Argument) else [parameter.opts[-1]]
            words += flag if one is True else [*flag, _word(one, parameter.type)]
    return printable(" ".join(words))


_UNRECORDED = {
    "overwrite",
    "as_json",
    "workers",
    "mem_limit",
    "output",
    "scene_out",
    "explain",
    "report",
    "measures",
    "scheduler",
    "plot",
}
"""How a file was made, not what it holds: the same inputs give the same bytes
whatever these say.
"""


def _word(value: Any, kind: click.ParamType | None) -> str:
    if isinstance(value, Path) or (isinstance(value, str) and "/" in value):
        return Path(value).name
    if isinstance(kind, Grid) and isinstance(value, tuple):
        return "x".join(map(str, value))
    if isinstance(kind, Pair):
        return f"{LENGTH.show(value[0])}={_word(value[1], None)}"
    if isinstance(kind, _Quantity):
        return kind.show(value)
    return format(value, ".12g") if isinstance(value, float) else str(value)


@contextmanager
def partly_told(as_json: bool) -> Iterator[None]:
    """Where a batch fails in part, print what it did as JSON on request, before its error."""
    from plenocli.execution.batch import PartialFailure

    try:
        yield
    except PlenoError as error:
        if as_json and isinstance(error.__cause__, PartialFailure):
            summary(error.__cause__.as_json(), as_json, "")
        raise


def summary(report: dict[str, Any], as_json: bool, line: str) -> None:
    """Print what a command did: `report` as JSON on request, else the one `line`."""
    if as_json:
        tell(json.dumps(json_value(report), allow_nan=False, sort_keys=True))
    else:
        tell(line)
