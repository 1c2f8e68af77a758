"""Radiances of the bands behind lenslets from a calibration and a capture's pixels, by the
method asked for or the best one.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from plenocli.base.errors import InputError, NumericsError

# `auto` takes a method that assumes more only where it predicts a mean square
# error this much smaller
WORTHWHILE = 1.05
SAMPLE = 256  # lenslets on which `auto` compares methods
LIT = 1024  # lenslets whose white tells the light


@dataclass(frozen=True)
class Response:
    """A calibration as demux uses it (arrays as in the calibration artefact).

    threads: for factoring it;
    predicted: from a description, not from captures.
    """

    response: np.ndarray
    variance: np.ndarray | None
    wavelengths: np.ndarray
    origin: np.ndarray
    window: tuple
    centres: np.ndarray
    valid: np.ndarray
    white: np.ndarray | None
    dark: object
    cfa: str
    units: str
    white_level: float
    exposure: float | None
    gain: float | None
    read_variance: float
    threads: int = 1
    predicted: bool = False

    @property
    def shared(self):
        """Whether one F serves all lenslets."""
        return self.response.ndim == 2

    @property
    def passing(self):
        """Whether the response is made lenslet by lenslet for one capture
        (plenocli.inverse.registration.moved_response), and never held whole.
        """
        return not isinstance(self.response, np.ndarray)

    @cached_property
    def sites(self):
        """Row and column indices of the valid lenslets, which results below are ordered by."""
        return np.nonzero(self.valid)

    @cached_property
    def corners(self):
        """First pixels (lenslet, 2) of the valid lenslets' windows."""
        return self.origin[self.sites]

    @cached_property
    def levels(self):
        """Dark levels under the windows, None where they are black levels alone or some window
        is not on the sensor.
        """
        from plenocli.forward.sensor.readout import Levels
        from plenocli.forward.sensor.superpixel import inside

        if self.dark.flat or not inside(self.corners, self.window, self.dark.mean.shape).all():
            return None
        return Levels(self.dark, self.corners, self.window).keep()

    @cached_property
    def factored(self):
        """plenocli.inverse.spectra.factored.Factored of the valid lenslets."""
        from plenocli.inverse.spectra.factored import factor

        return factor(self.response, None if self.shared else self.sites, self.threads)

    @cached_property
    def reference(self):
        """plenocli.inverse.registration.motion.Reference for the captures of this camera."""
        from plenocli.inverse.registration.motion import Reference

        origin = np.where(self.valid[..., None], self.origin, -(2**20))
        return Reference(
            self.response,
            origin,
            self.window,
            self.centres,
            self.cfa,
            self.dark.mean.shape,
            self.variance,
        )

    @cached_property
    def sample(self):
        """Indices of lenslets all over the array, enough to compare methods on."""
        return np.unique(
            np.linspace(0, len(self.sites[0]) - 1, min(len(self.sites[0]), SAMPLE)).astype(int)
        )

    @cached_property
    def sampled(self):
        """`factored` of the sample."""
        from plenocli.inverse.spectra.factored import factor

        return (
            factor(self.response, tuple(part[self.sample] for part in self.sites))
            if self.passing
            else self.factored.some(self.sample)
        )

    @cached_property
    def sampled_pixels(self):
        """`pixels` of the sample."""
        return self.pixels(self.sample)

    def pixels(self, which):
        """(pixel of each band (lenslet or 1, band), F there (lenslet or 1, pixel's band, band))
        for single-pixel extraction.
        """
        from plenocli.inverse.spectra.demultiplex import choose_pixels

        if self.shared:
            pixels = choose_pixels(self.response)[None]
            return pixels, self.response[pixels].astype(float)
        rows, columns = (part[which] for part in self.sites)
        step = max(1, 4_000_000 // int(np.prod(self.response.shape[-2:])))
        found = []
        for start in range(0, len(rows), step):
            f = self.response[rows[start : start + step], columns[start : start + step]]
            pixels = choose_pixels(f)
            found.append((pixels, np.take_along_axis(f, pixels[..., None], axis=-2).astype(float)))
        return tuple(np.concatenate(parts) for parts in zip(*found))

    def prepare(self):
        """Make now what all captures need and several threads would make at
        once; returns itself.
        """
        _ = self.levels, self.reference.gains
        return self


@dataclass(frozen=True)
class Estimate:
    """value, sigma (R, C, band) of the method used, and why that one.

    residual (R, C): mean square of x - F b over its expected one, 1 is noise alone, None where the
        noise is not known;
    record and warning as plenocli.inverse.registration.alignment gives them.
    """

    value: np.ndarray
    sigma: np.ndarray
    method: str
    why: str
    residual: np.ndarray | None = None
    record: dict | None = None
    warning: str | None = None


def read_response(path):
    """The Response of a calibration artefact; InputError where it holds none."""
    from plenocli.files.artefacts.container import read_artefact
    from plenocli.forward.sensor.frames import Dark

    artefact = read_artefact(path, "calibration", skip=("white/flat", "white/level"))
    data, attrs = artefact.data, artefact.attrs
    if "response/F" not in data:
        raise InputError(
            "holds no response F, only the lenslet grid", path, "calibrate with --band captures"
        )
    levels, response = attrs.get("white", {}), attrs.get("response", {})
    black = np.asarray(levels.get("black", 0.0), float)
    black = black.reshape(2, 2) if black.size == 4 else np.full((2, 2), float(black.ravel()[0]))
    dark_attrs = attrs.get("dark", {})
    dark = Dark(data["dark/mean"], black, dark_attrs.get("exposure"), dark_attrs.get("sigma"))
    gain, notes = response.get("gain_e_per_dn"), response.get("notes")
    predicted = isinstance(notes, dict) and notes.get("source") == "predicted"
    return Response(
        data["response/F"],
        data.get("response/covariance"),
        data["response/wavelength"],
        data["response/origin"],
        tuple(int(n) for n in data["response/window"]),
        data["grid/centre"],
        data["grid/valid"].astype(bool),
        data["response/white"],
        dark,
        str(response.get("cfa", "mono")),
        str(response.get("units", "DN")),
        float(levels.get("white", np.inf)),
        response.get("exposure_s"),
        None if gain is None else 1 / gain,
        float(response.get("read_noise", 0.0)) ** 2,
        predicted=predicted,
    )


def readout(exposure, c, path):
    """(Readout of an exposure with the calibration's colour filter array at its exposure time,
    (gain, read variance) that hold for it, or None where they are not known).
    """
    from plenocli.forward.sensor.readout import Readout

    if exposure.values.shape != c.dark.mean.shape:
        raise InputError(
            (
                f"is {exposure.values.shape[0]} x {exposure.values.shape[1]} px, the calibration "
                f"{c.dark.mean.shape[0]} x {c.dark.mean.shape[1]}"
            ),
            path,
            "use captures of the calibrated camera",
        )
    if exposure.units != c.units:
        raise InputError(
            f"is in {exposure.units}, the calibration in {c.units}",
            path,
            "make all captures in the same way",
        )
    if (exposure.seconds is None) != (c.exposure is None):
        raise InputError(
            (
                f"{'does not say' if exposure.seconds is None else 'says'} its exposure time, the "
                f"calibration {'does not' if c.exposure is None else 'does'}"
            ),
            path,
            "use files of one kind for all captures",
        )
    scale = 1.0 if c.exposure is None else c.exposure / exposure.seconds
    top = exposure.white if np.isfinite(exposure.white) else c.white_level
    signal = Readout(
        exposure.values, c.dark, exposure.seconds, exposure.black, top, scale, ready=c.levels
    )
    if exposure.sigma is not None:
        return signal, (0.0, (exposure.sigma * scale) ** 2)
    gain = c.gain if c.gain is not None else exposure.gain
    return signal, None if gain is None else (gain * scale, c.read_variance * scale**2)


def light_prior(c):
    """Mean and covariance of radiance for lmmse: reflectances of natural and man-made surfaces
    under the light of the calibration's white.

    None where the white image cannot tell the light in every band.
    """
    from plenocli.forward.scene.statistics import radiance_statistics, reflectance_statistics
    from plenocli.forward.scene.tables import surfaces
    from plenocli.inverse.spectra.demultiplex import demultiplex

    response, white = c.response, c.white
    if not c.shared:
        some = tuple(part[:: max(1, len(part) // LIT)] for part in c.sites)
        response, white = response[some], white[some]
    light = demultiplex(response, white, "pinv")[0].reshape(-1, len(c.wavelengths))
    light = light[np.isfinite(light).all(axis=1)]
    light = np.median(light, axis=0) if len(light) else np.zeros(1)
    if not (light > 0).all():
        return None
    mean, covariance = reflectance_statistics(surfaces(c.wavelengths))
    # narrow neighbouring bands are nearly the same number on most surfaces
    covariance = covariance + 1e-4 * np.eye(len(mean))
    return radiance_statistics(mean, covariance, light)


def estimate(c, values, noise, method, prior=None, ratio=False, stray=None):
    """The Estimate of a capture: a Readout, or superpixel values (R, C, pixel).

    Least squares first gives the expected radiance from which the noise of each pixel follows
    (where a lenslet has too little light for that, LMMSE); `auto` compares the mean square errors
    that the methods predict on lenslets all over the array.
    noise: (gain, read variance), or None.
    ratio: the radiance will be divided by another one from the same F, so that the error of F
        divides out (to first order, and but for crosstalk) and does not count.
    stray (4, pixel, n), by the parity of the window's first pixel: patterns of light that is no
        band's, unknowns of their own for all methods but single pixel.
    """
    job = _Job(c, *_with_stray(c, stray, prior, values), values, noise, ratio)
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
        sums = job.collect()
    else:
        used, why = (method, "asked for") if method != "auto" else job.best()
        sums = job.weighted(None, sandwich=used == "pinv")
    value, sigma = job.single_pixel(sums) if used == "single-pixel" else job.answer(sums, used)
    residual = None
    if noise is not None:
        with np.errstate(invalid="ignore", divide="ignore"):
            freedom = sums.count - job.unknowns
            residual = job.spread_out(
                np.where(
                    (freedom > 0) & ~sums.hard, sums.chi / np.maximum(freedom, 1), np.nan
                ).astype(np.float32)
            )
    return Estimate(
        job.spread_out(value[:, : job.bands]),
        job.spread_out(sigma[:, : job.bands]),
        used,
        why,
        residual,
    )


def _with_stray(c, stray, prior, values):
    """Calibration and prior with the patterns of stray light as further bands, scaled to the
    light of the others.
    """
    if stray is None:
        return c, prior
    from plenocli.inverse.registration.moved_response import widened

    some = tuple(part[c.sample] for part in c.sites)
    level = np.float32(max(float(np.nanmax(c.response if c.shared else c.response[some])), 1e-30))
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


def _brightest(c, values):
    if isinstance(values, np.ndarray):
        return np.nanmax(values)
    return np.nanmax(values.cut(c.corners[c.sample], c.window))


@dataclass
class _Job:
    """One capture with its calibration.

    c: as it is;
    whole: with stray light as further bands;
    prior likewise.
    """

    c: Response
    whole: Response
    prior: tuple | None
    values: object
    noise: tuple | None
    ratio: bool
    plain: np.ndarray | None = field(default=None)

    def __post_init__(self):
        self.bands, self.unknowns = len(self.c.wavelengths), self.whole.response.shape[-1]
        self.total = len(self.c.sites[0])
        self.sample = self.c.sample
        self.factored = None if self.whole.passing else self.whole.factored
        if isinstance(self.values, np.ndarray):
            own = self.values[self.c.sites]
            # lenslets by their index or a slice, free to be overwritten
            self.cut = lambda which: np.array(own[which], np.float32)
        else:
            self.cut = self.values.cutter(self.c.corners, self.c.window)

    def collect(self, which=None, **settings):
        """Sums of all lenslets, or those of an index array."""
        from plenocli.inverse.spectra.factored import collect, stream

        if which is None and self.whole.passing:
            self.factored, sums = stream(
                self.whole.response, self.whole.sites, self.cut, **settings
            )
            return sums
        if which is None:
            return collect(self.factored, self.cut, self.total, **settings)
        return collect(
            self._some(which), lambda part: self.cut(which[part]), len(which), **settings
        )

    def _some(self, which):
        if which is None or which is self.sample:
            return self.factored if which is None else self.whole.sampled
        if not self.whole.passing:
            return self.factored.some(which)
        from plenocli.inverse.spectra.factored import factor

        return factor(self.whole.response, tuple(part[which] for part in self.whole.sites))

    def weighted(self, which=None, sandwich=True):
        """Sums weighted by the noise that is expected."""
        known = self.whole.variance
        settings = dict(
            noise=self.noise,
            response_variance=None if self.ratio else known,
            doubt=known if self.ratio else None,
            sandwich=sandwich,
        )
        if not self.starved:
            return self.collect(which, **settings)
        count = self.total if which is None else len(which)
        first = self.collect(
            which, **settings | {"radiance": np.broadcast_to(self.prior[0], (count, self.unknowns))}
        )
        return self.collect(
            which, **settings | {"radiance": np.nan_to_num(self.answer(first, "lmmse", which)[0])}
        )

    @cached_property
    def starved(self):
        """Whether noise leaves less than ten levels of the prior's spread: then weights from
        least squares follow the noise.
        """
        if self.prior is None:
            return False
        few = self.sample[:: max(1, len(self.sample) // 64)]
        settings = dict(
            noise=self.noise,
            response_variance=None if self.ratio else self.whole.variance,
            sandwich=True,
        )
        sigma = self.answer(self.collect(few, **settings), "pinv", few)[1]
        sigma = sigma[np.isfinite(sigma).all(axis=-1)]
        return not len(sigma) or bool(
            (
                np.median(sigma[:, : self.bands], axis=0)
                > 0.1 * np.sqrt(np.diag(self.prior[1])[: self.bands])
            ).any()
        )

    def best(self):
        """(method, reason) with the least predicted error."""
        sums = self.weighted(self.sample)
        tried = {
            m: self.answer(sums, m, self.sample)[1][:, : self.bands]
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
        return used, "predicted rms error " + ", ".join(
            f"{m} {np.sqrt(e):.3g}" for m, e in error.items()
        )

    def answer(self, sums, method, which=None):
        """(radiances, standard deviations) of lenslets by one method; the few that single
        precision cannot do, in double.
        """
        from plenocli.inverse.spectra.factored import answer

        value, sigma = answer(self._some(which), sums, method, self.prior, self.noise is not None)
        hard = np.flatnonzero(sums.hard)
        if len(hard):
            value[hard], sigma[hard] = self._double(hard if which is None else which[hard], method)
        return value, sigma

    def _double(self, which, method):
        from plenocli.inverse.spectra.demultiplex import demultiplex, noise_variance

        f = (
            self.whole.response
            if self.whole.shared
            else self.whole.response[self.c.sites[0][which], self.c.sites[1][which]]
        )
        x, variance = self.cut(which), None
        if self.noise is not None:
            b = demultiplex(f, x, "pinv")[0]
            b = np.where(np.isfinite(b), b, 0.0 if self.prior is None else self.prior[0])
            variance = np.maximum(
                noise_variance(f, b, *self.noise, None if self.ratio else self.whole.variance),
                1e-12,
            )
        return demultiplex(f, x, method, variance=variance, prior=self.prior)

    def _radiance(self, sums, which=None):
        """Plain radiances (lenslet, band) of the calibration's bands."""
        b = (self._some(which).inverse @ sums.plain[..., None])[..., 0][:, : self.bands]
        return np.where(sums.hard[:, None], np.nan, b)

    def _single_pixel_error(self, radiance):
        """Mean square error that single-pixel extraction would make on the sample: crosstalk
        bias and the noise of one pixel.
        """
        rows = self.c.sampled_pixels[1]
        own = np.diagonal(rows, axis1=-2, axis2=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            bias = (rows @ np.nan_to_num(radiance)[..., None])[..., 0] / own - radiance
            variance = (self.noise[0] * np.clip(own * radiance, 0, None) + self.noise[1]) / own**2
            return float(np.nanmean(bias**2 + variance))

    def single_pixel(self, sums):
        """x[p] / F[p] at the calibrated pixels, sigma without the crosstalk bias; NaN sigma
        where the noise is not known.
        """
        from plenocli.inverse.spectra.demultiplex import noise_variance

        pixels, rows = self.c.pixels(slice(None))
        pixels = np.broadcast_to(pixels, (self.total, self.bands))
        step = max(1, 4_000_000 // self.c.response.shape[-2])
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
            variance = noise_variance(rows, np.nan_to_num(self._radiance(sums)), *self.noise, known)
            return b, np.where(np.isfinite(b), np.sqrt(np.maximum(variance, 1e-12)) / own, np.nan)

    def spread_out(self, values):
        """Values by lenslet as an array (R, C, ...), NaN at lenslets that are not valid."""
        out = np.full((*self.c.valid.shape, *values.shape[1:]), np.nan, values.dtype)
        out[self.c.sites] = values
        return out
