"""The description of a light-field microscope as TOML, both ways."""

import os
from pathlib import Path

from plenocli.base.toml import parse_toml
from plenocli.files.config.camera_file import section_lines, to_toml
from plenocli.files.config.toml_file import read_text
from plenocli.forward.camera.microscope import Microscope
from plenocli.forward.camera.model import Camera


def load_microscope(path: str | os.PathLike[str]) -> Microscope:
    """Read and check the description of a microscope.

    path: of the TOML file.

    Raises InputError where the file cannot be read, ConfigError for what it says.
    """
    return parse_microscope(read_text(Path(path), "camera"), path)


def parse_microscope(text: str, where: str | os.PathLike[str] = "camera") -> Microscope:
    """A Microscope from TOML text.

    text: of the description.
    where: what messages call it.

    Raises ConfigError, which lists every violation with its path.
    """
    return parse_toml(text, where, Microscope)


def microscope_toml(microscope: Microscope) -> str:
    """TOML text of a resolved microscope; deterministic."""
    return section_lines(microscope.model_dump(exclude_none=True))


def description_toml(camera: Camera | Microscope) -> str:
    """TOML text of a resolved description, whichever it is; deterministic."""
    return microscope_toml(camera) if isinstance(camera, Microscope) else to_toml(camera)
