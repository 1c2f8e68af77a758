"""Three signal-to-noise ratios, kept apart by name because they differ by many decibels.

All in dB (docs/model.md, "Measures").
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from plenocli.base.tiling import Plane

DEFINITIONS = {
    "snr_capture_db": (
        "20 log10(mean / standard deviation) of the estimate over a uniform white target, band by "
        "band: over repeated frames where there are several (temporal), else over the lenslets of "
        "one frame (spatial, so that what flat-fielding leaves counts as noise)"
    ),
    "snr_predicted_db": (
        "20 log10(estimate / predicted standard deviation), band by band: what the noise model "
        "promises before any repetition, taken at the root mean square of the prediction; the "
        "noise of calibration and white reference counts, which frames over time share: it may lie "
        "some dB below their capture SNR"
    ),
    "snr_capture_mean_db": "mean of snr_capture_db over the bands",
    "snr_predicted_mean_db": "mean of snr_predicted_db over the bands",
    "snr_over_single_pixel_db": (
        "snr_capture_mean_db less that of the result of single pixel extraction"
    ),
    "snr_sensor_db": (
        "10 log10(mean(y^2) / sigma^2) of the capture: the noise level of a simulation (60 dB in "
        "Berkner et al. 2013); the mean square of y, not its variance, is the signal"
    ),
}


@dataclass(frozen=True, kw_only=True)
class SnrScore:
    """SNR on a white target, dB, lists by band; a mean is NaN where a band is not finite, the
    predicted ones are None where no deviation is known. See DEFINITIONS.

    snr_target: what it was measured on, in words.
    """

    snr_target: str
    snr_capture_db: list[float]
    snr_predicted_db: list[float] | None
    snr_capture_mean_db: float
    snr_predicted_mean_db: float | None


def score_snr(target: str, frames: np.ndarray, sigma: np.ndarray | None) -> SnrScore:
    """Capture and predicted SNR on a white target.

    target: what it is, in words.
    frames: (frame, band, lenslet...).
    sigma: (band, lenslet...) predicted standard deviation of the first frame, or None.
    """
    capture = snr_capture(frames)
    predicted = None if sigma is None else snr_predicted(frames[0], sigma)
    return SnrScore(
        snr_target=target,
        snr_capture_db=capture.tolist(),
        snr_predicted_db=None if predicted is None else predicted.tolist(),
        snr_capture_mean_db=_mean(capture),
        snr_predicted_mean_db=None if predicted is None else _mean(predicted),
    )


def _mean(bands: np.ndarray) -> float:
    return float(bands.mean()) if np.isfinite(bands).all() else np.nan


def _decibel(ratio: np.ndarray) -> np.ndarray:
    with np.errstate(divide="ignore"):
        return 20 * np.log10(ratio)


def snr_capture(frames: np.ndarray) -> np.ndarray:
    """Capture SNR of estimates of one uniform white target.

    frames: (frame, band, lenslet...); lenslets with NaN are left out.

    Two or more frames: standard deviation over time at each lenslet, with which frame-to-frame
    change of the mean level counts as noise; for two frames it equals std(f1 - f2)/sqrt 2 at equal
    means. One frame: over its lenslets.

    Returns (band,) dB; NaN where fewer than two samples are left, infinite without noise.
    """
    frames = np.asarray(frames, dtype=np.float64)
    frames = frames.reshape(*frames.shape[:2], -1)
    frames = frames[:, :, np.isfinite(frames).all(axis=(0, 1))]
    count, bands, lenslets = frames.shape
    if lenslets == 0 or (count == 1 and lenslets == 1):
        return np.full(bands, np.nan)
    mean = frames.mean(axis=(0, 2))
    variance = (
        frames.var(axis=0, ddof=1).mean(axis=1) if count > 1 else frames[0].var(axis=1, ddof=1)
    )
    return _ratio(mean, np.sqrt(variance))


def snr_predicted(value: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Predicted SNR of estimates.

    value, sigma: (band, lenslet...), estimates and their predicted standard deviations.

    Returns (band,) dB; NaN where no lenslet has both.
    """
    value, sigma = (
        np.asarray(v, dtype=np.float64).reshape(np.shape(v)[0], -1) for v in (value, sigma)
    )
    valid = np.isfinite(value).all(0) & np.isfinite(sigma).all(0)
    if not valid.any():
        return np.full(len(value), np.nan)
    return _ratio(value[:, valid].mean(1), np.sqrt((sigma[:, valid] ** 2).mean(1)))


def snr_sensor(signal: ArrayLike | Plane, sigma: float, noisy: bool = False) -> float:
    """Sensor-model SNR of a capture with white noise, 10 log10(mean(y^2) / sigma^2).

    signal: any shape, or a Plane.
    sigma: standard deviation of the noise, in the unit of the signal.
    noisy: the signal carries the noise already, whose power is taken off.

    Returns dB; -inf where nothing is left.
    """
    if isinstance(signal, Plane):
        total = sum(float(np.sum(signal.window(rows) ** 2)) for rows in signal.in_bands())
        mean = total / math.prod(signal.shape)
    else:
        mean = float(np.mean(np.asarray(signal, dtype=np.float64) ** 2))
    power = mean - (sigma**2 if noisy else 0.0)
    return float(_ratio(np.sqrt(max(float(power), 0.0)), float(sigma)))


def _ratio(mean: ArrayLike, deviation: ArrayLike) -> np.ndarray:
    mean, deviation = np.maximum(mean, 0.0), np.asarray(deviation)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(
            deviation > 0, _decibel(mean / deviation), np.where(mean > 0, np.inf, np.nan)
        )
