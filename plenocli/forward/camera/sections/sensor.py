"""[sensor]: pixels, noise, colour filters."""

from typing import Annotated, ClassVar, Literal, Self

from pydantic import (
    Field,
    model_validator,
)

from plenocli.base.quantities import (
    Digits,
    Duration,
    ElectronRate,
    Electrons,
    Gain,
    Kelvins,
    Length,
    Pair,
    Section,
    Temperature,
    Unit,
)

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
