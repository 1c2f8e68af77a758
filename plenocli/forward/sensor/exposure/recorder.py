"""What a sensor reports of the light that reaches it, and how long it is exposed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError
from plenocli.base.progress import note
from plenocli.base.random_streams import stream
from plenocli.base.tiling import InParts
from plenocli.forward.scene.sample import ALL
from plenocli.forward.scene.white_reference import WHITE_LEVEL
from plenocli.forward.sensor.capture import Capture, CaptureMetadata, Levels
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.noise import Noise, white_noise

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.camera.sections.sensor import Sensor
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.sensor.detector import SensorModel


@dataclass
class Tally:
    """Pixels of a capture as far as they were recorded.

    counted: whether full well means something.
    peak: the largest value.
    full: pixels over full well, of `pixels`.
    """

    counted: bool
    peak: float = -np.inf
    full: int = 0
    pixels: int = 0

    @property
    def saturated(self) -> float:
        """Share of the pixels over full well."""
        return self.full / max(1, self.pixels)

    def add(self, values: np.ndarray, full: int = 0) -> None:
        """Count the pixels of a band, `full` of them over full well."""
        self.peak = max(self.peak, float(values.max()))
        self.full += full
        self.pixels += values.size


class Recorder:
    """What a sensor reports of relative light, band of rows by band of rows.

    tally: of the pixels.
    dtype: of what it reports.
    """

    def __init__(
        self,
        sensor: Sensor,
        options: ExposureOptions,
        scene: str,
        exposure: ExposureScale | None,
        stage: str = "capture-sim",
    ) -> None:
        """scene: its name, for messages.

        exposure: None for relative units.
        stage: whose random numbers the noise is.
        """
        from plenocli.forward.sensor.detector import SensorModel

        self.sensor, self.options, self.scene, self.exposure = sensor, options, scene, exposure
        self.model = SensorModel.of(sensor)
        self.tally = Tally(counted=exposure is not None)
        self.dtype = np.float64 if exposure is None else np.uint16
        self.spreads = exposure is not None and bool(self.model.crosstalk)
        self._noise, self._count, self._stage = Noise(), 1, stage

    def measure(self, mosaics: Iterable[np.ndarray]) -> None:
        """Look at the light of all bands before they are recorded, where noise is in proportion to
        it.
        """
        if self.exposure is None and self.options.snr_db is not None:
            self._noise = white_noise(map(self._relative, mosaics), self.options.snr_db)

    def begin(self, count: int) -> None:
        """Record `count` bands from the first one on."""
        self._count, self.tally.peak, self.tally.full, self.tally.pixels = count, -np.inf, 0, 0

    def _relative(self, mosaic: np.ndarray) -> np.ndarray:
        return mosaic / (self.sensor.quantum_efficiency if self.sensor.cfa == "mono" else 1.0)

    def band(self, number: int, mosaic: np.ndarray, own: slice = ALL) -> np.ndarray:
        """What is reported of a band.

        mosaic: (row, column) relative light of it and of rows beside it.
        own: its rows of them.
        """
        rng = stream(self.options.seed, self._stage, number)
        if self.exposure is None:
            values = self._relative(mosaic[own]).astype(np.float64, copy=False)
            if self._noise.sigma:
                values = values + rng.normal(0.0, self._noise.sigma, values.shape)
            self.tally.add(values)
            return values
        if not (mosaic.min() >= 0 and np.isfinite(mosaic).all()):
            raise InputError(
                "holds values below 0 or beyond all numbers, which no light has",
                self.scene,
                "clip it (reconstruct --clip), or use --noise none",
            )
        electrons, model = mosaic * self.exposure.electrons, self.model
        full = int(np.count_nonzero(electrons[own] >= self.sensor.full_well))
        if self._count > 1:
            electrons, model = self._apart(electrons, own)
        values = model.expose(electrons, rng, self.exposure.seconds, number)
        self.tally.add(values, full)
        return values

    def _apart(self, electrons: np.ndarray, own: slice) -> tuple[np.ndarray, SensorModel]:
        """(electrons of the band's own rows, the model of what is left to be done to them): of what
        concerns more than one band.
        """
        from plenocli.forward.sensor.detector import spread_to_neighbours

        if self.spreads:
            electrons = spread_to_neighbours(electrons, self.model.crosstalk)
        drift = stream(self.options.seed, self._stage, self._count).normal()
        black = self.model.black_level + drift * self.model.black_drift
        model = replace(self.model, crosstalk=0.0, black_drift=0.0, black_level=black)
        return electrons[own], model

    def tell(self) -> None:
        """A note where many pixels are over full well."""
        if self.tally.counted and self.tally.saturated > 0.001:
            note(
                f"{self.tally.saturated:.1%} of the pixels are over full well; a shorter "
                "--exposure would keep them"
            )

    def capture(self, mosaic: Any) -> Capture:
        """The capture with what the recorder knows of it; mosaic: an array, or InParts."""
        if not isinstance(mosaic, InParts):
            self.tell()
        if self.exposure is None:
            return Capture(
                mosaic=mosaic,
                units="relative",
                cfa=self.sensor.cfa,
                noise=self._noise,
                metadata=CaptureMetadata(
                    snr_db=self.options.snr_db, noise_from="--snr and --noise"
                ),
            )
        seconds, mono = self.exposure.seconds, self.sensor.cfa == "mono"
        electrons = self.exposure.electrons * (self.sensor.quantum_efficiency if mono else 1.0)
        return Capture(
            mosaic=mosaic,
            cfa=self.sensor.cfa,
            levels=Levels(
                black=np.full((2, 2), float(self.sensor.black_level)),
                white=float(self.model.white_level),
                gain=self.sensor.gain,
            ),
            exposure_s=seconds,
            noise=self.model.noise(seconds),
            metadata=CaptureMetadata(noise_from="camera", electrons_per_unit=electrons),
        )


def recorded(
    sensor: Sensor,
    mosaic: np.ndarray,
    options: ExposureOptions,
    scene: str,
    exposure: ExposureScale | None,
    stage: str,
) -> tuple[Capture, float | None]:
    """What a sensor reports of relative light (row, column), all at once, and the share of its
    pixels over full well, None in relative units.

    scene, exposure, stage: as of Recorder.
    """
    recorder = Recorder(sensor, options, scene, exposure, stage)
    recorder.measure([mosaic])
    capture = recorder.capture(recorder.band(0, mosaic))
    return capture, recorder.tally.saturated if recorder.tally.counted else None


@dataclass(frozen=True)
class ExposureScale:
    """How long the sensor is exposed, and to what.

    electrons: photo-electrons of a unit of relative light at a quantum efficiency of 1.
    seconds: s.
    """

    electrons: float
    seconds: float


def exposure_scale(
    camera: Camera,
    source: Quadrature,
    brightest: float,
    seconds: float | None,
    *,
    lamp: bool = False,
) -> ExposureScale:
    """Electrons and time of an exposure.

    Light of known strength gives photons in proportion to time; without a time, it lasts until a
    perfect white fills the brightest pixel to WHITE_LEVEL of full well. Without a strength that is
    what `light.white_exposure` does, and other times are relative to it.
    source: the light.
    brightest: relative light, quantum efficiency included, of the brightest pixel under a perfect
        white, above 0.
    seconds: exposure, None for the camera's own.
    lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.

    Raises ConfigError where the light's strength is one that its wavelengths do not have.
    docs/model.md, "From radiance to electrons".
    """
    from plenocli.forward.camera.geometry import point_etendue
    from plenocli.forward.scene.light import photon_radiance

    full = WHITE_LEVEL * camera.sensor.full_well / brightest
    own = camera.sensor.exposure
    asked = own if seconds is None else seconds
    if lamp or camera.light.strength is None:
        base = own or camera.light.white_exposure
        taken = asked or base
        return ExposureScale(full * taken / base, taken)
    rate = photon_radiance(camera, source) * point_etendue(camera)
    if asked is None:
        note(
            f"exposed for {full / rate * 1e3:.3g} ms, in which a perfect white fills the brightest "
            f"pixel to {WHITE_LEVEL:.0%} of full well"
        )
    taken = full / rate if asked is None else asked
    return ExposureScale(rate * taken, taken)
