"""What a scene requires of the camera model: depth, spectrum, extent and noise, read from TOML."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from plenocli.base.quantities import Length, Section, Wavelength, quantity
from plenocli.base.toml import parse_toml
from plenocli.base.units import parse_decibel
from plenocli.files.config.toml_file import read_text

Decibel = Annotated[
    float, quantity(parse_decibel, "40 dB", -100.0, 300.0, lambda value: f"{value:g} dB")
]
Count = tuple[Annotated[int, Field(ge=1, le=4096)], Annotated[int, Field(ge=1, le=4096)]]


class Scene(Section):
    """A scene as the accuracy dial sees it; what is left out is not narrowed.

    picture: photograph or spectral EXR, relative to this file, whose extent and bands count too;
    depth: nearest and farthest distance to the main lens, stored as the fewest planes that serve;
    spectrum: shortest and longest wavelength with light;
    lenslets: rows and columns of lenslets around the centre that see light;
    snr: amplitude ratio of a bright pixel to its noise.
    """

    picture: str | None = None
    depth: tuple[Length, Length] | None = None
    spectrum: tuple[Wavelength, Wavelength] | None = None
    lenslets: Count | None = None
    snr: Decibel | None = None

    @model_validator(mode="after")
    def _ascending(self) -> Self:
        for name in ("depth", "spectrum"):
            pair = getattr(self, name)
            if pair is not None and pair[0] > pair[1]:
                raise ValueError(f"{name} runs from the smaller to the larger")
        return self


def load_scene(path: str | Path) -> Scene:
    """Read and check a scene description.

    path: of the TOML file.

    Raises InputError where the file cannot be read, ConfigError for what it says.
    """
    path = Path(path)
    return parse_toml(read_text(path, "scene"), path, Scene)
