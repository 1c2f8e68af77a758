"""demux: band radiances or reflectances behind every lenslet of captures, with predicted standard deviations."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from plenocli.config import REFERENCE_REFLECTANCE
from plenocli.errors import InputError, NumericsError
from plenocli.stages.batch import attempt, one_by_one, plan_batch, summarise
from plenocli.stages.mosaics import read_exposure
from plenocli.stages.progress import bar

WORTHWHILE = 1.05  # `auto` takes a method that assumes more only where it predicts a mean square error this much smaller


@dataclass(frozen=True)
class Settings:
    """method: pinv, single-pixel, wls, lmmse, nnls or auto; reference_reflectance: of the white reference; register: auto, on
    or off, whether captures are brought into line with the calibration (plenocli.stages.alignment)."""

    method: str = "auto"
    reference: Path | None = None
    reference_reflectance: float = REFERENCE_REFLECTANCE
    register: str = "auto"


@dataclass(frozen=True)
class Response:
    """A calibration as demux uses it (arrays as in the calibration artefact)."""

    response: np.ndarray
    variance: np.ndarray | None
    wavelengths: np.ndarray
    origin: np.ndarray
    window: tuple
    centres: np.ndarray
    valid: np.ndarray
    white: np.ndarray
    dark: object
    cfa: str
    units: str
    white_level: float
    exposure: float | None
    gain: float | None
    read_variance: float


def run_demux(captures, output, *, calibration, settings=Settings(), suffix=".exr", workers=1, overwrite=False, command=""):
    """Demultiplex every capture; returns a summary dict.

    One capture gives the file `output` (.exr or .h5), several a folder with one file each, named after the capture;
    finished ones are skipped unless overwrite. A capture that fails does not stop the others: its message is printed
    and an error is raised at the end, with the exit code of the worst.
    """
    batch = plan_batch(captures, output, suffix, "spectra are", overwrite=overwrite, inputs=[*captures, calibration, settings.reference])
    arguments = (calibration, settings, overwrite, command)
    first = _Worker(*arguments) if batch.todo else None  # a broken calibration ends the run here, before any capture
    return summarise(batch, _outcomes(batch, first, arguments, workers))


def _outcomes(batch, first, arguments, workers):
    """(capture, report or PlenoError) of every job, in order; in this process or in several."""
    todo = batch.todo
    if workers == 1 or len(todo) < 2:
        yield from one_by_one(batch, first.demux if first else None)
        return
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    with ProcessPoolExecutor(min(workers, len(todo)), get_context("spawn"), _start, arguments) as pool:
        running = [(capture, pool.submit(_attempt, capture, target)) for capture, target in todo]
        for capture, job in bar(running, len(running), "captures"):
            yield capture, job.result()


def _start(*arguments):
    global _worker
    _worker = _Worker(*arguments)


def _attempt(capture, target):
    return attempt(_worker.demux, capture, target)


class _Worker:
    """What one process needs for any number of captures: calibration read, white reference demultiplexed, once."""

    def __init__(self, calibration, settings, overwrite, command):
        self.path, self.settings, self.overwrite, self.command = calibration, settings, overwrite, command
        self.calibration = read_response(calibration)
        self.reference = None
        self.prior = _prior(self.calibration)
        if settings.reference is not None:
            self.reference = self._radiance(settings.reference, self._plain_method())

    def _plain_method(self):
        """The white reference is demultiplexed without a prior: a prior's pull would not divide out."""
        method = self.settings.method
        return {"auto": "pinv", "lmmse": "wls"}.get(method, method)

    def _radiance(self, path, method):
        """Estimate of one capture, registered to the calibration first."""
        from plenocli.stages.alignment import BELIEVED, doubtful, judge, misfit

        signal, noise = _signal(read_exposure(path, cfa=self.calibration.cfa), self.calibration, path)
        found = self._aligned(signal, noise, method, path)
        if doubtful(found.residual, found.record):
            plain = self._aligned(signal, noise, method, path, levels=False)
            if misfit(found.residual) > BELIEVED * misfit(plain.residual):
                found = plain
        return replace(found, warning=judge(found.residual, found.record, path))

    def _aligned(self, signal, noise, method, path, levels=True):
        from plenocli.sensor.superpixel import extract
        from plenocli.stages.alignment import align, residuals

        c, signal, stray, record = align(self.calibration, signal, noise, self.settings.register, path, levels)
        values = extract(signal, c.origin, c.window)
        values[~c.valid] = np.nan
        found = estimate(c, values, noise, method, self.prior, ratio=self.settings.reference is not None, stray=stray)
        return replace(found, residual=residuals(c, values, found.plain, noise, stray), record=record)

    def demux(self, capture, target):
        """Demultiplex one capture and write it to `target`; returns its report."""
        from plenocli.artefacts import describe_inputs

        c = self.calibration
        found = self._radiance(capture, self.settings.method)
        value, sigma, method, why = found.value, found.sigma, found.method, found.why
        quantity = "radiance"
        if self.reference is not None:
            value, sigma = _reflectance(value, sigma, self.reference.value, self.reference.sigma, self.settings.reference_reflectance)
            quantity = "reflectance"
        if not np.isfinite(value).any():
            raise NumericsError("no lenslet could be demultiplexed", capture, "check exposure and calibration")
        inputs = describe_inputs({"capture": capture, "calibration": self.path, "reference": self.settings.reference})
        attrs = dict(quantity=quantity, method=method)
        if self.settings.reference is not None:
            attrs["reference"] = Path(self.settings.reference).name
        parameters = {"registration": found.record, "warning": found.warning, "asked": self.settings.method, "reason": why, "reference_reflectance": self.settings.reference_reflectance if self.reference is not None else None}
        _write(target, c.wavelengths, np.moveaxis(value, -1, 0), np.moveaxis(sigma, -1, 0), found.residual, attrs, parameters, inputs, self.overwrite, self.command)
        seen = np.isfinite(value).all(axis=-1)
        return dict(capture=Path(capture).name, output=str(target), method=method, reason=why, registration=found.record, warning=found.warning, quantity=quantity, lenslets=int(seen.sum()),
                    array=list(value.shape[:2]), bands_nm=[float(w * 1e9) for w in c.wavelengths],
                    mean=[float(v) for v in value[seen].mean(axis=0)], sigma=[float(v) for v in np.nanmean(sigma[seen], axis=0)] if np.isfinite(sigma[seen]).any() else None)


def read_response(path):
    """The Response of a calibration artefact; InputError where it holds none."""
    from plenocli.artefacts import read_artefact
    from plenocli.sensor.frames import Dark

    artefact = read_artefact(path, "calibration")
    data, attrs = artefact.data, artefact.attrs
    if "response/F" not in data:
        raise InputError("holds no response F, only the lenslet grid", path, "calibrate with --band captures")
    levels, response = attrs.get("white", {}), attrs.get("response", {})
    black = np.asarray(levels.get("black", 0.0), float)
    black = black.reshape(2, 2) if black.size == 4 else np.full((2, 2), float(black.ravel()[0]))
    dark_attrs = attrs.get("dark", {})
    dark = Dark(data["dark/mean"], black, dark_attrs.get("exposure"), dark_attrs.get("sigma"))
    gain = response.get("gain_e_per_dn")
    return Response(data["response/F"], data.get("response/covariance"), data["response/wavelength"], data["response/origin"],
                    tuple(int(n) for n in data["response/window"]), data["grid/centre"], data["grid/valid"].astype(bool), data["response/white"], dark, str(response.get("cfa", "mono")),
                    str(response.get("units", "DN")), float(levels.get("white", np.inf)), response.get("exposure_s"), None if gain is None else 1 / gain,
                    float(response.get("read_noise", 0.0)) ** 2)


def _signal(exposure, c, path):
    """Signal (rows, columns), dark removed, NaN where saturated, at the calibration's exposure; (gain, read variance) that hold there (None: unknown)."""
    from plenocli.sensor.frames import saturated

    if exposure.values.shape != c.dark.mean.shape:
        raise InputError(f"is {exposure.values.shape[0]} x {exposure.values.shape[1]} px, the calibration {c.dark.mean.shape[0]} x {c.dark.mean.shape[1]}", path, "use captures of the calibrated camera")
    if exposure.cfa != c.cfa:
        raise InputError(f"has the colour filter array {exposure.cfa}, the calibration {c.cfa}", path, "use captures of the calibrated camera")
    if exposure.units != c.units:
        raise InputError(f"is in {exposure.units}, the calibration in {c.units}", path, "make all captures in the same way")
    if (exposure.seconds is None) != (c.exposure is None):
        raise InputError("and the calibration do not both know their exposure time", path, "use files of one kind for all captures")
    scale = 1.0 if c.exposure is None else c.exposure / exposure.seconds
    signal = (np.asarray(exposure.values, np.float32) - c.dark.at(exposure.seconds)) * np.float32(scale)
    top = exposure.white if np.isfinite(exposure.white) else c.white_level
    signal[saturated(exposure.values, exposure.black, top)] = np.nan
    if exposure.sigma is not None:
        return signal, (0.0, (exposure.sigma * scale) ** 2)
    gain = c.gain if c.gain is not None else exposure.gain
    return signal, None if gain is None else (gain * scale, c.read_variance * scale**2)


@dataclass(frozen=True)
class Estimate:
    """value, sigma (R, C, band) of the method used, and why that one; plain: least squares radiances (R, C, unknown), stray
    light last where it is one. residual (R, C), record and warning as plenocli.stages.alignment gives them."""

    value: np.ndarray
    sigma: np.ndarray
    method: str
    why: str
    plain: np.ndarray
    residual: np.ndarray | None = None
    record: dict | None = None
    warning: str | None = None


def estimate(c, values, noise, method, prior=None, ratio=False, stray=None):
    """The Estimate of superpixel values (R, C, pixel).

    Least squares first gives the expected radiance from which the noise of each pixel follows (where a lenslet has too little
    light for that, LMMSE); `auto` compares the mean square errors that the methods predict. ratio: the radiance will be
    divided by another one from the same F, so that the error of F divides out (to first order, and but for crosstalk) and
    does not count. stray (R, C, pixel, n): patterns of light that is no band's, unknowns of their own for all methods but
    single pixel.
    """
    from plenocli.solvers.spectral import choose_pixels, demultiplex

    bands = len(c.wavelengths)
    whole, prior = _with_stray(c, stray, prior, values)

    def solve(m, variance=None):
        return tuple(part[..., :bands] for part in demultiplex((c if m == "single-pixel" else whole).response, values, m, variance=variance, pixels=pixels if m == "single-pixel" else None, prior=prior))

    pixels = choose_pixels(c.response) if method in ("auto", "single-pixel") else None
    start, spread = demultiplex(whole.response, values, "pinv")
    if noise is None:
        used = "pinv" if method == "auto" else method
        value, sigma = (start[..., :bands], spread[..., :bands]) if used == "pinv" else solve(used)
        return Estimate(value, sigma, used, "the sensor's noise is not known" if method == "auto" else "asked for", start)
    response_variance = None if ratio else whole.variance
    variance = _variance(whole, start, noise, response_variance)
    if prior is not None and _starved(whole, values, variance, prior):
        variance = _variance(whole, np.broadcast_to(prior[0], start.shape), noise, response_variance)
        variance = _variance(whole, demultiplex(whole.response, values, "lmmse", variance=variance, prior=prior)[0], noise, response_variance)
    if method != "auto":
        return Estimate(*solve(method, variance), method, "asked for", start)
    if not np.isfinite(start).any():
        raise NumericsError("no lenslet could be demultiplexed", fix="check that the capture is not saturated and that the bands of the calibration differ")
    tried = {m: solve(m, variance) for m in ("pinv", "wls", *(["lmmse"] if prior else []))}
    error = {m: float(np.nanmean(sigma**2)) for m, (_, sigma) in tried.items()}
    error["single-pixel"] = _single_pixel_error(c, pixels, start[..., :bands], noise)
    least = min(error.values())
    used = next(m for m in error if error[m] <= WORTHWHILE * least)
    if used == "single-pixel":
        tried[used] = solve(used, variance)
    why = "predicted rms error " + ", ".join(f"{m} {np.sqrt(e):.3g}" for m, e in error.items())
    return Estimate(*tried[used], used, why, start)


def _with_stray(c, stray, prior, values):
    """Calibration and prior with the patterns of stray light as further bands, scaled to the light of the others."""
    if stray is None:
        return c, prior
    level = np.float32(max(float(np.nanmax(c.response)), 1e-30))
    own = c.response if c.response.ndim > 2 else np.broadcast_to(c.response, (*c.valid.shape, *c.response.shape))
    count = stray.shape[-1]
    variance = None if c.variance is None else np.concatenate([c.variance, np.zeros((len(c.variance), count))], axis=1)
    if prior is not None:
        free = float(np.nanmax(values) / level) ** 2  # nothing is known of it beforehand
        mean, covariance = prior
        wide = np.diag(np.concatenate([np.zeros(len(mean)), np.full(count, free)]))
        wide[: len(mean), : len(mean)] = covariance
        prior = np.concatenate([mean, np.zeros(count)]), wide
    return replace(c, response=np.concatenate([own, stray * level], axis=-1), variance=variance), prior


def _starved(c, values, variance, prior):
    """Whether noise leaves less than ten levels of the prior's spread: then weights from least squares follow the noise."""
    from plenocli.solvers.spectral import demultiplex

    some = np.isfinite(values).any(axis=-1)
    picked = tuple(part[:: max(1, len(part) // 64)] for part in np.nonzero(some))
    response = c.response if c.response.ndim == 2 else c.response[picked]
    _, sigma = demultiplex(response, values[picked], "pinv", variance=variance[picked])
    sigma = sigma[np.isfinite(sigma).all(axis=-1)]
    bands = len(c.wavelengths)
    return not len(sigma) or bool((np.median(sigma[:, :bands], axis=0) > 0.1 * np.sqrt(np.diag(prior[1])[:bands])).any())


def _variance(c, radiance, noise, response_variance):
    """Pixel variance (R, C, pixel) float32 in blocks of lenslet rows: shot and read noise, and what F-hat does not know."""
    from plenocli.solvers.spectral import noise_variance

    radiance = np.nan_to_num(radiance)
    out = np.empty((*radiance.shape[:2], c.response.shape[-2]), np.float32)
    for row in range(len(out)):
        response = c.response if c.response.ndim == 2 else c.response[row]
        out[row] = noise_variance(response, radiance[row], noise[0], noise[1], response_variance)
    return np.maximum(out, 1e-12)


def _single_pixel_error(c, pixels, radiance, noise):
    """Mean square error that single-pixel extraction would make: crosstalk bias and the noise of one pixel."""
    from plenocli.solvers.spectral import single_pixel_bias

    shape = radiance.shape
    rows = c.response if c.response.ndim > 2 else np.broadcast_to(c.response, (*shape[:2], *c.response.shape))
    pixels = np.broadcast_to(pixels, shape)
    bias = single_pixel_bias(rows, pixels, np.nan_to_num(radiance))
    own = np.take_along_axis(rows, pixels[..., None, :], axis=-2)[..., 0, :]
    variance = (noise[0] * np.clip(own * radiance, 0, None) + noise[1]) / own**2
    return float(np.nanmean(np.where(np.isfinite(radiance), bias**2 + variance, np.nan)))


def _prior(c):
    """Mean and covariance of radiance for lmmse: reflectances of natural and man-made surfaces under the light of the
    calibration's white.

    None where the white image cannot tell the light in every band.
    """
    from plenocli.scene.statistics import radiance_statistics, reflectance_statistics
    from plenocli.scene.tables import surfaces
    from plenocli.solvers.spectral import demultiplex

    light, _ = demultiplex(c.response, c.white, "pinv")
    light = light.reshape(-1, len(c.wavelengths))
    light = light[np.isfinite(light).all(axis=1)]
    light = np.median(light, axis=0) if len(light) else np.zeros(1)
    if not (light > 0).all():
        return None
    mean, covariance = reflectance_statistics(surfaces(c.wavelengths))
    covariance = covariance + 1e-4 * np.eye(len(mean))  # narrow neighbouring bands are nearly the same number on most surfaces
    return radiance_statistics(mean, covariance, light)


def _reflectance(value, sigma, white, white_sigma, level):
    """Ratio to the white reference times its reflectance, with both relative errors."""
    with np.errstate(divide="ignore", invalid="ignore"):
        known = np.where(white > 0, white, np.nan)
        ratio = level * value / known
        spread = level / known * np.sqrt(sigma**2 + (value / known * white_sigma) ** 2)
    return ratio, spread


def _write(target, wavelengths, value, sigma, residual, attrs, parameters, inputs, overwrite, command):
    from plenocli.artefacts import Artefact, Provenance, provenance_texts, write_artefact, write_spectral_exr

    value, sigma, provenance = value.astype(np.float32), sigma.astype(np.float32), Provenance(command, inputs)
    if Path(target).suffix == ".h5":
        data = {"spectra/value": value, "spectra/sigma": sigma, "spectra/wavelength": wavelengths}
        if residual is not None:
            data["spectra/residual"] = residual
        write_artefact(target, Artefact("spectra", data, {"spectra": attrs | {"parameters": parameters}}, provenance), overwrite=overwrite)
        return
    import json

    from plenocli.scene.colour import preview_rgb

    whole = np.nan_to_num(value)
    if attrs["quantity"] == "reflectance":
        rgb = preview_rgb(wavelengths, whole)
    else:  # no light is taken off: shown under the one that was there
        rgb = preview_rgb(wavelengths, whole / max(float(whole.max()), 1e-30), "E")
    texts = {"method": attrs["method"], "parameters": json.dumps(parameters, sort_keys=True)} | provenance_texts(provenance)
    if attrs["quantity"] == "radiance":
        texts["emissiveUnits"] = "relative"
    write_spectral_exr(target, wavelengths, value, attrs["quantity"], rgb=rgb, sigma=sigma, attrs=texts, overwrite=overwrite)
