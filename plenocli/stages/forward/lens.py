"""Lenses: prescriptions imported, and what a lens does, as numbers and as text."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from plenocli.base.errors import NumericsError
from plenocli.base.text import Record
from plenocli.base.units import format_length
from plenocli.files.config.lens_file import lens_toml, load_lens
from plenocli.files.config.prescription_file import import_lens
from plenocli.forward.camera.lens import (
    disc_points,
    distortion,
    first_order,
    focal_shift,
    image_plane,
    lateral_colour,
    noll_coefficients,
    paraxial_image,
    transmitted,
    wavefront,
)
from plenocli.forward.camera.prescription import Prescription
from plenocli.forward.camera.raytrace import Pupil

Name = str | os.PathLike[str]


# --- show -----------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class PupilSummary:
    """Where a pupil is and how wide; None at infinity."""

    position_m: float | None
    radius_m: float | None


@dataclass(frozen=True, kw_only=True)
class FirstOrderSummary:
    """What a lens does to paraxial light of one wavelength.

    focal_shift_m: from the focus of the design wavelength.
    f_number: None where the exit pupil is at infinity.
    """

    wavelength_m: float
    focal_length_m: float
    back_focus_m: float
    focal_shift_m: float
    f_number: float | None
    front_principal_m: float
    rear_principal_m: float
    entrance_pupil: PupilSummary
    exit_pupil: PupilSummary


@dataclass(frozen=True, kw_only=True)
class AberrationSummary:
    """What a lens does to light of one wavelength from one field.

    lateral_colour_m: shift of the image from that of the design wavelength.
    noll_m: coefficients of the Zernike terms, in Noll's order.
    noll_rest_m: root mean square of what they leave.
    """

    wavelength_m: float
    lateral_colour_m: float
    image_height_m: float
    wavefront_rms_m: float
    wavefront_rms_waves: float
    noll_m: list[float]
    noll_rest_m: float


@dataclass(frozen=True, kw_only=True)
class FieldSummary:
    """What a lens does to light from one field, as far as its rays arrive.

    transmitted: share of the stop that is lit.
    distortion: relative.
    trouble: why the rest is missing.
    """

    angle_rad: float
    transmitted: float | None = None
    distortion: float | None = None
    wavelengths: list[AberrationSummary] | None = None
    trouble: str | None = None


@dataclass(frozen=True, kw_only=True)
class LensSummary:
    """What a lens does; lengths in m, angles in rad.

    file: name of its file.
    stop: number of the surface, from 1.
    object_distance_m: from the first vertex, None for infinity.
    """

    file: str
    name: str
    surfaces: int
    stop: int
    stop_diameter_m: float
    design_wavelength_m: float
    object_distance_m: float | None
    image_distance_m: float
    paraxial_image_distance_m: float
    wavelengths: list[FirstOrderSummary]
    fields: list[FieldSummary]

    def as_json(self) -> dict[str, Any]:
        """The summary for `--json`; what a field has not got is left out."""
        told = asdict(self)
        fields = [
            {name: value for name, value in field.items() if value is not None}
            for field in told.pop("fields")
        ]
        return told | {"fields": fields}


def run_lens_show(
    path: Name,
    *,
    wavelengths: Iterable[float] = (),
    fields: Iterable[float] = (0.0,),
    object_distance: float | None = None,
) -> LensSummary:
    """What the lens in the TOML file `path` does.

    wavelengths: m, default C, d and F lines with the design wavelength.
    fields: angles, rad.
    object_distance: m from the first vertex, default the lens's own.

    Raises InputError and ConfigError as load_lens does, NumericsError for a lens without power.
    """
    lens = load_lens(Path(path))
    distance = lens.object_distance if object_distance is None else object_distance
    chosen = sorted(set(wavelengths) or {486.1327e-9, 656.2725e-9, lens.design_wavelength})
    image = image_plane(lens, distance)
    paraxial = paraxial_image(lens, lens.design_wavelength, distance)
    shifts = focal_shift(lens, chosen, distance)
    return LensSummary(
        file=Path(path).name,
        name=lens.name,
        surfaces=len(lens.surfaces),
        stop=lens.stop + 1,
        stop_diameter_m=2 * lens.stop_radius,
        design_wavelength_m=lens.design_wavelength,
        object_distance_m=_finite(distance),
        image_distance_m=image,
        paraxial_image_distance_m=paraxial,
        wavelengths=[_first_order(lens, w, float(shift)) for w, shift in zip(chosen, shifts)],
        fields=[_field(lens, chosen, angle, distance) for angle in fields],
    )


def _first_order(lens: Prescription, wavelength: float, shift: float) -> FirstOrderSummary:
    data = first_order(lens, wavelength)
    return FirstOrderSummary(
        wavelength_m=wavelength,
        focal_length_m=data.focal_length,
        back_focus_m=data.back_focus,
        focal_shift_m=shift,
        f_number=_finite(data.f_number),
        front_principal_m=data.front_principal,
        rear_principal_m=data.rear_principal,
        entrance_pupil=_pupil(data.entrance_pupil),
        exit_pupil=_pupil(data.exit_pupil),
    )


def _pupil(pupil: Pupil) -> PupilSummary:
    return PupilSummary(position_m=_finite(pupil.position), radius_m=_finite(pupil.radius))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _field(
    lens: Prescription, wavelengths: Sequence[float], angle: float, distance: float
) -> FieldSummary:
    """W, lateral colour, distortion and vignetting at one field; a field whose chief ray
    fails says so instead.
    """
    found: dict[str, Any] = {}
    try:
        found.update(transmitted=transmitted(lens, lens.design_wavelength, angle, distance))
        found.update(
            distortion=distortion(lens, lens.design_wavelength, angle, distance) if angle else 0.0
        )
        colour = lateral_colour(lens, wavelengths, angle, distance)
        found.update(wavelengths=(rows := []))
        for wavelength, shift in zip(wavelengths, colour):
            rows.append(_aberration(lens, wavelength, float(shift), angle, distance))
    except NumericsError as error:
        found.update(trouble=error.what)
    return FieldSummary(angle_rad=angle, **found)


def _aberration(
    lens: Prescription, wavelength: float, shift: float, angle: float, distance: float
) -> AberrationSummary:
    points, weights = disc_points(16, 64)
    wave = wavefront(lens, wavelength, points, angle=angle, object_distance=distance)
    rms = wave.rms(weights)
    terms, rest = noll_coefficients(lens, wavelength, 22, angle=angle, object_distance=distance)
    return AberrationSummary(
        wavelength_m=wavelength,
        lateral_colour_m=shift,
        image_height_m=float(wave.centre[1]),
        wavefront_rms_m=rms,
        wavefront_rms_waves=rms / wavelength,
        noll_m=[float(c) for c in terms],
        noll_rest_m=rest,
    )


def describe(summary: LensSummary) -> str:
    """The summary of a lens as lines for a terminal."""
    distance = summary.object_distance_m
    lines = [
        (
            f"{summary.file}: {summary.name or 'lens'}, {summary.surfaces} surfaces, stop at "
            f"{summary.stop}, {summary.stop_diameter_m * 1e3:.6g} mm wide, designed at "
            f"{format_length(summary.design_wavelength_m)}"
        ),
        (
            f"  object at {'infinity' if distance is None else format_length(distance)}, image "
            f"plane {summary.image_distance_m * 1e3:.5f} mm behind the last vertex (paraxial "
            f"{summary.paraxial_image_distance_m * 1e3:.5f} mm)"
        ),
        (
            "  wavelength   focal length   back focus     focal shift   F-number  entrance pupil: "
            "place, diameter   exit pupil: place, diameter"
        ),
    ]
    lines += [
        f"  {row.wavelength_m * 1e9:7.2f} nm  {row.focal_length_m * 1e3:10.5f} mm  "
        f"{row.back_focus_m * 1e3:9.5f} mm  {row.focal_shift_m * 1e6:+9.2f} um  "
        f"{_shown(row.f_number):>8}  {_place(row.entrance_pupil)}  {_place(row.exit_pupil)}"
        for row in summary.wavelengths
    ]
    for field in summary.fields:
        lines += _field_lines(field)
    return "\n".join(lines)


def _field_lines(field: FieldSummary) -> list[str]:
    head = f"  field {math.degrees(field.angle_rad):.4g} deg: "
    if field.trouble is not None:
        return [head + field.trouble]
    return [
        head + f"{field.transmitted:.1%} of the stop lit, distortion {field.distortion:+.3%}",
        *(
            f"    {row.wavelength_m * 1e9:7.2f} nm  W rms {row.wavefront_rms_waves:.4f} "
            f"waves = {row.wavefront_rms_m * 1e9:.1f} nm  image height "
            f"{row.image_height_m * 1e3:.5f} mm  lateral colour "
            f"{row.lateral_colour_m * 1e6:+.2f} um"
            for row in field.wavelengths or ()
        ),
    ]


def _shown(value: float | None, form: str = ".4f") -> str:
    return "-" if value is None else f"{value:{form}}"


def _place(pupil: PupilSummary) -> str:
    if pupil.position_m is None or pupil.radius_m is None:
        return f"{'at infinity':>28}"
    return f"{pupil.position_m * 1e3:+12.5f}, {2 * pupil.radius_m * 1e3:9.5f} mm"


# --- import ---------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class ImportSummary(Record):
    """What was imported.

    output: the lens file.
    input: name of the prescription.
    glasses: names of the media but air.
    f_number: None where the exit pupil is at infinity.
    notes: what could not be kept.
    """

    output: str
    input: str
    surfaces: int
    glasses: list[str]
    focal_length_m: float
    f_number: float | None
    notes: list[str]


def run_lens_import(
    path: Name, output: Name, *, focal_length: float | None = None, overwrite: bool = False
) -> ImportSummary:
    """Convert a prescription into a lens file. Glasses are written out with their dispersion
    formulas.

    path: .zmx, CODE V .seq or optiland's .json.
    output: .toml.
    focal_length: to scale the lens to, m.
    overwrite: replace a file that is there.

    Raises InputError for what cannot be read or modelled, UsageError without optiland or where a
    file exists.
    """
    from plenocli.files.atomic import check_output, publish

    path, output = Path(path), Path(output)
    check_output(output, overwrite=overwrite, inputs=[path], suffixes=(".toml",))
    lens, notes = import_lens(path)
    if focal_length is not None:
        lens = lens.scaled(focal_length / first_order(lens, lens.design_wavelength).focal_length)
    data = first_order(lens, lens.design_wavelength)
    publish(output, lens_toml(lens, [f"from {path.name}", *notes]).encode(), overwrite=overwrite)
    return ImportSummary(
        output=str(output),
        input=path.name,
        surfaces=len(lens.surfaces),
        glasses=sorted({s.medium.name for s in lens.surfaces} - {"air"}),
        focal_length_m=data.focal_length,
        f_number=_finite(data.f_number),
        notes=notes,
    )


def line(summary: ImportSummary) -> str:
    """The summary of an import as one line, and one for each note."""
    head = (
        f"{summary.output}: {summary.surfaces} surfaces, f = "
        f"{summary.focal_length_m * 1e3:.6g} mm, F/{_shown(summary.f_number, '.4g')}, "
        f"glasses {', '.join(summary.glasses)}"
    )
    return "\n".join([head, *(f"  note: {note}" for note in summary.notes)])
