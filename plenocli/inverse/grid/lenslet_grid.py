"""The lenslets of a sensor as an array: where each is, and the lattice that they follow."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, kw_only=True)
class LensletGrid:
    """A lenslet grid. Positions are (row, column) px with pixel centres at integers.

    lattice: "square" or "hexagonal" (rows of a hexagonal grid are offset by half a pitch).
    pitch: (2,) px, lengths of the two lattice vectors (down, right).
    angle: degrees, of the right vector, positive towards larger rows.
    basis: (2, 2) px, mean lattice vectors [down, right].
    model: form of the map from lattice index to pixel.
    centres: (lenslet_row, lenslet_column, 2) px, the map at every site of the array.
    valid: (lenslet_row, lenslet_column), whether the cell lies in the frame and is lit.
    residual: (lenslet_row, lenslet_column) px, distance of the measured place from the map, NaN
        where not measured; None where nothing is known of it.
    rms: px, of the residuals of valid sites.
    expected_error: px rms, by which the map may be off as a whole: of a grid from captures of a
        scene; None: nothing is known beyond the residuals.
    """

    lattice: str
    pitch: np.ndarray
    angle: float
    basis: np.ndarray
    model: str
    centres: np.ndarray
    valid: np.ndarray
    residual: np.ndarray | None
    rms: float
    expected_error: float | None = None

    def window_shape(self) -> tuple[int, int]:
        """Rows and columns of a superpixel's window, px: the pitch, whole; a hexagonal cell's
        bounding square.
        """
        if self.lattice == "square":
            rows, columns = np.rint(np.abs(np.array([self.basis[0, 0], self.basis[1, 1]])))
        else:
            rows, columns = np.ceil(np.full(2, self.pitch.max()))
        return int(rows), int(columns)
