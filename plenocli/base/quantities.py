"""Fields of descriptions: numbers with a unit as text, read into SI, and the frozen
section that holds them.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationInfo,
)
from pydantic_core import core_schema

from plenocli.base.units import (
    UnitError,
    format_duration,
    format_length,
    parse_duration,
    parse_illuminance,
    parse_length,
    parse_luminance,
    parse_radiance,
    parse_spectral_radiance,
    parse_temperature,
)


@dataclass(frozen=True, eq=False)
class _Written:
    """What pydantic does with a float that is written as text.

    read: value and context -> SI value.
    pattern: the JSON Schema of the text.
    """

    read: Callable[[Any, ValidationInfo], float]
    pattern: dict[str, Any]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.with_info_before_validator_function(self.read, handler(source))

    def __get_pydantic_json_schema__(
        self, schema: core_schema.CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return dict(self.pattern)  # pydantic writes the default of each field into it


def quantity(
    parse: Callable[[str], float],
    example: str,
    low: float,
    high: float,
    show: Callable[[float], str],
) -> _Written:
    """What makes Annotated[float, ...] a number that is written as text with a unit.

    parse: text -> SI value.
    example: of such a text.
    low, high: ends of what is allowed, SI.
    show: SI value -> text.
    """

    def read(value: Any, info: ValidationInfo) -> float:
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
    return _Written(read, pattern)


def _suffix(unit: str) -> Callable[[str], float]:
    def parse(text: str) -> float:
        match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*" + re.escape(unit) + r"\s*", text)
        try:
            return float(match[1] if match else "")
        except ValueError:
            raise UnitError(f"{text!r} is no number of {unit}") from None

    return parse


def _plain(unit: str) -> Callable[[float], str]:
    return lambda number: f"{number:g} {unit}"


Length = Annotated[float, quantity(parse_length, "50 mm", 1e-9, 1e6, format_length)]


Gap = Annotated[float, quantity(parse_length, "0.1 mm", 0.0, 1.0, format_length)]


Wavelength = Annotated[float, quantity(parse_length, "550 nm", 100e-9, 100e-6, format_length)]


SignedLength = Annotated[float, quantity(parse_length, "20 nm", -1e-3, 1e-3, format_length)]


Place = Annotated[float, quantity(parse_length, "-2 mm", -10.0, 10.0, format_length)]


Electrons = Annotated[float, quantity(_suffix("e"), "15000 e", 0.0, 1e12, _plain("e"))]


Gain = Annotated[float, quantity(_suffix("DN/e"), "0.25 DN/e", 1e-9, 1e9, _plain("DN/e"))]


Duration = Annotated[float, quantity(parse_duration, "10 ms", 1e-9, 1e6, format_duration)]


Illuminance = Annotated[float, quantity(parse_illuminance, "500 lx", 1e-6, 1e9, _plain("lx"))]


Luminance = Annotated[float, quantity(parse_luminance, "150 cd/m2", 1e-6, 1e9, _plain("cd/m2"))]


Radiance = Annotated[float, quantity(parse_radiance, "0.5 W/m2/sr", 1e-12, 1e9, _plain("W/m2/sr"))]


SpectralRadiance = Annotated[
    float,
    quantity(
        parse_spectral_radiance,
        "2 mW/m2/sr/nm",
        1e-3,
        1e18,
        lambda number: f"{number * 1e-9:g} W/m2/sr/nm",
    ),
]


Temperature = Annotated[float, quantity(parse_temperature, "25 C", 173.15, 423.15, _plain("K"))]


Kelvins = Annotated[float, quantity(_suffix("K"), "7 K", 1.0, 100.0, _plain("K"))]


ElectronRate = Annotated[float, quantity(_suffix("e/s"), "5 e/s", 0.0, 1e12, _plain("e/s"))]


Digits = Annotated[float, quantity(_suffix("DN"), "1.5 DN", 0.0, 65535.0, _plain("DN"))]


Unit = Annotated[float, Field(gt=0.0, le=1.0)]


Pair = tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]


FileName = Annotated[str, Field(min_length=1, max_length=1000)]


class Section(BaseModel):
    """A table of a description: frozen, without unknown keys or numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)


MOST_PLANES = 1000
"""Planes of a volume."""
_RANGE = re.compile(r"\s*(\S+ ?\S+)\s+to\s+(\S+ ?\S+)\s+step\s+(\S+ ?\S+)\s*")


def planes_of(value: Any) -> Any:
    """The planes of "-12 um to 12 um step 1 um" as a list; what is no text stays.

    Raises ValueError for text that is no such range.
    """
    if not isinstance(value, str):
        return value
    found = _RANGE.fullmatch(value)
    if found is None:
        raise ValueError(
            f'{value!r} is no range of planes; write for example "-12 um to 12 um step 1 um", or a '
            'list such as ["-5 um", "0 um", "5 um"]'
        )
    start, end, step = (parse_length(part) for part in found.groups())
    if not step > 0 or end < start:
        raise ValueError(f"{value!r} must rise in steps above 0")
    count = math.floor((end - start) / step * (1 + 1e-12) + 1e-9) + 1
    if count > MOST_PLANES:
        raise ValueError(f"{value!r} has {count} planes; at most {MOST_PLANES} are possible")
    # a plane in focus is at 0, and 394 mm not a rounding error away
    depths = (float(f"{round(start / step + i, 9) * step:.12g}") for i in range(count))
    return [format_length(depth) for depth in depths]
