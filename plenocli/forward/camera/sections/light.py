"""[light]: wavelengths, bands and strength."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import (
    Field,
    model_validator,
)

from plenocli.base.quantities import (
    Duration,
    Illuminance,
    Length,
    Luminance,
    Radiance,
    Section,
    SpectralRadiance,
    Wavelength,
)
from plenocli.base.units import format_length
from plenocli.forward.camera.sections.filter_array import Polarisation
from plenocli.forward.camera.sections.resolved import LEFT_OUT, Resolved


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
    ] = LEFT_OUT
    band: Band | None = None
    design_wavelength: Resolved[Wavelength] = LEFT_OUT
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
