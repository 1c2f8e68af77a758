"""Labelled spectra of a user's own, and a chart that shows them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plenocli.forward.scene.chart import patch_of
from plenocli.forward.scene.sample import ALL

MOST_PATCHES = 48
"""Patches of a chart; of more spectra every class shows some, evenly taken."""


@dataclass(frozen=True)
class LabelledSpectra:
    """Reflectances of known classes.

    labels: (spectrum,) names of their classes.
    wavelengths: (node,) m, ascending.
    spectra: (spectrum, node), linear between the nodes and constant beyond them.
    """

    labels: tuple[str, ...]
    wavelengths: np.ndarray
    spectra: np.ndarray

    def at(self, wavelengths: ArrayLike) -> np.ndarray:
        """Reflectance (spectrum, wavelength) at wavelengths (n,) m."""
        asked = np.atleast_1d(np.asarray(wavelengths, float))
        return np.stack([np.interp(asked, self.wavelengths, one) for one in self.spectra])


class SpectraChart:
    """A flat chart of labelled spectra, each a patch, row by row; what is left over begins anew."""

    spectral = True

    def __init__(self, shown: LabelledSpectra) -> None:
        """shown: of many spectra, MOST_PATCHES, as many of one class as of another."""
        names = list(dict.fromkeys(shown.labels))
        most = max(1, MOST_PATCHES // len(names))
        of = {n: [i for i, label in enumerate(shown.labels) if label == n] for n in names}
        some = {
            n: [all_[i * len(all_) // most] for i in range(most)] if len(all_) > most else all_
            for n, all_ in of.items()
        }
        chosen = sorted(i for places in some.values() for i in places)
        self.spectra = LabelledSpectra(
            tuple(shown.labels[i] for i in chosen), shown.wavelengths, shown.spectra[chosen]
        )
        self.rows = max(1, round(np.sqrt(len(chosen) * 2 / 3)))
        self.columns = -(-len(chosen) // self.rows)

    def at(self, wavelength: float, rows: int, columns: int, part: slice = ALL) -> np.ndarray:
        """Reflectance (row, column) at a wavelength (m) on rows x columns object points, of the
        rows `part`.
        """
        values = self.spectra.at(wavelength)[:, 0]
        return values[self._numbers(rows, columns, whole=False)[part]].astype(np.float32)

    def whole(self, rows: int, columns: int) -> np.ndarray:
        """(row, column) bool, which cells of a grid see one patch alone."""
        return self._numbers(rows, columns, whole=True) >= 0

    def _numbers(self, rows: int, columns: int, whole: bool) -> np.ndarray:
        """(row, column) number of the spectrum that each cell sees, -1 for several."""
        row, column = (
            patch_of(rows, self.rows, 0.0, whole),
            patch_of(columns, self.columns, 0.0, whole),
        )
        number = (row[:, None] * self.columns + column[None]) % len(self.spectra.labels)
        return np.where((row[:, None] < 0) | (column[None] < 0), -1, number)
