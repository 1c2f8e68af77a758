"""A measured transmittance: a text file of wavelengths and values."""

from __future__ import annotations

import csv
import math
import re
from pathlib import Path
from typing import Any

from plenocli.base.errors import InputError
from plenocli.base.units import LENGTHS
from plenocli.files.config.toml_file import read_text

WANTED = "give a text file of two columns, wavelength in nm and transmittance from 0 to 1"


def read_curve(path: Path) -> dict[str, Any]:
    """The table of a filter's transmittance, as a camera description has it.

    Two columns, wavelength and transmittance, apart by commas, semicolons, tabs or spaces. A header
    line may name the unit of the wavelengths (nm unless it does) and a per cent sign; lines that
    begin with # are left out. Rows may come in any order.
    path: of the file.

    Returns {"wavelength": texts with units, ascending; "transmittance": numbers}.
    Raises InputError, with the line, for what is no such table.
    """
    lines = [
        (number, line.strip())
        for number, line in enumerate(
            read_text(path, "filter", WANTED).removeprefix("\ufeff").splitlines(), 1
        )
        if line.strip() and not line.lstrip().startswith("#")
    ]
    rows, unit, percent = [], "nm", False
    for number, line in lines:
        try:
            wavelength, value = (float(cell) for cell in _cells(line))
            if not math.isfinite(wavelength + value):
                raise ValueError
            rows.append((wavelength, value))
        except ValueError:
            # a header has no figures at its start: what has is a row that was mistyped
            if rows or number != lines[0][0] or line[0] in "+-.0123456789":
                raise InputError(
                    f"line {number} is no wavelength and transmittance: {line[:60]!r}", path, WANTED
                ) from None
            words = re.split(r"[\s()\[\],;]+", line.lower())
            unit = next((word for word in words if word in LENGTHS), unit)
            percent = "%" in line
    rows.sort()
    _check(rows, percent, unit, path)
    scale = 0.01 if percent else 1.0
    return {
        "wavelength": [f"{w!r} {unit}" for w, _ in rows],
        "transmittance": [min(1.0, max(0.0, scale * t)) for _, t in rows],
    }


def _cells(line: str) -> list[str]:
    for mark in (";", "\t", ","):
        if mark in line:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=mark))]
    return line.split()


NOISE = 0.02
"""Below 0 and above 1: what a spectrometer's noise makes of nothing and of all."""


def _check(rows: list[tuple[float, float]], percent: bool, unit: str, path: Path) -> None:
    if len(rows) < 2:
        raise InputError(f"holds {len(rows)} rows of wavelength and transmittance", path, WANTED)
    top = max(t for _, t in rows) / (100 if percent else 1)
    low = min(t for _, t in rows) / (100 if percent else 1)
    if not (-NOISE <= low and top <= 1 + NOISE):
        raise InputError(
            f"holds transmittances from {low:.4g} to {top:.4g}, which go from 0 to 1",
            path,
            "say % in its header line if they are per cent",
        )
    if any(b[0] == a[0] for a, b in zip(rows, rows[1:])):
        twice = next(a[0] for a, b in zip(rows, rows[1:]) if b[0] == a[0])
        raise InputError(f"has {twice:g} {unit} twice", path, "keep one of the two rows")
