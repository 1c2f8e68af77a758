"""What a scene requires of the model: how far, which colours, which lenslets, and how fine
noise lets anyone see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from plenocli.forward.sensor.detector import SensorModel

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

HIDDEN = 0.3
"""A model error of this share of the noise, both relative to the signal, adds under 5 % to the
total: it cannot be seen.
"""

DIM = 0.1
"""Share of an accuracy that wavelengths of little light may be left out for."""


@dataclass(frozen=True, kw_only=True)
class SceneNeeds:
    """What is known of a scene; None where it is not.

    depth: nearest and farthest distance (m) to the main lens, for depth_planes;
    spectrum: lowest and highest wavelength (m) with light;
    light: (wavelengths in m, root mean square of the scene's light at each, in any unit), linear
        between them and constant beyond;
    lenslets: (rows, columns) that see light;
    noise: relative noise of a pixel at the brightest;
    source: who says so.
    """

    depth: tuple | None = None
    spectrum: tuple | None = None
    light: tuple | None = None
    lenslets: tuple | None = None
    noise: float | None = None
    source: str = "scene"


def sensor_noise(camera: Camera) -> float:
    """Relative noise of a pixel of `camera` at full well: shot and read noise over the
    signal (EMVA 1288).
    """
    return SensorModel.from_camera(camera).noise_at_full_well


def visible_accuracy(noise: float) -> float:
    """The finest model error worth computing, within what the dial offers.

    noise: of a pixel, relative to the signal.

    Returns a relative error.
    """
    return min(0.3, max(1e-8, HIDDEN * noise))


def seen_wavelengths(
    wavelengths: Sequence[float], needs: SceneNeeds | None, accuracy: float
) -> tuple[tuple[float, ...], float]:
    """The wavelengths that the scene has light at.

    wavelengths: m;
    needs: what is known of the scene, None for nothing;
    accuracy: of the scene's image, of which the dimmest ones may take DIM together.

    Returns (those kept, light of the others over that of the brightest: the most that a picture of
    all loses without them); all are kept where else none would be.
    """
    every = np.asarray(wavelengths, float)
    light = np.ones(len(every))
    if needs is not None and needs.light is not None:
        light = np.interp(every, *needs.light)
    if needs is not None and needs.spectrum is not None:
        low, high = needs.spectrum
        light = light * ((low * (1 - 1e-9) <= every) & (every <= high * (1 + 1e-9)))
    if not light.max() > 0:
        return tuple(wavelengths), 0.0
    order = np.argsort(light, kind="stable")
    lost = np.cumsum(light[order]) / light.max()
    count = int((lost <= DIM * accuracy).sum())
    kept = np.sort(order[count:])
    return tuple(wavelengths[n] for n in kept), float(lost[count - 1]) if count else 0.0
