"""Training pictures for dictionaries and for the statistics of natural images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.files.read.scenes import EMBEDDED, embedded_photograph
from plenocli.inverse.prior.natural_images import TrainingPicture
from plenocli.inverse.prior.shelf import Shelf

DEFAULT = (
    "skimage:camera",
    "skimage:coffee",
    "skimage:chelsea",
    "skimage:rocket",
    "skimage:coins",
    "skimage:moon",
    "skimage:brick",
    "skimage:grass",
    "skimage:gravel",
    "skimage:motorcycle_left",
)
"""Photographs that ship with scikit-image, but for the astronaut, which is the test picture."""

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".bmp", ".ppm", ".pgm", ".webp")
"""What is taken for a picture in a folder."""


def read_training(
    names: Sequence[str],
    shape: tuple[int, int],
    *,
    not_scene: str | None = None,
    limit: int | None = None,
) -> list[TrainingPicture]:
    """Linear luminance pictures for dictionaries and statistics, each with its name.

    names: files, folders or skimage:NAME; () means DEFAULT. A folder stands for the pictures in it
        and below; what cannot be read there is left out with a note.
    shape: (rows, columns) that a picture must have at least.
    not_scene: name of a test scene; a default picture of that name is left out with a note, one
        asked for is an error (statistics from the test picture would flatter every result).
    limit: bytes beyond which the pictures lie in a temporary file, decoded one at a time.

    Returns [(name, (row, column) float32)].
    Raises InputError where nothing is left.
    """
    from plenocli.forward.scene.sample import luminance

    wanted, shelf = _expand(names or DEFAULT), Shelf(limit)
    stem = Path(str(not_scene).removeprefix(EMBEDDED)).stem if not_scene else None
    pictures = []
    for name, asked in wanted:
        asked = asked and bool(names)
        if stem and Path(str(name).removeprefix(EMBEDDED)).stem == stem:
            if asked:
                raise InputError(
                    "is the captured scene itself; results trained on it would flatter",
                    name,
                    "train on other pictures",
                )
            note(f"training leaves out {name}, which is the captured scene")
            continue
        try:
            picture = np.asarray(luminance(linear_values(name)), float)
        except InputError as error:
            if asked:
                raise
            note(f"training leaves out a picture: {error}")
            continue
        if min(picture.shape[0] - shape[0], picture.shape[1] - shape[1]) < 0:
            note(
                f"training leaves out {name}: {picture.shape[0]} x {picture.shape[1]} pixels are "
                f"less than a block of {shape[0]} x {shape[1]}"
            )
            continue
        if not (picture.min() >= 0 and np.ptp(picture) > 0):
            if not asked:
                note(f"training leaves out {name}: no structure, or values below 0")
                continue
            raise InputError(
                "has no structure to learn from, or values below 0", name, "train on photographs"
            )
        top = float(picture.max(initial=0))
        pictures.append((str(name), shelf.keep(picture / top if top > 1 else picture)))
    if not pictures:
        raise InputError(
            "no training picture is left",
            fix=f"give pictures of at least {shape[0]} x {shape[1]} pixels",
        )
    return pictures


def _expand(names: Sequence[str]) -> list[tuple[str, bool]]:
    """[(name, asked for by itself)], folders replaced by their pictures in order of their paths."""
    out = []
    for name in names:
        if str(name).startswith(EMBEDDED) or not Path(name).is_dir():
            out.append((name, True))
            continue
        found = sorted(p for p in Path(name).rglob("*") if p.suffix.lower() in SUFFIXES)
        if not found:
            raise InputError("holds no pictures", name, f"give a folder with {', '.join(SUFFIXES)}")
        out += [(str(p), False) for p in found]
    return out


def linear_values(name: str) -> np.ndarray:
    """Linear values of a file or of skimage:NAME, (row, column) or (row, column, channel)."""
    if str(name).startswith(EMBEDDED):
        return embedded_photograph(str(name).removeprefix(EMBEDDED))
    from plenocli.files.images.pictures import read_picture

    return read_picture(name).values


def files_of(names: Sequence[str]) -> list[str] | None:
    """The paths among the names, folders as their pictures, for the provenance of an artefact."""
    return [str(n) for n, _ in _expand(names) if not str(n).startswith(EMBEDDED)] or None
