"""Lens prescriptions: import through optiland, and what a lens does, as numbers and as text."""

import contextlib
import io
import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, NumericsError, UsageError
from plenocli.base.extras import how_to_install
from plenocli.base.units import format_length
from plenocli.files.config.lens_file import lens_toml, load_lens
from plenocli.forward.camera.glass import AIR, GLASSES, Medium, medium
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
from plenocli.forward.camera.prescription import Prescription, Surface
from plenocli.forward.camera.raytrace import entrance_pupil

MAX_BYTES = 4 << 20
"""No prescription is longer; what is, is some other file."""
SUFFIXES = (".zmx", ".seq", ".json")


# --- show -----------------------------------------------------------------------------------------


def run_lens_show(path, *, wavelengths=(), fields=(0.0,), object_distance=None):
    """What the lens in the TOML file `path` does, as a JSON-able dict; lengths in m, angles in rad.

    wavelengths: m, default C, d and F lines with the design wavelength;
    fields: rad;
    object_distance: m from the first vertex, default the lens's own.
    Raises InputError and ConfigError as load_lens does, NumericsError for a lens without power.
    """
    lens = load_lens(path)
    distance = lens.object_distance if object_distance is None else object_distance
    chosen = sorted(set(wavelengths) or {486.1327e-9, 656.2725e-9, lens.design_wavelength})
    report = {
        "file": Path(path).name,
        "name": lens.name,
        "surfaces": len(lens.surfaces),
        "stop": lens.stop + 1,
        "stop_diameter_m": 2 * lens.stop_radius,
        "design_wavelength_m": lens.design_wavelength,
        "object_distance_m": distance if math.isfinite(distance) else None,
        "image_distance_m": image_plane(lens, distance),
        "paraxial_image_distance_m": paraxial_image(lens, lens.design_wavelength, distance),
    }
    shifts = focal_shift(lens, chosen, distance)
    report["wavelengths"] = [_chromatic(lens, w, float(shift)) for w, shift in zip(chosen, shifts)]
    report["fields"] = [_field(lens, chosen, angle, distance) for angle in fields]
    return report


def _chromatic(lens, wavelength, shift):
    data = first_order(lens, wavelength)
    return {
        "wavelength_m": wavelength,
        "focal_length_m": data.focal_length,
        "back_focus_m": data.back_focus,
        "focal_shift_m": shift,
        "f_number": _finite(data.f_number),
        "front_principal_m": data.front_principal,
        "rear_principal_m": data.rear_principal,
        "entrance_pupil": {
            "position_m": _finite(data.entrance_pupil.position),
            "radius_m": _finite(data.entrance_pupil.radius),
        },
        "exit_pupil": {
            "position_m": _finite(data.exit_pupil.position),
            "radius_m": _finite(data.exit_pupil.radius),
        },
    }


def _finite(value):
    return value if math.isfinite(value) else None


def _field(lens, wavelengths, angle, distance):
    """W, lateral colour, distortion and vignetting at one field; a field whose chief ray
    fails says so instead.
    """
    report = {"angle_rad": angle}
    try:
        report["transmitted"] = transmitted(lens, lens.design_wavelength, angle, distance)
        report["distortion"] = (
            distortion(lens, lens.design_wavelength, angle, distance) if angle else 0.0
        )
        colour = lateral_colour(lens, wavelengths, angle, distance)
        points, weights = disc_points(16, 64)
        report["wavelengths"] = []
        for w, shift in zip(wavelengths, colour):
            wave = wavefront(lens, w, points, angle=angle, object_distance=distance)
            rms = wave.rms(weights)
            terms, rest = noll_coefficients(lens, w, 22, angle=angle, object_distance=distance)
            report["wavelengths"].append(
                {
                    "wavelength_m": w,
                    "lateral_colour_m": float(shift),
                    "image_height_m": float(wave.centre[1]),
                    "wavefront_rms_m": rms,
                    "wavefront_rms_waves": rms / w,
                    "noll_m": [float(c) for c in terms],
                    "noll_rest_m": rest,
                }
            )
    except NumericsError as error:
        report["trouble"] = error.what
    return report


def describe(report):
    """The report of `run_lens_show` as lines for a terminal."""
    design = report["design_wavelength_m"]
    distance = report["object_distance_m"]
    lines = [
        (
            f"{report['file']}: {report['name'] or 'lens'}, {report['surfaces']} surfaces, stop at "
            f"{report['stop']}, {report['stop_diameter_m'] * 1e3:.6g} mm wide, designed at "
            f"{format_length(design)}"
        ),
        (
            f"  object at {'infinity' if distance is None else format_length(distance)}, image "
            f"plane {report['image_distance_m'] * 1e3:.5f} mm behind the last vertex (paraxial "
            f"{report['paraxial_image_distance_m'] * 1e3:.5f} mm)"
        ),
        (
            "  wavelength   focal length   back focus     focal shift   F-number  entrance pupil: "
            "place, diameter   exit pupil: place, diameter"
        ),
    ]
    for row in report["wavelengths"]:
        lines.append(
            f"  {row['wavelength_m'] * 1e9:7.2f} nm  {row['focal_length_m'] * 1e3:10.5f} mm  "
            f"{row['back_focus_m'] * 1e3:9.5f} mm  {row['focal_shift_m'] * 1e6:+9.2f} um  "
            f"{_shown(row['f_number']):>8}  {_pupil(row['entrance_pupil'])}  "
            f"{_pupil(row['exit_pupil'])}"
        )
    for field in report["fields"]:
        head = f"  field {math.degrees(field['angle_rad']):.4g} deg: "
        if "trouble" in field:
            lines.append(head + field["trouble"])
            continue
        lines.append(
            head
            + f"{field['transmitted']:.1%} of the stop lit, distortion {field['distortion']:+.3%}"
        )
        lines += [
            (
                f"    {row['wavelength_m'] * 1e9:7.2f} nm  W rms {row['wavefront_rms_waves']:.4f} "
                f"waves = {row['wavefront_rms_m'] * 1e9:.1f} nm  image height "
                f"{row['image_height_m'] * 1e3:.5f} mm  lateral colour "
                f"{row['lateral_colour_m'] * 1e6:+.2f} um"
            )
            for row in field["wavelengths"]
        ]
    return "\n".join(lines)


def _shown(value, form=".4f"):
    return "-" if value is None else f"{value:{form}}"


def _pupil(pupil):
    if pupil["position_m"] is None:
        return f"{'at infinity':>28}"
    return f"{pupil['position_m'] * 1e3:+12.5f}, {2 * pupil['radius_m'] * 1e3:9.5f} mm"


# --- import ---------------------------------------------------------------------------------------


def run_lens_import(path, output, *, focal_length=None, overwrite=False):
    """Convert the prescription at `path` (.zmx, CODE V .seq, optiland's .json) into a lens file
    at `output`, .toml.

    Glasses are written out with their dispersion formulas.
    focal_length (m): scale the lens to it.
    Returns a JSON-able report with notes on what could not be kept. InputError for what cannot be
    read or modelled, UsageError without optiland.
    """
    from plenocli.files.atomic import check_output, publish

    path, output = Path(path), Path(output)
    check_output(output, overwrite=overwrite, inputs=[path], suffixes=(".toml",))
    lens, notes = import_lens(path)
    if focal_length is not None:
        lens = lens.scaled(focal_length / first_order(lens, lens.design_wavelength).focal_length)
    data = first_order(lens, lens.design_wavelength)
    publish(output, lens_toml(lens, [f"from {path.name}", *notes]).encode(), overwrite=overwrite)
    return {
        "output": str(output),
        "input": path.name,
        "surfaces": len(lens.surfaces),
        "glasses": sorted({s.medium.name for s in lens.surfaces} - {"air"}),
        "focal_length_m": data.focal_length,
        "f_number": _finite(data.f_number),
        "notes": notes,
    }


def line(report):
    """The report of `run_lens_import` as one line, and one for each note."""
    return "\n".join(
        [
            (
                f"{report['output']}: {report['surfaces']} surfaces, f = "
                f"{report['focal_length_m'] * 1e3:.6g} mm, F/{_shown(report['f_number'], '.4g')}, "
                f"glasses {', '.join(report['glasses'])}"
            ),
            *(f"  note: {note}" for note in report["notes"]),
        ]
    )


def import_lens(path):
    """(Prescription, notes) of a .zmx, .seq or .json prescription, read by optiland; errors
    as `run_lens_import`.
    """
    path = Path(path)
    optic, said = _read(path)
    if path.suffix.lower() == ".zmx":
        names, indices = _zmx_glasses(path)
    else:
        names, indices = {}, {}
    notes = sorted({text for text in said})
    surfaces = list(optic.surfaces)
    places = [_number(s.geometry.cs.z) / 1e3 for s in surfaces[1:]]
    if len(places) < 2:
        raise InputError(
            "holds no surface between object and image", path, "give the prescription of a lens"
        )
    found, stops = [], []
    for i, surface in enumerate(surfaces[1:-1], 1):
        if surface.is_stop:
            stops.append(i - 1)
        found.append(
            _surface(
                surface, i, path, places[i] - places[i - 1], names.get(i), indices.get(i), notes
            )
        )
    if len(stops) != 1:
        raise InputError(
            f"has {len(stops)} stops instead of one", path, "mark one surface as the stop"
        )
    # CODE V keeps the defocus behind the image surface
    extra = getattr(surfaces[-1], "thickness", 0.0)
    extra = 0.0 if extra is None or not math.isfinite(_number(extra)) else _number(extra) / 1e3
    found[-1] = replace(found[-1], thickness=found[-1].thickness + extra)
    object_z = _number(surfaces[0].geometry.cs.z) / 1e3
    far = math.inf if math.isinf(object_z) or abs(object_z) > 1e4 else places[0] - object_z
    wavelength = float(optic.primary_wavelength) * 1e-6
    lens = Prescription(
        surfaces=tuple(found),
        stop=stops[0],
        stop_radius=1.0,
        design_wavelength=wavelength,
        object_distance=far,
        name=(getattr(optic, "name", "") or path.stem).strip(),
    )
    radius = (
        _number(optic.paraxial.EPD())
        / 1e3
        / 2
        / abs(entrance_pupil(lens, wavelength).magnification)
    )
    return _pruned(replace(lens, stop_radius=radius)), notes


def _read(path):
    """(optiland's Optic, list of what it said); every failure is an InputError
    that names the file.
    """
    from plenocli.files.artefacts.provenance import require_file

    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            (
                f"is {path.suffix or 'a file without a suffix'}; prescriptions are read as "
                f"{', '.join(SUFFIXES)}"
            ),
            path,
            "convert it to .zmx",
        )
    if require_file(path) > MAX_BYTES:
        raise InputError(
            f"is larger than {MAX_BYTES} bytes and so no prescription", path, "give a .zmx file"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            from optiland import fileio
    except ImportError as error:
        raise UsageError(
            f"importing a prescription needs optiland ({error})",
            path,
            how_to_install("lens"),
        ) from None
    load = {
        ".zmx": fileio.load_zemax_file,
        ".seq": fileio.load_codev_file,
        ".json": fileio.load_optiland_file,
    }[path.suffix.lower()]
    printed = io.StringIO()
    try:
        with warnings.catch_warnings(record=True) as caught, contextlib.redirect_stdout(printed):
            warnings.simplefilter("always")
            optic = load(str(path))
    except Exception as error:  # a parser of others meets any file
        raise InputError(
            f"optiland cannot read it ({type(error).__name__}: {error})",
            path,
            "check that it is a sequential prescription",
        ) from None
    said = [
        str(w.message).splitlines()[0]
        for w in caught
        if "optiland" in str(w.category) or issubclass(w.category, UserWarning)
    ]
    return optic, [
        text.strip().removeprefix("Warning: ")
        for text in [*said, *printed.getvalue().splitlines()]
        if text.strip()
    ]


def _number(value):
    return float(np.ravel(value)[0])


def _surface(surface, number, path, thickness, name, model, notes):
    """One Surface from optiland's; refuses mirrors, tilts and shapes that the
    tracer does not know.
    """
    geometry = surface.geometry
    kind = type(geometry).__name__
    where = f"surface {number}"
    if getattr(surface.interaction_model, "is_reflective", False):
        raise InputError(f"{where} is a mirror", path, "only refracting lenses are modelled")
    if kind not in ("StandardGeometry", "EvenAsphere", "Plane"):
        raise InputError(
            f"{where} is of the kind {kind}", path, "spheres, conics and even aspheres are modelled"
        )
    if any(
        abs(_number(getattr(geometry.cs, axis))) > 1e-12 for axis in ("x", "y", "rx", "ry", "rz")
    ):
        raise InputError(f"{where} is tilted or off axis", path, "only centred lenses are modelled")
    radius = _number(geometry.radius) / 1e3
    coefficients = (
        [_number(c) for c in getattr(geometry, "coefficients", None) or ()]
        if kind == "EvenAsphere"
        else []
    )
    while coefficients and coefficients[-1] == 0:
        coefficients.pop()
    asphere = tuple(c * 1e3 ** (2 * i - 1) for i, c in enumerate(coefficients, 1))
    outer = getattr(surface.aperture, "r_max", None)
    if surface.aperture is not None and (outer is None or _number(surface.aperture.r_min)):
        notes.append(f"{where}: its aperture is no full disc and is left out")
    semi = (
        _number(outer) / 1e3
        if outer is not None and math.isfinite(_number(outer)) and _number(outer) > 0
        else math.inf
    )
    return Surface(
        curvature=0.0 if math.isinf(radius) else 1 / radius,
        thickness=thickness,
        medium=_medium(surface.material_post, where, name, model, notes),
        conic=_number(getattr(geometry, "k", 0.0) or 0.0),
        asphere=asphere,
        semi_diameter=semi,
    )


def _medium(material, where, name, model, notes):
    """The Medium of optiland's material: its dispersion formula where plenocli has it, else a
    fit; nd and Vd as they are.
    """
    kind = type(material).__name__
    if kind == "IdealMaterial":
        n = _number(material.index)
        return AIR if n == 1 else Medium(name or f"n{n:.5f}", "constant", (n,))
    if kind.startswith("AbbeMaterial"):
        nd, vd = model if model else (_number(material.index), float(np.ravel(material.abbe)[0]))
        if name in GLASSES:
            return medium(name)
        notes.append(
            (
                f"{where}: glass {name or '?'} is in no catalogue at hand; nd = {nd:g}, Vd = "
                f"{vd:g} of the file stand for it"
            )
            + (
                " (Zemax's placeholder: give the glass its true data)"
                if (nd, vd) == (1.5, 40.0)
                else ""
            )
        )
        return Medium(name or f"nd{nd:.5f}vd{vd:.2f}", "abbe", (nd, vd), (380e-9, 780e-9))
    label = str(getattr(material, "name", None) or name or f"glass of {where}")
    limits = tuple(
        float(l) * 1e-6
        for l in getattr(material, "_formula_wavelength_range", None) or (0.38, 0.78)
    )
    values = [float(v) for v in np.ravel(getattr(material, "coefficients", ()))]
    pairs = tuple(zip(values[1::2], values[2::2]))
    formula = getattr(material, "_n_formula", None)
    if formula == "formula 1" and values[0] == 0:
        return Medium(label, "sellmeier", tuple((b, c * c) for b, c in pairs), limits)
    if formula == "formula 2" and values[0] == 0:
        return Medium(label, "sellmeier", pairs, limits)
    if formula in ("formula 3", "formula 5"):
        return Medium(
            label,
            "polynomial" if formula == "formula 3" else "cauchy",
            ((values[0], 0.0), *pairs),
            limits,
        )
    return _fitted(material, label, where, limits, notes)


def _fitted(material, label, where, limits, notes):
    """A polynomial n^2 through 81 values of any other dispersion law, within the visible; the
    note names what it leaves.
    """
    low, high = max(limits[0], 380e-9), min(limits[1], 780e-9)
    l = np.linspace(low, high, 81) * 1e6
    n = np.array([_number(material.n(float(w))) for w in l])
    powers = (0.0, 2.0, -2.0, -4.0, -6.0, -8.0)
    found = np.linalg.lstsq(np.stack([l**p for p in powers], axis=1), n * n, rcond=None)[0]
    rest = np.abs(np.sqrt(sum(a * l**p for a, p in zip(found, powers))) - n).max()
    notes.append(
        f"{where}: the dispersion of {label} is fitted from {low * 1e9:.0f} to {high * 1e9:.0f} "
        f"nm, to {rest:.1g} of its index"
    )
    return Medium(
        label, "polynomial", tuple((float(a), p) for a, p in zip(found, powers)), (low, high)
    )


def _zmx_glasses(path):
    """({surface number: glass name}, {surface number: (nd, Vd)}) as a Zemax file writes them:
    optiland forgets unknown names.
    """
    data = path.read_bytes()
    text = data.decode(
        "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", errors="replace"
    )
    names, models, number = {}, {}, None
    for words in (line.split() for line in text.splitlines()):
        if words[:1] == ["SURF"] and len(words) > 1 and words[1].isdigit():
            number = int(words[1])
        elif words[:1] == ["GLAS"] and number is not None and len(words) > 1:
            names[number] = words[1]
            try:
                models[number] = (float(words[4]), float(words[5]))
            except (IndexError, ValueError):
                continue
    return names, {i: m for i, m in models.items() if m[0] > 1 and m[1] > 0}


def _pruned(lens):
    """The lens without surfaces that do nothing: flat, air on both sides, not the stop, no
    aperture, not first or last.
    """
    surfaces, stop = list(lens.surfaces), lens.stop
    for i in range(len(surfaces) - 2, 0, -1):
        surface, before = surfaces[i], surfaces[i - 1]
        if (
            i != stop
            and surface.vertex_curvature == 0
            and not any(surface.asphere)
            and surface.medium == before.medium
            and math.isinf(surface.semi_diameter)
        ):
            surfaces[i - 1] = replace(before, thickness=before.thickness + surface.thickness)
            del surfaces[i]
            stop -= i < stop
    return replace(lens, surfaces=tuple(surfaces), stop=stop)
