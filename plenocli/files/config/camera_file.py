"""The camera's description as TOML, both ways."""

import os
import re
from pathlib import Path
from typing import Any

from plenocli.base.toml import parse_toml
from plenocli.base.units import format_duration, format_length
from plenocli.files.config.toml_file import read_text
from plenocli.forward.camera.model import Camera

_OBJECTIVE = re.compile(r"^\s*\[\s*objective\s*\]", re.MULTILINE)


def describes_microscope(path: str | os.PathLike[str]) -> bool:
    """Whether a description has an [objective], as a microscope's has.

    Raises InputError where the file cannot be read.
    """
    return _OBJECTIVE.search(read_text(Path(path), "camera")) is not None


def load_camera(path: str | os.PathLike[str]) -> Camera:
    """Read and check a camera description.

    path: of the TOML file.

    Raises InputError where the file cannot be read, ConfigError for what it says.
    """
    path = Path(path)
    return parse_toml(
        read_text(path, "camera"), path, Camera, prepare=lambda data: with_curves(data, path.parent)
    )


def with_curves(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A description whose filters have the curves and the drawing that they name by file: what is
    written of the camera later holds the values.

    data: the tables of a camera file; curves and drawing are put into it.
    folder: of that file, to which names are relative.

    Raises InputError for a file that holds no curve, or no drawing.
    """
    section = data.get("filter_array")
    if not isinstance(section, dict):
        return data
    from plenocli.files.config.curve_file import read_curve
    from plenocli.files.images.maps import read_drawing

    if isinstance(section.get("drawing"), str):
        section["drawing"] = read_drawing(folder / section["drawing"])
    filters = section.get("filters")
    for one in filters if isinstance(filters, list) else ():
        if isinstance(one, dict) and isinstance(one.get("curve"), str):
            one["curve"] = read_curve(folder / one["curve"])
    return data


def parse_camera(text: str, where: str | os.PathLike[str] = "camera") -> Camera:
    """A Camera from TOML text.

    text: of the description.
    where: what messages call it.

    Raises ConfigError, which lists every violation with its path.
    """
    return parse_toml(text, where, Camera)


_UNITS = {
    "full_well": "e",
    "read_noise": "e",
    "gain": "DN/e",
    "dark_current": "e/s",
    "temperature": "K",
    "dark_current_doubling": "K",
    "dsnu": "e",
    "hot_pixel_current": "e/s",
    "black_drift": "DN",
    "illuminance": "lx",
    "luminance": "cd/m2",
    "radiance": "W/m2/sr",
    "spectral_radiance": "W/m2/sr/m",
}


_NUMBERS = {
    "magnification",
    "numerical_aperture",
    "medium_index",
    "specimen_index",
    "rings",
    "f_number",
    "obscuration",
    "fill_factor",
    "pixel_fill_factor",
    "quantum_efficiency",
    "peak",
    "blocking",
    "transmission",
    "transmittance",
    "index",
    "leak",
    "pixel_shift",
    "prnu",
    "hot_pixels",
    "crosstalk",
    "model_error",
}


def to_toml(camera: Camera) -> str:
    """TOML text of a resolved camera, one key a line, lengths with units; deterministic."""
    return section_lines(camera.model_dump(exclude_none=True))


def section_lines(sections: dict[str, Any]) -> str:
    """TOML text of the sections of a description in SI units, one key a line."""
    lines = []
    for section, values in sections.items():
        lines.append(f"[{section}]")
        lines += [f"{key} = {_toml(key, value)}" for key, value in values.items()]
        lines.append("")
    return "\n".join(lines)


def _toml(key: str, value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(k, v)}" for k, v in value.items()) + " }"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(_toml(key, v) for v in value) + "]"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, int):
        return str(value)
    if key in _UNITS:
        return f'"{value!r} {_UNITS[key]}"'
    if key in ("white_exposure", "exposure"):
        return f'"{format_duration(value)}"'
    return repr(value) if key in _NUMBERS else f'"{format_length(value)}"'
