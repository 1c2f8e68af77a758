"""A light-field microscope: an objective whose image falls on lenslets, and a volume before it.

The image side is telecentric, as that of an objective with its tube lens is: superpixels have the
pitch of the lenslets. Depth is measured from the plane that is focused on the lenslets, positive
away from the objective.
"""

import math
from typing import Annotated, Self

from pydantic import BeforeValidator, Field, PrivateAttr, model_validator

from plenocli.base.quantities import (
    MOST_PLANES,
    Length,
    Pair,
    Section,
    SignedLength,
    planes_of,
)
from plenocli.base.units import format_length
from plenocli.forward.camera.plausible import unusual
from plenocli.forward.camera.sections.lenslet_array import Lattice
from plenocli.forward.camera.sections.light import Light
from plenocli.forward.camera.sections.main_lens import Aberration
from plenocli.forward.camera.sections.sensor import Sensor

Planes = Annotated[
    tuple[SignedLength, ...],
    Field(min_length=1, max_length=MOST_PLANES),
    BeforeValidator(planes_of),
]
Samples = Annotated[int, Field(ge=1, le=64)]
Index = Annotated[float, Field(ge=1.0, le=5.0)]


class Objective(Section):
    """The objective with its tube lens.

    magnification: from the specimen to the lenslet array.
    medium_index: of the immersion that it was made for.
    specimen_index: of the specimen, where it is another; the light then crosses from one into the
        other `specimen_depth` before the focused plane.
    aberrations: Zernike terms of the pupil (Noll), of unit radius at the numerical aperture.
    rings: measured intensity over the pupil, at equal steps of the sine from the middle to the
        edge, relative; without them the amplitude is that of a lens with Abbe's sine condition.
    """

    magnification: Annotated[float, Field(ge=0.1, le=1000.0)]
    numerical_aperture: Annotated[float, Field(gt=0.0, lt=2.0)]
    medium_index: Index = 1.0
    specimen_index: Index | None = None
    specimen_depth: Length | None = None
    aberrations: tuple[Aberration, ...] = ()
    rings: Annotated[tuple[Annotated[float, Field(ge=0.0)], ...], Field(max_length=200)] = ()

    @model_validator(mode="after")
    def _within(self) -> Self:
        least = min(self.medium_index, self.specimen_index or self.medium_index)
        if self.numerical_aperture >= least:
            raise ValueError(
                f"numerical_aperture {self.numerical_aperture:g} is not below the refractive index "
                f"{least:g}: light in such directions stays in the specimen; give medium_index "
                "(such as 1.33 for water, 1.515 for oil)"
            )
        if (self.specimen_index is None) != (self.specimen_depth is None):
            raise ValueError("specimen_index and specimen_depth go together")
        if self.rings and (len(self.rings) < 2 or not max(self.rings) > 0):
            raise ValueError("rings needs two values or more, one of them above 0")
        return self


class Specimen(Section):
    """The volume before the objective.

    planes: depths, rising: a list, or "-12 um to 12 um step 1 um".
    samples_per_lenslet: voxels (rows, columns) under one lenslet.
    """

    planes: Planes
    samples_per_lenslet: tuple[Samples, Samples] = (3, 3)

    @model_validator(mode="after")
    def _rising(self) -> Self:
        if any(b <= a for a, b in zip(self.planes, self.planes[1:])):
            raise ValueError("planes must rise without repetition")
        return self


class MicroscopeArray(Lattice):
    """The lenslets; on a hexagonal lattice rows are close-packed, and every other one stands half a
    pitch to the right.
    """

    pitch: Length
    focal_length: Length
    count: Pair = (11, 11)


class Microscope(Section):
    """A light-field microscope in SI units."""

    objective: Objective
    object: Specimen
    lenslet_array: MicroscopeArray
    sensor: Sensor
    light: Light
    _text: str = PrivateAttr("")

    @model_validator(mode="after")
    def _resolve(self) -> Self:
        light = self.light
        if light.design_wavelength is None:
            middle = light.wavelengths[len(light.wavelengths) // 2]
            self.__dict__.update(light=light.model_copy(update={"design_wavelength": middle}))
        if self.sensor.cfa != "mono":
            raise ValueError(
                f'sensor.cfa = "{self.sensor.cfa}": volumes are of monochrome sensors; leave it out'
            )
        lengths = {
            "lenslet_array.pitch": self.lenslet_array.pitch,
            "lenslet_array.focal_length": self.lenslet_array.focal_length,
            "sensor.distance": self.sensor.distance,
            "sensor.pixel_pitch": self.sensor.pixel_pitch,
        }
        if asked := unusual(lengths):
            raise ValueError(asked)
        for axis, pixels in enumerate(self.sensor.pixels_per_lenslet):
            spacing = self.lenslet_array.pitch / self.sensor.pixel_pitch
            spacing *= self.lenslet_array.row_spacing if axis == 0 else 1.0
            if abs(pixels / spacing - 1) > 0.1:
                raise ValueError(
                    f"sensor.pixels_per_lenslet {pixels} in {('rows', 'columns')[axis]}, but "
                    f"{spacing:.4g} pixels of {format_length(self.sensor.pixel_pitch)} fit under a "
                    f"lenslet {format_length(self.lenslet_array.pitch)} wide; captures are "
                    "resampled to whole pixels, by at most a tenth"
                )
        deepest = max(abs(plane) for plane in self.object.planes)
        lens = self.objective
        index = lens.specimen_index or lens.medium_index
        slope = lens.numerical_aperture / math.sqrt(index**2 - lens.numerical_aperture**2)
        blur = deepest * slope * lens.magnification / self.lenslet_array.pitch
        if blur > MOST_BLUR:
            raise ValueError(
                f"object.planes: a point {format_length(deepest)} out of focus is spread over "
                f"{blur:.0f} lenslets on each side; at most {MOST_BLUR} are possible"
            )
        return self


MOST_BLUR = 60
"""Lenslets on each side of its own that a point may be spread over."""
