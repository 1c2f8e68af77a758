"""What is scored: a picture, spectra or a dictionary, whatever kind of file it came from."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from plenocli.base.tiling import Plane


@dataclass(frozen=True, kw_only=True)
class ToldFigures:
    """What reconstruct tells of its result by itself, None where it does not; see the DEFINITIONS
    of quality.
    """

    noise_relative: float | None = None
    model_error_relative: float | None = None
    limited_by: str | None = None
    noise_raised: float | None = None
    detail_kept: float | None = None
    seen_share: float | None = None


@dataclass(frozen=True, kw_only=True)
class Result:
    """One result of the inverse stages.

    path: its file.
    kind: "image", "spectra" or "dictionary".
    plane: (row, column) or (band, row, column), which may still be in the file; atoms (point, atom)
        of a dictionary.
    wavelengths: (band,) m, None for a single picture.
    deviation: like plane, or None.
    s1: like plane, what is polarised of spectra (plenocli.inverse.spectra.spectra), or None.
    quantity: "radiance", "reflectance", or "" for pictures.
    method: how it was computed, "" where nobody says.
    block: (rows, columns) of object points under a lenslet, where the file says so.
    told: what reconstruct says of a picture by itself.
    seen: (object_row, object_column) share of the object under a lenslet that the sensor tells
        apart, or None.
    scale: by which a dictionary's matrix was divided.
    object_shape: (rows, columns) of a dictionary's atoms, or None.
    rgb: (3, row, column) linear sRGB of a picture in colour, or None.
    history: what learning a dictionary recorded, name -> values by iteration.
    """

    path: Path
    kind: str
    plane: Plane
    wavelengths: np.ndarray | None = None
    deviation: Plane | None = None
    s1: np.ndarray | None = None
    quantity: str = ""
    method: str = ""
    block: tuple[int, int] | None = None
    told: ToldFigures = ToldFigures()
    seen: np.ndarray | None = None
    scale: float = 1.0
    object_shape: tuple[int, ...] | None = None
    rgb: np.ndarray | None = None
    history: Mapping[str, np.ndarray] = field(default_factory=dict)

    @cached_property
    def values(self) -> np.ndarray:
        """All of the plane, in memory, float64."""
        return self.plane.window()

    @cached_property
    def sigma(self) -> np.ndarray | None:
        """All of the deviation, in memory, float64."""
        return None if self.deviation is None else self.deviation.window()

    @property
    def name(self) -> str:
        """The name of its file, without folder and suffix."""
        return self.path.stem

    @property
    def bands(self) -> np.ndarray:
        """(band,) m, the wavelengths of a result that has bands."""
        if self.wavelengths is None:
            raise ValueError(f"{self.path} is a single picture")
        return self.wavelengths

    @property
    def grid(self) -> tuple[int, int]:
        """(rows, columns) of the plane."""
        rows, columns = self.plane.shape[-2:]
        return rows, columns


@dataclass(frozen=True)
class WhiteTarget:
    """Spectra of a white target: frames (frame, band, row, column), and sigma (band, row, column)
    of the first, or None.
    """

    frames: np.ndarray
    sigma: np.ndarray | None
