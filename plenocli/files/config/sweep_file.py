"""A sweep: which camera, which of its keys and of the stages' options vary, over what, and
what counts as better.

Every point of the design space is a plain dict of dotted keys and values as they would stand in a
camera file ("main_lens.f_number") or on a command line ("reconstruct.method"). Nothing here
computes optics or opens another file.
"""

import difflib
import re
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, ValidationError, model_validator

from plenocli.base.errors import ConfigError
from plenocli.base.quantities import FileName, Section
from plenocli.base.text import shown
from plenocli.base.toml import known_keys, parse_toml
from plenocli.base.units import (
    UnitError,
    format_duration,
    format_length,
    parse_duration,
    parse_length,
)
from plenocli.files.artefacts.schema import FURTHEST
from plenocli.files.config.toml_file import read_text
from plenocli.forward.camera.microscope import Microscope
from plenocli.forward.camera.model import Camera

STAGES = (
    "simulate-pif",
    "capture-sim",
    "reconstruct",
    "simulate-response",
    "calibrate",
    "demux",
    "refocus",
    "volume",
    "score",
)
"""Stages whose options may be set and varied."""
MAX_POINTS = 100_000
DIGITS = 9
"""Significant digits of values between the ends of a range, so that a table reads well."""

_UNITLESS = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s]\S*)\s*")
_ALTERNATIVES = (
    ("main_lens", "aperture_diameter", "f_number"),
    ("lenslet_array", "pitch", "superpixel_pitch"),
    ("light", "wavelengths", "band"),
)
_RANGE = {"from", "to", "steps", "scale", "whole"}


class Range(Section):
    """Values between two ends, which carry the same unit.

    low, high: the ends, "from" and "to" in the file; numbers, or text with a unit.
    steps: how many (a grid needs it).
    scale: how they are spaced.
    whole: whole numbers.
    """

    low: Annotated[Any, Field(alias="from")]
    high: Annotated[Any, Field(alias="to")]
    steps: Annotated[int, Field(ge=2, le=10_000)] | None = None
    scale: Literal["linear", "log"] = "linear"
    whole: bool = False

    @model_validator(mode="after")
    def _ends(self) -> Self:
        (low, unit), (high, other) = _measure(self.low), _measure(self.high)
        if unit != other:
            raise ValueError(f"{self.low!r} and {self.high!r} are not of one kind")
        if not low < high:
            raise ValueError(
                "a range runs from the smaller to the larger value, not from "
                f"{self.low!r} to {self.high!r}"
            )
        if self.scale == "log" and low <= 0:
            raise ValueError(f"a range on a logarithmic scale starts above 0, not at {self.low!r}")
        if self.whole and (unit is not None or low != int(low) or high != int(high)):
            raise ValueError("whole = true goes with whole numbers without a unit")
        return self

    def at(self, share: float) -> Any:
        """The value at a share 0 ... 1 of the way; the nearest step where steps are given."""
        (low, unit), (high, _) = _measure(self.low), _measure(self.high)
        if self.steps is not None:
            share = min(int(share * self.steps), self.steps - 1) / (self.steps - 1)
        elif self.whole:  # each number an equal part
            low, high = low - 0.5 * (self.scale == "linear"), high + 0.5 * (self.scale == "linear")
        value = low * (high / low) ** share if self.scale == "log" else low + (high - low) * share
        if self.whole:
            ends = (int(_measure(self.low)[0]), int(_measure(self.high)[0]))
            return min(max(int(np.floor(value + 0.5)), ends[0]), ends[1])
        return _written(float(f"{value:.{DIGITS}g}"), unit)

    def levels(self) -> list[Any]:
        """The steps in order, each once."""
        shares = () if self.steps is None else (np.arange(self.steps) + 0.5) / self.steps
        return list(dict.fromkeys(self.at(float(share)) for share in shares))


class Choice:
    """One of several values, in the order given."""

    def __init__(self, values: Sequence[Any]) -> None:
        """values: at least one."""
        self.values = values

    def at(self, share: float) -> Any:
        """The value at a share 0 ... 1 of the list."""
        return self.values[min(int(share * len(self.values)), len(self.values) - 1)]

    def levels(self) -> list[Any]:
        """All values."""
        return list(self.values)


Axis = Range | Choice
"""The values of a key that varies."""


class Sweep(Section):
    """The description as it stands in the file; `vary`, `set` and `follow` flat, by dotted key.

    camera: the file that all points start from, relative to this one.
    chain: "spatial" (simulate-pif, capture-sim, reconstruct, score) or "spectral" (simulate-pif,
        capture-sim, simulate-response or calibrate, demux, score); default by whether the camera
        has a filter array. "joint" (both: a chart demultiplexed and a picture reconstructed in
        bands), "expected" (simulate-response and what it lets expect of score's classes, nothing
        captured) and "depth" (capture-sim, refocus, score) only where it is named; "volume"
        (simulate-pif, capture-sim, volume, score) where the camera has an [objective].
    design: how points are chosen.
    samples: how many points a Latin hypercube has.
    vary: key -> values or range.
    point: the points of a list, key -> value each.
    set: key -> value at all points.
    follow: keys computed from others, products and quotients of keys and numbers.
    front: what counts as better, metric -> min or max.
    options: stage -> option -> value, in the file sections named like the commands.
    """

    camera: FileName
    chain: Literal["spatial", "spectral", "joint", "expected", "depth", "volume"] | None = None
    design: Literal["grid", "latin-hypercube", "list"] = "grid"
    samples: Annotated[int, Field(ge=1, le=MAX_POINTS)] | None = None
    vary: dict[str, Any] = {}
    point: tuple[dict[str, Any], ...] = ()
    set: dict[str, Any] = {}
    follow: dict[str, Any] = {}
    front: dict[str, Literal["min", "max"]] = {}
    options: dict[str, dict[str, Any]] = {}

    @model_validator(mode="before")
    @classmethod
    def _sections(cls, data: Any) -> dict[str, Any]:
        data = dict(data)
        options = {stage: data.pop(stage) for stage in STAGES if stage in data}
        known = [name for name in cls.model_fields if name != "options"] + list(STAGES)
        for name in data:
            if name not in known:
                near = difflib.get_close_matches(name, known, 1, 0.5)
                raise ValueError(
                    f"{name}: unknown key; "
                    + (f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}")
                )
        wrong = [stage for stage, values in options.items() if not isinstance(values, dict)]
        if wrong:
            raise ValueError(f"{wrong[0]} is a section of options, such as [{wrong[0]}]")
        for name in ("vary", "set", "follow"):
            if isinstance(data.get(name), dict):
                data[name] = _flat(data[name])
        if isinstance(data.get("point"), list):
            data["point"] = [_flat(p) if isinstance(p, dict) else p for p in data["point"]]
        return data | {"options": options}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.design == "list") != bool(self.point):
            raise ValueError('[[point]] sections go with design = "list", and only with it')
        if self.design == "list" and self.vary:
            raise ValueError('design = "list" takes its values from [[point]]; leave [vary] out')
        if self.design != "list" and not self.vary:
            raise ValueError("[vary] is missing: name at least one key and its values")
        if (self.samples is not None) != (self.design == "latin-hypercube"):
            raise ValueError(
                'samples (how many points) goes with design = "latin-hypercube", and only with it'
            )
        overlap = [key for key in self.varied if key in self.follow]
        if overlap:
            raise ValueError(f"{overlap[0]} both varies and follows other keys")
        return self

    @property
    def varied(self) -> list[str]:
        """The keys that differ between points, in the order of the file."""
        return (
            list(self.vary)
            if self.vary
            else list(dict.fromkeys(key for point in self.point for key in point))
        )


def load_sweep(path: str | Path) -> tuple[Sweep, dict[str, Axis]]:
    """Read and check a sweep.

    path: of the TOML file.

    Returns (the description, the values of each key that varies).
    Raises InputError where the file cannot be read, ConfigError for what it says.
    """
    path = Path(path)
    sweep = parse_toml(read_text(path, "sweep"), path, Sweep)
    problems = [p for key in (*sweep.varied, *sweep.set, *sweep.follow) if (p := unknown_key(key))]
    axes = {}
    for key, values in sweep.vary.items():
        try:
            axes[key] = _axis(values)
        except (ValueError, UnitError) as error:
            problems.append(f"vary.{key}: {_said(error)}")
    if problems:
        raise ConfigError(
            f"{len(problems)} violation{'s'[: len(problems) > 1]}\n  " + "\n  ".join(problems), path
        )
    return sweep, axes


def points(sweep: Sweep, axes: Mapping[str, Axis], seed: int = 0) -> list[dict[str, Any]]:
    """The points of the design in order.

    A grid lists the last key fastest. A Latin hypercube (McKay et al. 1979) cuts every axis into
    `samples` equal parts and takes each part once.

    sweep: the description.
    axes: key -> values.
    seed: decides which parts of a hypercube's axes meet.

    Returns key -> value of each point.
    Raises ConfigError where there are too many, or a range of a grid has no steps.
    """
    if sweep.design == "list":
        return [dict(point) for point in sweep.point]
    if sweep.samples is not None:  # a Latin hypercube
        rng = np.random.default_rng([seed, *b"sweep"])
        shares = np.stack(
            [
                (rng.permutation(sweep.samples) + rng.random(sweep.samples)) / sweep.samples
                for _ in axes
            ],
            axis=1,
        )
        return [
            {key: axis.at(float(share)) for (key, axis), share in zip(axes.items(), row)}
            for row in shares
        ]
    endless = [key for key, axis in axes.items() if isinstance(axis, Range) and axis.steps is None]
    if endless:
        raise ConfigError(
            "a grid needs steps, how many values to take between from and to",
            f"vary.{endless[0]}",
            'give steps, or design = "latin-hypercube" and samples',
        )
    levels = [axis.levels() for axis in axes.values()]
    count = int(np.prod([len(values) for values in levels], dtype=object))
    if count > MAX_POINTS:
        raise ConfigError(
            f"the grid has {count} points, more than {MAX_POINTS}",
            "vary",
            'take fewer steps, or design = "latin-hypercube"',
        )
    return [dict(zip(axes, values)) for values in product(*levels)]


def unknown_key(key: str) -> str | None:
    """Why a dotted key names nothing, in words; None where it is a key of a camera or an option
    of a stage (whose name is not looked at).
    """
    head, _, rest = key.partition(".")
    if head in STAGES:
        return None if rest and "." not in rest else f"{key}: name one option, such as {head}.seed"
    path = key.split(".")
    if len(path) < 2:
        return f"{key}: write section.key, such as main_lens.f_number or reconstruct.method"
    kinds = [kind for kind in (Camera, Microscope) if path[0] in kind.model_fields]
    for depth, name in enumerate(path):
        if name.isdigit() or name == "*":
            continue
        known = [key for kind in kinds for key in known_keys(path[:depth], kind)]
        if not depth:
            known = [*Camera.model_fields, *Microscope.model_fields, *STAGES]
        known = list(dict.fromkeys(known))
        if name not in known:
            near = difflib.get_close_matches(name, known, 1, 0.5)
            return f"{key}: unknown key {name}; " + (
                f"did you mean {'.'.join([*path[:depth], near[0]])}?"
                if near
                else f"known here: {', '.join(known)}"
            )
    return None


def changed(
    data: Mapping[str, Any], values: Mapping[str, Any], follow: Mapping[str, Any]
) -> dict[str, Any]:
    """A camera description with some keys set and others computed.

    data: nested, as read from TOML; it is left as it was.
    values: dotted key -> value; the options of stages among them are left alone.
    follow: dotted key -> product or quotient of keys and numbers.

    Of the filters a changed layout takes as many as it has cells.

    Returns the nested description.
    Raises ConfigError where a key is not there or an expression cannot be computed.
    """
    copy = _copy(data)
    for key, value in values.items():
        if key.partition(".")[0] not in STAGES:
            _put(copy, key, value)
    if "filter_array.layout" in values:
        _fill(copy["filter_array"])
    for key, expression in follow.items():
        _put(copy, key, _computed(copy, key, expression))
    return copy


def options_of(sweep: Sweep, point: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What the stages are run with at a point: the sections of the file with what varies put in.

    sweep: the description.
    point: dotted key -> value.

    Returns stage -> option -> value.
    """
    found = {stage: dict(values) for stage, values in sweep.options.items()}
    for key, value in {**sweep.set, **point}.items():
        stage, _, option = key.partition(".")
        if stage in STAGES:
            found.setdefault(stage, {})[option] = value
    return found


def number(value: Any) -> float | None:
    """A value as a number: lengths in m, durations in s, others in their own unit; None for
    words, lists and switches.
    """
    try:
        return _measure(value)[0]
    except ValueError:
        return None


def unit(value: Any) -> str:
    """The unit of number(value): "m", "s", what the text says, or ""."""
    try:
        return _measure(value)[1] or ""
    except ValueError:
        return ""


# --- reading --------------------------------------------------------------------------------------


def _axis(values: Any) -> Axis:
    if isinstance(values, dict):
        try:
            made = Range.model_validate(values)
        except ValidationError as error:
            raise ValueError(
                "; ".join(
                    f"{'.'.join(map(str, e['loc']))}: {e['msg']}".lstrip(": ")
                    for e in error.errors()
                )
            ) from None
        return made
    if not isinstance(values, list) or not values:
        raise ValueError(
            f"{values!r} is no list of values and no range; write for example [6, 8, 11] or {{ "
            'from = "50 um", to = "250 um", steps = 5 }'
        )
    for i, value in enumerate(values):
        if isinstance(value, float) and not abs(value) <= FURTHEST:
            raise ValueError(f"{value!r} is not finite, or no quantity")
        if value in values[:i] and any(type(value) is type(v) and value == v for v in values[:i]):
            raise ValueError(f"{value!r} stands twice")
    return Choice(values)


def _said(error: Exception) -> str:
    return str(error).replace("Value error, ", "")


def _flat(table: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Nested tables as dotted keys; a table that is a range stays one."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        if isinstance(value, dict) and value and not set(value) & _RANGE:
            out |= _flat(value, f"{before}{key}.")
        else:
            out[f"{before}{key}"] = value
    return out


def _measure(value: Any) -> tuple[float, str | None]:
    """(number in SI, unit) of a number or of text with a unit; ValueError for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise ValueError(f"{shown(value)} is no number and no number with a unit")
    if not isinstance(value, str):
        if not abs(value) <= FURTHEST:
            raise ValueError(f"{value!r} is not finite, or no quantity")
        return float(value), None
    for parse, unit in ((parse_length, "m"), (parse_duration, "s")):
        try:
            return parse(value), unit
        except UnitError:
            continue
    match = _UNITLESS.fullmatch(value)
    if match is None:
        raise ValueError(f'{value!r} is no number with a unit, such as "250 um"')
    return float(match[1]), match[2]


def _written(value: float, unit: str | None) -> float | str:
    if unit is None:
        return value
    return {"m": format_length, "s": format_duration}.get(unit, lambda v: f"{v:.{DIGITS}g} {unit}")(
        value
    )


def _copy(data: Any) -> Any:
    return (
        {k: _copy(v) for k, v in data.items()}
        if isinstance(data, dict)
        else [_copy(v) for v in data]
        if isinstance(data, list)
        else data
    )


def _put(data: dict[str, Any], key: str, value: Any) -> None:
    """Set a dotted key; * stands for every entry of a list; what excludes the key leaves."""
    *path, last = key.split(".")
    targets = [data]
    for depth, name in enumerate(path):
        targets = [
            inner
            for target in targets
            for inner in _entries(target, name, path[: depth + 1], key, make=True)
        ]
    for target in targets:
        if isinstance(target, list):
            for i in _indices(target, last, path, key):
                target[i] = value
            continue
        target[last] = value
        for section, *names in _ALTERNATIVES:
            if path == [section] and last in names:
                for other in names:
                    if other != last:
                        target.pop(other, None)


def _fill(array: dict[str, Any]) -> None:
    """Leave as many filters as the layout has cells; what is no layout is told later."""
    layout, filters = array.get("layout"), array.get("filters")
    if isinstance(layout, list) and isinstance(filters, list):
        if len(layout) == 2 and all(type(n) is int and n > 0 for n in layout):
            array["filters"] = filters[: layout[0] * layout[1]]


def _entries(
    target: Any, name: str, path: Sequence[str], key: str, make: bool = False
) -> list[Any]:
    if isinstance(target, list):
        return [target[i] for i in _indices(target, name, path[:-1], key)]
    if (
        make
        and isinstance(target, dict)
        and name not in target
        and len(path) == 1
        and name != "filter_array"
    ):
        target[name] = {}
    if not isinstance(target, dict) or name not in target:
        raise ConfigError(
            f"{'.'.join(path)} is not given in the camera, so that a part of it cannot be set",
            key,
            "give it whole in the camera file",
        )
    return [target[name]]


def _indices(target: Sequence[Any], name: str, path: Sequence[str], key: str) -> Sequence[int]:
    if name == "*":
        return range(len(target))
    if not name.isdigit() or int(name) >= len(target):
        raise ConfigError(
            f"{'.'.join(path)} has {len(target)} entries, counted from 0",
            key,
            f"write {'.'.join(path)}.0 or {'.'.join(path)}.*",
        )
    return [int(name)]


_FACTOR = re.compile(r"\s*([*/]?)\s*([^*/]+)")


def _computed(data: Mapping[str, Any], key: str, expression: Any) -> float | str:
    """The value of a product such as "sensor.pixel_pitch * 13 / 2"; a length where one length is
    left over, else a number.
    """
    if not isinstance(expression, str) or not expression.strip():
        raise ConfigError(
            f"{expression!r} is no product of keys and numbers",
            f"follow.{key}",
            'write for example "sensor.pixel_pitch * 13"',
        )
    value, power, place = 1.0, 0, 0
    while place < len(expression.rstrip()):
        match = _FACTOR.match(expression, place)
        if match is None or (match[1] == "") != (place == 0):
            raise ConfigError(
                f"{expression!r} is no product of keys and numbers",
                f"follow.{key}",
                "use * and / only",
            )
        term, unit = _term(data, key, match[2].strip())
        if match[1] == "/" and term == 0:
            raise ConfigError(
                f"{expression!r} divides by {match[2].strip()}, which is 0",
                f"follow.{key}",
                "divide by something else",
            )
        sign = -1 if match[1] == "/" else 1
        value, power, place = value * term**sign, power + sign * (unit == "m"), match.end()
    if power not in (0, 1):
        raise ConfigError(
            f"{expression!r} is a length to the power of {power}",
            f"follow.{key}",
            "a key takes a length or a number",
        )
    return _written(float(f"{value:.{DIGITS}g}"), "m" if power else None)


def _term(data: Mapping[str, Any], key: str, text: str) -> tuple[float, str | None]:
    """(number, unit) of a key or of a number, with or without a unit."""
    found: Any = text
    if re.match(r"[A-Za-z_]", text):
        problem = unknown_key(text)
        if problem:
            raise ConfigError(problem, f"follow.{key}")
        found = data
        path = text.split(".")
        for depth, name in enumerate(path):
            found = _entries(found, name, path[: depth + 1], f"follow.{key}")[0]
    else:
        try:
            found = float(text)
        except ValueError:
            pass
    try:
        value, unit = _measure(found)
    except ValueError as error:
        raise ConfigError(
            f"{text}: {error}", f"follow.{key}", "use lengths and plain numbers"
        ) from None
    if unit not in (None, "m"):
        raise ConfigError(
            f"{text} is {shown(found)}", f"follow.{key}", "use lengths and plain numbers"
        )
    return value, unit
