"""What a scene requires of the model: how far, which colours, which lenslets, and how fine
noise lets anyone see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from plenocli.forward.sensor.detector import SensorModel

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera

HIDDEN = 0.3
"""A model error of this share of the noise, both relative to the signal, adds under 5 % to the
total: it cannot be seen.
"""


@dataclass(frozen=True, kw_only=True)
class SceneNeeds:
    """What is known of a scene; None where it is not.

    depth: nearest and farthest distance (m) to the main lens, for depth_planes;
    spectrum: lowest and highest wavelength (m) with light;
    lenslets: (rows, columns) that see light;
    noise: relative noise of a pixel at the brightest;
    source: who says so.
    """

    depth: tuple | None = None
    spectrum: tuple | None = None
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
    wavelengths: Sequence[float], needs: SceneNeeds | None
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Part wavelengths into those that the scene has light at and others.

    wavelengths: m;
    needs: what is known of the scene, None for nothing.

    Returns (kept, left out); all are kept where else none would be.
    """
    if needs is None or needs.spectrum is None:
        return tuple(wavelengths), ()
    low, high = needs.spectrum
    kept = tuple(w for w in wavelengths if low * (1 - 1e-9) <= w <= high * (1 + 1e-9))
    return (
        (kept, tuple(w for w in wavelengths if w not in kept)) if kept else (tuple(wavelengths), ())
    )
