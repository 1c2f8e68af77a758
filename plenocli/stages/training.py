"""Training pictures for dictionaries and for the statistics of natural images."""

from pathlib import Path

import numpy as np

from plenocli.errors import InputError
from plenocli.stages.progress import note
from plenocli.stages.scenes import EMBEDDED, embedded_photograph

DEFAULT = ("skimage:camera", "skimage:coffee", "skimage:chelsea", "skimage:rocket", "skimage:coins", "skimage:moon", "skimage:brick",
           "skimage:grass", "skimage:gravel", "skimage:motorcycle_left")
"""Photographs that ship with scikit-image, but for the astronaut, which is the test picture."""

SCALES = (1, 2, 4)


def read_training(names, shape, *, not_scene=None):
    """Linear luminance pictures [(name, (row, column) float64)] of at least `shape`, from files or skimage:NAME; () means DEFAULT.

    not_scene: name of a test scene; a default picture of that name is left out with a note, one asked for is an error
    (statistics from the test picture would flatter every result). InputError where nothing is left.
    """
    from plenocli.scene.sample import luminance

    stem = Path(str(not_scene).removeprefix(EMBEDDED)).stem if not_scene else None
    pictures = []
    for name in names or DEFAULT:
        if stem and Path(str(name).removeprefix(EMBEDDED)).stem == stem:
            if names:
                raise InputError("is the captured scene itself; results trained on it would flatter", name, "train on other pictures")
            note(f"training leaves out {name}, which is the captured scene")
            continue
        try:
            picture = np.asarray(luminance(_values(name)), float)
        except InputError as error:
            if names:
                raise
            note(f"training leaves out a default picture: {error}")
            continue
        if min(picture.shape[0] - shape[0], picture.shape[1] - shape[1]) < 0:
            note(f"training leaves out {name}: {picture.shape[0]} x {picture.shape[1]} pixels are less than a block of {shape[0]} x {shape[1]}")
            continue
        if not (picture.min() >= 0 and np.ptp(picture) > 0):
            raise InputError("has no structure to learn from, or values below 0", name, "train on photographs")
        top = float(picture.max(initial=0))
        pictures.append((str(name), picture / top if top > 1 else picture))
    if not pictures:
        raise InputError("no training picture is left", fix=f"give pictures of at least {shape[0]} x {shape[1]} pixels")
    return pictures


def split_by_scene(pictures):
    """(training, held out): every fifth picture, from the third on, judges; one picture alone has to do both."""
    if len(pictures) == 1:
        note("one training picture only: the validation patches come from it too, so the figures flatter")
        return pictures, pictures
    held = set(range(2, len(pictures), 5)) or {len(pictures) - 1}
    return [p for k, p in enumerate(pictures) if k not in held], [pictures[k] for k in sorted(held)]


def at_scales(pictures, shape):
    """The (name, picture) pairs and their area averages by 2 and 4, as long as two blocks of `shape` fit: scenes come in all sizes."""
    from plenocli.scene.sample import block_mean

    out = []
    for name, picture in pictures:
        for k in SCALES:
            rows, columns = (n // k * k for n in picture.shape)
            if k == 1 or min(rows // k - 2 * shape[0], columns // k - 2 * shape[1]) >= 0:
                out.append((name, block_mean(picture[:rows, :columns], (k, k)) if k > 1 else picture))
    return out


def _values(name):
    if str(name).startswith(EMBEDDED):
        return embedded_photograph(str(name).removeprefix(EMBEDDED))
    from plenocli.artefacts import read_picture

    return read_picture(name).values


def files_of(names):
    """The paths among the names, for the provenance of an artefact."""
    return [str(n) for n in names if not str(n).startswith(EMBEDDED)] or None
