"""A lens prescription as TOML: surfaces with units, dispersion formulas of its glasses, the stop;
checked whole, read into SI.

    [lens]
    name = "triplet"
    design_wavelength = "587.5618 nm"
    stop = 5                              # its number, counted from 1
    stop_diameter = "5.8 mm"
    [[surface]]
    radius = "12.44 mm"                   # or "flat"; positive: centre behind the surface
    thickness = "5.514 mm"                # to the next surface; the last: to the image plane
    glass = "N-SK16"                      # behind the surface; left out: air
    conic = -1.2
    asphere = { r4 = "9.6e-05 mm^-3" }
    semi_diameter = "6 mm"                # rays further out are lost
    [glass.N-SK16]                        # left out: plenocli's own catalogue
    sellmeier = [[1.34317774, 0.00704687339], ...]    # um; or polynomial, cauchy, nd and vd
    range = ["310 nm", "2500 nm"]
"""

import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, PlainValidator, WithJsonSchema, model_validator

from plenocli.base.errors import ConfigError
from plenocli.base.quantities import Length, Section, Wavelength, quantity
from plenocli.base.toml import parse_toml
from plenocli.base.units import LENGTHS, UnitError, format_length, parse_length
from plenocli.files.config.toml_file import read_text
from plenocli.forward.camera.glass import AIR, Medium, medium
from plenocli.forward.camera.prescription import Prescription, Surface

Thickness = Annotated[float, quantity(parse_length, "5 mm", -10.0, 1e3, format_length)]
_MAX_ORDER = 20


def _radius(value: Any) -> float:
    """Radius (m, infinite for a plane) of text such as "50 mm" or "flat"."""
    if isinstance(value, str) and value.strip().lower() in ("flat", "inf", "infinity"):
        return math.inf
    length = parse_length(value) if isinstance(value, str) else None
    if length is None:
        raise ValueError(f'{value!r} needs its unit as text, such as "50 mm", or "flat"')
    if not 1e-6 <= abs(length) <= 1e6:
        raise ValueError(
            f"{value!r} is no radius; write a length from 1 um to 1000 km, negative for a centre "
            'before the surface, or "flat"'
        )
    return length


Radius = Annotated[
    float,
    PlainValidator(_radius),
    WithJsonSchema(
        {
            "type": "string",
            "description": (
                'length such as "50 mm", positive where the centre lies behind, or "flat"'
            ),
        }
    ),
]


def _coefficients(value: Any) -> tuple[float, ...]:
    """(a_1, a_2, ...) in m^(1 - 2i) of a table such as { r4 = "9.6e-05 mm^-3" }."""
    if not isinstance(value, dict):
        raise ValueError('must be a table such as { r4 = "9.6e-05 mm^-3" }')
    found = {}
    for key, text in value.items():
        order = int(key[1:]) if re.fullmatch(r"r\d{1,2}", key) else 0
        if order not in range(2, _MAX_ORDER + 1, 2):
            raise ValueError(f"{key!r} is no even power; use r2, r4, ... r{_MAX_ORDER}")
        found[order // 2] = _per_length(text, order - 1)
    return tuple(found.get(i, 0.0) for i in range(1, max(found, default=0) + 1))


def _per_length(text: Any, power: int) -> float:
    match = (
        re.fullmatch(r"\s*([-+]?[0-9.]+(?:[eE][-+]?\d+)?)\s*([a-zµμ]+)\^-(\d+)\s*", text)
        if isinstance(text, str)
        else None
    )
    if match is None or match.group(2) not in LENGTHS or int(match.group(3)) != power:
        raise UnitError(
            f'{text!r} must be a number per length to the power {power}, such as "1e-5 mm^-{power}"'
        )
    scale = round(-math.log10(LENGTHS[match.group(2)]))
    # one decimal conversion keeps the double nearest to the text
    digits, _, exponent = match.group(1).lower().partition("e")
    return float(f"{digits}e{int(exponent or 0) + scale * power}")


Asphere = Annotated[
    tuple,
    PlainValidator(_coefficients),
    WithJsonSchema(
        {
            "type": "object",
            "additionalProperties": {"type": "string"},
            "description": (
                'coefficients of even powers of the height, such as { r4 = "9.6e-05 mm^-3" }'
            ),
        }
    ),
]
Pairs = Annotated[tuple[tuple[float, float], ...], Field(min_length=1, max_length=16)]


class SurfaceEntry(Section):
    radius: Radius = math.inf
    thickness: Thickness = 0.0
    glass: str = "air"
    conic: Annotated[float, Field(ge=-1e6, le=1e6)] = 0.0
    asphere: Asphere = ()
    semi_diameter: Length | None = None


class GlassEntry(Section):
    """A dispersion formula (plenocli.forward.camera.glass.Medium), exactly one, and the
    range it holds on.
    """

    sellmeier: Pairs | None = None
    polynomial: Pairs | None = None
    cauchy: Pairs | None = None
    nd: Annotated[float, Field(ge=1.0, le=5.0)] | None = None
    vd: Annotated[float, Field(ge=5.0, le=150.0)] | None = None
    range: tuple[Wavelength, Wavelength] | None = None

    @model_validator(mode="after")
    def _one_formula(self) -> Self:
        given = [
            name
            for name in ("sellmeier", "polynomial", "cauchy", "nd")
            if getattr(self, name) is not None
        ]
        if len(given) != 1 or (self.nd is None) != (self.vd is None):
            raise ValueError("give exactly one of sellmeier, polynomial, cauchy, or nd with vd")
        if self.range and self.range[0] >= self.range[1]:
            raise ValueError("range must ascend")
        return self

    def medium(self, name: str) -> Medium:
        """The glass of this entry under the name given; without a range it is trusted from 300 nm
        to 2.5 um, nd and vd from 380 to 780 nm.
        """
        if self.nd is not None:
            return Medium(name, "abbe", (self.nd, self.vd), self.range or (380e-9, 780e-9))
        formula = next(
            f for f in ("sellmeier", "polynomial", "cauchy") if getattr(self, f) is not None
        )
        return Medium(name, formula, getattr(self, formula), self.range or (300e-9, 2.5e-6))


class LensEntry(Section):
    name: str = ""
    design_wavelength: Wavelength = 587.5618e-9
    stop: Annotated[int, Field(ge=1)]
    stop_diameter: Length
    object_distance: Length | None = None


class LensFile(Section):
    """The whole description, by the names of the TOML file."""

    lens: LensEntry
    surface: Annotated[tuple[SurfaceEntry, ...], Field(min_length=1, max_length=500)]
    glass: dict[str, GlassEntry] = {}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        wrong = []
        if self.lens.stop > len(self.surface):
            wrong.append(
                f"lens.stop is {self.lens.stop}, but there are {len(self.surface)} surfaces"
            )
        for i, entry in enumerate(self.surface, 1):
            try:
                self.medium(entry.glass).index(self.lens.design_wavelength)
            except ConfigError as error:
                wrong.append(
                    f"surface {i}: {error.what}; write its dispersion as "
                    f"[glass.{_key(entry.glass)}]"
                )
        if self.surface[-1].glass.lower() != "air":
            wrong.append("the last surface must end in air")
        if all(math.isinf(e.radius) and not e.asphere for e in self.surface):
            wrong.append("all surfaces are flat")
        if wrong:
            raise ValueError("; ".join(wrong))
        return self

    def medium(self, name: str) -> Medium:
        """The glass that this file means by a name: its own entry, else the catalogue's.

        Raises ConfigError for an unknown one.
        """
        return self.glass[name].medium(name) if name in self.glass else medium(name)

    def prescription(self) -> Prescription:
        """The lens in SI units."""
        surfaces = tuple(
            Surface(
                curvature=0.0 if math.isinf(e.radius) else 1 / e.radius,
                thickness=e.thickness,
                medium=self.medium(e.glass),
                conic=e.conic,
                asphere=e.asphere,
                semi_diameter=math.inf if e.semi_diameter is None else e.semi_diameter,
            )
            for e in self.surface
        )
        distance = math.inf if self.lens.object_distance is None else self.lens.object_distance
        return Prescription(
            surfaces=surfaces,
            stop=self.lens.stop - 1,
            stop_radius=self.lens.stop_diameter / 2,
            design_wavelength=self.lens.design_wavelength,
            object_distance=distance,
            name=self.lens.name,
        )


def load_lens(path: str | Path) -> Prescription:
    """Read and check a lens description.

    path: of the TOML file.

    Raises InputError where it cannot be read, ConfigError for what it says.
    """
    return parse_lens(read_text(Path(path), "lens"), path)


def parse_lens(text: str, where: str | Path = "lens") -> Prescription:
    """A lens from TOML text.

    text: of the description.
    where: what messages call it.

    Raises ConfigError, which lists every violation with its path.
    """
    return parse_toml(text, where, LensFile).prescription()


# --- writing --------------------------------------------------------------------------------------


def lens_toml(lens: Prescription, comments: Iterable[str] = ()) -> str:
    """TOML text of a lens that parse_lens reads back to an equal one.

    lens: its glasses are written out.
    comments: lines for the top.
    """
    lines = [f"# {text}" for text in comments] + ["[lens]"]
    if lens.name:
        lines.append(f"name = {_text(lens.name)}")
    lines += [
        f'design_wavelength = "{format_length(lens.design_wavelength)}"',
        f"stop = {lens.stop + 1}",
        f'stop_diameter = "{format_length(2 * lens.stop_radius)}"',
    ]
    if math.isfinite(lens.object_distance):
        lines.append(f'object_distance = "{format_length(lens.object_distance)}"')
    for surface in lens.surfaces:
        lines += ["", "[[surface]]", *_surface_lines(surface)]
    glasses = {s.medium.name: s.medium for s in lens.surfaces if s.medium != AIR}
    for name, glass in glasses.items():
        lines += ["", f"[glass.{_key(name)}]", *_glass_lines(glass)]
    return "\n".join(lines) + "\n"


def _surface_lines(surface: Surface) -> list[str]:
    lines = [f'radius = "{_shown_radius(surface.curvature)}"']
    if surface.thickness:
        lines.append(f'thickness = "{format_length(surface.thickness)}"')
    if surface.medium != AIR:
        lines.append(f"glass = {_text(surface.medium.name)}")
    if surface.conic:
        lines.append(f"conic = {surface.conic!r}")
    if any(surface.asphere):
        terms = [
            f'r{2 * i} = "{a!r} m^-{2 * i - 1}"' for i, a in enumerate(surface.asphere, 1) if a
        ]
        lines.append(f"asphere = {{ {', '.join(terms)} }}")
    if math.isfinite(surface.semi_diameter):
        lines.append(f'semi_diameter = "{format_length(surface.semi_diameter)}"')
    return lines


def _shown_radius(curvature: float) -> str:
    """The shortest radius whose inverse is this curvature, to the last bit where there is one."""
    if curvature == 0:
        return "flat"
    radius = 1 / curvature
    near = (
        *(float(f"{radius:.{digits}g}") for digits in (6, 9, 12, 15)),
        radius,
        math.nextafter(radius, math.inf),
        math.nextafter(radius, -math.inf),
    )
    return format_length(next((r for r in near if 1 / r == curvature), radius))


def _glass_lines(glass: Medium) -> list[str]:
    limits = [f'range = ["{format_length(glass.limits[0])}", "{format_length(glass.limits[1])}"]']
    if glass.formula == "abbe":
        return [f"nd = {glass.coefficients[0]!r}", f"vd = {glass.coefficients[1]!r}", *limits]
    pairs = ((glass.coefficients[0], 0.0),) if glass.formula == "constant" else glass.coefficients
    formula = "cauchy" if glass.formula == "constant" else glass.formula
    return [
        f"{formula} = [{', '.join(f'[{a!r}, {b!r}]' for a, b in pairs)}]",
        *(limits if math.isfinite(glass.limits[1]) else []),
    ]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _text(name)


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'
