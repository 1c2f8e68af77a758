"""The camera: one description of source, optics and detector, checked whole, kept in SI units.

Planes along the axis: object --object.distance--> main lens --lenslet_array.distance--> lenslet
array --sensor.distance--> sensor. All violations of a file are reported together,
each with its path.
"""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from plenocli.base.errors import ConfigError
from plenocli.base.quantities import (
    MOST_PLANES,
    Digits,
    Duration,
    ElectronRate,
    Electrons,
    FileName,
    Gain,
    Gap,
    Illuminance,
    Kelvins,
    Length,
    Luminance,
    Pair,
    Place,
    Radiance,
    Section,
    SignedLength,
    SpectralRadiance,
    Temperature,
    Unit,
    Wavelength,
    planes_of,
    quantity,
)
from plenocli.base.text import by
from plenocli.base.toml import violations
from plenocli.base.units import UnitError, format_length, parse_length, parse_wavelength
from plenocli.forward.camera.plausible import Lengths, implausible, unusual
from plenocli.forward.camera.quadrature import Disc

ROW_SPACING = math.sqrt(3) / 2
"""Spacing of the rows of a hexagonal lattice, in units of its pitch."""


if TYPE_CHECKING:
    _T = TypeVar("_T")
    Resolved = Annotated[_T, "may be left out of a file"]
else:

    class Resolved:
        """What a file may leave out or give in another way, and a Camera always has."""

        def __class_getitem__(cls, kind):
            return kind | None


_LEFT_OUT: Any = None


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
    aberrations: for a lenslet to the right of the axis (+x); they turn with its azimuth.
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


def _known_glass(name: str) -> str:
    from plenocli.forward.camera.glass import medium

    try:
        if name.lower() != "none":
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
    aperture_diameter: Resolved[Length] = _LEFT_OUT
    f_number: Annotated[float, Field(gt=0.1, le=1000)] | None = None
    aperture_shape: Resolved[Literal["circle", "square", "annulus", "image"]] = _LEFT_OUT
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


class Object(Section):
    """What is before the camera.

    planes: distances, rising, of the planes of a volume that is looked for, a list or
        "380 mm to 420 mm step 5 mm"; without them all stands at `distance`, which is in focus.
    """

    distance: Length
    samples_per_lenslet: Pair = (40, 40)
    planes: (
        Annotated[
            tuple[Length, ...],
            Field(min_length=1, max_length=MOST_PLANES),
            BeforeValidator(planes_of),
        ]
        | None
    ) = None

    @model_validator(mode="after")
    def _rising(self) -> Self:
        planes = self.planes or ()
        if any(b <= a for a, b in zip(planes, planes[1:])):
            raise ValueError("planes must rise without repetition")
        return self


class Lattice(Section):
    """How lenslets stand, and their openings: `fill_factor` times the pitch across."""

    lattice: Literal["square", "hexagonal"] = "square"
    aperture_shape: Resolved[Literal["square", "circle", "hexagon"]] = _LEFT_OUT
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
    pitch: Resolved[Length] = _LEFT_OUT
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


Share = Annotated[float, Field(ge=0.0, lt=1.0)]


class Sensor(Section):
    """The sensor. What is fixed about its pixels (dsnu, prnu, hot_pixels) is drawn from `serial`,
    as sensors of one kind differ, and is the same in every frame.

    exposure: its time, under a light of known strength; without it as long as fills a perfect
        white to 80 % of full well.
    dark_current: electrons a second and pixel in the mean, at 25 C.
    temperature: of the sensor; dark currents double every `dark_current_doubling`.
    dsnu: standard deviation over the pixels of the electrons without light and time.
    prnu: standard deviation over the pixels of their sensitivity, relative.
    hot_pixels: share of the pixels with a dark current of `hot_pixel_current` in the mean.
    crosstalk: share of a pixel's electrons that its four neighbours collect together.
    black_drift: standard deviation from frame to frame of the black level.
    """

    distance: Length
    pixel_pitch: Length
    pixels_per_lenslet: Pair
    pixel_fill_factor: Unit = 1.0
    cfa: Literal["mono", "RGGB", "BGGR", "GRBG", "GBRG"] = "mono"
    camera: str | None = None
    quantum_efficiency: Unit = 1.0
    full_well: Electrons = 15000.0
    read_noise: Electrons = 4.0
    gain: Gain = 0.25
    bits: Annotated[int, Field(ge=2, le=16)] = 12
    black_level: Annotated[int, Field(ge=0, le=65534)] = 0
    exposure: Duration | None = None
    dark_current: ElectronRate | None = None
    temperature: Temperature | None = None
    dark_current_doubling: Kelvins | None = None
    dsnu: Electrons | None = None
    prnu: Share | None = None
    hot_pixels: Share | None = None
    hot_pixel_current: ElectronRate | None = None
    crosstalk: Share | None = None
    black_drift: Digits | None = None
    serial: Annotated[int, Field(ge=0, lt=2**32)] | None = None

    DETECTION: ClassVar[frozenset[str]] = frozenset(
        "quantum_efficiency full_well read_noise gain bits black_level exposure dark_current "
        "temperature dark_current_doubling dsnu prnu hot_pixels hot_pixel_current crosstalk "
        "black_drift serial cfa camera".split()
    )
    """Keys that say what becomes of the light, not where it goes."""

    @model_validator(mode="after")
    def _levels(self) -> Self:
        if self.black_level >= 2**self.bits - 1:
            raise ValueError(f"black_level {self.black_level} leaves no range in {self.bits} bits")
        if self.cfa != "mono" and self.camera is None:
            raise ValueError(
                f'cfa = "{self.cfa}" needs camera, the name of measured sensitivities, such '
                'as "Nikon 5100 (NPL)"'
            )
        if self.full_well <= 0:
            raise ValueError("full_well must be above 0 e")
        return self

    @model_validator(mode="after")
    def _dark(self) -> Self:
        if self.hot_pixel_current is not None and not self.hot_pixels:
            raise ValueError("hot_pixel_current goes with hot_pixels, the share of such pixels")
        if self.dark_current_doubling is not None and self.temperature is None:
            raise ValueError("dark_current_doubling goes with temperature")
        return self


class Band(Section):
    """A band of light around `center`, `fwhm` wide: photons per wavelength fall off as a Gaussian,
    cut off at 1.5 fwhm on either side, or are constant (box).
    """

    center: Wavelength
    fwhm: Length
    shape: Literal["gaussian", "box"] = "gaussian"

    @model_validator(mode="after")
    def _narrow(self) -> Self:
        if self.fwhm > self.center / 3:
            raise ValueError(
                f"fwhm {format_length(self.fwhm)} is more than a third of the centre, "
                f"{format_length(self.center)}: give several bands' wavelengths instead"
            )
        return self


Polarisation = Literal["0 deg", "90 deg"]
"""Direction of the electric field: along the rows of the pupil (+x), or across them."""


class Light(Section):
    """What lights the scene.

    Its strength is that of a perfect white in the scene, by one of: `illuminance` (lux on it),
    `luminance`, `radiance` (over all its wavelengths) or `spectral_radiance` (at
    design_wavelength). Without any, exposure is relative: a perfect white fills the brightest pixel
    to 80 % of full well in `white_exposure`, whatever the lens, the filters and the pixels. A
    narrow band that --target mono shows has a lamp of its own, whose exposure is always relative.

    Exactly one of `wavelengths` (lines) and `band` is given; with a band, `wavelengths`
    resolves to its centre. A camera with filters may leave both out: its bands are their centres.
    `polarisation`: of all light; without it light is unpolarised, or as polarised as the scene.
    """

    wavelengths: Resolved[
        Annotated[tuple[Wavelength, ...], Field(min_length=1, max_length=1000)]
    ] = _LEFT_OUT
    band: Band | None = None
    design_wavelength: Resolved[Wavelength] = _LEFT_OUT
    illuminant: str = "D65"
    polarisation: Polarisation | None = None
    white_exposure: Duration = 0.01
    illuminance: Illuminance | None = None
    luminance: Luminance | None = None
    radiance: Radiance | None = None
    spectral_radiance: SpectralRadiance | None = None

    STRENGTHS: ClassVar[tuple[str, ...]] = (
        "illuminance",
        "luminance",
        "radiance",
        "spectral_radiance",
    )

    @property
    def strength(self) -> str | None:
        """Name of the key that says how strong the light is; None where exposure is relative."""
        return next((key for key in self.STRENGTHS if getattr(self, key) is not None), None)

    @model_validator(mode="after")
    def _one_strength(self) -> Self:
        given = [key for key in self.STRENGTHS if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"give at most one of {' and '.join(given)}")
        return self

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        if self.band is not None and self.wavelengths is None:
            self.__dict__.update(wavelengths=(self.band.center,))
        if self.wavelengths is None or (
            self.band is not None and self.wavelengths != (self.band.center,)
        ):
            raise ValueError("give exactly one of wavelengths and band")
        if any(b <= a for a, b in zip(self.wavelengths, self.wavelengths[1:])):
            raise ValueError("wavelengths must ascend without repetition")
        return self


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

    center: Resolved[Wavelength] = _LEFT_OUT
    fwhm: Resolved[Length] = _LEFT_OUT
    peak: Resolved[Unit] = _LEFT_OUT
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
_OF_BANDS = ("light", "filter_array")

PixelShift = Annotated[float, Field(ge=-0.5, le=0.5)]


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


class Fitted(Section):
    """What a fit to captures found beside the description (plenocli.inverse.fit): how far the
    pixels of every superpixel are shifted from its chief ray, and the relative error that a system
    matrix of this camera is still expected to have.
    """

    pixel_shift: tuple[PixelShift, PixelShift] = (0.0, 0.0)
    model_error: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0


def _check_range(section: str, glass: str, wavelengths: Sequence[float]) -> None:
    """ValueError where a glass is not described at one of the wavelengths (m)."""
    from plenocli.forward.camera.glass import medium

    if glass.lower() == "none":
        return
    try:
        for wavelength in wavelengths:
            medium(glass).index(wavelength)
    except ConfigError as error:
        raise ValueError(f"{section}.glass: {error.what}; {error.fix}") from None


class Camera(Section):
    """A plenoptic camera in SI units; every default and alternative is resolved when it is made."""

    main_lens: MainLens
    object: Object
    lenslet_array: LensletArray
    sensor: Sensor
    light: Light
    filter_array: FilterArray | None = None
    fitted: Fitted | None = None
    _text: str = PrivateAttr("")

    @model_validator(mode="before")
    @classmethod
    def _bands_of_filters(cls, data: Any) -> Any:
        """Bands that [light] does not name are the centres of the filters, each once."""
        sections = [data.get(name) if isinstance(data, dict) else None for name in _OF_BANDS]
        light, cells = (section if isinstance(section, dict) else None for section in sections)
        if light is None or cells is None or light.keys() & {"wavelengths", "band"}:
            return data
        found: list[float] = []
        given = [f.get("center") for f in cells.get("filters") or () if isinstance(f, dict)]
        try:
            centres = sorted(parse_wavelength(c) if isinstance(c, str) else c for c in given if c)
        except (UnitError, TypeError):
            return data  # which is told where it stands
        for centre in centres:
            if not found or centre - found[-1] > SAME_BAND:
                found.append(centre)
        bands = [format_length(centre) for centre in found]
        return {**data, "light": {**light, "wavelengths": bands}} if bands else data

    @model_validator(mode="after")
    def _resolve(self) -> Self:
        lens, array, light = self.main_lens, self.lenslet_array, self.light
        trouble = implausible(self._lengths())
        if trouble:
            raise ValueError(trouble)
        if self.sensor.exposure is not None and light.strength is None:
            raise ValueError(
                "sensor.exposure needs to know how strong the light is: give light.illuminance "
                '(such as "500 lx"), luminance, radiance or spectral_radiance; or give '
                "light.white_exposure, in which a perfect white fills the brightest pixel to 80 % "
                "of full well"
            )
        if lens.aperture_diameter is None:
            width = {"aperture_diameter": array.distance / lens.f_number, "f_number": None}
            self.__dict__.update(main_lens=lens.model_copy(update=width))
        if array.pitch is None:
            pitch = array.superpixel_pitch / (1 + self.sensor.distance / array.distance)
            pitches = {"pitch": pitch, "superpixel_pitch": None}
            self.__dict__.update(lenslet_array=array.model_copy(update=pitches))
        if light.design_wavelength is None:
            middle = light.wavelengths[len(light.wavelengths) // 2]
            self.__dict__.update(light=light.model_copy(update={"design_wavelength": middle}))
        used = (self.light.design_wavelength, *light.wavelengths)
        _check_range("main_lens", self.main_lens.glass, used)
        _check_range("lenslet_array", self.lenslet_array.glass, used)
        self._check_field()
        if self.filter_array is not None:
            self.__dict__.update(filter_array=self._fitting(self.filter_array))
        return self

    def _check_field(self) -> None:
        """ValueError where rows of main_lens.field end before the array does."""
        rows, array = self.main_lens.field, self.lenslet_array
        reach = [(n - 1) / 2 * array.pitch for n in array.count]
        corner = math.hypot(reach[0] * array.row_spacing, reach[1])
        if rows and rows[-1].height < corner * (1 - 1e-9):
            raise ValueError(
                f"main_lens.field ends at {format_length(rows[-1].height)} from the axis, the "
                f"array at {format_length(corner)}: add a row for its corner"
            )

    def _lengths(self) -> Lengths:
        """The lengths as they are given, before any is derived from others."""
        lens, array, sensor = self.main_lens, self.lenslet_array, self.sensor
        given = {
            "main_lens.focal_length": lens.focal_length,
            "main_lens.aperture_diameter": lens.aperture_diameter,
            "object.distance": self.object.distance,
            "lenslet_array.distance": array.distance,
            "lenslet_array.pitch": array.pitch,
            "lenslet_array.superpixel_pitch": array.superpixel_pitch,
            "lenslet_array.focal_length": array.focal_length,
            "sensor.distance": sensor.distance,
            "sensor.pixel_pitch": sensor.pixel_pitch,
            "filter_array.size": None if self.filter_array is None else self.filter_array.size,
        }
        wavelengths = self.light.wavelengths
        return Lengths(
            by_key={key: value for key, value in given.items() if value is not None},
            f_number=lens.f_number,
            pixels=max(sensor.pixels_per_lenslet),
            wavelengths=(min(wavelengths), max(wavelengths)),
        )

    def unusual_lengths(self) -> str | None:
        """What its lengths may have been meant to be (plausible.unusual)."""
        return unusual(self._lengths().by_key)

    def _fitting(self, cells: FilterArray) -> FilterArray:
        """The filter array with its size; ValueError where it does not fit into the pupil."""
        lens = self.main_lens
        if cells.size is None and any(one.polygon is not None for one in cells.filters):
            return cells
        if cells.size is None:
            inscribed = cells.layout is not None and lens.aperture_shape != "square"
            within = math.sqrt(0.5) if inscribed else 1
            cells = cells.model_copy(update={"size": lens.aperture_diameter * within})
        elif cells.size > lens.aperture_diameter * (1 + 1e-9):
            raise ValueError(
                f"filter_array.size {format_length(cells.size)} is wider than the pupil, "
                f"{format_length(lens.aperture_diameter)}"
            )
        if cells.layout is not None and cells.gap * max(cells.layout) >= (cells.size or 0):
            raise ValueError("filter_array.gap leaves no room for the filters")
        return cells

    @property
    def superpixel_pitch(self) -> float:
        """Spacing of superpixel centres on the sensor, m: pitch (1 + z3/z2), by similar
        triangles from the pupil's centre.
        """
        return self.lenslet_array.pitch * (1 + self.sensor.distance / self.lenslet_array.distance)

    @property
    def pixel_mismatch(self) -> tuple[float, float]:
        """(rows, columns): spacing of superpixels in pixels minus pixels_per_lenslet; zero when
        they tile whole pixels.
        """
        pitch = self.superpixel_pitch / self.sensor.pixel_pitch
        rows, columns = self.sensor.pixels_per_lenslet
        return pitch * self.lenslet_array.row_spacing - rows, pitch - columns

    def with_fit(self, pixel_shift: tuple[float, float], model_error: float) -> "Camera":
        """This camera with what a fit found beside it, as in Fitted."""
        fitted = Fitted(pixel_shift=pixel_shift, model_error=model_error)
        return self.model_copy(update={"fitted": fitted})

    def replace(self, **changes: Any) -> "Camera":
        """A camera with dotted keys changed to SI values: replace(**{"object.distance": 0.6}).

        Raises ConfigError where the changed description does not hold.
        """
        data = self.model_dump()
        for path, value in changes.items():
            section, key = path.split(".")
            data[section][key] = value
        try:
            changed = Camera.model_validate(data, context={"si": True})
        except ValidationError as error:
            raise violations(error, "camera", Camera) from None
        kept = {
            name: old
            for name, old in self.main_lens._samples.items()
            if getattr(changed.main_lens, name) == getattr(self.main_lens, name)
        }
        return changed.attach(**{name: getattr(old, "values", old) for name, old in kept.items()})

    def attach(self, **samples: Any) -> "Camera":
        """A camera that carries what its files hold: attach(aperture_image=..., wavefront=...,
        prescription=...).

        aperture_image: square array, intensity transmittance 0..1;
        wavefront: square array, m, positive for phase advance, at least 4 x 4;
        prescription: a Prescription.

        Raises ConfigError for keys that the description lacks and for values that cannot be.
        """
        lens = self.main_lens.model_copy()
        lens._samples = dict(lens._samples)
        for name, values in samples.items():
            where = f"main_lens.{name}"
            if (
                name not in ("aperture_image", "wavefront", "prescription")
                or getattr(lens, name) is None
            ):
                raise ConfigError("names no file, so that values cannot belong to it", where)
            if name == "prescription":
                lens._samples[name] = values
                continue
            trouble = _trouble(name, np.asarray(values))
            if trouble:
                raise ConfigError(trouble, where)
            lens._samples[name] = Samples(values)
        return self.model_copy(update={"main_lens": lens})


MAX_SAMPLES = 1024
"""Largest side of an aperture image or a wavefront grid."""
MAX_WAVEFRONT = 1e-3
"""Largest wavefront error, m."""


def _trouble(name: str, values: np.ndarray) -> str | None:
    """Why values cannot be an aperture image or a wavefront, in words; None where they can."""
    if values.ndim != 2 or values.shape[0] != values.shape[1] or values.dtype.kind not in "biuf":
        return f"must be a square grid of numbers, not {by(values.shape)}"
    least = 4 if name == "wavefront" else 1
    if not least <= len(values) <= MAX_SAMPLES:
        return f"must have {least} to {MAX_SAMPLES} values a side, not {len(values)}"
    if not np.isfinite(values).all():
        return f"holds {int((~np.isfinite(values)).sum())} values that are NaN or infinite"
    low, high = float(values.min()), float(values.max())
    if name == "wavefront":
        return (
            None
            if max(-low, high) <= MAX_WAVEFRONT
            else f"holds {max(-low, high):g} m; a wavefront error is at most {MAX_WAVEFRONT:g} m"
        )
    if low < 0 or high > 1:
        return (
            f"holds values from {low:g} to {high:g}; an intensity transmittance lies within 0 ... 1"
        )
    return None if high > 0 else "lets no light through: all values are 0"
