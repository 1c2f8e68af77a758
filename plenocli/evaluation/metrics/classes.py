"""Which of a user's own classes is it? Spectra told apart by what is known of the classes and of
the noise, and how often that should succeed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FOLDS = 5
"""Parts of the lenslets, each judged by classes that were learnt from the others."""
DEFINITIONS = {
    "classes_seen": "classes of --classes that the truth shows",
    "class_accuracy": (
        "share of lenslets whose class is that of the truth: the likeliest of the classes, each "
        "normally distributed with the mean of its spectra and the covariance that all share, with "
        "the predicted noise on it; with --learnt, mean and covariance are those of the other four "
        "fifths of the lenslets"
    ),
    "class_accuracy_low": "lower end of its 95 % confidence interval (Wilson 1927)",
    "class_accuracy_high": "upper end of its 95 % confidence interval",
    "class_accuracy_predicted": (
        "what class_accuracy is at least expected to be from the classes and the predicted noise "
        "alone: 1 less the sum over the other classes of Phi(-d/2), d their distance in standard "
        "deviations (union bound; exact for two classes)"
    ),
    "detection_auc": (
        "how often a lenslet of the class of --detect looks more like it than one of another class "
        "(area under the receiver operating characteristic) to the linear filter that its mean, "
        "the others' means and covariance and the predicted noise call for"
    ),
    "detection_auc_low": "lower end of its 95 % confidence interval (Hanley and McNeil 1982)",
    "detection_auc_high": "upper end of its 95 % confidence interval",
    "detection_auc_predicted": (
        "what detection_auc is expected to be from the classes and the predicted noise alone: "
        "Phi(difference of the filter's means / root of the sum of its variances)"
    ),
    "target_contrast": (
        "mean answer of that filter on the class of --detect less that on the others, over the "
        "standard deviation on the others"
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
    def of_spectra(cls, labels: Sequence[str], spectra: np.ndarray) -> Classes:
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
class DetectionScore:
    """How well one class stands out from the others, see DEFINITIONS."""

    detection_auc: float
    detection_auc_low: float
    detection_auc_high: float
    detection_auc_predicted: float
    target_contrast: float


@dataclass(frozen=True, kw_only=True)
class ClassScore:
    """How well classes are told apart, see DEFINITIONS; None where the noise is not known, and
    detection where no class is looked for or the truth shows it alone or not at all.
    """

    classes_seen: int
    class_accuracy: float
    class_accuracy_low: float
    class_accuracy_high: float
    class_accuracy_predicted: float | None
    class_distance: float | None
    detection: DetectionScore | None = None


def score_classes(
    values: np.ndarray,
    truth: np.ndarray,
    sigma: np.ndarray | None,
    classes: Classes,
    detect: str | None = None,
    learnt: bool = False,
) -> ClassScore | None:
    """Spectra told apart.

    values, truth: (band, row, column).
    sigma: predicted standard deviation, like values; None: not known.
    classes: of spectra in the same bands.
    detect: name of the class that is looked for, one of theirs.
    learnt: whether lenslets are judged by what other lenslets of each class look like, and not by
        what the classes are.

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
    said = learnt_classes(found, right) if learnt else assigned(found, classes.means, spread)
    hits = said == right
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
        detection=None
        if detect is None
        else score_detection(
            found, right == classes.names.index(detect), Filter.of(classes, detect, spread)
        ),
    )


@dataclass(frozen=True, kw_only=True)
class Filter:
    """The linear filter that one class stands out by.

    weights: (band,).
    contrast: expected difference of its answers on the class and on the others.
    variances: of its answers, on the class and on the others.
    """

    weights: np.ndarray
    contrast: float
    variances: tuple[float, float]

    @classmethod
    def of(cls, classes: Classes, name: str, spread: np.ndarray) -> Filter:
        """The filter for the class `name`.

        spread: (band, band) covariance of spectra of one class, with noise.

        Fisher's discriminant between it and the mixture of the others in equal parts.
        """
        apart, mixed = cls._beside(classes, name, spread)
        root = whitening((spread + mixed) / 2)
        return cls.answering(classes, name, spread, root @ (root.T @ apart))

    @classmethod
    def answering(
        cls, classes: Classes, name: str, spread: np.ndarray, weights: np.ndarray
    ) -> Filter:
        """A filter of given weights (band,), and its answers as in `of`."""
        apart, mixed = cls._beside(classes, name, spread)
        return cls(
            weights=weights,
            contrast=float(weights @ apart),
            variances=(float(weights @ spread @ weights), float(weights @ mixed @ weights)),
        )

    @staticmethod
    def _beside(classes: Classes, name: str, spread: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean of a class less the others' (band,), and the covariance of these (band, band)."""
        place = classes.names.index(name)
        others = np.delete(classes.means, place, axis=0)
        mixed = spread + np.cov(others.T, ddof=0) if len(others) > 1 else spread
        return classes.means[place] - others.mean(axis=0), mixed

    @property
    def auc(self) -> float:
        """Expected area under the receiver operating characteristic of normal answers."""
        from scipy.special import ndtr

        spread = np.sqrt(sum(self.variances))
        return float(ndtr(self.contrast / spread)) if spread > 0 else 1.0


def score_detection(
    spectra: np.ndarray, target: np.ndarray, known: Filter
) -> DetectionScore | None:
    """How well a filter's answers tell one class.

    spectra: (spectrum, band).
    target: (spectrum,) bool, which of them are of the class.

    Returns None where all or none are.
    """
    from scipy.stats import rankdata

    count = int(target.sum())
    rest = len(target) - count
    if not count or not rest:
        return None
    answers = spectra @ known.weights
    ranks = rankdata(answers)
    auc = float((ranks[target].sum() - count * (count + 1) / 2) / (count * rest))
    # of pairs that share a member, as exponential answers have it
    one, two = auc / (2 - auc) - auc**2, 2 * auc**2 / (1 + auc) - auc**2
    variance = (auc * (1 - auc) + (count - 1) * one + (rest - 1) * two) / (count * rest)
    reach = 1.959964 * np.sqrt(max(variance, 0.0))
    deviation = float(answers[~target].std())
    apart = float(answers[target].mean() - answers[~target].mean())
    return DetectionScore(
        detection_auc=auc,
        detection_auc_low=max(auc - reach, 0.0),
        detection_auc_high=min(auc + reach, 1.0),
        detection_auc_predicted=known.auc,
        target_contrast=apart / deviation if deviation > 0 else np.inf,
    )


def assigned(spectra: np.ndarray, means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(spectrum,) number of the likeliest class.

    spectra: (spectrum, band).
    means: (class, band).
    covariance: (band, band) that all classes share; where it is singular, plain distances count.
    """
    root = whitening(covariance)
    distance = np.linalg.norm((spectra[:, None] - means[None]) @ root, axis=-1)
    return distance.argmin(axis=1)


def learnt_classes(spectra: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(spectrum,) likeliest class of each, as the others know the classes: every FOLDS-th is judged
    by the rest.

    spectra: (spectrum, band).
    labels: (spectrum,) numbers.
    """
    said = np.empty(len(labels), int)
    for part in range(min(FOLDS, len(labels))):
        judged = np.arange(len(labels)) % FOLDS == part
        if judged.all():
            return labels
        rest = Classes.of_spectra([str(label) for label in labels[~judged]], spectra[~judged])
        place = assigned(spectra[judged], rest.means, rest.covariance)
        said[judged] = np.array(rest.names, int)[place]
    return said


def distances_between(means: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(class, class) Mahalanobis distances, infinite on the diagonal."""
    root = whitening(covariance)
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


def whitening(covariance: np.ndarray) -> np.ndarray:
    """(band, band) W with W W^T the inverse of a covariance; the identity where there is none."""
    values, vectors = np.linalg.eigh(covariance)
    if not values[0] > 1e-12 * max(values[-1], 1e-300):
        return np.eye(len(covariance))
    return vectors / np.sqrt(values)
