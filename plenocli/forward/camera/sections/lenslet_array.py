"""[lenslet_array]: the lattice and its lenslets."""

import math
from typing import Literal, Self

from pydantic import model_validator

from plenocli.base.quantities import (
    Length,
    Pair,
    Section,
    Unit,
)
from plenocli.forward.camera.sections.main_lens import Glass
from plenocli.forward.camera.sections.resolved import LEFT_OUT, Resolved

ROW_SPACING = math.sqrt(3) / 2
"""Spacing of the rows of a hexagonal lattice, in units of its pitch."""


class Lattice(Section):
    """How lenslets stand, and their openings: `fill_factor` times the pitch across."""

    lattice: Literal["square", "hexagonal"] = "square"
    aperture_shape: Resolved[Literal["square", "circle", "hexagon"]] = LEFT_OUT
    fill_factor: Unit = 1.0

    @model_validator(mode="after")
    def _apart(self) -> Self:
        if self.aperture_shape is None:
            square = self.lattice == "square"
            self.__dict__.update(aperture_shape="square" if square else "hexagon")
        other = {"square": "hexagon", "hexagonal": "square"}[self.lattice]
        if self.aperture_shape == other and self.fill_factor > ROW_SPACING:
            raise ValueError(
                f'lenslets of aperture_shape = "{other}" overlap on a {self.lattice} lattice '
                f"where fill_factor is above {ROW_SPACING:.4f}"
            )
        return self

    @property
    def row_spacing(self) -> float:
        """Distance of neighbouring rows of lenslets over the pitch: 1, or sqrt(3)/2 on a
        hexagonal lattice.
        """
        return ROW_SPACING if self.lattice == "hexagonal" else 1.0


class LensletArray(Lattice):
    """The lenslets.

    profile: their phase in the exact model, "hyperbolic" (a plane wave comes to a point at the
        focal length) or "parabolic" (the paraxial phase, which leaves spherical aberration).
    """

    distance: Length
    pitch: Resolved[Length] = LEFT_OUT
    superpixel_pitch: Length | None = None
    focal_length: Length
    glass: Glass = "none"
    profile: Literal["hyperbolic", "parabolic"] = "hyperbolic"
    count: Pair = (11, 11)

    @model_validator(mode="after")
    def _one_pitch(self) -> Self:
        if (self.pitch is None) == (self.superpixel_pitch is None):
            raise ValueError(
                "give exactly one of pitch (on the array) and superpixel_pitch (on the sensor)"
            )
        return self
