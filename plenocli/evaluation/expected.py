"""What a camera should deliver of a population of surfaces: their mean and covariance carried
through optics, detector and demultiplexing, without a draw. docs/model.md, "Measures".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from plenocli.evaluation.metrics.classes import (
    Classes,
    Filter,
    distances_between,
    predicted_accuracy,
    whitening,
)
from plenocli.forward.scene.statistics import reflectance_statistics
from plenocli.forward.scene.white_reference import REFERENCE_REFLECTANCE
from plenocli.forward.sensor.noise import Noise
from plenocli.inverse.spectra.demultiplex import demultiplex
from plenocli.inverse.spectra.demultiplexer import method_of_white

METHODS = ("pinv", "wls", "lmmse", "single-pixel")
"""Those that are linear in the pixels."""
DEFINITIONS = {
    "rmse_expected": "mean of rmse_expected_per_band over the bands",
    "rmse_expected_per_band": (
        "root mean square error of reflectance that the mean and covariance of the spectra of "
        "--classes lead to through optics, detector and demultiplexing, each an even field"
    ),
    "noise_expected_per_band": "the part of it that is noise",
    "reference_snr_expected_db": (
        "least signal-to-noise ratio over the bands of the white reference that is divided by, dB; "
        "below some 14 dB expected figures are too good, as errors of a ratio are reckoned to "
        "first order"
    ),
    "class_accuracy_expected": (
        "what class_accuracy is at least expected to be (union bound) from the classes' means and "
        "covariance so carried through"
    ),
    "class_accuracy_ideal": (
        "the same for who sees the pixels themselves and knows the camera: what no processing "
        "exceeds"
    ),
    "class_distance_ideal": "distance of the two nearest classes so seen, standard deviations",
    "detection_auc_expected": "what detection_auc is expected to be, carried through likewise",
}


@dataclass(frozen=True, kw_only=True)
class Optics:
    """A superpixel that sees an even field.

    signal: (pixel, node), DN that a reflectance of one leaves by the light of each wavelength.
    truth: (band, node), what a reflectance is in each band, rows summing to 1.
    noise: of a pixel's value.
    """

    signal: np.ndarray
    truth: np.ndarray
    noise: Noise


@dataclass(frozen=True, kw_only=True)
class Processing:
    """How reflectances are made of pixels.

    response: F (pixel, band).
    method: of METHODS.
    prior: mean (band,) and covariance (band, band) of radiance, for lmmse.
    """

    response: np.ndarray
    method: str
    prior: tuple[np.ndarray, np.ndarray] | None = None

    def operator(self, variance: np.ndarray, method: str) -> tuple[np.ndarray, np.ndarray]:
        """Psi (band, pixel) and b_0 (band,) of the estimate b = Psi x + b_0.

        variance: (pixel,) of the values.
        """
        count = len(self.response)
        units = np.concatenate([np.zeros((1, count)), np.eye(count)])
        found = demultiplex(
            np.asarray(self.response, float), units, method, variance=variance, prior=self.prior
        )[0]
        return (found[1:] - found[0]).T, found[0]


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """Reflectances as they come out: gain r + offset, with noise.

    gain: (band, node).
    offset: (band,).
    noise: (band, band) covariance, that of the white reference included.
    reference: (band,) standard deviations of its noise that the white reference has of signal.
    """

    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray
    reference: np.ndarray

    @classmethod
    def of(cls, optics: Optics, processing: Processing, spectra: np.ndarray) -> Estimates:
        """Those of a population relative to a white reference.

        spectra: (spectrum, node); the noise is that of their mean, in which shot noise is linear.
        """
        mean, covariance = reflectance_statistics(spectra)
        white = optics.signal.sum(axis=1) * REFERENCE_REFLECTANCE
        variances = [
            np.asarray(optics.noise.variance(x), float) * np.ones(len(white))
            for x in (optics.signal @ mean, white)
        ]
        psi, offset = processing.operator(variances[0], processing.method)
        own = method_of_white(processing.method)
        psi_white, none = processing.operator(variances[1], own)
        level = psi_white @ white + none
        scale = REFERENCE_REFLECTANCE / level
        gain, offset = scale[:, None] * (psi @ optics.signal), scale * offset
        noise = np.outer(scale, scale) * ((psi * variances[0]) @ psi.T)
        # the reference's, in the ratio
        seen = gain @ mean + offset
        square = np.outer(seen, seen) + gain @ covariance @ gain.T
        spread = (psi_white * variances[1]) @ psi_white.T
        return cls(
            gain=gain,
            offset=offset,
            noise=noise + square * spread / np.outer(level, level),
            reference=level / np.sqrt(np.diag(spread)),
        )


@dataclass(frozen=True, kw_only=True)
class ExpectedScore:
    """What is expected, see DEFINITIONS; None where no class is looked for."""

    rmse_expected: float
    rmse_expected_per_band: list[float]
    noise_expected_per_band: list[float]
    reference_snr_expected_db: float
    class_accuracy_expected: float
    class_accuracy_ideal: float
    class_distance_ideal: float
    detection_auc_expected: float | None = None


def expected_score(
    optics: Optics,
    processing: Processing,
    labels: Sequence[str],
    spectra: np.ndarray,
    detect: str | None = None,
    learnt: bool = False,
) -> ExpectedScore:
    """What a camera and a way of processing should deliver of labelled spectra.

    labels: (spectrum,) names of classes.
    spectra: (spectrum, node) reflectances.
    detect: the class that is looked for.
    learnt: whether classes are known by how the camera shows them, and not by what they are.

    Every class is taken as normal with its mean and the covariance about it that all share.
    """
    found = Estimates.of(optics, processing, spectra)
    mean, covariance = reflectance_statistics(spectra)
    wrong = found.gain - optics.truth
    error = wrong @ mean + found.offset
    variance = np.diag(wrong @ covariance @ wrong.T + found.noise)
    rmse = np.sqrt(error**2 + variance)
    classes = Classes.of_spectra(labels, spectra)
    share = np.array([labels.count(name) for name in classes.names]) / len(labels)
    pixels = _pixels(optics, classes, mean)
    judged = _judged(optics, found, classes, learnt)
    return ExpectedScore(
        rmse_expected=float(rmse.mean()),
        rmse_expected_per_band=rmse.tolist(),
        noise_expected_per_band=np.sqrt(np.diag(found.noise)).tolist(),
        reference_snr_expected_db=float(20 * np.log10(max(found.reference.min(), 1e-6))),
        class_accuracy_expected=float(share @ _told(judged, found, classes)),
        class_accuracy_ideal=float(share @ predicted_accuracy(pixels)),
        class_distance_ideal=float(pixels.min()),
        detection_auc_expected=None
        if detect is None
        else _detected(judged, found, classes, detect, share),
    )


def _pixels(optics: Optics, classes: Classes, mean: np.ndarray) -> np.ndarray:
    """(class, class) distances as the pixels themselves tell them."""
    deviation = np.sqrt(np.asarray(optics.noise.variance(optics.signal @ mean)))
    seen = optics.signal / np.maximum(deviation, 1e-300)[:, None]
    # (I + B C B^T)^-1 acts where the signal does: in as many dimensions as wavelengths
    left, size, right = np.linalg.svd(seen, full_matrices=False)
    across = size[:, None] * right
    spread = np.eye(len(size)) + across @ classes.covariance @ across.T
    return distances_between(classes.means @ across.T, spread)


_Judged = tuple[Classes, np.ndarray]
"""The classes as a score knows them, and the covariance (band, band) that it reckons with."""


def _judged(optics: Optics, found: Estimates, classes: Classes, learnt: bool) -> _Judged:
    if learnt:
        real = found.gain @ classes.covariance @ found.gain.T + found.noise
        return Classes(classes.names, classes.means @ found.gain.T + found.offset, real), real
    truth = optics.truth
    known = Classes(classes.names, classes.means @ truth.T, truth @ classes.covariance @ truth.T)
    return known, known.covariance + np.diag(np.diag(found.noise))


def _told(judged: _Judged, found: Estimates, classes: Classes) -> np.ndarray:
    """(class,) least share that a score tells rightly from estimates."""
    from scipy.special import ndtr

    known, reckoned = judged
    real = found.gain @ classes.covariance @ found.gain.T + found.noise
    seen = classes.means @ found.gain.T + found.offset
    root = whitening(reckoned)
    apart = known.means[:, None] - known.means[None]
    weights = apart @ root @ root.T
    middle = (known.means[:, None] + known.means[None]) / 2
    margin = np.sum(weights * (seen[:, None] - middle), axis=-1)
    deviation = np.sqrt(np.einsum("ijb,bc,ijc->ij", weights, real, weights))
    np.fill_diagonal(margin, np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        lost = ndtr(-margin / np.where(deviation > 0, deviation, 1e-300))
    return np.clip(1 - lost.sum(axis=1), 0.0, 1.0)


def _detected(
    judged: _Judged, found: Estimates, classes: Classes, name: str, share: np.ndarray
) -> float:
    """Expected area under the receiver operating characteristic of a score's filter."""
    known, reckoned = judged
    real = found.gain @ classes.covariance @ found.gain.T + found.noise
    seen = classes.means @ found.gain.T + found.offset
    return Filter.of(known, name, reckoned).auc(seen, real, share)
