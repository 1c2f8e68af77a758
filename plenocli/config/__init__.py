"""Camera descriptions with units, read at the border and kept in SI inside."""

from plenocli.config.units import format_length, parse_length

REFERENCE_REFLECTANCE = 0.99
"""Of the white reference target, as the paper's Labsphere (Spectralon 99%), flat over the visible: what capture-sim shows and demux and score divide by, unless told otherwise."""

__all__ = ["REFERENCE_REFLECTANCE", "Camera", "camera_schema", "format_length", "load_camera", "parse_camera", "parse_length"]


def __getattr__(name):
    # pydantic costs 0.1 s: only those who read a camera pay for it
    if name in ("Camera", "camera_schema", "load_camera", "parse_camera"):
        from plenocli.config import camera

        return getattr(camera, name)
    raise AttributeError(name)
