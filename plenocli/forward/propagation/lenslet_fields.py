"""What every model makes: the fields behind the lenslets, asked for as pixel energies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from plenocli.forward.camera.geometry import Geometry
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import BandPlan, PifPlan

Flips = tuple[bool, bool, bool]
"""Symmetry: (flip rows, flip columns, transpose)."""
PixelEnergies = Callable[[np.ndarray, np.ndarray, np.ndarray], None]
"""Called with rows, columns (point,) and an array (point, pixel row, pixel column) to fill."""


@dataclass(frozen=True, kw_only=True)
class FieldNotes:
    """How fields were made.

    separable_terms: of the factor tables, 0 where there are none;
    field_tail: root energy of what was cut from the main lens's spread function;
    psf_terms: terms of the spread function, where they are not separable_terms;
    products: pairs of terms that the tables are compressed from, 0 where there are none;
    band_nodes: wavelengths that stand for a band of light, 0 for a line.
    """

    separable_terms: int
    field_tail: float
    psf_terms: int = 0
    products: int = 0
    band_nodes: int = 0


class LensletFields(ABC):
    """Pixel energies of object points through the lenslets, at one wavelength or in one band.

    A model defines `on_superpixel` or, where it computes all superpixels of a point at once,
    `columns`, and gets the other from here.

    symmetry: under which pupil and lenslets do not change;
    superpixels: (rows, columns) that the energies are wanted on;
    by_superpixel: whether superpixels are computed one by one, so that asking for one costs less;
    shared_axis: points with the same index along this axis (0 rows, 1 columns) share work.
    """

    symmetry: Flips
    notes: FieldNotes
    superpixels: tuple[int, int]
    by_superpixel: bool = True
    shared_axis: int = 1

    @abstractmethod
    def __init__(self, camera: Camera, geometry: Geometry, plan: PifPlan, band: BandPlan) -> None:
        """Set up the fields at the wavelength of `geometry`, with the node counts of `band`."""

    @abstractmethod
    def incident(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Light of points that enters the lenslets of the neighbourhood, or a bound of it from
        above.

        rows, columns: (point,) indices.

        Returns (point,), shares of the light through the aperture.
        """

    def columns(self, rows: np.ndarray, columns: np.ndarray, out: np.ndarray) -> None:
        """Pixel energies of points on all superpixels.

        rows, columns: (point,) indices;
        out: (point, superpixel row, superpixel column, pixel row, pixel column), filled.
        """
        for sy, sx in np.ndindex(*out.shape[1:3]):
            self.on_superpixel(sy, sx)(rows, columns, out[:, sy, sx])

    def on_superpixel(self, sy: int, sx: int) -> PixelEnergies:
        """What fills in the pixel energies on one superpixel; several threads may call it.

        sy, sx: row and column of the superpixel, from the corner of the grid.
        """
        return partial(self._one_of_all, sy, sx)

    def _one_of_all(
        self, sy: int, sx: int, rows: np.ndarray, columns: np.ndarray, out: np.ndarray
    ) -> None:
        every = np.empty((len(rows), *self.superpixels, *out.shape[1:]), out.dtype)
        self.columns(rows, columns, every)
        out[...] = every[:, sy, sx]
