"""A camera with everything that its description names by file."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from plenocli.base.errors import ConfigError, InputError
from plenocli.base.progress import note

if TYPE_CHECKING:
    from plenocli.files.artefacts.container import Artefact
    from plenocli.forward.camera.model import Camera

Name = str | os.PathLike[str]
_NAMED = ("aperture_image", "wavefront", "prescription")
"""Keys of [main_lens] that name files."""


def read_camera(path: Name) -> Camera:
    """The camera described at `path`, with its aperture image, wavefront and lens file read and
    attached; names are relative to `path`'s folder.

    Raises InputError for a file that cannot be read or whose values cannot be, ConfigError for the
    description.
    """
    from plenocli.files.config.camera_file import load_camera
    from plenocli.forward.camera import model

    camera = load_camera(path)
    if isinstance(camera, model.Camera) and (asked := camera.unusual_lengths()):
        note(f"warning: {Path(path).name}: {asked}")
    for key, file in _named(path, camera).items():
        values = _reader(key)(file)
        try:
            camera = camera.attach(**{key: values})
        except ConfigError as error:
            raise InputError(
                error.what, file, f"mend it, or [main_lens] {key} in {Path(path).name}"
            ) from None
    return camera


def _reader(key: str) -> Callable[[Path], Any]:
    """What reads the file that a key of [main_lens] names; most cameras name none."""
    from plenocli.files.config.lens_file import load_lens
    from plenocli.files.images.maps import read_transmittance, read_wavefront

    return dict(zip(_NAMED, (read_transmittance, read_wavefront, load_lens)))[key]


def camera_files(path: Name, camera: Camera) -> dict[str, Name]:
    """Role -> path of the description and of every file that it names, for describe_inputs."""
    return {"camera": path} | {
        key.replace("_", " "): file for key, file in _named(path, camera).items()
    }


def require_same_files(camera_path: Name, camera: Camera, artefact: Artefact, where: Name) -> None:
    """InputError unless the files that `camera` names are, byte for byte, those that
    `artefact` was made with.
    """
    from plenocli.files.artefacts.provenance import file_digest

    for role, file in camera_files(camera_path, camera).items():
        known = artefact.provenance.inputs.get(role, {}).get("sha256")
        if role != "camera" and known != file_digest(file):
            raise InputError(
                f"was made with another {role} than {Path(file).name}",
                where,
                "run simulate-pif on this camera",
            )


def described_camera(artefact: Artefact, where: Name) -> Camera | None:
    """The camera that an artefact says it was made for; None where it does not, or the description
    needs other files.

    where: the artefact's file.
    """
    from plenocli.files.config.camera_file import parse_camera

    try:
        config = artefact.provenance.config
        camera = parse_camera(config, where) if config else None
    except ConfigError:
        return None
    return None if camera is None or _named(where, camera) else camera


def _named(path: Name, camera: Camera) -> dict[str, Path]:
    lens = camera.main_lens
    return {
        key: Path(path).parent / getattr(lens, key)
        for key in _NAMED
        if getattr(lens, key) is not None
    }
