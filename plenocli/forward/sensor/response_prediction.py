"""The response matrix F predicted from a description of the camera: what each superpixel makes of
an even object in each band. docs/model.md, "The response predicted".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import ConfigError, UsageError
from plenocli.forward.camera.geometry import finely_sampled
from plenocli.forward.camera.pupil import polarisations
from plenocli.forward.propagation.accuracy_record import AccuracyRecord
from plenocli.forward.propagation.response import (
    field_response,
    own_light,
    uniform_response,
    valid_for,
)
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.exposure.recorder import exposure_scale

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.propagation.plan import PifPlan
    from plenocli.forward.scene.light import Quadrature
    from plenocli.forward.sensor.superpixel_kinds import SuperpixelKinds

WAVES_ERR = 0.03
"""What F by waves is taken to be known to, relative (L2) in every band: it agrees with simulated
captures within 2 %, and scenes have light over the whole width of a filter.
"""
RAYS_ERR = 0.12
"""The same for F by rays, where there is nothing by waves beside it."""
DARK = 1e-12
"""Share of an object point's light on the brightest pixel that is none at all."""
OFF_CENTRE = 1e-3
"""px by which a superpixel may lie off its window's middle and count as centred."""


@dataclass(frozen=True, kw_only=True)
class PredictionOptions:
    """How F is computed.

    model: "ray", "fresnel", "exact" or "auto".
    own_field: light of the lenslet's own object points alone.
    accuracy, superpixels, coherent_ring: of the system matrices, where those are summed
        (plenocli.forward.accuracy.dial.plan_pif).
    """

    model: str = "auto"
    own_field: bool = False
    accuracy: float | None = None
    superpixels: Any = "auto"
    coherent_ring: Any = "auto"


@dataclass(frozen=True, kw_only=True)
class PredictionNotes:
    """What is recorded of a predicted F beside its values.

    model: of the propagation.
    closed_form: whether no system matrix had to be summed.
    own_field: whether only the lenslet's own object points sent light.
    own_light: (band,), share of the light that comes from a lenslet's own field.
    rays_against_waves: (band,), relative (L2), where both are there, else None.
    error: (band,), what F is taken to be known to, relative (L2).
    source: "predicted".
    """

    model: str
    closed_form: bool
    own_field: bool
    own_light: list[float]
    rays_against_waves: list[float] | None
    error: list[float]
    source: str = field(default="predicted", init=False)

    def as_json(self) -> dict[str, Any]:
        """The notes of the response in its file: what there is of the above."""
        return {name: value for name, value in asdict(self).items() if value is not None}


class ResponsePrediction:
    """Response of the superpixels at single wavelengths: by the closed form where it holds, else
    by summing a system matrix.

    camera: its description.
    options: how F is computed.
    kinds: the superpixels.
    where: the description's file, for messages.

    Raises UsageError for options that this response does not need, ConfigError where it has no
    closed form and superpixels lie off their windows' middles.
    """

    def __init__(
        self,
        camera: Camera,
        options: PredictionOptions,
        kinds: SuperpixelKinds,
        where: str | Path,
    ) -> None:
        self.camera, self.options, self.kinds = camera, options, kinds
        asked = "fresnel" if options.model == "auto" else options.model
        why = (
            "the exact model has none"
            if asked == "exact"
            else "the lenslet's own field was asked for"
            if options.own_field
            else valid_for(camera, asked)
        )
        self.closed, self.model = why is None, asked if why is None else options.model
        self.plan: PifPlan | None = None
        given = [
            name
            for name in ("accuracy", "superpixels", "coherent_ring")
            if getattr(options, name) not in (None, "auto")
        ]
        if self.closed and given:
            raise UsageError(
                (
                    f"--{given[0].replace('_', '-')} is of the sum over a system matrix, which "
                    "this response needs none of"
                ),
                fix="leave it out, or take --model exact",
            )
        if not self.closed and np.abs(kinds.shifts).max() > OFF_CENTRE:
            raise ConfigError(
                (
                    f"lenslets lie at {len(kinds.shifts)} different places within their pixels, "
                    f"and there is no closed form: {why}"
                ),
                where,
                "take --model ray, or a superpixel pitch of whole pixels",
            )

    def at(self, wavelength: float) -> np.ndarray:
        """Share of the light of one object point that each pixel gets.

        wavelength: m.

        Returns (kind's shift, pixel).
        """
        from plenocli.forward.accuracy.dial import pif_builder

        if self.closed:
            return uniform_response(self.camera, wavelength, self.model, self.kinds.shifts)
        builder = pif_builder(
            finely_sampled(self.camera, wavelength),
            wavelength,
            model=self.model,
            accuracy=self.options.accuracy,
            superpixels=self.options.superpixels,
            coherent_ring=self.options.coherent_ring,
        )
        self.plan = builder.plan
        found = field_response(builder)
        own = found[(builder.offsets == 0).all(axis=1)] if self.options.own_field else found
        return np.broadcast_to(own.sum(axis=0), (len(self.kinds.shifts), found.shape[1]))

    def white_signal(
        self, source: Quadrature, exposure: float | None, *, lamp: bool = False
    ) -> tuple[np.ndarray, float]:
        """Expected signal of the white reference.

        source: the light.
        exposure: s; None: the camera's own.
        lamp: whether the light is not the camera's [light], but a lamp as bright as is needed.

        Returns (kind, pixel) DN, and the exposure in s.
        Raises ConfigError where no light reaches the sensor.
        """
        light: Any = 0.0
        for part in self._light(source):
            light = light + part
        scale, seconds = self._exposed(source, light, exposure, lamp)
        return self._mosaicked(light) * scale, seconds

    def polarised_signal(self, lamp: Quadrature, exposure: float | None) -> np.ndarray | None:
        """By how much the signal of the white reference grows where a lamp's light is all along 0
        degrees, and falls where it is along 90 degrees.

        lamp, exposure: as white_signal's.

        Returns (kind, pixel) DN, None for a camera that does not tell them apart.
        """
        seen = polarisations(self.camera)
        if len(seen) == 1:
            return None
        along, across = (
            np.sum(
                list(ResponsePrediction(one, self.options, self.kinds, "camera")._light(lamp)),
                axis=0,
            )
            for one in seen
        )
        scale, _ = self._exposed(lamp, (along + across) / 2, exposure, True)
        return self._mosaicked((along - across) / 2) * scale

    def spectral_signal(
        self, source: Quadrature, exposure: float | None
    ) -> tuple[np.ndarray, float]:
        """Expected signal of a surface of reflectance one, wavelength by wavelength.

        source, exposure: as white_signal's.

        Returns (kind, pixel, node) DN, and the exposure in s.
        Raises ConfigError where no light reaches the sensor.
        """
        parts = list(self._light(source))
        scale, seconds = self._exposed(source, np.sum(parts, axis=0), exposure, False)
        seen = np.stack([self._mosaicked(part) for part in parts], axis=-1)
        return seen * (scale / REFERENCE_REFLECTANCE), seconds

    def _light(self, source: Quadrature) -> Iterator[np.ndarray]:
        """(letter, kind's shift, pixel) light of each wavelength, where every object point sends
        one unit through the clear pupil.
        """
        from plenocli.forward.sensor.cfa import sensitivity

        points = float(np.prod(self.camera.object.samples_per_lenslet))
        efficiency = sensitivity(self.camera, source.wavelengths)[1]
        for index, wavelength in enumerate(source.wavelengths):
            photons = points * source.photons[index] * efficiency[:, index]
            yield photons[:, None, None] * self.at(wavelength)[None]

    def _exposed(
        self, source: Quadrature, light: np.ndarray, exposure: float | None, lamp: bool
    ) -> tuple[float, float]:
        """DN of the white reference for one unit of light, and the exposure in s."""
        peak = float(light.max())
        if not peak > DARK:
            raise ConfigError(
                f"no light of {source.wavelengths[0] * 1e9:g} nm reaches the sensor",
                "camera",
                "check filters, wavelengths and sensitivities",
            )
        scale = exposure_scale(self.camera, source, peak, exposure, lamp=lamp)
        return scale.electrons * REFERENCE_REFLECTANCE * self.camera.sensor.gain, scale.seconds

    def _mosaicked(self, light: np.ndarray) -> np.ndarray:
        """(kind, pixel) of light (letter, kind's shift, pixel), as the colour filters see it."""
        from plenocli.forward.sensor.cfa import cfa_map, sensitivity

        camera, kinds = self.camera, self.kinds
        letters = sensitivity(camera, np.array(camera.light.wavelengths))[0]
        mosaics = [
            cfa_map(kinds.window, camera.sensor.cfa, phase).ravel() for phase in kinds.phases
        ]
        return np.stack(
            [
                sum(
                    np.where(mosaic == letter, light[n, kind], 0.0)
                    for n, letter in enumerate(letters)
                )
                for kind, mosaic in enumerate(mosaics)
            ]
        )

    def notes(self, bands: tuple[float, ...]) -> PredictionNotes:
        """What is recorded of F in `bands` (m), once it was computed."""
        against = self._rays_against_waves(bands)
        model = self.model if self.plan is None else self.plan.model
        apart = [0.0] * len(bands)
        if model == "ray":
            apart = [RAYS_ERR] * len(bands) if against is None else against
        return PredictionNotes(
            model=model,
            closed_form=self.closed,
            own_field=self.options.own_field,
            own_light=[own_light(self.camera, w) for w in bands],
            rays_against_waves=against,
            error=[float(np.hypot(WAVES_ERR, one)) for one in apart],
        )

    def _rays_against_waves(self, bands: tuple[float, ...]) -> list[float] | None:
        if valid_for(self.camera, "fresnel") is not None:
            return None
        pairs = [
            [uniform_response(self.camera, w, model)[0] for model in ("ray", "fresnel")]
            for w in bands
        ]
        return [float(np.linalg.norm(ray - wave) / np.linalg.norm(wave)) for ray, wave in pairs]

    @property
    def accuracy(self) -> AccuracyRecord:
        """Of F, once it was computed."""
        if self.plan is None:
            return AccuracyRecord(model=self.model, rung="closed form, even object")
        return self.plan.accuracy_record()
