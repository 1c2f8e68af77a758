"""Labelled spectra of a user's own: a table, or a folder of tables and spectral images."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError, UsageError
from plenocli.files.config.toml_file import read_text
from plenocli.forward.scene.labelled import LabelledSpectra

LARGEST = 1e30
"""Of a pixel of an image, which is carried in single precision."""
BRIGHTEST = 10.0
"""Reflectance in a table, white being 1: what is fluorescent or shines back at the light may be
above 1. Measured ones are below 0 by their noise at the most, a hundredth of it.
"""
WANTED = (
    "give a .csv whose first column are wavelengths in nm, and every other the reflectances of one "
    "spectrum below the name of its class; or a folder with a folder, a .csv or a spectral image "
    "for each class, named like it"
)
MOST = 1024
"""Spectra that are taken of one image, evenly over its pixels."""
_IMAGES = (".exr", ".h5")


def read_labelled(path: Path | str, bands: np.ndarray | None = None) -> LabelledSpectra:
    """The labelled spectra of a table or a folder.

    path: of a CSV file, whose columns with the same name are spectra of one class; or of a folder,
        in which every folder, .csv, spectral .exr or .h5 holds the spectra of the class that it is
        named after (in a folder of them the columns' names mean nothing; of an image every pixel
        is a spectrum, at most MOST of them).
    bands: (band,) m that must lie within the table.

    Spectra of several files are brought to all wavelengths of all of them, in the range that they
    share.
    Raises InputError for what is no such table, for fewer than two classes, and where a band lies
    beyond the table.
    """
    path = Path(path)
    found = _folder(path) if path.is_dir() else _table(path)
    if len(set(found.labels)) < 2 or not all(found.labels):
        raise InputError(f"names {len(set(found.labels))} classes", path, WANTED)
    nm = found.wavelengths * 1e9
    inside = nm[0] - 1e-6, nm[-1] + 1e-6
    beyond = [] if bands is None else [b for b in bands * 1e9 if not inside[0] <= b <= inside[1]]
    if beyond:
        raise InputError(
            f"goes from {nm[0]:g} to {nm[-1]:g} nm, there is a band at {beyond[0]:.4g} nm",
            path,
            "give spectra that reach over all bands, their wavelengths in nm",
        )
    return found


def require_class(known: LabelledSpectra, name: str | None, path: Path | str) -> None:
    """UsageError where a class is looked for (--detect) that there is none of.

    known: the labelled spectra of `path`.
    """
    if name not in (None, *known.labels):
        raise UsageError(
            f"{name} is no class of {path}",
            "--detect",
            f"choose one of {', '.join(dict.fromkeys(known.labels))}",
        )


def _table(path: Path) -> LabelledSpectra:
    lines = read_text(path, "class", WANTED).splitlines()
    # programs for tables write semicolons where the comma is a decimal point
    comma = next((c for c in ",;\t" if lines and c in lines[0]), ",")
    head, *rows = [row for row in csv.reader(lines, delimiter=comma) if any(row)] or [[]]
    labels = tuple(name.strip() for name in head[1:])
    if not labels:
        raise InputError("names 0 classes in its first line", path, WANTED)
    try:
        numbers = np.array([[float(cell) for cell in row] for row in rows])
    except ValueError as error:
        raise InputError(f"is no table of numbers ({error})", path, WANTED) from None
    if numbers.ndim != 2 or numbers.shape[1] != len(head) or len(numbers) < 2:
        raise InputError("has lines of different length, or fewer than three", path, WANTED)
    numbers = numbers[np.argsort(numbers[:, 0])]
    nm, values = numbers[:, 0], numbers[:, 1:]
    if not np.isfinite(nm).all() or (np.diff(nm) <= 0).any():
        raise InputError("has a wavelength twice, or one that is no number", path, WANTED)
    for wrong, trouble, mend in (
        (~np.isfinite(values), "not finite", "leave the spectrum or the wavelength out"),
        (values > BRIGHTEST, "no reflectance", "write 0.25 for 25 %"),
        (values < -BRIGHTEST / 100, "below 0", "give reflectances of 0 to 1"),
    ):
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            raise InputError(
                f"has {values[row, column]:g} at {nm[row]:g} nm in column {column + 2} "
                f"({labels[column]}), which is {trouble}",
                path,
                mend,
            )
    return LabelledSpectra(labels, nm * 1e-9, values.T)


def _image(path: Path, label: str) -> LabelledSpectra:
    """The pixels of a spectral image, that have values in all bands, as spectra of one class."""
    from plenocli.files.artefacts.reading import read_artefact
    from plenocli.files.images.pictures import read_picture

    if path.suffix == ".h5":
        found = read_artefact(path, ("image", "spectra"))
        nodes, values = (
            found.data.get(f"{found.kind}/wavelength"),
            found.data[f"{found.kind}/value"],
        )
    else:
        picture = read_picture(path)
        nodes, values = picture.wavelengths, np.moveaxis(picture.values, -1, 0)
    if nodes is None or len(nodes) < 2:
        raise InputError("has no wavelengths, or one", path, "give a spectral image")
    pixels = np.asarray(values, float).reshape(len(nodes), -1).T
    pixels = pixels[(np.abs(pixels) <= LARGEST).all(axis=1)]
    if not len(pixels):
        raise InputError("has no pixel with values in all bands", path, WANTED)
    pixels = pixels[:: -(-len(pixels) // MOST)]
    order = np.argsort(nodes)
    return LabelledSpectra((label,) * len(pixels), nodes[order], pixels[:, order])


def _folder(path: Path) -> LabelledSpectra:
    files = [
        (entry.stem if entry.is_file() else entry.name, file)
        for entry in sorted(path.iterdir())
        for file in (sorted(entry.iterdir()) if entry.is_dir() else [entry])
        if file.suffix.lower() in (".csv", *_IMAGES)
    ]
    if not files:
        raise InputError("holds no spectra", path, WANTED)
    parts = []
    for label, file in files:
        if file.suffix.lower() in _IMAGES:
            parts.append(_image(file, label))
        else:
            table = _table(file)
            parts.append(
                LabelledSpectra((label,) * len(table.labels), table.wavelengths, table.spectra)
            )
    low, high = max(p.wavelengths[0] for p in parts), min(p.wavelengths[-1] for p in parts)
    if not low < high:
        raise InputError("holds spectra that share no wavelengths", path, WANTED)
    nodes = np.unique(np.concatenate([p.wavelengths for p in parts]).round(15))
    nodes = nodes[(nodes >= low - 1e-15) & (nodes <= high + 1e-15)]
    return LabelledSpectra(
        tuple(label for p in parts for label in p.labels),
        nodes,
        np.concatenate([p.at(nodes) for p in parts]),
    )
