"""What a scene file requires of the camera model, as the accuracy dial takes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.files.read.scenes import read_scene
from plenocli.forward.accuracy.scene_needs import SceneNeeds
from plenocli.forward.scene.scenes import Cube
from plenocli.forward.scene.tables import illuminant

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

DARK = 1e-6
"""Lenslets whose part of the picture is below this share of its peak see no light."""


def read_needs(name: str | Path, camera: Camera) -> SceneNeeds:
    """What a scene requires of the camera model.

    name: of a scene .toml, or whatever read_scene takes, whose bands and extent then count.

    Raises InputError, ConfigError or UsageError where it cannot be read.
    """
    if Path(name).suffix.lower() != ".toml":
        return replace(_from_picture(name, camera), source=Path(name).name)
    from plenocli.files.config.scene_file import load_scene

    scene = load_scene(name)
    found = (
        _from_picture(Path(name).parent / scene.picture, camera) if scene.picture else SceneNeeds()
    )
    return SceneNeeds(
        depth=scene.depth,
        spectrum=scene.spectrum,
        light=found.light,
        lenslets=found.lenslets if scene.lenslets is None else scene.lenslets,
        noise=None if scene.snr is None else 10 ** (-scene.snr / 20),
        source=Path(name).name,
    )


def _from_picture(name: str | Path, camera: Camera) -> SceneNeeds:
    """Extent in lenslets and, of a spectral picture, its light at each of its bands under the
    camera's lamp.
    """
    scene = read_scene(str(name), spectral=True)
    count = camera.lenslet_array.count
    wavelengths = scene.wavelengths if isinstance(scene, Cube) else camera.light.wavelengths
    # eight points a lenslet see every lit one
    planes = np.stack(
        [
            scene.at(float(w), count[0] * 8, count[1] * 8)
            .reshape(count[0], 8, count[1], 8)
            .max(axis=(1, 3))
            for w in wavelengths
        ]
    )
    peak = planes.max()
    if peak <= 0:
        return SceneNeeds(lenslets=(1, 1))
    lit = (planes > DARK * peak).any(axis=0)
    rows, columns = (np.flatnonzero(lit.any(axis=axis)) for axis in (1, 0))
    found = SceneNeeds(lenslets=(int(rows[-1] - rows[0] + 1), int(columns[-1] - columns[0] + 1)))
    if isinstance(scene, Cube):
        light = [
            float(np.sqrt(np.square(plane).mean())) * illuminant(camera.light.illuminant, float(w))
            for w, plane in zip(wavelengths, planes)
        ]
        found = replace(found, light=(tuple(map(float, wavelengths)), tuple(light)))
    return found
