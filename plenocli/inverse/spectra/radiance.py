"""Radiances of the bands behind lenslets from a calibration and a capture's pixels, by the
method asked for or the best one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from plenocli.base.errors import InputError, NumericsError
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.calibration.calibration import there
from plenocli.inverse.spectra.bands import with_polarisation
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
BATCH_NUMBERS = 4_000_000
"""Pixels of lenslets that are held at a time."""
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
    if exposure.shape != shape:
        raise InputError(
            (
                f"is {exposure.shape[0]} x {exposure.shape[1]} px, the calibration "
                f"{shape[0]} x {shape[1]}"
            ),
            path,
            "use captures of the calibrated camera",
        )
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
    )
    known = exposure.white_noise
    if known is not None and known.white:
        return signal, known.scaled(scale)
    gain = sensor.gain if sensor.gain is not None else exposure.levels.gain
    if gain is None:
        return signal, None
    return signal, Noise(gain=gain, read_variance=sensor.read_variance).scaled(scale)


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
    job = _Estimation(c=c, widened=widened, prior=prior, values=values, noise=noise, ratio=ratio)
    if noise is None:
        if method in ("wls", "lmmse"):
            raise NumericsError(
                f"{method} weighs pixels by their noise, which is not known",
                fix="give the sensor's gain and read noise (--camera) or use pinv",
            )
        used, why = (
            ("pinv", "the sensor's noise is not known")
            if method == "auto"
            else (method, "asked for")
        )
        sums = job.equations()
    else:
        used, why = (method, "asked for") if method != "auto" else job.best()
        sums = job.weighted(None, sandwich=used == "pinv")
    value, sigma = job.single_pixel(sums) if used == "single-pixel" else job.solved(sums, used)
    return Spectra(
        value=np.moveaxis(job.spread_out(value[:, : job.bands]), -1, 0),
        sigma=np.moveaxis(job.spread_out(sigma[:, : job.bands]), -1, 0),
        wavelength=c.wavelengths,
        quantity="radiance",
        method=used,
        trace=Trace(asked=method, reason=why),
        residual=None if noise is None else job.residual(sums),
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

    some = tuple(part[c.sample] for part in c.sites)
    level = np.float32(max(float(np.nanmax(c.at(some))), 1e-30))
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
    """One capture with its calibration.

    c: the responses as they are.
    widened: with stray light as further bands; prior likewise.
    values, noise, ratio: as estimate's.
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
    ) -> None:
        self.c, self.widened, self.prior, self.noise, self.ratio = c, widened, prior, noise, ratio
        self.bands, self.unknowns = len(c.wavelengths), widened.response.shape[-1]
        self.total = len(c.sites[0])
        self.sample = c.sample
        self.factored = None if widened.passing else widened.factored
        self.cut: Callable[[Any], np.ndarray]
        if isinstance(values, np.ndarray):
            own = values[c.sites]
            # lenslets by their index or a slice, free to be overwritten
            self.cut = lambda which: np.array(own[which], np.float32)
        else:
            self.cut = values.cutter(c.corners, c.window)

    def equations(self, which: np.ndarray | None = None, **settings: Any) -> NormalEquations:
        """Normal equations of all lenslets, or those of an index array."""
        from plenocli.inverse.spectra.factored import normal_equations, streamed_equations

        if which is None and self.widened.passing:
            self.factored, sums = streamed_equations(
                self.widened.response, self.widened.sites, self.cut, **settings
            )
            return sums
        if which is None:
            return normal_equations(self.widened.factored, self.cut, self.total, **settings)
        return normal_equations(
            self._some(which), lambda part: self.cut(which[part]), len(which), **settings
        )

    def _some(self, which: np.ndarray | None) -> FactoredResponses:
        if which is None or which is self.sample:
            return there(self.factored) if which is None else self.widened.sampled
        if not self.widened.passing:
            return self.widened.factored.some(which)
        from plenocli.inverse.spectra.factored import factor

        return factor(self.widened.response, tuple(part[which] for part in self.widened.sites))

    def weighted(self, which: np.ndarray | None = None, sandwich: bool = True) -> NormalEquations:
        """Normal equations weighted by the noise that is expected."""
        known = self.widened.variance
        settings = dict(
            noise=self.noise,
            response_variance=None if self.ratio else known,
            doubt=known if self.ratio else None,
            sandwich=sandwich,
        )
        if self.prior is None or not self.starved:
            return self.equations(which, **settings)
        count = self.total if which is None else len(which)
        first = self.equations(
            which, **settings | {"radiance": np.broadcast_to(self.prior[0], (count, self.unknowns))}
        )
        return self.equations(
            which, **settings | {"radiance": np.nan_to_num(self.solved(first, "lmmse", which)[0])}
        )

    @cached_property
    def starved(self) -> bool:
        """Whether noise leaves less than ten levels of the prior's spread: then weights from
        least squares follow the noise.
        """
        if self.prior is None:
            return False
        few = self.sample[:: max(1, len(self.sample) // 64)]
        settings = dict(
            noise=self.noise,
            response_variance=None if self.ratio else self.widened.variance,
            sandwich=True,
        )
        sigma = self.solved(self.equations(few, **settings), "pinv", few)[1]
        sigma = sigma[np.isfinite(sigma).all(axis=-1)]
        return not len(sigma) or bool(
            (
                np.median(sigma[:, : self.bands], axis=0)
                > 0.1 * np.sqrt(np.diag(self.prior[1])[: self.bands])
            ).any()
        )

    def best(self) -> tuple[str, str]:
        """(method, reason) with the least predicted error."""
        sums = self.weighted(self.sample)
        tried = {
            m: self.solved(sums, m, self.sample)[1][:, : self.bands]
            for m in ("pinv", "wls", *(["lmmse"] if self.prior else []))
        }
        if not np.isfinite(tried["pinv"]).any():
            raise NumericsError(
                "no lenslet could be demultiplexed",
                fix=(
                    "check that the capture is not saturated and that the bands of "
                    "the calibration differ"
                ),
            )
        error = {m: float(np.nanmean(sigma**2)) for m, sigma in tried.items()}
        error["single-pixel"] = self._single_pixel_error(self._radiance(sums, self.sample))
        least = min(error.values())
        used = next(m for m in error if error[m] <= WORTHWHILE * least)
        return used, "predicted rms error of radiance " + ", ".join(
            f"{m} {np.sqrt(e):.3g}" for m, e in error.items()
        )

    def solved(
        self, sums: NormalEquations, method: str, which: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """(radiances, standard deviations) of lenslets by one method; the few that single
        precision cannot do, in double.
        """
        from plenocli.inverse.spectra.factored import solve

        value, sigma = solve(self._some(which), sums, method, self.prior, self.noise is not None)
        hard = np.flatnonzero(sums.hard)
        if len(hard):
            value[hard], sigma[hard] = self._double(hard if which is None else which[hard], method)
        return value, sigma

    def _double(self, which: np.ndarray, method: str) -> tuple[np.ndarray, np.ndarray]:
        from plenocli.inverse.spectra.demultiplex import demultiplex, noise_variance

        f = self.widened.at((self.c.sites[0][which], self.c.sites[1][which]))
        x, variance = self.cut(which), None
        if self.noise is not None:
            b = demultiplex(f, x, "pinv")[0]
            b = np.where(np.isfinite(b), b, 0.0 if self.prior is None else self.prior[0])
            variance = np.maximum(
                noise_variance(f, b, self.noise, None if self.ratio else self.widened.variance),
                1e-12,
            )
        return demultiplex(f, x, method, variance=variance, prior=self.prior)

    def _radiance(self, sums: NormalEquations, which: np.ndarray | None = None) -> np.ndarray:
        """Radiances (lenslet, band) of the calibration's bands by unweighted least squares."""
        b = (self._some(which).inverse @ sums.unweighted[..., None])[..., 0][:, : self.bands]
        return np.where(sums.hard[:, None], np.nan, b)

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

    def single_pixel(self, sums: NormalEquations) -> tuple[np.ndarray, np.ndarray]:
        """x[p] / F[p] at the calibrated pixels, sigma without the crosstalk bias; NaN sigma
        where the noise is not known.
        """
        from plenocli.inverse.spectra.demultiplex import noise_variance

        pixels, rows = self.c.pixels(slice(None))
        pixels = np.broadcast_to(pixels, (self.total, self.bands))
        step = max(1, BATCH_NUMBERS // self.c.response.shape[-2])
        x = np.concatenate(
            [
                np.take_along_axis(self.cut(slice(s, s + step)), pixels[s : s + step], axis=1)
                for s in range(0, self.total, step)
            ]
        ).astype(float)
        own = np.diagonal(rows, axis1=-2, axis2=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            b = np.where(own > 0, x / own, np.nan)
            if self.noise is None:
                return b, np.full_like(b, np.nan)
            known = None if self.ratio or self.c.variance is None else self.c.variance[pixels]
            variance = noise_variance(rows, np.nan_to_num(self._radiance(sums)), self.noise, known)
            return b, np.where(np.isfinite(b), np.sqrt(np.maximum(variance, 1e-12)) / own, np.nan)

    def residual(self, sums: NormalEquations) -> np.ndarray:
        """Mean square of the residuals over the expected one (lenslet_row, lenslet_column)."""
        with np.errstate(invalid="ignore", divide="ignore"):
            freedom = sums.count - self.unknowns
            return self.spread_out(
                np.where(
                    (freedom > 0) & ~sums.hard, sums.chi / np.maximum(freedom, 1), np.nan
                ).astype(np.float32)
            )

    def spread_out(self, values: np.ndarray) -> np.ndarray:
        """Values by lenslet as an array (R, C, ...), NaN at lenslets that are not valid."""
        out = np.full((*self.c.valid.shape, *values.shape[1:]), np.nan, values.dtype)
        out[self.c.sites] = values
        return out
