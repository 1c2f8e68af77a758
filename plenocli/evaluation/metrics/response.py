"""How far one response matrix F is from another: band by band, pixel by pixel, and in what
it makes of spectra.

Responses are (lenslet, pixel, band); NaN pixels of either are left out. See docs/model.md, "The
response predicted".
"""

from dataclasses import dataclass

import numpy as np

DEFINITIONS = {
    "response_gain_per_band": (
        "factor by which the response must be multiplied to fit the truth in a band, least "
        "squares; a white reference divides it out"
    ),
    "response_error_per_band": (
        "norm of (gain x response - truth) over that of the truth, of the means over lenslets"
    ),
    "response_error_lenslet_per_band": (
        "the same for single lenslets, median: with the noise of the calibration"
    ),
    "response_pixel_per_band": (
        "largest error of a pixel over the brightest pixel of the band, of the means over lenslets"
    ),
    "response_leak": (
        "largest share of one band's radiance that least squares with the response finds in "
        "another band of the truth"
    ),
}


@dataclass(frozen=True, kw_only=True)
class ResponseScore:
    """Measures of one response against another, lists by band; see DEFINITIONS."""

    response_gain_per_band: list[float]
    response_error_per_band: list[float]
    response_error_lenslet_per_band: list[float]
    response_pixel_per_band: list[float]
    response_leak: float


def score_response(response: np.ndarray, truth: np.ndarray) -> ResponseScore:
    """Measures of a response against the true one.

    response, truth: (lenslet, pixel, band) of the same lenslets, NaN where unknown.

    docs/model.md, "The response predicted".
    """
    error, gain, mean = response_error(response, truth)
    with np.errstate(invalid="ignore"):
        single = np.linalg.norm(np.nan_to_num(response * gain - truth), axis=1) / np.linalg.norm(
            np.nan_to_num(truth), axis=1
        )
    seen = np.isfinite(error).all(axis=1)
    size = np.linalg.norm(mean[seen], axis=0)
    leak = np.linalg.pinv(error[seen] + mean[seen]) @ mean[seen]
    own = np.diag(leak)
    return ResponseScore(
        response_gain_per_band=gain.tolist(),
        response_error_per_band=(np.linalg.norm(error[seen], axis=0) / size).tolist(),
        response_error_lenslet_per_band=np.median(single, axis=0).tolist(),
        response_pixel_per_band=(np.abs(error[seen]).max(axis=0) / mean[seen].max(axis=0)).tolist(),
        response_leak=float(np.abs(leak - np.diag(own)).max() / own.min()),
    )


def response_error(
    response: np.ndarray, truth: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How far a response lies from the true one after a gain for each band.

    response, truth: (lenslet, pixel, band) of the same lenslets, NaN where unknown.

    Returns (gain x response - truth, averaged over lenslets, (pixel, band), NaN where never
    known; gain (band,); mean truth (pixel, band)).
    """
    both = np.isfinite(response) & np.isfinite(truth)
    f, t = np.where(both, response, 0), np.where(both, truth, 0)
    gain = (f * t).sum(axis=(0, 1)) / (f * f).sum(axis=(0, 1))
    count = both.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return (gain * f - t).sum(axis=0) / count, gain, t.sum(axis=0) / count
