"""Reads one RAW file in a process of its own, with limits, because LibRaw has to survive files that
nobody can vouch for.

Run by `raw.py` as a script: python -P raw_child.py FILE MEMORY_BYTES BASE_BYTES CPU_SECONDS

stdout: one line of JSON, then the mosaic as little-endian uint16, row by row. Nothing is written to
disk.
"""

import json
import logging
import os
import resource
import sys
from typing import Any

COPIES = 4
"""Of a mosaic that exist at the same time while it is read, in this process and the other."""


def limit(address_space: int, cpu_seconds: int) -> None:
    """Bound this process, in bytes and s, before any foreign byte is parsed."""
    for kind, value in (
        (resource.RLIMIT_AS, address_space),
        (resource.RLIMIT_CPU, cpu_seconds),
        (resource.RLIMIT_FSIZE, 0),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        resource.setrlimit(kind, (value, value))


def read(path: str, memory: int) -> tuple[dict[str, Any], bytes]:
    """(description, mosaic bytes) of a RAW file; the description has "refused" with the reason
    where it holds no mosaic, "declared" and "needed" bytes where these are more than `memory`.
    """
    import rawpy

    try:
        path.encode()
    except UnicodeEncodeError:  # LibRaw is given UTF-8 only
        path = f"/proc/self/fd/{os.open(path, os.O_RDONLY)}"
    with rawpy.imread(path) as raw:
        declared = 2 * raw.sizes.raw_width * raw.sizes.raw_height
        if COPIES * declared > memory:
            return {
                "refused": "is too large",
                "declared": declared,
                "needed": COPIES * declared,
            }, b""
        if raw.raw_type != rawpy.RawType.Flat:
            return {
                "refused": (
                    f"holds {raw.raw_image.shape[-1]} values a pixel, not a colour filter mosaic: "
                    "it is demosaiced, a scan or a stack"
                )
            }, b""
        visible = raw.raw_image_visible
        colours = raw.raw_colors_visible
        found = {
            "shape": list(visible.shape),
            "full_shape": list(raw.raw_image.shape),
            "description": raw.color_desc.decode("latin-1"),
            "colour_count": int(raw.num_colors),
            "black": [float(v) for v in raw.black_level_per_channel],
            "white": float(raw.white_level),
            "camera_white": None
            if raw.camera_white_level_per_channel is None
            else [float(v) for v in raw.camera_white_level_per_channel],
            "exposure_s": float(raw.other.shutter_speed),
            "iso": float(raw.other.iso_speed),
            "f_number": float(raw.other.aperture),
            "focal_length_m": float(raw.other.focal_length) / 1000,
        }
        indices = colours[:2, :2].astype(int)
        if colours.shape[0] >= 2 and colours.shape[1] >= 2:
            repeats = all(
                (colours[i::2, j::2] == indices[i, j]).all() for i in (0, 1) for j in (0, 1)
            )
            found |= {"indices": indices.tolist(), "repeats": repeats}
        # a copy: LibRaw frees the mosaic when it is closed
        return found, visible.astype("<u2").tobytes()


def exif(path: str) -> dict[str, Any]:
    """Make, model and exposure from the EXIF tags, as far as they can be read."""
    import exifread

    logging.disable(logging.CRITICAL)
    try:
        with open(path, "rb") as stream:
            tags = exifread.process_file(stream, details=False)
    except Exception:  # a courtesy: whatever breaks in the tags, the mosaic stands on its own
        return {}
    found: dict[str, Any] = {}
    for key, name in (("Image Make", "make"), ("Image Model", "model")):
        if key in tags:
            found[name] = str(tags[key]).strip("\0 ")
    for key in ("EXIF ExposureTime", "Image ExposureTime"):
        try:
            found.setdefault("exposure_s", float(tags[key].values[0]))
        except (KeyError, IndexError, TypeError, ValueError, ZeroDivisionError, AttributeError):
            continue
    return found


def main() -> None:
    """Read sys.argv and answer on stdout, as said above; every failure becomes an
    answer with "refused".
    """
    path, memory, base, cpu_seconds = sys.argv[1], *map(int, sys.argv[2:])
    channel = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever a library prints must not mix with the answer
    limit(memory + base, cpu_seconds)
    pixels = b""
    try:
        found, pixels = read(path, memory)
        found["exif"] = exif(path)
    except MemoryError:
        found = {"refused": "needs more memory than the limit allows"}
    except Exception as error:
        text = getattr(error, "strerror", None) or (error.args[0] if error.args else "")
        text = text.decode("latin-1") if isinstance(text, bytes) else str(text)
        found = {"refused": f"{text}", "error": type(error).__name__}
    channel.write(json.dumps(found).encode() + b"\n" + pixels)
    channel.close()


if __name__ == "__main__":
    main()
