"""Spectra from any number of captures with one calibration, each registered to it first."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.budget import budget
from plenocli.base.errors import ConfigError, InputError, NumericsError, UsageError
from plenocli.base.progress import note
from plenocli.base.tiling import FORGETFUL, Keeper, kept
from plenocli.forward.sensor.frames import REACH
from plenocli.inverse.registration.alignment import align, believed, doubtful, misfit_told
from plenocli.inverse.spectra.bands import by_filter, by_state
from plenocli.inverse.spectra.crosstalk import METHODS as NEIGHBOURLY
from plenocli.inverse.spectra.crosstalk import (
    Crosstalk,
    displacement,
    require_noise,
    sensor_of,
    windows_of,
)
from plenocli.inverse.spectra.radiance import (
    estimate,
    held_memory,
    light_prior,
    memory_by_tiles,
    readout,
)
from plenocli.inverse.spectra.responses import LensletResponses

if TYPE_CHECKING:
    from plenocli.forward.camera.model import Camera
    from plenocli.forward.scene.labelled import LabelledSpectra
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.calibration.calibration import Calibration
    from plenocli.inverse.registration.alignment import Aligned, Registration
    from plenocli.inverse.registration.motion import Motion
    from plenocli.inverse.spectra.neighbours import MovingResponse, NeighbourLight
    from plenocli.inverse.spectra.spectra import Spectra

Name = str | Path
LEAST_STEP = 0.002
"""px, of a displacement that is worth another solution."""
FOLLOWED = 0.02
"""px: neighbours' light is displaced by multiples of it."""
PLANES, PLANES_OF_MOVED = 15, 25
"""Numbers in single precision for each pixel of all superpixels that all lenslets together take, of
a capture as calibrated and of one that moved (measured).
"""
TURNS = 2
"""Looks for motion, each with the neighbours' light as the last left it."""
SHIFTS = 3
"""Solutions of a capture whose lenslets are displaced alike, each where the last one says."""


class Demultiplexer:
    """A calibration factored, once for all captures.

    responses: of its lenslets.
    prior: mean and covariance of radiance, where the calibration's white tells the light.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        method: str = "auto",
        register: str = "auto",
        ratio: bool = False,
        camera: Camera | None = None,
        known: LabelledSpectra | None = None,
        threads: int = 1,
        several: bool = True,
        keeper: Keeper = FORGETFUL,
        where: str | os.PathLike | None = None,
    ) -> None:
        """Factor a calibration.

        calibration: with windows, white, dark and response.
        method: pinv, single-pixel, wls, lmmse, nnls, coupled, fine or auto.
        register: auto, on or off, whether captures are brought into line with the calibration.
        ratio: whether spectra will be divided by those of a white reference, which a prior's pull
            must not spoil.
        camera: description of the calibrated camera, from which neighbours' light is predicted;
            None: lenslets are demultiplexed one by one.
        known: spectra whose mean and covariance are the prior's; None: those of many surfaces.
        threads: for factoring the response.
        several: whether many captures follow; for one, less is kept in memory.
        keeper: of what follows from the calibration and takes long.
        where: file of the calibration, for messages.

        Raises UsageError where a method needs a camera that there is none of, ConfigError for one
            that tells no neighbours' light, InputError for a response that is no sensor's.
        """
        calibration = by_state(calibration)
        if ratio:
            calibration = by_filter(calibration, camera)
        responses = LensletResponses.of(calibration)
        brightest = responses.brightest
        if not 0 < brightest <= REACH:
            raise InputError(
                f"has a response of {brightest:.2g} to a light of 1, as no sensor does",
                where or "the calibration",
                "calibrate again",
            )
        self.method, self.register, self.ratio = method, register, ratio
        self.neighbours = self._neighbours(calibration, camera)
        self.moving = _moving(calibration, self.neighbours)
        self._displaced: dict[tuple[float, ...], NeighbourLight] = {}
        prior = partial(light_prior, responses, known)
        found = kept(keeper, "prior", lambda: prior() or ())
        self.prior = (found[0], found[1]) if found else None
        # its superpixels, one for every lenslet, have served
        calibration = replace(calibration, white=None)
        self.responses = LensletResponses.of(calibration, threads, several).prepare()

    def _neighbours(self, calibration: Calibration, camera: Camera | None) -> NeighbourLight | None:
        """Neighbours' light; a note where there is no telling and nobody insists."""
        from plenocli.inverse.spectra.neighbours import neighbour_light

        if self.method not in (*NEIGHBOURLY, "auto"):
            return None
        if camera is None:
            if self.method in NEIGHBOURLY:
                raise UsageError(
                    f"--method {self.method} predicts neighbours' light from the camera's "
                    "description, and the calibration holds none",
                    fix="give --camera",
                )
            note(
                "no description of the camera: neighbours' light is not taken off, and where "
                "neighbouring lenslets differ errors are larger than stated; give --camera"
            )
            return None
        try:
            return neighbour_light(camera, calibration)
        except ConfigError as error:
            if self.method in NEIGHBOURLY:
                raise
            note(f"warning: {error}: lenslets are demultiplexed one by one")
            return None

    def estimate(
        self,
        capture: Capture,
        path: Name,
        method: str | None = None,
        keeper: Keeper = FORGETFUL,
    ) -> Spectra:
        """Radiances of one capture, registered to the calibration.

        path: of the capture, for messages.
        method: instead of the usual one.
        keeper: of tiles of this capture, or of solutions for all lenslets.

        Returns Spectra whose bands may come in two states (plenocli.inverse.spectra.bands).
        Raises InputError where capture and calibration do not go together, NumericsError where no
        lenslet can be demultiplexed.
        """
        method = method or self.method
        signal, noise = readout(capture, self.responses, path)
        require_noise(noise, method)
        if self.neighbours is None or noise is None or method not in (*NEIGHBOURLY, "auto"):
            found = self._alone(partial(self._aligned, signal, noise, method, path, keeper))
        else:
            found = self._together(self.neighbours, signal, noise, method, path, keeper)
        if not np.isfinite(found.value).any():
            raise NumericsError(
                "no lenslet could be demultiplexed", path, "check exposure and calibration"
            )
        warning = misfit_told(found.residual, found.trace.registration)
        return replace(found, trace=replace(found.trace, warning=warning))

    def _alone(self, aligned: Callable[..., Spectra]) -> Spectra:
        """Lenslet by lenslet; aligned: _aligned of one capture."""
        found = aligned(self.register)
        tried = found.trace.registration
        if tried and self.register == "auto" and doubtful(found.residual, tried):
            return self._believed(found, tried, aligned)
        return found

    def _together(
        self,
        light: NeighbourLight,
        signal: Readout,
        noise: Noise,
        method: str,
        path: Name,
        keeper: Keeper,
    ) -> Spectra:
        """All lenslets at once; motion is looked for in what neighbours did not do, and taken where
        it explains more.
        """
        c = self.responses
        self._require_together(signal, path, PLANES)
        best = self._crosstalk(c, light, windows_of(c, signal), noise, keeper.under("still"))
        found: Registration | None = None
        last = best
        for turn in range(TURNS if self.register != "off" else 0):
            plane = sensor_of(last.c, last.freed())
            aligned = align(c, plane, noise, self.register, path)
            if aligned.registration and "motion" in aligned.registration.corrected:
                # what moved responses have wrong in shape passes for an offset and stray light
                aligned = align(c, plane, noise, self.register, path, levels=False)
            tried = aligned.registration
            if tried is None or tried.motion is None or not tried.corrected:
                found = found or tried
                break
            self._require_together(signal, path, PLANES_OF_MOVED)
            moved = keeper.under(f"moved{turn}")
            last = self._moved(light, aligned, tried.motion, signal, noise, moved)
            if self.register == "auto" and not last.explains_more_than(best):
                found = found or replace(tried, corrected=())
                break
            best, found = last, tried
        spectra = best.spectra(method)
        return replace(spectra, trace=replace(spectra.trace, registration=found))

    def _require_together(self, signal: Readout, path: Name, planes: int) -> None:
        c = self.responses
        needed = held_memory(c, signal) + 4 * planes * c.valid.size * math.prod(c.window)
        fewer = "take --method pinv, by which lenslets are alone"
        budget().require(needed, "demultiplexing all lenslets together", path, fewer)

    def _moved(
        self,
        light: NeighbourLight,
        aligned: Aligned,
        motion: Motion,
        signal: Readout,
        noise: Noise,
        keeper: Keeper,
    ) -> Crosstalk:
        """The capture where its lenslets are, without what else stands between it and the
        calibration: displaced alike by prediction, or each by splines where that explains more.
        """
        corrected = aligned.registration.corrected if aligned.registration else ()
        plain = signal - motion.offset if "offset" in corrected else signal

        def solved(c: LensletResponses, light: NeighbourLight, name: str) -> Crosstalk:
            values = windows_of(c, plain)
            if "stray light" in corrected:
                values -= motion.stray * np.nanmean(values, axis=-1, keepdims=True)
            return self._crosstalk(c, light, values, noise, keeper.under(name))

        before, after = self.responses, aligned.responses
        if "motion" not in corrected:
            return solved(after, light, "alike")
        each = None
        if self.moving is None or not after.shared:
            near = self._at(light, displacement(before, after, motion))
            each = solved(after, near, "each")
            if self.moving is None:
                return each
        shift = motion.at(before.centres[before.sites]).mean(axis=0)
        known = 0 if before.variance is None else before.variance
        for turn in range(SHIFTS):
            whole = np.rint(shift)
            c, rest = replace(before, origin=before.origin + whole.astype(int)), shift - whole
            response, variance = self.moving.at(rest), known + self.moving.variance(rest)
            c = replace(c, response=response.astype(np.float32), variance=variance)
            found = solved(c, self._at(light, rest), f"shift{turn}")
            step = np.clip(found.shift_step(self.moving, rest), -0.1, 0.1)
            if np.abs(step).max() < LEAST_STEP:
                break
            shift = shift + step
        return each if each is not None and each.explains_more_than(found) else found

    def _at(self, light: NeighbourLight, shift: np.ndarray) -> NeighbourLight:
        """Neighbours' light near a displacement (2,) px, the last one kept for the next capture."""
        steps = FOLLOWED * np.rint(shift / FOLLOWED)
        place = tuple(float(step) for step in steps)
        if place not in self._displaced:
            self._displaced = {place: light.moved(steps, self.responses.calibration)}
        return self._displaced[place]

    def _crosstalk(
        self,
        c: LensletResponses,
        light: NeighbourLight,
        values: np.ndarray,
        noise: Noise,
        keeper: Keeper,
    ) -> Crosstalk:
        return Crosstalk(c, light, values, noise, ratio=self.ratio, keeper=keeper)

    def _believed(
        self,
        found: Spectra,
        registration: Registration,
        aligned: Callable[..., Spectra],
    ) -> Spectra:
        """`found`, or the estimate with motion alone corrected, or with nothing: the first that
        explains its residuals.
        """
        uncorrected = aligned("off")
        if believed(found.residual, uncorrected.residual):
            return found
        if "motion" in registration.corrected:
            moved = (
                found if registration.corrected == ("motion",) else aligned("auto", levels=False)
            )
            if believed(moved.residual, uncorrected.residual):
                return moved
        trace = replace(uncorrected.trace, registration=replace(registration, corrected=()))
        return replace(uncorrected, trace=trace)

    def _aligned(
        self,
        signal: Readout,
        noise: Noise | None,
        method: str,
        path: Name,
        keeper: Keeper,
        mode: str,
        levels: bool = True,
    ) -> Spectra:
        aligned = align(self.responses, signal, noise, mode, path, levels)
        needed = memory_by_tiles(aligned.responses, signal)
        budget().require(needed, "demultiplexing", path, "cut the capture")
        found = estimate(
            aligned.responses,
            aligned.signal,
            noise,
            method,
            self.prior,
            self.ratio,
            aligned.stray,
            keeper.under(mode if levels else f"{mode} but levels"),
        )
        return replace(found, trace=replace(found.trace, registration=aligned.registration))


def _moving(calibration: Calibration, light: NeighbourLight | None) -> MovingResponse | None:
    """The response of all lenslets where it can be displaced by prediction."""
    from plenocli.inverse.spectra.neighbours import MovingResponse

    if light is None or not LensletResponses.of(calibration).shared:
        return None
    try:
        return MovingResponse(light.camera, calibration)
    except ConfigError:
        return None


def tell_misfit(told: Mapping[str, Spectra]) -> None:
    """One line on all captures, by name, that the calibration does not describe."""
    warned = {name: found.trace.warning for name, found in told.items() if found.trace.warning}
    if warned:
        note(f"warning: {', '.join(warned)}: {next(iter(warned.values()))}")


def method_of_white(method: str) -> str:
    """The method for a white reference beside captures demultiplexed by `method`."""
    return {"auto": "pinv", "coupled": "pinv", "fine": "pinv", "lmmse": "wls"}.get(method, method)
