"""[main_lens]: focal length, pupil, aberrations, glass or prescription."""

import math
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    model_validator,
)

from plenocli.base.errors import ConfigError
from plenocli.base.quantities import (
    FileName,
    Length,
    Section,
    SignedLength,
    Unit,
    quantity,
)
from plenocli.base.units import format_length, parse_length
from plenocli.forward.camera.quadrature import Disc
from plenocli.forward.camera.sections.resolved import LEFT_OUT, Resolved


class Samples:
    """Values on a square grid that a camera carries beside its description: float64, read-only;
    equal where the values are.
    """

    def __init__(self, values: ArrayLike) -> None:
        self.values = np.array(values, float)
        self.values.flags.writeable = False

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Samples) and np.array_equal(self.values, other.values)

    def __hash__(self) -> int:
        return hash(self.values.tobytes())


def noll_indices(j: int) -> tuple[int, int]:
    """Radial and signed azimuthal order (n, m) of Noll's Zernike polynomial j >= 1; m < 0 is the
    sine term.

    Noll 1976.
    """
    n = int((math.sqrt(8 * j - 7) - 1) / 2)
    rest = j - n * (n + 1) // 2 - 1
    m = 2 * ((rest + 1 - n % 2) // 2) + n % 2
    return n, (-m if j % 2 else m)


class Aberration(Section):
    """One Zernike term of the wavefront error W in the main-lens pupil, Noll index, in
    metres of optical path.
    """

    noll: Annotated[int, Field(ge=1, le=231)]
    coefficient: SignedLength


class FieldRow(Section):
    """The main lens as lenslets at `height` from the optical axis see it, beside what it is for all
    of them.

    transmission: share of a round pupil's area that rims leave open; the rest is beyond a disc of
        the pupil's size whose centre is moved away from the lenslet, as by a rim behind the lens.
    aberrations: for a lenslet to the right of the axis (+x); they turn with its azimuth. Terms of
        one index add up.
    """

    height: Annotated[float, quantity(parse_length, "5 mm", 0.0, 1.0, format_length)]
    transmission: Unit = 1.0
    aberrations: tuple[Aberration, ...] = ()

    @model_validator(mode="after")
    def _symmetric(self) -> Self:
        odd = [term.noll for term in self.aberrations if noll_indices(term.noll)[1] < 0]
        if odd:
            raise ValueError(
                f"Noll terms {', '.join(map(str, odd))} are sines, which a lens that is symmetric "
                "about its axis does not have for a lenslet to the right of it"
            )
        return self

    @property
    def is_symmetric(self) -> bool:
        """Whether the lens is the same in all directions."""
        return self.transmission == 1 and all(
            noll_indices(term.noll)[1] == 0 for term in self.aberrations if term.coefficient
        )

    def coefficient(self, noll: int) -> float:
        """Of the term of that index, m."""
        return sum(term.coefficient for term in self.aberrations if term.noll == noll)


def _known_glass(name: str) -> str:
    if name.lower() == "none":
        return name
    from plenocli.forward.camera.glass import medium

    try:
        medium(name)
    except ConfigError as error:
        raise ValueError(f"{error.what}; {error.fix}") from None
    return name


Glass = Annotated[str, AfterValidator(_known_glass)]


class MainLens(Section):
    """The main lens. `aperture_image` (intensity transmittance) and `wavefront` (metres) name files
    with values on a square grid of cells over the square of side aperture_diameter: rows in the
    sense of the sensor's rows, downwards, looking along the light. `prescription` names a lens file
    (plenocli.files.config.lens_file): its focal shift and wavefront error at the object and
    aperture of this camera take the place of `glass`; focal_length must be the lens's own. What
    files hold is attached by Camera.attach; nothing here opens a file.

    field: what the lens is to lenslets off the axis, rows by height from 0 to the array's corner,
        interpolated in between. A prescription needs none: its pupil and wavefront are traced for
        every lenslet, rims where surfaces have a semi_diameter.
    apodisation: amplitude over the exit wave of the exact model. "aplanatic" (a lens that keeps
        Abbe's sine condition, as lenses corrected over a field do), "uniform-pupil" (an evenly lit
        plane aperture) or "uniform-sine" (even in direction cosines, which gives Airy's pattern).
    """

    focal_length: Length
    aperture_diameter: Resolved[Length] = LEFT_OUT
    f_number: Annotated[float, Field(gt=0.1, le=1000)] | None = None
    aperture_shape: Resolved[Literal["circle", "square", "annulus", "image"]] = LEFT_OUT
    aperture_image: FileName | None = None
    obscuration: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    glass: Glass = "none"
    aberrations: tuple[Aberration, ...] = ()
    apodisation: Literal["aplanatic", "uniform-pupil", "uniform-sine"] = "aplanatic"
    wavefront: FileName | None = None
    prescription: FileName | None = None
    field: tuple[FieldRow, ...] = ()
    _rims: tuple[Disc, ...] = PrivateAttr(())
    _samples: dict = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _one_aperture(self) -> Self:
        if (self.aperture_diameter is None) == (self.f_number is None):
            raise ValueError("give exactly one of aperture_diameter and f_number")
        if self.aperture_shape is None:
            plain = self.aperture_image is None
            self.__dict__.update(aperture_shape="circle" if plain else "image")
        if (self.aperture_shape == "image") != (self.aperture_image is not None):
            raise ValueError(
                'aperture_image is the whole aperture: it goes with aperture_shape = "image" (or '
                "none), and only with it"
            )
        if (self.aperture_shape == "annulus") != (self.obscuration > 0):
            raise ValueError(
                'obscuration (above 0) goes with aperture_shape = "annulus", and only with it'
            )
        if self.prescription is not None and self.glass.lower() != "none":
            raise ValueError(
                "glass and prescription exclude each other: a lens file names its own glasses"
            )
        heights = [row.height for row in self.field]
        if heights and (heights[0] != 0 or any(b <= a for a, b in zip(heights, heights[1:]))):
            raise ValueError("heights of field must ascend from 0 without repetition")
        if self.field and not self.field[0].is_symmetric:
            raise ValueError(
                "the first row of field is the axis, where a lens is the same in all directions: "
                "no transmission below 1, and only Noll terms without azimuth (4, 11, 22 ...)"
            )
        if self.aperture_shape == "image" and any(row.transmission < 1 for row in self.field):
            raise ValueError(
                'transmission below 1 is of a pupil with a rim, which aperture_shape = "image" '
                "lacks"
            )
        return self

    @property
    def rims(self) -> tuple[Disc, ...]:
        """Discs (y, x, radius; m) beyond which rims cut the pupil of a lens that was resolved for
        one lenslet (plenocli.forward.camera.field).
        """
        return self._rims

    def samples(self, name: str) -> Any:
        """What the file that a key names holds.

        name: "aperture_image", "wavefront" or "prescription".

        Returns the values (row, column), of "prescription" the Prescription; None without
            a name.
        Raises ConfigError where they have not been attached.
        """
        if getattr(self, name) is None:
            return None
        if name not in self._samples:
            raise ConfigError(
                f"the values of {getattr(self, name)!r} are missing",
                f"main_lens.{name}",
                "read the camera from its file",
            )
        return getattr(self._samples[name], "values", self._samples[name])
