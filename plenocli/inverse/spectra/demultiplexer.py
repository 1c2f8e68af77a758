"""Spectra from any number of captures with one calibration, each registered to it first."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.inverse.registration.alignment import align, believed, doubtful, warn_of_misfit
from plenocli.inverse.spectra.radiance import estimate, light_prior, readout
from plenocli.inverse.spectra.responses import LensletResponses

if TYPE_CHECKING:
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.calibration.calibration import Calibration
    from plenocli.inverse.registration.alignment import Registration
    from plenocli.inverse.spectra.spectra import Spectra

Name = str | Path


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
        threads: int = 1,
    ) -> None:
        """Factor a calibration.

        calibration: with windows, white, dark and response.
        method: pinv, single-pixel, wls, lmmse, nnls or auto.
        register: auto, on or off, whether captures are brought into line with the calibration.
        ratio: whether spectra will be divided by those of a white reference, which a prior's pull
            must not spoil.
        threads: for factoring the response.
        """
        self.method, self.register, self.ratio = method, register, ratio
        self.prior = light_prior(LensletResponses.of(calibration))
        # its superpixels, one for every lenslet, have served
        self.responses = LensletResponses.of(replace(calibration, white=None), threads).prepare()

    def estimate(self, capture: Capture, path: Name, method: str | None = None) -> Spectra:
        """Radiances of one capture, registered to the calibration.

        path: of the capture, for messages.
        method: instead of the usual one.

        Raises InputError where capture and calibration do not go together, NumericsError where no
        lenslet can be demultiplexed.
        """
        method = method or self.method
        signal, noise = readout(capture, self.responses, path)
        found = self._aligned(signal, noise, method, path, self.register)
        tried = found.trace.registration
        if tried and self.register == "auto" and doubtful(found.residual, tried):
            found = self._believed(found, tried, signal, noise, method, path)
        if not np.isfinite(found.value).any():
            raise NumericsError(
                "no lenslet could be demultiplexed", path, "check exposure and calibration"
            )
        warning = warn_of_misfit(found.residual, found.trace.registration, path)
        return replace(found, trace=replace(found.trace, warning=warning))

    def _believed(
        self,
        found: Spectra,
        registration: Registration,
        signal: Readout,
        noise: Noise | None,
        method: str,
        path: Name,
    ) -> Spectra:
        """`found`, or the estimate with motion alone corrected, or with nothing: the first that
        explains its residuals.
        """
        uncorrected = self._aligned(signal, noise, method, path, "off")
        if believed(found.residual, uncorrected.residual):
            return found
        if "motion" in registration.corrected:
            moved = (
                found
                if registration.corrected == ("motion",)
                else self._aligned(signal, noise, method, path, "auto", levels=False)
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
        mode: str,
        levels: bool = True,
    ) -> Spectra:
        aligned = align(self.responses, signal, noise, mode, path, levels)
        found = estimate(
            aligned.responses,
            aligned.signal,
            noise,
            method,
            self.prior,
            self.ratio,
            aligned.stray,
        )
        return replace(found, trace=replace(found.trace, registration=aligned.registration))
