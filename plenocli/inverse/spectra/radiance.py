"""Radiances of the bands behind lenslets from a calibration and a capture's pixels, by the
method asked for or the best one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.base.tiling import FORGETFUL, Keeper, bands, kept
from plenocli.forward.sensor.frames import require_sensor
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra.bands import with_polarisation
from plenocli.inverse.spectra.demultiplex import demultiplex, noise_variance
from plenocli.inverse.spectra.factored import normal_equations, solve, tile_of
from plenocli.inverse.spectra.spectra import Spectra, Trace

if TYPE_CHECKING:
    from plenocli.forward.scene.labelled import LabelledSpectra
    from plenocli.forward.sensor.capture import Capture
    from plenocli.forward.sensor.readout import Readout
    from plenocli.inverse.spectra.factored import FactoredResponses, NormalEquations
    from plenocli.inverse.spectra.responses import LensletResponses

WORTHWHILE = 1.05
"""`auto` takes a method that assumes more only where it predicts a mean square error this much
smaller.
"""
NUMBER_BYTES, LENSLET_BYTES, MOVED_BYTES = 16, 300, 150
"""Memory for each number of a tile, for each lenslet and, where responses are made for one capture,
for each lenslet more (measured).
"""
Prior = tuple[np.ndarray, np.ndarray]
"""Mean (band,) and covariance (band, band) of radiances."""


def readout(
    exposure: Capture, c: LensletResponses, path: str | Path
) -> tuple[Readout, Noise | None]:
    """A capture as light at the calibration's exposure time, and the noise of it.

    exposure: with the calibration's colour filter array.
    path: of the capture, for messages.

    Returns Readout and Noise, None where it is not known.
    Raises InputError where capture and calibration do not go together.
    """
    from plenocli.forward.sensor.readout import Readout

    sensor, shape = c.calibration.sensor, c.dark.mean.shape
    require_sensor(exposure.shape, shape, path)
    if exposure.units != sensor.units:
        raise InputError(
            f"is in {exposure.units}, the calibration in {sensor.units}",
            path,
            "make all captures in the same way",
        )
    if (exposure.exposure_s is None) != (sensor.exposure is None):
        raise InputError(
            (
                f"{'does not say' if exposure.exposure_s is None else 'says'} its exposure time, "
                f"the calibration {'does not' if sensor.exposure is None else 'does'}"
            ),
            path,
            "use files of one kind for all captures",
        )
    scale = (
        1.0
        if sensor.exposure is None or exposure.exposure_s is None
        else sensor.exposure / exposure.exposure_s
    )
    top = exposure.levels.white if np.isfinite(exposure.levels.white) else sensor.white_level
    signal = Readout(
        values=exposure.mosaic,
        dark=c.dark,
        exposure_s=exposure.exposure_s,
        black=exposure.levels.black,
        white=top,
        scale=scale,
        ready=c.levels,
        brightest=c.brightest,
        path=path,
    )
    known = exposure.white_noise
    if known is not None and known.white:
        return signal, known.scaled(scale)
    gain = sensor.gain if sensor.gain is not None else exposure.levels.gain
    if gain is None:
        return signal, None
    return signal, Noise(gain=gain, read_variance=sensor.read_variance).scaled(scale)


def held_memory(c: LensletResponses, signal: Readout) -> int:
    """Bytes of what a capture and its calibration hold, but for what stays in files."""
    parts = [signal.values, c.dark.mean, c.response]
    held = sum(part.nbytes for part in parts if isinstance(part, np.ndarray))
    factors = 0 if c.shared or c.passing else 4 * math.prod(c.response.shape)
    return held + factors


def memory_by_tiles(c: LensletResponses, signal: Readout) -> int:
    """Bytes that `estimate` takes of a Readout, with what is held."""
    lenslets, (pixels, bands) = len(c.sites[0]), c.response.shape[-2:]
    numbers = min(lenslets, tile_of(c.response)) * pixels * (1 if c.shared else bands)
    each = LENSLET_BYTES if isinstance(c.response, np.ndarray) else LENSLET_BYTES + MOVED_BYTES
    return held_memory(c, signal) + NUMBER_BYTES * numbers + each * lenslets


def light_prior(c: LensletResponses, known: LabelledSpectra | None = None) -> Prior | None:
    """Mean and covariance of radiance for lmmse: reflectances of natural and man-made surfaces
    under the light of the calibration's white.

    known: spectra that stand for the scene instead.

    Returns (band,) and (band, band), None where the white image cannot tell the light in every
    band.
    """
    from plenocli.forward.scene.statistics import radiance_statistics, reflectance_statistics
    from plenocli.forward.scene.tables import surfaces

    light = c.white_light
    if light is None:
        return None
    mean, covariance = reflectance_statistics(
        surfaces(c.wavelengths) if known is None else known.at(c.wavelengths)
    )
    if c.states is not None:
        covariance = with_polarisation(covariance, mean, c.states)
    # narrow neighbouring bands are nearly the same number on most surfaces
    covariance = covariance + 1e-4 * np.eye(len(mean))
    return radiance_statistics(mean, covariance, light)


def estimate(
    c: LensletResponses,
    values: Readout | np.ndarray,
    noise: Noise | None,
    method: str,
    prior: Prior | None = None,
    ratio: bool = False,
    stray: np.ndarray | None = None,
    keeper: Keeper = FORGETFUL,
) -> Spectra:
    """The radiances of a capture.

    Least squares first gives the expected radiance from which the noise of each pixel follows
    (where a lenslet has too little light for that, LMMSE); `auto` compares the mean square errors
    that the methods predict on lenslets all over the array.
    values: a Readout, or superpixels (lenslet_row, lenslet_column, pixel).
    noise: of the values; None: unknown.
    method: pinv, wls, lmmse, nnls, single-pixel or auto.
    prior: of the radiances, for lmmse.
    ratio: whether the radiance will be divided by another one from the same F, so that the error of
        F divides out (to first order, and but for crosstalk) and does not count.
    stray: (4, pixel, n), by the parity of the window's first pixel: patterns of light that is no
        band's, unknowns of their own for all methods but single pixel.
    keeper: of what is finished, of this capture by this method alone.

    Returns Spectra, of the quantity radiance.
    Raises NumericsError where the method needs the noise or a prior that there is none of, or no
        lenslet can be demultiplexed.
    """
    if method == "lmmse" and prior is None:
        raise NumericsError(
            "lmmse needs to know the light in every band, which the calibration's white does not "
            "tell",
            fix="use wls or pinv",
        )
    widened, prior = _with_stray(c, stray, prior, values)
    job = _Estimation(
        c=c,
        widened=widened,
        prior=prior,
        values=values,
        noise=noise,
        ratio=ratio,
        keeper=keeper,
    )
    if noise is None and method in ("wls", "lmmse"):
        raise NumericsError(
            f"{method} weighs pixels by their noise, which is not known",
            fix="give the sensor's gain and read noise (--camera) or use pinv",
        )
    used, why = method, "asked for"
    if method == "auto":
        used, why = ("pinv", "the sensor's noise is not known") if noise is None else job.best()
    value, sigma, residual = job.answers(used)
    return Spectra(
        value=np.moveaxis(value, -1, 0),
        sigma=np.moveaxis(sigma, -1, 0),
        wavelength=c.wavelengths,
        quantity="radiance",
        method=used,
        trace=Trace(asked=method, reason=why),
        residual=None if noise is None else residual,
        states=c.states,
    )


def _with_stray(
    c: LensletResponses, stray: np.ndarray | None, prior: Prior | None, values: Readout | np.ndarray
) -> tuple[LensletResponses, Prior | None]:
    """Calibration and prior with the patterns of stray light as further bands, scaled to the
    light of the others.
    """
    if stray is None:
        return c, prior
    from plenocli.inverse.registration.moved_response import widened

    level = np.float32(max(float(np.nanmax(c.sampled_response)), 1e-30))
    count = stray.shape[-1]
    variance = (
        None
        if c.variance is None
        else np.concatenate([c.variance, np.zeros((len(c.variance), count))], axis=1)
    )
    if prior is not None:
        free = float(_brightest(c, values) / level) ** 2  # nothing is known of it beforehand
        mean, covariance = prior
        wide = np.diag(np.concatenate([np.zeros(len(mean)), np.full(count, free)]))
        wide[: len(mean), : len(mean)] = covariance
        prior = np.concatenate([mean, np.zeros(count)]), wide
    return replace(
        c, response=widened(c.response, stray * level, c.origin, c.sites), variance=variance
    ), prior


def _brightest(c: LensletResponses, values: Readout | np.ndarray) -> float:
    if isinstance(values, np.ndarray):
        return np.nanmax(values)
    return np.nanmax(values.cut(c.corners[c.sample], c.window))


class _Estimation:
    """One capture with its calibration, whose lenslets are estimated tile by tile.

    c: the responses as they are.
    widened: with stray light as further bands; prior likewise.
    values, noise, ratio, keeper: as estimate's.
    """

    def __init__(
        self,
        *,
        c: LensletResponses,
        widened: LensletResponses,
        prior: Prior | None,
        values: Readout | np.ndarray,
        noise: Noise | None,
        ratio: bool,
        keeper: Keeper,
    ) -> None:
        self.c, self.widened, self.prior, self.noise, self.ratio = c, widened, prior, noise, ratio
        self.values, self.keeper = values, keeper
        self.bands, self.unknowns = len(c.wavelengths), widened.response.shape[-1]

    def cut(self, which: np.ndarray | slice) -> np.ndarray:
        """Superpixels (lenslet, pixel) float32 of lenslets, NaN where unknown."""
        if isinstance(self.values, np.ndarray):
            return np.asarray(self.values[tuple(s[which] for s in self.c.sites)], np.float32)
        return self.values.cutter(self.c.corners, self.c.window)(which)

    @cached_property
    def sample(self) -> _Lenslets:
        """Lenslets all over the array."""
        return _Lenslets(self, self.c.sample, self.widened.sampled)

    def answers(self, method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(radiances, their standard deviations, (lenslet_row, lenslet_column, band) each; mean
        square of the residuals over the expected one (lenslet_row, lenslet_column)) by one method,
        NaN where they cannot be told.
        """
        shape = self.c.valid.shape
        value, sigma = (np.full((*shape, self.bands), np.nan) for _ in range(2))
        residual = np.full(shape, np.nan, np.float32)
        for part in bands(len(self.c.sites[0]), tile_of(self.widened.response)):
            places = tuple(site[part] for site in self.c.sites)
            value[places], sigma[places], residual[places] = kept(
                self.keeper, f"{part.start}-{part.stop}", partial(self._answer, part, method)
            )
        return value, sigma, residual

    def _answer(self, part: slice, method: str) -> tuple[np.ndarray, ...]:
        """`answers` of some lenslets, (lenslet, band) and (lenslet,)."""
        tile = _Lenslets(self, part, self.widened.some(part))
        sums = tile.equations() if self.noise is None else tile.weighted(method == "pinv")
        found = tile.single_pixel(sums) if method == "single-pixel" else tile.solved(sums, method)
        value, sigma = (one[:, : self.bands] for one in found)
        return value, sigma, tile.residual(sums)

    @cached_property
    def starved(self) -> bool:
        """Whether noise leaves less than ten levels of the prior's spread: then weights from
        least squares follow the noise.
        """
        prior = self.prior
        if prior is None:
            return False
        return bool(kept(self.keeper, "starved", lambda: [np.array(self._starved(prior))])[0])

    def _starved(self, prior: Prior) -> bool:
        few = slice(None, None, max(1, len(self.c.sample) // 64))
        lenslets = _Lenslets(self, self.c.sample[few], self.widened.sampled.some(few))
        sums = lenslets.equations(
            noise=self.noise,
            response_variance=None if self.ratio else self.widened.variance,
            sandwich=True,
        )
        sigma = lenslets.solved(sums, "pinv")[1]
        sigma = sigma[np.isfinite(sigma).all(axis=-1)]
        return not len(sigma) or bool(
            (
                np.median(sigma[:, : self.bands], axis=0)
                > 0.1 * np.sqrt(np.diag(prior[1])[: self.bands])
            ).any()
        )

    def best(self) -> tuple[str, str]:
        """(method, reason) with the least predicted error."""
        names = "pinv", "wls", *(["lmmse"] if self.prior else []), "single-pixel"
        (errors,) = kept(self.keeper, "errors", lambda: [np.array(self._errors(names[:-1]))])
        error = dict(zip(names, errors.tolist()))
        least = min(error.values())
        used = next(m for m in error if error[m] <= WORTHWHILE * least)
        return used, "predicted rms error of radiance " + ", ".join(
            f"{m} {np.sqrt(e):.3g}" for m, e in error.items()
        )

    def _errors(self, names: Sequence[str]) -> list[float]:
        """Predicted mean square errors of methods, and of single-pixel extraction."""
        sums = self.sample.weighted()
        tried = {m: self.sample.solved(sums, m)[1][:, : self.bands] for m in names}
        if not np.isfinite(tried["pinv"]).any():
            raise NumericsError(
                "no lenslet could be demultiplexed",
                fix=(
                    "check that the capture is not saturated and that the bands of "
                    "the calibration differ"
                ),
            )
        error = [float(np.nanmean(sigma**2)) for sigma in tried.values()]
        return [*error, self._single_pixel_error(self.sample.radiance(sums))]

    def _single_pixel_error(self, radiance: np.ndarray) -> float:
        """Mean square error that single-pixel extraction would make on the sample: crosstalk
        bias and the noise of one pixel.
        """
        assert self.noise is not None
        rows = self.c.sampled_pixels[1]
        own = np.diagonal(rows, axis1=-2, axis2=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            bias = (rows @ np.nan_to_num(radiance)[..., None])[..., 0] / own - radiance
            variance = self.noise.variance(own * radiance) / own**2
            return float(np.nanmean(bias**2 + variance))


class _Lenslets:
    """Some lenslets of one capture, cut out.

    job: of all of them.
    which: by their index among the valid ones.
    factored: their responses.
    """

    def __init__(
        self, job: _Estimation, which: np.ndarray | slice, factored: FactoredResponses
    ) -> None:
        self.job, self.which, self.factored = job, which, factored
        self.values = job.cut(which)

    def equations(self, **settings: Any) -> NormalEquations:
        """Their normal equations."""
        return normal_equations(
            self.factored, lambda part: self.values[part].copy(), len(self.values), **settings
        )

    def weighted(self, sandwich: bool = True) -> NormalEquations:
        """Normal equations weighted by the noise that is expected."""
        job, known = self.job, self.job.widened.variance
        settings = dict(
            noise=job.noise,
            response_variance=None if job.ratio else known,
            doubt=known if job.ratio else None,
            sandwich=sandwich,
        )
        if job.prior is None or not job.starved:
            return self.equations(**settings)
        even = np.broadcast_to(job.prior[0], (len(self.values), job.unknowns))
        first = self.equations(**settings, radiance=even)
        return self.equations(**settings, radiance=np.nan_to_num(self.solved(first, "lmmse")[0]))

    def solved(self, sums: NormalEquations, method: str) -> tuple[np.ndarray, np.ndarray]:
        """(radiances, standard deviations) by one method; the few that single precision cannot do,
        in double.
        """
        value, sigma = solve(
            self.factored, sums, method, self.job.prior, self.job.noise is not None
        )
        hard = np.flatnonzero(sums.hard)
        if len(hard):
            value[hard], sigma[hard] = self._double(hard, method)
        return value, sigma

    def _double(self, hard: np.ndarray, method: str) -> tuple[np.ndarray, np.ndarray]:
        job = self.job
        f = job.widened.at(tuple(site[self.which][hard] for site in job.c.sites))
        x, variance = self.values[hard], None
        if job.noise is not None:
            b = demultiplex(f, x, "pinv")[0]
            b = np.where(np.isfinite(b), b, 0.0 if job.prior is None else job.prior[0])
            variance = np.maximum(
                noise_variance(f, b, job.noise, None if job.ratio else job.widened.variance),
                1e-12,
            )
        return demultiplex(f, x, method, variance=variance, prior=job.prior)

    def radiance(self, sums: NormalEquations) -> np.ndarray:
        """Radiances (lenslet, band) of the calibration's bands by unweighted least squares."""
        b = (self.factored.inverse @ sums.unweighted[..., None])[..., 0][:, : self.job.bands]
        return np.where(sums.hard[:, None], np.nan, b)

    def single_pixel(self, sums: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
        """x[p] / F[p] at the calibrated pixels, sigma without the crosstalk bias; NaN sigma
        where the noise is not known.
        """
        c, noise = self.job.c, self.job.noise
        pixels, rows = c.pixels(self.which)
        pixels = np.broadcast_to(pixels, (len(self.values), self.job.bands))
        x = np.take_along_axis(self.values, pixels, axis=1).astype(float)
        own = np.diagonal(rows, axis1=-2, axis2=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            b = np.where(own > 0, x / own, np.nan)
            if noise is None:
                return b, np.full_like(b, np.nan)
            known = None if self.job.ratio or c.variance is None else c.variance[pixels]
            variance = noise_variance(rows, np.nan_to_num(self.radiance(sums)), noise, known)
            return b, np.where(np.isfinite(b), np.sqrt(np.maximum(variance, 1e-12)) / own, np.nan)

    def residual(self, sums: NormalEquations) -> np.ndarray:
        """Mean square (lenslet,) of the residuals over the expected one."""
        freedom = sums.count - self.job.unknowns
        with np.errstate(invalid="ignore", divide="ignore"):
            power = sums.chi / np.maximum(freedom, 1)
        return np.where((freedom > 0) & ~sums.hard, power, np.nan)
