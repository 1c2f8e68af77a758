"""Which of a user's own classes is it? Spectra told apart by what is known of the classes and of
the noise, and how often that should succeed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

DEFINITIONS = {
    "classes_seen": "classes of --classes that the truth shows",
    "class_accuracy": (
        "share of lenslets whose class is that of the truth: the likeliest of the classes, each "
        "normally distributed with the mean of its spectra and the covariance that all share, with "
        "the predicted noise on it"
    ),
    "class_accuracy_low": "lower end of its 95 % confidence interval (Wilson 1927)",
    "class_accuracy_high": "upper end of its 95 % confidence interval",
    "class_accuracy_predicted": (
        "what class_accuracy is at least expected to be from the classes and the predicted noise "
        "alone: 1 less the sum over the other classes of Phi(-d/2), d their distance in standard "
        "deviations (union bound; exact for two classes)"
    ),
    "class_distance": "distance of the two classes that are hardest to tell, standard deviations",
}


@dataclass(frozen=True)
class Classes:
    """What is to be told apart.

    names: of the classes.
    means: (class, band).
    covariance: (band, band) of spectra about the mean of their class.
    """

    names: tuple[str, ...]
    means: np.ndarray
    covariance: np.ndarray

    @classmethod
    def of_spectra(cls, labels: tuple[str, ...], spectra: np.ndarray) -> Classes:
        """The classes of labelled spectra.

        labels: (spectrum,) names; those that are equal are one class.
        spectra: (spectrum, band).
        """
        names = tuple(dict.fromkeys(labels))
        member = np.array([names.index(label) for label in labels])
        means = np.stack([spectra[member == k].mean(axis=0) for k in range(len(names))])
        apart = spectra - means[member]
        free = len(spectra) - len(names)
        return cls(
            names, means, apart.T @ apart / free if free else np.zeros((apart.shape[1],) * 2)
        )


@dataclass(frozen=True, kw_only=True)
class ClassScore:
    """How well classes are told apart, see DEFINITIONS; None where the noise is not known."""

    classes_seen: int
    class_accuracy: float
    class_accuracy_low: float
    class_accuracy_high: float
    class_accuracy_predicted: float | None
    class_distance: float | None


def score_classes(
    values: np.ndarray, truth: np.ndarray, sigma: np.ndarray | None, classes: Classes
) -> ClassScore | None:
    """Spectra told apart.

    values, truth: (band, row, column).
    sigma: predicted standard deviation, like values; None: not known.
    classes: of spectra in the same bands.

    Returns None where no lenslet has values, truth and, if any has, noise.
    """
    bands = len(values)
    cubes = [values, truth] if sigma is None else [values, truth, sigma]
    known = np.isfinite(np.stack(cubes)).all(axis=(0, 1))
    if not known.any():
        return None
    found, true = values[:, known].T, truth[:, known].T
    noise = np.zeros((bands, bands))
    if sigma is not None:
        noise = np.diag(np.mean(sigma[:, known] ** 2, axis=1))
    spread = classes.covariance + noise
    right = assigned(true, classes.means, classes.covariance)
    hits = assigned(found, classes.means, spread) == right
    low, high = wilson(int(hits.sum()), len(hits))
    seen, counts = np.unique(right, return_counts=True)
    distances = distances_between(classes.means, spread) if sigma is not None else None
    return ClassScore(
        classes_seen=len(seen),
        class_accuracy=float(hits.mean()),
        class_accuracy_low=low,
        class_accuracy_high=high,
        class_accuracy_predicted=None
        if distances is None
        else float(np.average(predicted_accuracy(distances)[seen], weights=counts)),
        class_distance=None if distances is None else float(np.min(distances)),
    )


def assigned(spectra: np.ndarray, means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(spectrum,) number of the likeliest class.

    spectra: (spectrum, band).
    means: (class, band).
    covariance: (band, band) that all classes share; where it is singular, plain distances count.
    """
    root = _whitening(covariance)
    distance = np.linalg.norm((spectra[:, None] - means[None]) @ root, axis=-1)
    return distance.argmin(axis=1)


def distances_between(means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(class, class) Mahalanobis distances, infinite on the diagonal."""
    root = _whitening(covariance)
    found = np.linalg.norm((means[:, None] - means[None]) @ root, axis=-1)
    np.fill_diagonal(found, np.inf)
    return found


def predicted_accuracy(distances: np.ndarray) -> np.ndarray:
    """(class,) least share that is told rightly, from distances (class, class) between classes of
    equal covariance.
    """
    from scipy.special import ndtr

    return np.clip(1 - ndtr(-distances / 2).sum(axis=1), 0.0, 1.0)


def wilson(hits: int, count: int) -> tuple[float, float]:
    """95 % confidence interval of a share (Wilson 1927)."""
    from scipy.stats import binomtest

    found = binomtest(hits, count).proportion_ci(0.95, "wilson")
    return float(found.low), float(found.high)


def _whitening(covariance: np.ndarray) -> np.ndarray:
    """(band, band) W with W W^T the inverse; the identity where there is none."""
    values, vectors = np.linalg.eigh(covariance)
    if not values[0] > 1e-12 * max(values[-1], 1e-300):
        return np.eye(len(covariance))
    return vectors / np.sqrt(values)
