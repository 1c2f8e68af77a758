"""How an exposure is computed, as a user asks for it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ExposureOptions:
    """How an exposure is computed.

    refine: object points per side for each point of the camera description.
    superpixels: (rows, columns) that one lenslet's light may reach, or "auto".
    coherent_ring: lenslets whose light interferes, or "auto".
    accuracy: relative, None as the noise needs.
    model: of the propagation, "auto", "ray", "fresnel" or "exact".
    snr_db: of white noise instead of the sensor's own, dB.
    noise: "sensor" or "none".
    exposure: s, None for the camera's own.
    field_nodes: places of the field along an axis whose matrices stand for all lenslets, None for
        the axis alone.
    seed: of the noise.
    """

    refine: int = 1
    superpixels: str | tuple[int, int] = "auto"
    coherent_ring: str | int = "auto"
    accuracy: float | None = None
    model: str = "auto"
    snr_db: float | None = None
    noise: str = "sensor"
    exposure: float | None = None
    field_nodes: int | None = None
    seed: int = 0
