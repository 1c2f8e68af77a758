"""[filter_array]: filters in the main lens, their spectra and places."""

import math
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import (
    Field,
    model_validator,
)

from plenocli.base.quantities import (
    Gap,
    Length,
    Pair,
    Place,
    Section,
    Unit,
    Wavelength,
)
from plenocli.forward.camera.sections.resolved import LEFT_OUT, Resolved

Polarisation = Literal["0 deg", "90 deg"]
"""Direction of the electric field: along the rows of the pupil (+x), or across them."""


class Curve(Section):
    """Measured intensity transmittance, linear between its wavelengths, which ascend."""

    wavelength: Annotated[tuple[Wavelength, ...], Field(min_length=2, max_length=4000)]
    transmittance: Annotated[
        tuple[Annotated[float, Field(ge=0.0, le=1.0)], ...], Field(min_length=2, max_length=4000)
    ]

    @model_validator(mode="after")
    def _paired(self) -> Self:
        if len(self.wavelength) != len(self.transmittance):
            raise ValueError(
                f"holds {len(self.wavelength)} wavelengths and {len(self.transmittance)} values"
            )
        if any(b <= a for a, b in zip(self.wavelength, self.wavelength[1:])):
            raise ValueError("wavelengths must ascend without repetition")
        if not max(self.transmittance) > 0:
            raise ValueError("lets no light through: all values are 0")
        return self


class Filter(Section):
    """Intensity transmittance of one cell of the filter array, as one of
    - a Gaussian band, peak exp(-4 ln2 ((l - center)/fwhm)^2) on a floor of `blocking`;
    - `transmittance` alike at all wavelengths: 1 is a clear cell, less a neutral one;
    - a measured `curve`, in a file of two columns.

    polariser: direction of the electric field that it lets through, "0 deg" along rows (+x) or "90
        deg"; the numbers above are those of light of this state.
    leak: transmittance for the crossed state over that for its own.
    polygon: its corners [y, x] in the pupil, instead of a cell of a layout; y downwards.
    index: effective refractive index of an interference filter, whose band moves to shorter
        wavelengths with the angle of the light: T(l) becomes T(l / sqrt(1 - (sin t / index)^2)).
    """

    center: Resolved[Wavelength] = LEFT_OUT
    fwhm: Resolved[Length] = LEFT_OUT
    peak: Resolved[Unit] = LEFT_OUT
    blocking: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    transmittance: Unit | None = None
    curve: Curve | None = None
    polariser: Polarisation | None = None
    leak: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    polygon: (
        Annotated[tuple[tuple[Place, Place], ...], Field(min_length=3, max_length=1000)] | None
    ) = None
    index: Annotated[float, Field(ge=1.0, le=5.0)] | None = None

    @model_validator(mode="after")
    def _one_kind(self) -> Self:
        if self.leak is not None and self.polariser is None:
            raise ValueError("leak goes with polariser")
        band = self.center is not None or self.fwhm is not None
        kinds = [band, self.transmittance is not None, self.curve is not None]
        if sum(kinds) != 1:
            raise ValueError(
                "give exactly one of center and fwhm (a band), transmittance (a clear or neutral "
                "cell) and curve (a measured one)"
            )
        if band and (self.center is None or self.fwhm is None):
            raise ValueError("a band has center and fwhm")
        if not band and (self.peak is not None or self.blocking is not None):
            raise ValueError("peak and blocking go with center and fwhm")
        if self.transmittance is not None and self.index is not None:
            raise ValueError("index goes with a band or a curve, which it moves")
        if band:
            whole = {"peak": self.peak or 0.8, "blocking": self.blocking or 0.0}
            self.__dict__.update(whole)
        return self

    def passes(self, state: str | None) -> float:
        """Share of light of a polarisation that it leaves; state None: unpolarised light."""
        if self.polariser is None or self.polariser == state:
            return 1.0
        leak = self.leak or 0.0
        return leak if state is not None else (1 + leak) / 2

    @property
    def middle(self) -> float | None:
        """Mean wavelength that it lets through, m; None where it lets all through alike."""
        if self.curve is None:
            return self.center
        return float(np.average(self.curve.wavelength, weights=self.curve.transmittance))

    @property
    def brightest(self) -> float | None:
        """Wavelength (m) of the largest transmittance; None where it lets all through alike."""
        if self.curve is None:
            return self.center
        return self.curve.wavelength[int(np.argmax(self.curve.transmittance))]

    @property
    def width(self) -> float:
        """Of the band that it lets through, m: full width at half maximum, of a curve its area over
        its peak; infinite where it lets all through alike.
        """
        if self.curve is None:
            return self.fwhm or math.inf
        area = np.trapezoid(self.curve.transmittance, self.curve.wavelength)
        return float(area) / max(self.curve.transmittance)

    @property
    def detail(self) -> float:
        """Width (m) of the Gaussian band whose flanks are as steep as its steepest, infinite where
        it lets all through alike; no less than FINEST_DETAIL.
        """
        if self.curve is None:
            return self.fwhm or math.inf
        steepest = np.abs(np.diff(self.curve.transmittance) / np.diff(self.curve.wavelength)).max()
        if steepest == 0:
            return math.inf
        flank = max(self.curve.transmittance) / steepest
        return max(FINEST_DETAIL, min(self.width, GAUSSIAN_FLANK * float(flank)))


FINEST_DETAIL = 5e-9
"""m; flanks of measured filters that are steeper are averaged over by the wavelengths between."""
GAUSSIAN_FLANK = 2 * math.sqrt(2 * math.log(2)) * math.exp(-0.5)
"""Steepest slope of a Gaussian band of unit peak and full width at half maximum."""
FILTER_SIGNS = ".123456789abcdefghijklmnopqrstuvwxyz"
"""What names filters in a drawing, by their number from 1."""
SAME_BAND = 1e-9
"""m; filters whose centres are nearer have one band."""


Drawn = Annotated[str, Field(min_length=1, max_length=256, pattern="^[.0-9a-z]+$")]


class FilterArray(Section):
    """Filters in the main lens, by one of
    - `layout`: as many cells by rows and columns, row by row, with a `gap` between them;
    - `drawing`: rows of a picture over the square of side `size`, a character a place: "1" to "9"
      and "a" to "z" for the filters from the first on, "." for none; a file may name a grey PNG
      instead, whose levels from dark to bright are the filters in their order, 0 is none;
    - a polygon of each filter.

    side: of the main lens that they stand on, which says at which angles light crosses them: those
        of the cone from the object point, or of that to its image on the array.
    """

    layout: Pair | None = None
    drawing: Annotated[tuple[Drawn, ...], Field(min_length=1, max_length=256)] | None = None
    gap: Gap = 0.0
    size: Length | None = None
    side: Literal["object", "image"] | None = None
    filters: tuple[Filter, ...]

    @model_validator(mode="after")
    def _one_place_a_filter(self) -> Self:
        outlined = [one.polygon is not None for one in self.filters]
        if [self.layout is not None, self.drawing is not None, any(outlined)].count(True) != 1:
            raise ValueError(
                "say where the filters are by exactly one of layout, drawing and a polygon of each"
            )
        if self.layout is not None and len(self.filters) != math.prod(self.layout):
            rows, columns = self.layout
            raise ValueError(
                f"layout {rows} x {columns} needs {rows * columns} filters, row by row; there are "
                f"{len(self.filters)}"
            )
        if any(outlined) and not all(outlined):
            raise ValueError(f"filters.{outlined.index(False)} has no polygon, others have")
        if self.gap and self.layout is None:
            raise ValueError("gap goes with layout")
        if self.size is not None and any(outlined):
            raise ValueError("size goes with layout or drawing; polygons have lengths of their own")
        self._check_drawing()
        if self.side is not None and all(one.index is None for one in self.filters):
            raise ValueError("side goes with filters whose index says how far their bands move")
        return self

    def _check_drawing(self) -> None:
        rows = self.drawing or ("1",)
        if len({len(row) for row in rows}) > 1:
            raise ValueError("rows of drawing are not of one length")
        used = {FILTER_SIGNS.index(sign) for row in rows for sign in row if sign not in ".0"}
        missing = set(range(1, len(self.filters) + 1)) ^ used if self.drawing else set()
        if missing:
            raise ValueError(
                f"drawing and filters differ: {FILTER_SIGNS[min(missing)]!r} is not in both; there "
                f"are {len(self.filters)} filters"
            )
