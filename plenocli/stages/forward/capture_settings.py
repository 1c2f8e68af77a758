"""What a simulated capture is asked for, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from plenocli.forward.sensor.exposure.options import ExposureOptions


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What the command line says beyond the files.

    target: "white", "dark", "mono:450nm" or "colorchecker", None where there is a scene.
    sampling: "fit" or "crop", of a photograph.
    refine: object points per side for each point of the camera description.
    bandwidth: of the light, m.
    spectral_step: m, None as the light needs.
    superpixels: (rows, columns) that one lenslet's light may reach, or "auto".
    coherent_ring: lenslets whose light interferes, or "auto".
    accuracy: relative, None as the noise needs.
    model: of the propagation, "auto" or a rung.
    snr_db: of white noise instead of the sensor's own, dB.
    noise: "sensor" or "none".
    exposure: s, None for the camera's own.
    field_nodes: places of the field along an axis whose matrices stand for all lenslets, None for
        the axis alone.
    polarisation: degree of linear polarisation of the scene's light, a number or the name of a
        picture, None where it is not polarised.
    seed: of the noise.
    """

    target: str | None = None
    sampling: str = "fit"
    refine: int = 1
    bandwidth: float = 0.0
    spectral_step: float | None = None
    superpixels: str | tuple[int, int] = "auto"
    coherent_ring: str | int = "auto"
    accuracy: float | None = None
    model: str = "auto"
    snr_db: float | None = None
    noise: str = "sensor"
    exposure: float | None = None
    field_nodes: int | None = None
    polarisation: str | None = None
    seed: int = 0

    @property
    def options(self) -> ExposureOptions:
        """What of them the simulation knows."""
        return ExposureOptions(
            refine=self.refine,
            superpixels=self.superpixels,
            coherent_ring=self.coherent_ring,
            accuracy=self.accuracy,
            model=self.model,
            snr_db=self.snr_db,
            noise=self.noise,
            exposure=self.exposure,
            field_nodes=self.field_nodes,
            seed=self.seed,
        )


@dataclass(frozen=True, kw_only=True)
class CaptureSummary:
    """What capture-sim wrote.

    output: the file.
    rows, columns: of its mosaic.
    wavelengths: how many the light was computed at.
    units: of the mosaic.
    peak: its largest value.
    noise_sigma: standard deviation of the noise, None where the sensor's noise is simulated.
    saturated: share of the pixels over full well, None in relative units.
    exposure_s: s, None in relative units.
    """

    output: Path
    rows: int
    columns: int
    wavelengths: int
    units: str
    peak: float | int
    noise_sigma: float | None = None
    saturated: float | None = None
    exposure_s: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The summary for `--json`; what does not apply is left out."""
        named = {
            "units": self.units,
            "noise_sigma": self.noise_sigma,
            "peak": self.peak,
            "saturated": self.saturated,
            "exposure_s": self.exposure_s,
            "output": str(self.output),
            "rows": self.rows,
            "columns": self.columns,
            "wavelengths": self.wavelengths,
        }
        return {name: value for name, value in named.items() if value is not None}
