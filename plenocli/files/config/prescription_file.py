"""Lens prescriptions of other programs, read through optiland."""

from __future__ import annotations

import contextlib
import io
import math
import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.base.text import how_to_install
from plenocli.forward.camera.glass import AIR, GLASSES, Medium, medium
from plenocli.forward.camera.prescription import Prescription, Surface
from plenocli.forward.camera.raytrace import entrance_pupil

MAX_BYTES = 4 << 20
"""No prescription is longer; what is, is some other file."""
SUFFIXES = (".zmx", ".seq", ".json")


@dataclass(frozen=True, kw_only=True)
class ZemaxGlass:
    """A glass as a Zemax file names it.

    name: of the catalogue.
    index: (nd, Vd), None where the file does not say them.
    """

    name: str
    index: tuple[float, float] | None = None


def import_lens(path: str | os.PathLike[str]) -> tuple[Prescription, list[str]]:
    """A .zmx, CODE V .seq or optiland .json prescription, read by optiland.

    Returns the lens and notes on what could not be kept.
    Raises InputError for what cannot be read or modelled, UsageError without optiland.
    """
    path = Path(path)
    optic, said = _read(path)
    glasses = _zmx_glasses(path) if path.suffix.lower() == ".zmx" else {}
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
        found.append(_surface(surface, i, path, places[i] - places[i - 1], glasses.get(i), notes))
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


def _read(path: Path) -> tuple[Any, list[str]]:
    """(optiland's Optic, list of what it said); every failure is an InputError
    that names the file.
    """
    from plenocli.files.artefacts.provenance import require_file

    if path.suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"is {path.suffix or 'a file without a suffix'}; prescriptions are read as "
            f"{', '.join(SUFFIXES)}",
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
            f"importing a prescription needs optiland ({error})", path, how_to_install("lens")
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


def _number(value: Any) -> float:
    return float(np.ravel(value)[0])


def _surface(
    surface: Any,
    number: int,
    path: Path,
    thickness: float,
    glass: ZemaxGlass | None,
    notes: list[str],
) -> Surface:
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
        medium=_medium(surface.material_post, where, glass, notes),
        conic=_number(getattr(geometry, "k", 0.0) or 0.0),
        asphere=asphere,
        semi_diameter=semi,
    )


def _medium(material: Any, where: str, glass: ZemaxGlass | None, notes: list[str]) -> Medium:
    """The Medium of optiland's material: its dispersion formula where plenocli has it, else a
    fit; nd and Vd as they are.
    """
    kind, name = type(material).__name__, glass.name if glass else None
    if kind == "IdealMaterial":
        n = _number(material.index)
        return AIR if n == 1 else Medium(name or f"n{n:.5f}", "constant", (n,))
    if kind.startswith("AbbeMaterial"):
        nd, vd = (glass and glass.index) or (_number(material.index), _number(material.abbe))
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
    low, high = getattr(material, "_formula_wavelength_range", None) or (0.38, 0.78)
    limits = (float(low) * 1e-6, float(high) * 1e-6)
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


def _fitted(
    material: Any, label: str, where: str, limits: tuple[float, float], notes: list[str]
) -> Medium:
    """A polynomial n^2 through 81 values of any other dispersion law, within the visible; the
    note names what it leaves.
    """
    low, high = max(limits[0], 380e-9), min(limits[1], 780e-9)
    microns = np.linspace(low, high, 81) * 1e6
    n = np.array([_number(material.n(float(w))) for w in microns])
    powers = (0.0, 2.0, -2.0, -4.0, -6.0, -8.0)
    found = np.linalg.lstsq(np.stack([microns**p for p in powers], axis=1), n * n, rcond=None)[0]
    rest = np.abs(np.sqrt(sum(a * microns**p for a, p in zip(found, powers))) - n).max()
    notes.append(
        f"{where}: the dispersion of {label} is fitted from {low * 1e9:.0f} to {high * 1e9:.0f} "
        f"nm, to {rest:.1g} of its index"
    )
    return Medium(
        label, "polynomial", tuple((float(a), p) for a, p in zip(found, powers)), (low, high)
    )


def _zmx_glasses(path: Path) -> dict[int, ZemaxGlass]:
    """Glasses by surface number as a Zemax file writes them: optiland forgets unknown names."""
    data = path.read_bytes()
    text = data.decode(
        "utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8", errors="replace"
    )
    names: dict[int, str] = {}
    models: dict[int, tuple[float, float]] = {}
    number = None
    for words in (line.split() for line in text.splitlines()):
        if words[:1] == ["SURF"] and len(words) > 1 and words[1].isdigit():
            number = int(words[1])
        elif words[:1] == ["GLAS"] and number is not None and len(words) > 1:
            names[number] = words[1]
            try:
                models[number] = (float(words[4]), float(words[5]))
            except (IndexError, ValueError):
                continue
    return {
        i: ZemaxGlass(
            name=name,
            index=models[i] if i in models and models[i][0] > 1 and models[i][1] > 0 else None,
        )
        for i, name in names.items()
    }


def _pruned(lens: Prescription) -> Prescription:
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
