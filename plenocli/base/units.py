"""Numbers with units as text, parsed once at the border: "250 um", "60dB", "4GiB", "10 ms"."""

import math
import re
from collections.abc import Callable, Mapping

LENGTHS = {
    "pm": 1e-12,
    "nm": 1e-9,
    "um": 1e-6,
    "µm": 1e-6,
    "μm": 1e-6,
    "mm": 1e-3,
    "cm": 1e-2,
    "m": 1.0,
    "km": 1e3,
}
DURATIONS = {"us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0}
ILLUMINANCES = {"mlx": 1e-3, "lx": 1.0, "klx": 1e3}
LUMINANCES = {"cd/m2": 1.0, "kcd/m2": 1e3}
RADIANCES = {"uW/m2/sr": 1e-6, "mW/m2/sr": 1e-3, "W/m2/sr": 1.0}
SPECTRAL_RADIANCES = {
    "uW/m2/sr/nm": 1e3,
    "mW/m2/sr/nm": 1e6,
    "W/m2/sr/nm": 1e9,
    "W/m2/sr/m": 1.0,
}
BYTES = {
    "B": 1,
    "KiB": 2**10,
    "MiB": 2**20,
    "GiB": 2**30,
    "TiB": 2**40,
    "kB": 10**3,
    "MB": 10**6,
    "GB": 10**9,
    "TB": 10**12,
}

_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s]\S*)?\s*")


class UnitError(ValueError):
    """Text that is not a number with a known unit."""


def _parse(text: str, units: Mapping[str, float], what: str, example: str) -> float:
    match = _NUMBER.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise UnitError(f"{text!r} is no {what}; write a number and a unit, such as {example!r}")
    number, unit = match.groups()
    if unit is None:
        raise UnitError(
            f"{text!r} has no unit; a {what} needs one of {', '.join(units)}, such as {example!r}"
        )
    if unit not in units:
        raise UnitError(
            f"{text!r} is no {what}; the unit must be one of {', '.join(units)}, "
            f"such as {example!r}"
        )
    # dividing by the exact power of ten keeps "550 nm" the double nearest to 550e-9
    scale = units[unit]
    value = (
        float(f"{number}e{round(math.log10(scale))}")
        if scale < 1 and "e" not in number.lower()
        else float(number) * scale
    )
    if not math.isfinite(value):
        raise UnitError(f"{text!r} is too large for a {what} such as {example!r}")
    return value


def parse_length(text: str) -> float:
    """Metres from text such as "250 um" or "550nm"; a bare number is refused (UnitError)."""
    return _parse(text, LENGTHS, "length", "250 um")


def parse_wavelength(text: str) -> float:
    """Metres from text such as "550nm", from 100 nm to 100 um (UnitError otherwise)."""
    value = parse_length(text)
    if value <= 0:
        raise UnitError(f"{text!r} must be above 0")
    if not 100e-9 <= value <= 100e-6:
        raise UnitError(
            f"{text!r} is no wavelength of this model, which goes from 100 nm to 100 um"
        )
    return value


def parse_duration(text: str) -> float:
    """Seconds from text such as "10 ms"; a bare number is refused (UnitError)."""
    return _parse(text, DURATIONS, "duration", "10 ms")


def parse_illuminance(text: str) -> float:
    """Lux from text such as "500 lx" (UnitError otherwise)."""
    return _parse(text, ILLUMINANCES, "illuminance", "500 lx")


def parse_luminance(text: str) -> float:
    """Candela per square metre from text such as "150 cd/m2" (UnitError otherwise)."""
    return _parse(text, LUMINANCES, "luminance", "150 cd/m2")


def parse_radiance(text: str) -> float:
    """W/m2/sr from text such as "0.5 W/m2/sr" (UnitError otherwise)."""
    return _parse(text, RADIANCES, "radiance", "0.5 W/m2/sr")


def parse_spectral_radiance(text: str) -> float:
    """W/m2/sr/m from text such as "2 mW/m2/sr/nm" (UnitError otherwise)."""
    return _parse(text, SPECTRAL_RADIANCES, "spectral radiance", "2 mW/m2/sr/nm")


def parse_temperature(text: str) -> float:
    """Kelvin from text such as "25 C" or "298.15 K" (UnitError otherwise)."""
    value = _parse(text, {"C": 1.0, "degC": 1.0, "K": 1.0}, "temperature", "25 C")
    return value if text.rstrip().endswith("K") else value + 273.15


def parse_bytes(text: str) -> int:
    """Bytes from text such as "4GiB"; a bare number is refused (UnitError)."""
    return int(_parse(text, BYTES, "memory size", "4GiB"))


def parse_decibel(text: str) -> float:
    """Decibels from text such as "60dB"; "none" and bare numbers are refused (UnitError)."""
    return _parse(text, {"dB": 1.0, "db": 1.0}, "ratio", "60dB")


def parse_number(text: str) -> float:
    """A finite number without a unit (UnitError otherwise)."""
    try:
        value = float(text)
    except (TypeError, ValueError):
        raise UnitError(f"{text!r} is no number; write for example 0.5") from None
    if not math.isfinite(value):
        raise UnitError(f"{text!r} is not a finite number; write for example 0.5")
    return value


def format_length(metres: float) -> str:
    """The shortest text that parse_length reads back to the same double, in a handy unit:
    5.5e-7 -> "550 nm".
    """
    return _format(metres, LENGTHS, ("nm", "um", "mm"), "m", parse_length)


def format_duration(seconds: float) -> str:
    """The shortest text that parse_duration reads back to the same double: 0.01 -> "10 ms"."""
    return _format(seconds, DURATIONS, ("us", "ms"), "s", parse_duration)


def _format(
    value: float,
    units: Mapping[str, float],
    small: tuple[str, ...],
    base: str,
    parse: Callable[[str], float],
) -> str:
    unit = next((u for u in small if abs(value) / units[u] < 999.9995), base)
    for digits in (6, 9, 12, 15, 17):
        text = f"{value / units[unit]:.{digits}g} {unit}"
        if parse(text) == value:
            return text
    return f"{value!r} {base}"
