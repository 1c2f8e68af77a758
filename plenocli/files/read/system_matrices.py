"""The system matrix as learn-dict and reconstruct use it: one matrix (superpixel, pixel,
point) in float64.
"""

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.text import by


@dataclass(frozen=True)
class System:
    """blocks (offset, pixel, point), points of several bands one band after the other;

    offsets (offset, 2); shapes (rows, columns) of a superpixel and an object block;
    accuracy: the record that simulate-pif left;
    bands (band,): wavelengths (m) of the pictures that the object has, empty where it is one
        picture without a colour;
    illuminant: the light that the bands' shares are for.
    """

    path: Path
    blocks: np.ndarray
    offsets: np.ndarray
    pixel_shape: tuple
    object_shape: tuple
    accuracy: dict = field(default_factory=dict)
    bands: tuple = ()
    illuminant: str | None = None

    @property
    def own(self):
        return self.blocks[np.flatnonzero(np.all(self.offsets == 0, axis=1))[0]]

    @cached_property
    def even(self):
        """The superpixel of an even object, (pixel, band): what light of one band makes of it."""
        return self.own.reshape(len(self.own), max(1, len(self.bands)), -1).sum(axis=2)

    def levels(self, y):
        """Brightness of each band, (..., band), behind superpixels y (..., pixel), by least
        squares on `even`.
        """
        return y @ np.linalg.pinv(self.even, rcond=1e-3).T


def read_system(path, mem_limit=None, *, by_band=False):
    """System of a pif artefact. InputError where it lacks (0, 0) or belongs to a hexagonal lattice.

    Several wavelengths are averaged, as equal shares of the light;
    by_band: those of a camera with filters in its pupil make an object with several
        bands (sensor.light.band_weights).
    """
    from plenocli.files.artefacts.shards import read_pif

    artefact = read_pif(path, mem_limit)
    if artefact.attrs.get("pif", {}).get("lattice", "square") != "square":
        raise InputError(
            (
                "belongs to a hexagonal lattice, whose object blocks do not tile a "
                "picture in rows and columns"
            ),
            path,
            "use the pif of a camera with a square lattice",
        )
    offsets = np.asarray(artefact.data["pif/lenslet_offset"], int)
    if not np.any(np.all(offsets == 0, axis=1)):
        raise InputError(
            "lacks the object's own superpixel, offset (0, 0)", path, "run simulate-pif again"
        )
    shapes = [
        tuple(int(n) for n in artefact.data[f"pif/{name}_shape"]) for name in ("pixel", "object")
    ]
    matrices = artefact.data["pif/A"]
    if matrices.shape[2:] != (np.prod(shapes[0]), np.prod(shapes[1])):
        raise InputError(
            (
                f"has matrices of {by(matrices.shape[2:])} for superpixels of {by(shapes[0])} "
                f"pixels and blocks of {by(shapes[1])} points"
            ),
            path,
            "run simulate-pif again",
        )
    bands, weights, illuminant = _bands(artefact, path) if by_band else ((), None, None)
    if weights is None:
        if len(matrices) > 1:
            note(
                f"{Path(path).name} holds {len(matrices)} wavelengths; they are averaged, as "
                "equal shares of the light"
            )
        weights = np.full((1, len(matrices)), 1 / len(matrices))
    blocks = np.concatenate(
        [
            sum(
                (w * np.asarray(a, np.float64) for w, a in zip(row, matrices) if w),
                np.zeros(matrices.shape[1:]),
            )
            for row in weights
        ],
        axis=2,
    )
    return System(
        Path(path), blocks, offsets, *shapes, artefact.provenance.accuracy, bands, illuminant
    )


def _bands(artefact, path):
    """(wavelengths of the bands, weights (band, wavelength), illuminant) of a pif whose camera
    has filters; ((), None, None) for others.
    """
    from plenocli.files.config.camera_file import parse_camera
    from plenocli.forward.scene.light import band_weights
    from plenocli.forward.scene.tables import illuminant

    if not artefact.provenance.config:
        return (), None, None
    camera = parse_camera(artefact.provenance.config, path)
    if camera.filter_array is None:
        return (), None, None
    bands, weights = band_weights(
        camera, artefact.data["pif/wavelength"], lambda w: illuminant(camera.light.illuminant, w)
    )
    return tuple(float(b) for b in bands), weights, camera.light.illuminant
