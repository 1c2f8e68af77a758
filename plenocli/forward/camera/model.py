"""The camera: one description of source, optics and detector, checked whole, kept in SI units.

Planes along the axis: object --object.distance--> main lens --lenslet_array.distance--> lenslet
array --sensor.distance--> sensor. All violations of a file are reported together,
each with its path.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    Field,
    PrivateAttr,
    ValidationError,
    model_validator,
)

from plenocli.base.errors import ConfigError
from plenocli.base.quantities import (
    MOST_PLANES,
    Length,
    Pair,
    Section,
    planes_of,
)
from plenocli.base.text import by
from plenocli.base.toml import violations
from plenocli.base.units import UnitError, format_length, parse_wavelength
from plenocli.forward.camera.plausible import Lengths, implausible, unusual
from plenocli.forward.camera.sections.filter_array import SAME_BAND, FilterArray
from plenocli.forward.camera.sections.lenslet_array import LensletArray
from plenocli.forward.camera.sections.light import Light
from plenocli.forward.camera.sections.main_lens import MainLens, Samples
from plenocli.forward.camera.sections.sensor import Sensor


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


_OF_BANDS = ("light", "filter_array")

PixelShift = Annotated[float, Field(ge=-0.5, le=0.5)]


class Fitted(Section):
    """What a fit to captures found beside the description (plenocli.inverse.fit): how far the
    pixels of every superpixel are shifted from its chief ray, and the relative error that a system
    matrix of this camera is still expected to have.
    """

    pixel_shift: tuple[PixelShift, PixelShift] = (0.0, 0.0)
    model_error: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0


def _check_range(section: str, glass: str, wavelengths: Sequence[float]) -> None:
    """ValueError where a glass is not described at one of the wavelengths (m)."""
    if glass.lower() == "none":
        return
    from plenocli.forward.camera.glass import medium

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
            digits = 3 - math.floor(math.log10(corner))
            enough = round(math.ceil(corner * 10**digits) / 10**digits, digits)
            raise ValueError(
                f"main_lens.field ends at {format_length(rows[-1].height)} from the axis, the "
                f"array within {format_length(enough)}: add a row for its corner"
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
