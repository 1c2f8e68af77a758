"""Whether the lengths of a description can belong to one camera, and which of them is most likely
written in a wrong unit.

A length a thousand times too long or too short gives a camera that no model can serve, or one that
puts no light on its pixels; what a model says of it then helps nobody.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from plenocli.base.units import format_length

STEEPEST, SLOWEST = 0.1, 1000.0
"""F-numbers of the main lens and the lenslets."""
SLOWEST_IMAGE = 1e5
"""F-number of the light that comes from the pupil; what blurs is refused for that."""
MOST_BLUR = 1000.0
"""Lenslets that the image of a point may be spread over."""
MOST_DEFOCUS = 100.0
"""Superpixels that the light of a lenslet may be spread over."""
WINDOWS = (1e-3, 30.0)
"""Width of the pixels kept of a superpixel, in superpixel pitches."""
SMALLEST_PIXEL = 1 / 50
"""Wavelengths."""
SMALLEST_FILTERS = 0.01
"""Width of the filter array in pupils."""
UNITS = (1e-3, 1e3, 1e-6, 1e6, 1e-9, 1e9)
"""What a slip of the unit multiplies a length by."""
USUAL = {
    "main_lens.focal_length": (0.5e-3, 5.0),
    "main_lens.aperture_diameter": (20e-6, 1.0),
    "object.distance": (0.5e-3, 1e6),
    "lenslet_array.distance": (0.5e-3, 5.0),
    "lenslet_array.pitch": (2e-6, 5e-3),
    "lenslet_array.superpixel_pitch": (2e-6, 5e-3),
    "lenslet_array.focal_length": (5e-6, 0.1),
    "sensor.distance": (5e-6, 0.1),
    "sensor.pixel_pitch": (0.2e-6, 0.2e-3),
}
"""m: what is outside can be computed, but is no camera's that anybody has built."""
_TYPICAL_F = 8.0


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """The lengths of a description as they are written.

    by_key: m, by their dotted keys; either of two keys where one of them is to be given;
    f_number: of the main lens on the image side, None where its diameter is given;
    pixels: of a superpixel along its longer side;
    wavelengths: shortest and longest, m.
    """

    by_key: Mapping[str, float]
    f_number: float | None
    pixels: int
    wavelengths: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class _Ratio:
    """A number without unit that a camera has within limits.

    typical: what most cameras have.
    """

    value: float
    low: float = 1.0
    high: float = math.inf
    typical: float
    sentence: str

    @property
    def excess(self) -> float:
        """How far beyond its limits, as a logarithm; 0 within."""
        value = math.log(self.value)
        return max(0.0, math.log(self.low) - value, value - math.log(self.high))


def implausible(lengths: Lengths) -> str | None:
    """What is wrong with the lengths of a camera in one sentence, with the one that is most likely
    written in a wrong unit; None where they can belong to one camera.
    """
    worst = max(_ratios(lengths), key=lambda r: r.excess)
    if worst.excess <= 1e-9:
        return None
    return worst.sentence + _meant(lengths)


def unusual(by_key: Mapping[str, float]) -> str | None:
    """The lengths (m, by dotted keys) that are far from those of cameras, each with what may have
    been meant, in one sentence; None where there are none. Ratios do not show where all are in a
    wrong unit.
    """
    asked = []
    for key, value in by_key.items():
        low, high = USUAL.get(key, (0.0, math.inf))
        meant = next((value * f for f in UNITS if low <= value * f <= high), None)
        derived = key == "lenslet_array.pitch" and "lenslet_array.superpixel_pitch" in by_key
        if not low <= value <= high and meant is not None and not derived:
            asked.append(f"{key} is {_text(value)}: did you mean {_text(meant)}?")
    return "; ".join(asked) or None


@dataclass(frozen=True, kw_only=True)
class _Shape:
    """Lengths (m) as in Geometry, all derived from those that are given."""

    f1: float
    z1: float
    z2: float
    z3: float
    f2: float
    D1: float
    D2: float
    pixel: float

    @property
    def superpixel(self) -> float:
        return self.D2 * (1 + self.z3 / self.z2)


def _shape(lengths: Lengths) -> _Shape:
    at = lengths.by_key
    z2, z3 = at["lenslet_array.distance"], at["sensor.distance"]
    wide = at.get("lenslet_array.superpixel_pitch")
    return _Shape(
        f1=at["main_lens.focal_length"],
        z1=at["object.distance"],
        z2=z2,
        z3=z3,
        f2=at["lenslet_array.focal_length"],
        D1=z2 / lengths.f_number if lengths.f_number else at["main_lens.aperture_diameter"],
        D2=at["lenslet_array.pitch"] if wide is None else wide / (1 + z3 / z2),
        pixel=at["sensor.pixel_pitch"],
    )


def _ratios(lengths: Lengths) -> list[_Ratio]:
    s = _shape(lengths)
    return [
        _stop("main_lens.focal_length", s.f1, "a pupil", s.D1),
        _stop("lenslet_array.distance", s.z2, "a pupil", s.D1, SLOWEST_IMAGE),
        _stop("lenslet_array.focal_length", s.f2, "lenslets", s.D2),
        _stop("sensor.distance", s.z3, "lenslets", s.D2),
        *_in_wavelengths(s, *lengths.wavelengths),
        *_spreads(s),
        *_shares(s, lengths),
    ]


def _stop(key: str, distance: float, what: str, width: float, slowest: float = SLOWEST) -> _Ratio:
    """The F-number of a distance behind an opening."""
    return _Ratio(
        value=distance / width,
        low=STEEPEST,
        high=slowest,
        typical=_TYPICAL_F,
        sentence=f"{key} {_text(distance)} behind {what} {_text(width)} wide is "
        f"f/{distance / width:.3g}, where f/{STEEPEST:g} to f/{slowest:g} can be computed",
    )


def _in_wavelengths(s: _Shape, shortest: float, longest: float) -> list[_Ratio]:
    """What has to be large against the wavelength."""
    D2, z3, pixel = s.D2, s.z3, s.pixel
    return [
        _Ratio(
            value=D2 / longest,
            typical=100.0,
            sentence=f"lenslets {_text(D2)} wide are {D2 / longest:.2g} wavelengths of "
            f"{_text(longest)}: such openings are no lenses",
        ),
        _Ratio(
            value=z3 / longest,
            typical=1000.0,
            sentence=f"sensor.distance {_text(z3)} is {z3 / longest:.2g} wavelengths of "
            f"{_text(longest)}: light does not propagate as waves over that",
        ),
        _Ratio(
            value=pixel / shortest,
            low=SMALLEST_PIXEL,
            typical=4.0,
            sentence=f"sensor.pixel_pitch {_text(pixel)} is {pixel / shortest:.2g} wavelengths of "
            f"{_text(shortest)}: no pixel is as small",
        ),
    ]


def _spreads(s: _Shape) -> list[_Ratio]:
    """Over what the light of a point and of a lenslet is spread."""
    f1, z1, z2, z3, f2, D2 = s.f1, s.z1, s.z2, s.z3, s.f2, s.D2
    blur = s.D1 * z2 * abs(1 / z1 + 1 / z2 - 1 / f1)
    superpixel, defocus = s.superpixel, D2 * z3 * abs(1 / z2 + 1 / z3 - 1 / f2)
    return [
        _Ratio(
            value=1 + blur / D2,
            high=1 + MOST_BLUR,
            typical=1.0,
            sentence=f"the image of an object at {_text(z1)} is blurred over {blur / D2:.3g} "
            f"lenslets (at most {MOST_BLUR:g} can be computed): main_lens.focal_length "
            f"{_text(f1)}, lenslet_array.distance {_text(z2)}",
        ),
        _Ratio(
            value=1 + defocus / superpixel,
            high=1 + MOST_DEFOCUS,
            typical=1.0,
            sentence=f"the light of a lenslet is spread over {defocus / superpixel:.3g} "
            f"superpixels (at most {MOST_DEFOCUS:g} can be computed): "
            f"lenslet_array.focal_length {_text(f2)}, sensor.distance {_text(z3)}",
        ),
    ]


def _shares(s: _Shape, lengths: Lengths) -> list[_Ratio]:
    """Widths against what they have to cover."""
    at, D1, pixel, superpixel = lengths.by_key, s.D1, s.pixel, s.superpixel
    window = lengths.pixels * pixel
    found = [
        _Ratio(
            value=window / superpixel,
            low=WINDOWS[0],
            high=WINDOWS[1],
            typical=1.0,
            sentence=f"{lengths.pixels} pixels of {_text(pixel)} are {window / superpixel:.3g} "
            f"times as wide as a superpixel, {_text(superpixel)}",
        ),
    ]
    if "filter_array.size" in at:
        size = at["filter_array.size"]
        found.append(
            _Ratio(
                value=size / D1,
                low=SMALLEST_FILTERS,
                high=1 + 1e-9,
                typical=0.8,
                sentence=f"filter_array.size {_text(size)} is {size / D1:.3g} of a pupil "
                f"{_text(D1)} wide",
            )
        )
    return found


def _meant(lengths: Lengths) -> str:
    """The change of one unit that makes the most usual camera of these lengths, as a question;
    else advice.
    """
    best, least = None, math.inf
    for key, value in lengths.by_key.items():
        for factor in UNITS:
            changed = Lengths(
                by_key={**lengths.by_key, key: value * factor},
                f_number=lengths.f_number,
                pixels=lengths.pixels,
                wavelengths=lengths.wavelengths,
            )
            ratios = _ratios(changed)
            far = sum(math.log(r.value / r.typical) ** 2 for r in ratios)
            if far < least and all(r.excess <= 1e-9 for r in ratios):
                best, least = (key, value, factor), far
    if best is None:
        return "; check the units of its lengths"
    key, value, factor = best
    return f"; {key} is {_text(value)}: was {_text(value * factor)} meant?"


def _text(metres: float) -> str:
    """A length to four digits."""
    return format_length(float(f"{metres:.4g}"))
