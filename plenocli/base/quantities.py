"""Fields of descriptions: numbers with a unit as text, read into SI, and the frozen
section that holds them.
"""

import re
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, WithJsonSchema

from plenocli.base.units import (
    UnitError,
    format_duration,
    format_length,
    parse_duration,
    parse_length,
)


def quantity(parse, example, low, high, show):
    """An annotated float that is written as text with a unit and lies within [low, high] in SI."""

    def read(value: Any, info) -> float:
        """SI value of text with a unit, or of a number where the context says
        that it is SI already.
        """
        if info.context and info.context.get("si"):
            number = value
        elif isinstance(value, str):
            number = parse(value)
        else:
            raise ValueError(f"{value!r} needs its unit as text, such as {example!r}")
        if number is not None and not low <= number <= high:
            raise ValueError(f"{value!r} is outside {show(low)} ... {show(high)}")
        return number

    pattern = {
        "type": "string",
        "description": f"number and unit, such as {example!r}, from {show(low)} to {show(high)}",
    }
    return Annotated[float, BeforeValidator(read), WithJsonSchema(pattern)]


def _suffix(unit):
    def parse(text):
        match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*" + re.escape(unit) + r"\s*", text)
        try:
            return float(match.group(1))
        except (AttributeError, ValueError):
            raise UnitError(f"{text!r} is no number of {unit}") from None

    return parse


def _plain(unit):
    return lambda number: f"{number:g} {unit}"


Length = quantity(parse_length, "50 mm", 1e-9, 1e6, format_length)


Gap = quantity(parse_length, "0.1 mm", 0.0, 1.0, format_length)


Wavelength = quantity(parse_length, "550 nm", 100e-9, 100e-6, format_length)


SignedLength = quantity(parse_length, "20 nm", -1e-3, 1e-3, format_length)


Electrons = quantity(_suffix("e"), "15000 e", 0.0, 1e12, _plain("e"))


Gain = quantity(_suffix("DN/e"), "0.25 DN/e", 1e-9, 1e9, _plain("DN/e"))


Duration = quantity(parse_duration, "10 ms", 1e-9, 1e6, format_duration)


Unit = Annotated[float, Field(gt=0.0, le=1.0)]


Pair = tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]


FileName = Annotated[str, Field(min_length=1, max_length=1000)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
