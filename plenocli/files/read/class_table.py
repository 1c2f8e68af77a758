"""The classes that a user wants told apart: a table of labelled spectra."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.evaluation.metrics.classes import Classes
from plenocli.files.config.toml_file import read_text

WANTED = (
    "give a .csv whose first column are wavelengths in nm, and every other the reflectances of one "
    "spectrum below the name of its class"
)


def read_classes(path: Path, bands: np.ndarray) -> Classes:
    """The classes of a table, seen in some bands.

    path: of a CSV file; columns with the same name are spectra of one class.
    bands: (band,) m; spectra are linear between the table's wavelengths.

    Raises InputError for what is no such table, for fewer than two classes, and where a band lies
    beyond the table.
    """
    head, *rows = [
        row for row in csv.reader(read_text(path, "class", WANTED).splitlines()) if any(row)
    ] or [[]]
    labels = tuple(name.strip() for name in head[1:])
    if len(set(labels)) < 2 or not all(labels):
        raise InputError(f"names {len(set(labels))} classes in its first line", path, WANTED)
    try:
        numbers = np.array([[float(cell) for cell in row] for row in rows])
    except ValueError as error:
        raise InputError(f"is no table of numbers ({error})", path, WANTED) from None
    if numbers.ndim != 2 or numbers.shape[1] != len(head) or len(numbers) < 2:
        raise InputError("has lines of different length, or fewer than three", path, WANTED)
    numbers = numbers[np.argsort(numbers[:, 0])]
    nm, spectra = numbers[:, 0], numbers[:, 1:].T
    if not np.isfinite(numbers).all() or (np.diff(nm) <= 0).any():
        raise InputError("has a wavelength twice, or values that are not finite", path, WANTED)
    beyond = [b for b in bands * 1e9 if not nm[0] - 1e-6 <= b <= nm[-1] + 1e-6]
    if beyond:
        raise InputError(
            f"goes from {nm[0]:g} to {nm[-1]:g} nm, the result has a band at {beyond[0]:.4g} nm",
            path,
            WANTED,
        )
    return Classes.of_spectra(
        labels, np.stack([np.interp(bands * 1e9, nm, spectrum) for spectrum in spectra])
    )
