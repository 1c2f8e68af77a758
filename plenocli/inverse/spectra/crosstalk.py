"""Spectra of a capture freed from neighbours' light, and whether that is worth it: methods are
rehearsed on the capture that the found picture would make. docs/model.md, section 9, "Neighbours".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from plenocli.base.errors import NumericsError
from plenocli.base.tiling import FORGETFUL, Keeper
from plenocli.inverse.registration.motion import SIGNIFICANT
from plenocli.inverse.spectra.coupled import (
    LatticeAnswer,
    LatticeCapture,
    coupled,
    fine,
    likeliest,
    neighbour_part,
    shift_step,
)
from plenocli.inverse.spectra.radiance import estimate
from plenocli.inverse.spectra.spectra import Spectra, Trace

if TYPE_CHECKING:
    from plenocli.forward.sensor.noise import Noise
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.registration.motion import Motion
    from plenocli.inverse.spectra.neighbours import MovingResponse, NeighbourLight
    from plenocli.inverse.spectra.responses import LensletResponses

METHODS = ("coupled", "fine")
WHOLE = 0.75
"""Share of its pixels that a lenslet needs to be solved with the others; the rest are solved alone,
their neighbours' light taken off.
"""
BATCH_NUMBERS = 4_000_000


class Crosstalk:
    """One capture with responses, and the neighbours' light of its lenslets.

    c: the responses where the lenslets are.
    light: of the neighbours, there.
    values: (lenslet_row, lenslet_column, pixel), NaN where unknown.
    noise: of the values.
    ratio: whether errors of F divide out, as plenocli.inverse.spectra.radiance.estimate has it.
    keeper: of solutions.

    first: the answer with one radiance a lenslet.
    """

    def __init__(
        self,
        c: LensletResponses,
        light: NeighbourLight,
        values: np.ndarray,
        noise: Noise,
        *,
        ratio: bool = False,
        keeper: Keeper = FORGETFUL,
    ) -> None:
        """Solve for one radiance a lenslet."""
        self.c, self.light, self.values = c, light, values
        self.noise, self.ratio, self.keeper = noise, ratio, keeper
        response, own = _common(c)
        self.capture = LatticeCapture(
            values=values,
            response=response,
            own=own,
            response_variance=c.variance,
            noise=noise,
            start=np.moveaxis(self._alone(values, "pinv").value, 0, -1),
            ratio=ratio,
        )
        self.first: LatticeAnswer = coupled(self.capture, light, keeper=keeper)

    def _alone(self, values: np.ndarray, method: str) -> Spectra:
        return estimate(self.c, values, self.noise, method, ratio=self.ratio)

    def shift_step(self, moving: MovingResponse, shift: np.ndarray) -> np.ndarray:
        """By how much (2,) px the superpixels lie elsewhere than at `shift`."""
        return shift_step(self.capture, self.first, np.nan_to_num(moving.slopes(shift)))

    def explains_more_than(self, other: Crosstalk) -> bool:
        """Whether it leaves less of the lenslets than another look at the same capture, by more
        than they scatter: of pixels that both explain, beside the noise alone, since what a
        response has wrong, or leaves open, is no excuse.
        """
        both = (self.first.left != 0) & (other.first.left != 0)
        gain = other._left(both) - self._left(both)
        gain = gain[np.isfinite(gain)]
        return len(gain) > 0 and bool(gain.mean() > SIGNIFICANT * gain.std() / np.sqrt(len(gain)))

    def _left(self, which: np.ndarray) -> np.ndarray:
        """Mean square (lenslet_row, lenslet_column) of what is left over that of the noise.

        which: (lenslet_row, lenslet_column, pixel), that count.
        """
        f, count = np.nan_to_num(self.capture.response), which.sum(axis=-1)
        noise = self.noise.variance(np.clip(self.first.value, 0, None) @ f.T)
        power = np.where(which, self.first.left**2 / np.maximum(noise, 1e-12), 0).sum(axis=-1)
        return np.asarray(power / np.where(count > 0, count, np.nan))

    def freed(self) -> np.ndarray:
        """The values as if every lenslet's neighbours were like itself."""
        return self.values - neighbour_part(self.first, self.capture.response)

    def spectra(self, method: str) -> Spectra:
        """By "coupled", "fine" or the best of all, "auto"."""
        # fine makes patterns of a field of what is wrong with F, most where it is predicted
        answers = {"coupled": self.first}
        if method == "fine" or (method == "auto" and not self.c.predicted):
            stepped = likeliest(self.capture, self.first, self.light)
            # what was fitted may be an edge inside a field
            light = self.first.light if all(stepped) else self.light
            found = {"fine": fine(self.capture, self.first, light, stepped, self.keeper)}
            answers = answers | found if all(stepped) else found
        if method in METHODS:
            return self._told(answers[method], method, method, "asked for")
        error = {
            one: float(np.nanmean(each.sigma[self.c.valid] ** 2)) for one, each in answers.items()
        }
        name = min(error, key=lambda one: error[one])
        answer, biases = answers[name], {}
        # wls and lmmse lean on dark pixels, where neighbours' light lies: pinv in all of 40 cases
        for other in ("pinv", "single-pixel"):
            guess = self._alone(self._noiseless(answer), other)
            biases[other] = guess.value - np.moveaxis(answer.value, -1, 0)
            error[other] = float(np.nanmean(guess.sigma**2 + biases[other] ** 2))
        used = min(error, key=lambda one: error[one])
        why = "predicted rms error of radiance " + ", ".join(
            f"{m} {np.sqrt(e):.3g}" for m, e in error.items()
        )
        if used == name:
            return self._told(answer, "auto", name, why)
        alone = self._alone(self.values, used)
        sigma = np.hypot(alone.sigma, biases[used]).astype(alone.sigma.dtype)
        return _spectra(alone, alone.value, sigma, alone.residual, Trace(asked="auto", reason=why))

    def _noiseless(self, answer: LatticeAnswer) -> np.ndarray:
        """The capture that an answer makes, as far as it was looked at."""
        seen = answer.system.forward(answer.points)
        if self.capture.own is not None:
            seen = seen + self.capture.own(answer.value)
        return np.where(np.isfinite(self.values), seen, np.nan).astype(np.float32)

    def _told(self, answer: LatticeAnswer, asked: str, used: str, why: str) -> Spectra:
        """An answer as Spectra; lenslets that lost many pixels are solved alone."""
        share = self.capture.known.mean(axis=-1)
        value, sigma = (np.moveaxis(part, -1, 0).copy() for part in (answer.value, answer.sigma))
        part = neighbour_part(answer, self.capture.response)
        alone = self._alone(self.values - part, "pinv")
        few = (share < WHOLE) | ~self.c.valid
        value[:, few], sigma[:, few] = alone.value[:, few], alone.sigma[:, few]
        residual = answer.residual.astype(np.float32)
        residual[few] = np.nan if alone.residual is None else alone.residual[few]
        trace = Trace(asked=asked, reason=why)
        return _spectra(alone, value, sigma, residual, trace, used)


def _spectra(
    like: Spectra,
    value: np.ndarray,
    sigma: np.ndarray,
    residual: np.ndarray | None,
    trace: Trace,
    method: str | None = None,
) -> Spectra:
    return replace(
        like,
        value=value,
        sigma=sigma,
        method=method or like.method,
        trace=trace,
        residual=residual,
    )


def _common(
    c: LensletResponses,
) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray] | None]:
    """(The typical F (pixel, band), and what lenslets' own add to superpixels, or None)."""
    mean = np.asarray(c.typical, float)
    if c.shared:
        return mean, None
    step = max(1, BATCH_NUMBERS // mean.size)

    def own(radiance: np.ndarray) -> np.ndarray:
        out = np.full((*c.valid.shape, len(mean)), np.nan, np.float32)
        for first in range(0, len(c.sites[0]), step):
            places = tuple(part[first : first + step] for part in c.sites)
            apart = c.at(places) - mean
            out[places] = (apart @ radiance[places][..., None])[..., 0]
        return out

    return mean, own


def windows_of(c: LensletResponses, signal: Readout | np.ndarray) -> np.ndarray:
    """Superpixels (lenslet_row, lenslet_column, pixel) float32 of a capture, NaN where unknown."""
    from plenocli.forward.sensor.superpixel import extract

    out = np.full((*c.valid.shape, c.window[0] * c.window[1]), np.nan, np.float32)
    out[c.sites] = extract(signal, c.corners[:, None], c.window)[:, 0]
    return out


def sensor_of(c: LensletResponses, values: np.ndarray) -> np.ndarray:
    """The sensor (row, column) that superpixels lie on, NaN between them."""
    out = np.full(c.dark.mean.shape, np.nan, np.float32)
    rows, columns = c.window
    for (row, column), part in zip(c.corners, values[c.sites]):
        inside = out[max(row, 0) : row + rows, max(column, 0) : column + columns]
        if inside.shape == (rows, columns):
            inside[:] = part.reshape(rows, columns)
    return out


def displacement(before: LensletResponses, after: LensletResponses, motion: Motion) -> np.ndarray:
    """Mean displacement (2,) px of a motion that whole pixels of the windows did not follow."""
    sites = before.sites
    whole = (after.origin - before.origin)[sites]
    return (motion.at(before.centres[sites]) - whole).mean(axis=0)


def require_noise(noise: Noise | None, method: str) -> None:
    """Refuse a method that weighs pixels where their noise is not known."""
    if noise is None and method in METHODS:
        raise NumericsError(
            f"{method} weighs pixels by their noise, which is not known",
            fix="give the sensor's gain and read noise (calibrate --camera) or use pinv",
        )
