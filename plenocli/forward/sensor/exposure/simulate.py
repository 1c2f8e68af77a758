"""One exposure: source -> optics -> detector, from a scene to what the sensor records."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import ConfigError
from plenocli.base.progress import bar
from plenocli.base.tiling import InParts, bands
from plenocli.forward.scene.scenes import Polarised, Uniform
from plenocli.forward.sensor.capture import Capture, SuperpixelGrid
from plenocli.forward.sensor.exposure.carried_light import (
    SensorLight,
    carry_light,
    coarser,
    sampled_object,
)
from plenocli.forward.sensor.exposure.matrices import AnyMatrix, Build, build_matrix, held_matrix
from plenocli.forward.sensor.exposure.options import ExposureOptions
from plenocli.forward.sensor.exposure.recorder import ExposureScale, Recorder, Tally, exposure_scale

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.scene.scenes import Scene

BAND = 5 << 19
"""Pixels that are exposed together, as whole rows of lenslets, at most: what a larger sensor
records is worked out, and its noise drawn, in bands of rows. Noise depends on it.
"""


@dataclass(frozen=True, kw_only=True)
class SimulatedCapture:
    """What a simulated sensor records, and the truth.

    capture: what it records.
    scene: (band, row, column) reflectance of the object on the points of reconstruction.
    wavelengths: (band,) m, of the scene's bands.
    tally: of the pixels; of a mosaic InParts it grows with the parts.
    degree: (row, column) degree of polarisation on the points of reconstruction, None where light
        is not polarised.
    """

    capture: Capture
    scene: np.ndarray | InParts
    wavelengths: np.ndarray
    tally: Tally
    degree: np.ndarray | None = None

    @property
    def saturated(self) -> float | None:
        """Share of the pixels over full well, None in relative units."""
        return self.tally.saturated if self.tally.counted else None

    def in_memory(self) -> SimulatedCapture:
        """The same without InParts."""
        mosaic = self.capture.mosaic
        if not isinstance(mosaic, InParts):
            return self
        assert isinstance(self.scene, InParts)
        capture = replace(self.capture, mosaic=mosaic.whole())
        return replace(self, capture=capture, scene=self.scene.whole())


def simulate_capture(
    camera: Camera,
    source: Quadrature,
    scene: Scene,
    options: ExposureOptions,
    *,
    matrices: Mapping[float, AnyMatrix] | None = None,
    build: Build | None = None,
    name: str = "scene",
    band_m: float | None = None,
    in_parts: bool = False,
) -> SimulatedCapture:
    """One exposure of a scene.

    source: wavelengths of the light and their photons.
    scene: what is in front of the camera.
    options: how it is computed, the noise, the exposure.
    matrices: system matrices by wavelength (m); None: computed as the options ask.
    build: computes them, default build_matrix.
    name: of the scene, for later stages and messages.
    band_m: centre of the narrow band that lights the scene, m, where there is one.
    in_parts: whether mosaic and scene of a sensor of more than BAND pixels are InParts, worked out
        while they are written.

    Raises ConfigError where superpixels do not tile the sensor or no light reaches it,
    NumericsError where memory or accuracy do not suffice, InputError for a scene below zero, which
    a mosaic InParts raises when it is worked out.
    Berkner et al. 2013, section 2.
    """
    # shares of polarised light are those of the whole
    rows = [slice(0, camera.lenslet_array.count[0])]
    rows = rows if isinstance(scene, Polarised) else _bands(camera)
    if len(rows) > 1 and matrices is None:
        make = build or build_matrix
        matrices = {
            w: held_matrix(camera, options, make(camera, w, options)) for w in source.wavelengths
        }

    def lit(part: slice) -> SensorLight:
        return carry_light(camera, source, scene, options, matrices, part, build=build)

    first = lit(rows[0])
    if not float(first.white.max()) > 0:
        raise ConfigError(
            "no light of this source reaches the sensor",
            "camera",
            "check filters, wavelengths and illuminant",
        )
    recorder = _recorder(camera, source, first.white, options, name, lamp=band_m is not None)
    truth = sampled_object(camera, scene, options.refine, rows)
    if len(rows) == 1:
        recorder.measure([first.mosaic])
        mosaic: np.ndarray | InParts = recorder.band(0, first.mosaic)
    else:
        recorder.measure(lit(part).mosaic for part in rows)
        mosaic = _in_bands(camera, rows, lit, recorder)
    found = SimulatedCapture(
        capture=_described(recorder.capture(mosaic), camera, truth.shape, name, band_m),
        scene=truth if len(rows) > 1 else truth.whole(),
        wavelengths=np.array(camera.light.wavelengths[: truth.shape[0]]),
        tally=recorder.tally,
        degree=_degree(camera, scene, options.refine),
    )
    return found if in_parts else found.in_memory()


def _degree(camera: Camera, scene: Scene, refine: int) -> np.ndarray | None:
    """Degree of polarisation (row, column) on the points of reconstruction, or None."""
    if not isinstance(scene, Polarised):
        return None
    count, samples = camera.lenslet_array.count, camera.object.samples_per_lenslet
    grid = (count[0] * samples[0] * refine, count[1] * samples[1] * refine)
    return coarser(scene.degree_at(*grid), refine)


def _bands(camera: Camera) -> list[slice]:
    """Rows of lenslets that are exposed together."""
    (rows, columns), pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    return bands(rows, BAND // (columns * pixels[0] * pixels[1]))


def _in_bands(
    camera: Camera,
    rows: Sequence[slice],
    lit: Callable[[slice], SensorLight],
    recorder: Recorder,
) -> InParts:
    """The mosaic of a sensor that is exposed band by band."""
    count, pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    # what pixels of the next lenslets pass on
    near = 1 if recorder.spreads else 0

    def parts() -> Iterator[np.ndarray]:
        recorder.begin(len(rows))
        for number, part in enumerate(bar(rows, len(rows), "bands of lenslets")):
            around = slice(max(0, part.start - near), min(count[0], part.stop + near))
            own = slice(
                (part.start - around.start) * pixels[0], (part.stop - around.start) * pixels[0]
            )
            yield recorder.band(number, lit(around).mosaic, own)
        recorder.tell()

    shape = (count[0] * pixels[0], count[1] * pixels[1])
    return InParts(shape=shape, dtype=recorder.dtype, parts=parts)


def dark_capture(
    camera: Camera, options: ExposureOptions, name: str = "dark", *, in_parts: bool = False
) -> SimulatedCapture | None:
    """The exposure without light, for which no optics are needed.

    options: the noise, the exposure.
    name: of the scene, for later stages and messages.
    in_parts: as of simulate_capture.

    Returns None where light of known strength and no exposure are given: how long a perfect white
    may shine decides, and the optics say that. The capture does not tell electrons_per_unit.
    Raises NumericsError where the noise is to be in proportion to the light.
    """
    count, pixels = camera.lenslet_array.count, camera.sensor.pixels_per_lenslet
    rows, exposure = _bands(camera), None
    if options.snr_db is None and options.noise != "none":
        seconds = options.exposure or camera.sensor.exposure
        if seconds is None and camera.light.strength is not None:
            return None
        exposure = ExposureScale(1.0, seconds or camera.light.white_exposure)
    recorder = Recorder(camera.sensor, options, name, exposure)

    def dark(part: slice) -> np.ndarray:
        return np.zeros(((part.stop - part.start) * pixels[0], count[1] * pixels[1]))

    def parts() -> Iterator[np.ndarray]:
        recorder.begin(len(rows))
        for number, part in enumerate(rows):
            yield recorder.band(number, dark(part))

    recorder.measure(map(dark, rows))
    shape = (count[0] * pixels[0], count[1] * pixels[1])
    capture = recorder.capture(InParts(shape=shape, dtype=recorder.dtype, parts=parts))
    capture = replace(capture, metadata=replace(capture.metadata, electrons_per_unit=None))
    scene = sampled_object(camera, Uniform(0.0), options.refine, rows)
    found = SimulatedCapture(
        capture=_described(capture, camera, scene.shape, name, None),
        scene=scene,
        wavelengths=np.array(camera.light.wavelengths[:1]),
        tally=recorder.tally,
    )
    return found if in_parts and len(rows) > 1 else found.in_memory()


def require_tiling(camera: Camera, where: str | Path) -> None:
    """ConfigError unless superpixels of whole pixels tile the sensor."""
    if camera.lenslet_array.lattice != "square":
        raise ConfigError(
            "capture-sim tiles a sensor with superpixels, which a hexagonal lattice does not allow",
            where,
            'set lenslet_array.lattice = "square"',
        )
    drift = max(abs(m) * n / 2 for m, n in zip(camera.pixel_mismatch, camera.lenslet_array.count))
    if drift > 0.05:
        rows, columns = camera.sensor.pixels_per_lenslet
        raise ConfigError(
            (
                "the superpixel pitch is "
                f"{camera.superpixel_pitch / camera.sensor.pixel_pitch:.4f} pixels, not {rows} x "
                f"{columns}: at the array's edge superpixels would be {drift:.2f} pixels off"
            ),
            where,
            (
                "set lenslet_array.superpixel_pitch = "
                f'"{rows * camera.sensor.pixel_pitch * 1e6:.6g} um" instead of pitch'
            ),
        )


def require_memory_for(
    camera: Camera,
    options: ExposureOptions,
    where: str | Path,
    *,
    in_parts: bool = False,
    polarised: bool = False,
) -> None:
    """Refuse, before any work, a sensor or an object larger than the memory granted: light, white
    and mosaic, float64, by colour, of what is exposed together.

    in_parts: whether mosaic and scene are written as they come, and never all in memory.
    polarised: whether the scene is.
    """
    from plenocli.base.budget import budget

    rows = [slice(0, camera.lenslet_array.count[0])] if polarised else _bands(camera)
    count, lenslets = camera.lenslet_array.count, int(np.prod(camera.lenslet_array.count))
    pixels, points = (
        int(np.prod(n, dtype=object))
        for n in (camera.sensor.pixels_per_lenslet, camera.object.samples_per_lenslet)
    )
    colours = 1 if camera.sensor.cfa == "mono" else 3
    together = (rows[0].stop - rows[0].start) * count[1]
    needed = 8 * together * (pixels * (2 * colours + 3) + 2 * points * options.refine**2)
    if len(rows) > 1 and not in_parts:
        needed += 8 * lenslets * (2 * pixels + points)
    budget().require(
        needed,
        "the capture",
        where,
        "take fewer lenslets, pixels or points, a smaller --refine",
    )


def _recorder(
    camera: Camera,
    source: Quadrature,
    white: np.ndarray,
    options: ExposureOptions,
    scene: str,
    *,
    lamp: bool,
) -> Recorder:
    """What records relative light whose white is (colour, pixel) `white`.

    scene: its name, for messages.
    lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.
    """
    exposure = None
    if options.snr_db is None and options.noise != "none":
        brightest = float(white.max())
        exposure = exposure_scale(camera, source, brightest, options.exposure, lamp=lamp)
    return Recorder(camera.sensor, options, scene, exposure)


def _described(
    capture: Capture,
    camera: Camera,
    truth: tuple[int, ...],
    name: str,
    band_m: float | None,
) -> Capture:
    """The capture with what later stages need to know beside the mosaic.

    truth: shape (band, row, column) of the object as sampled.
    """
    from plenocli.forward.sensor.cfa import colour_profile

    metadata = replace(
        capture.metadata,
        scene_shape=tuple(truth[1:]),
        target=Path(name).name,
        illuminant=camera.light.illuminant,
        band_m=band_m,
    )
    grid = SuperpixelGrid.tiled(camera.lenslet_array.count, camera.sensor.pixels_per_lenslet)
    profile = colour_profile(camera)
    return replace(capture, grid=grid, metadata=metadata, profile=profile)
